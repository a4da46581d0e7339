"""Differences between students beyond what training seeds alone make.

Few training seeds per student tell little of their spread, many students together more: the variance between training
seeds is pooled over all students, as in a one-way analysis of variance, and a difference of two means has a t interval
with its degrees of freedom. Assumes that seeds spread all students alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtr, stdtrit

from brainbench.core.errors import UsageError
from brainbench.core.records import Interval


@dataclass(frozen=True)
class Contrast:
    """Difference of two students' mean success."""

    difference: float
    """Share of the first less share of the second."""
    interval: Interval
    """95 %, not corrected for the number of contrasts."""
    p: float
    """p of no difference, two-sided, not corrected for the number of contrasts."""


def pooled_spread(groups: Sequence[Sequence[float]]) -> tuple[float, int]:
    """Return the standard deviation and its degrees of freedom within groups: a student's success by training seed.

    Raises:
        UsageError: no student has two training seeds.
    """
    freedom = sum(len(group) - 1 for group in groups)
    if freedom < 1:
        raise UsageError(
            "Every student has one training seed, which tells nothing of the spread between seeds; train one more "
            "with another --seed."
        )
    within = sum(float(np.sum((np.asarray(group) - np.mean(group)) ** 2)) for group in groups)
    return math.sqrt(within / freedom), freedom


def contrast(one: Sequence[float], other: Sequence[float], spread: float, freedom: int) -> Contrast:
    """Return the difference of two students' means, given the success of each training seed.

    The spread is the standard deviation between training seeds of :func:`pooled_spread`, with its degrees of freedom.
    """
    difference = float(np.mean(one) - np.mean(other))
    # Two-sample t with the pooled spread: its degrees of freedom are those of all students, not of these two.
    error = spread * math.sqrt(1 / len(one) + 1 / len(other))
    half = float(stdtrit(freedom, 0.975)) * error
    p = 2 * float(stdtr(freedom, -abs(difference) / error)) if error else float(difference == 0)
    interval = Interval(difference - half, difference + half, 0.95, f"t, spread pooled with {freedom} degrees")
    return Contrast(difference, interval, p)
