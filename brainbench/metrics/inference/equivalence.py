"""Equivalence of a model with the animals: the NeuroAI Turing test.

A large p of a difference is no evidence of equality. Two one-sided tests (Schuirmann 1987) ask instead
whether the difference between the model's score and the animals' consistency with one another, paired
by animal, is demonstrably smaller than a stated margin. Both scores are noise-corrected by the same
estimator, so both would be 1 without noise and individual differences.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.core.records import Interval, Score, Status
from brainbench.metrics.inference.intervals import VERIFIED_ANIMALS, t_interval
from brainbench.metrics.inference.multiple import paired_values

MARGIN = 0.1
"""Difference in noise-corrected score below which model and animals count as alike."""


@dataclass(frozen=True)
class EquivalenceTest:
    """Result of two one-sided tests of a model against the animals' own consistency."""

    difference: float
    """Mean over animals of the model's value minus the animal's consistency with the others."""
    margin: float
    interval: Interval | None
    """Interval of the difference at level 1 − 2α: inside ±margin exactly when the model passes."""
    p: float
    """p of equivalence: the larger of the two one-sided p."""
    p_lower: float
    """p of the hypothesis that the model is worse than the animals by the margin or more."""
    p_upper: float
    """p of the hypothesis that the model is better than the animals by the margin or more."""
    verdict: str
    """``equivalent``, ``worse``, ``better`` (the interval lies wholly outside the margin) or ``undecided``."""
    status: Status
    reason: str = ""
    animals: int = 0

    def summary(self) -> str:
        """Return the result in one line."""
        if self.status == "undefined" or self.interval is None:
            return f"undefined: {self.reason}"
        text = (
            f"{self.verdict} (margin ±{self.margin:g}): model − animals {self.difference:+.3f} "
            f"[{self.interval.low:+.3f}, {self.interval.high:+.3f}], p = {self.p:.2g}"
        )
        return text if self.status == "ok" else f"{text} ({self.status}: {self.reason})"


def equivalence_test(
    values: ArrayLike, consistency: ArrayLike, *, margin: float = MARGIN, alpha: float = 0.05
) -> EquivalenceTest:
    """Test whether values [A] of a model equal the animals' consistency [A] up to ``margin``.

    Args:
        values: Noise-corrected score of the model on each animal.
        consistency: Noise-corrected score of each animal against the others.
        margin: Largest difference that still counts as alike, > 0.
        alpha: Level of each one-sided test; the interval has level 1 − 2α.

    Raises:
        UsageError: a margin or an alpha out of range, or arrays that differ in length.

    >>> test = equivalence_test([0.90, 0.93, 0.88, 0.91, 0.92], [0.91, 0.90, 0.90, 0.92, 0.90])
    >>> test.verdict, round(test.difference, 3)
    ('equivalent', 0.002)
    """
    if not margin > 0:
        raise UsageError(f"An equivalence margin is positive; received {margin}.")
    if not 0 < alpha < 0.5:
        raise UsageError(f"alpha lies between 0 and 0.5, such as 0.05; received {alpha}.")
    model, animals = np.asarray(values, dtype=np.float64).ravel(), np.asarray(consistency, dtype=np.float64).ravel()
    if len(model) != len(animals):
        raise UsageError(f"Values are paired by animal; received {len(model)} and {len(animals)}.")
    # Differences are paired by animal, so an animal without either value is left out.
    both = np.isfinite(model) & np.isfinite(animals)
    difference = (model - animals)[both]
    count = len(difference)
    if count < 2:
        reason = f"{count} animals have both a model's value and a consistency; at least 2 are needed"
        return EquivalenceTest(math.nan, margin, None, math.nan, math.nan, math.nan, "undecided", "undefined", reason)
    # Two one-sided t tests (Schuirmann 1987), t = (margin ± mean)/error with A − 1 degrees of freedom. Both reject at
    # level α exactly when the interval at level 1 − 2α lies within ±margin.
    mean, interval = float(difference.mean()), t_interval(difference, 1 - 2 * alpha)
    error = float(difference.std(ddof=1)) / math.sqrt(count)
    lower, upper = (_tail(distance, error, count) for distance in (mean + margin, margin - mean))
    low, high = (interval.low, interval.high) if interval else (math.nan, math.nan)
    if low > -margin and high < margin:
        verdict = "equivalent"
    else:
        verdict = "worse" if high < -margin else "better" if low > margin else "undecided"
    few = count < VERIFIED_ANIMALS
    reason = f"{count} animals: coverage of the interval not verified below {VERIFIED_ANIMALS}" if few else ""
    return EquivalenceTest(
        mean, margin, interval, max(lower, upper), lower, upper, verdict, "unreliable" if few else "ok", reason, count
    )


def turing_test(
    score: Score, animal_to_animal: Score, *, margin: float = MARGIN, alpha: float = 0.05
) -> EquivalenceTest:
    """Test a model's score against the animals' consistency with one another, paired by animal.

    Raises:
        UsageError: a margin or an alpha out of range, or scores by different estimators.
    """
    if score.estimator != animal_to_animal.estimator:
        raise UsageError(
            f"Model and animals must be scored by one estimator; received {score.estimator!r} and "
            f"{animal_to_animal.estimator!r}."
        )
    return equivalence_test(*paired_values(score, animal_to_animal), margin=margin, alpha=alpha)


def _tail(distance: float, error: float, count: int) -> float:
    """Return P(t ≥ distance/error) with count − 1 degrees of freedom."""
    from scipy.special import stdtr

    # Without spread the t statistic is infinite; the sign of the distance alone decides.
    if error == 0:
        return 0.0 if distance > 0 else 1.0
    return float(stdtr(count - 1, -distance / error))
