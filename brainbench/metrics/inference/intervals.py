"""Confidence intervals of a score: over animals, and over animals and stimuli together."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.records import Interval, Score
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, LEVEL, check_level, two_factor_error

BEYOND = 1.1
"""Scaled score that no interval should lie above: a tenth of the scale more than all that is reliable."""


def two_factor_interval(
    value: float, animals: ArrayLike, without_stimulus: ArrayLike, level: float = LEVEL
) -> Interval | None:
    """Return the t interval of a mean over animals and stimuli; None for fewer than two of either.

    ``animals`` [A] are the values of single animals, ``without_stimulus`` [K] the mean without each stimulus in turn.

    Raises:
        UsageError: a level outside (0, 1).
    """
    from scipy.special import stdtrit

    check_level(level)
    error, freedom = (float(found) for found in two_factor_error(animals, without_stimulus))
    if not math.isfinite(error):
        return None
    half = float(stdtrit(freedom, (1 + level) / 2)) * error if error > 0 else 0.0
    count, stimuli = (np.isfinite(np.asarray(part, dtype=np.float64)).sum() for part in (animals, without_stimulus))
    what = f"t over {count} animals and {stimuli} stimuli (jackknife)"
    return Interval(value - half, value + half, level, what)


def interval_reasons(animals: int, stimuli: int) -> tuple[str, ...]:
    """Say what the numbers of animals and stimuli mean for the interval and for comparisons of models."""
    if animals == 1:
        return ("one animal: no confidence interval, since nothing is known about other animals",)
    lacking = []
    if animals < FEWEST_ANIMALS:
        lacking.append(f"{animals} animals, at least {FEWEST_ANIMALS} are needed")
    if stimuli < FEWEST_STIMULI:
        lacking.append(f"{stimuli} stimuli, at least {FEWEST_STIMULI} are needed")
    return (f"too few to tell models apart: {'; '.join(lacking)}",) if lacking else ()


def held_to_scale(score: Score) -> Score:
    """Return the score, unreliable where it lies above what is attainable: nothing can explain more than that."""
    span = score.scaled_interval
    if score.status != "ok" or span is None or not span.low > BEYOND:
        return score
    reason = f"above all that is reliable (at least {span.low:.2f} of it): the scale of this metric does not hold here"
    return replace(score, status="unreliable", reasons=(reason, *score.reasons))
