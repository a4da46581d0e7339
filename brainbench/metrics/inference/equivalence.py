"""Equivalence of a model with the animals: the NeuroAI Turing test.

A large p of a difference is no evidence of equality. Two one-sided tests (Schuirmann 1987) ask instead
whether the difference between the model's score and the animals' consistency with one another, paired
by animal and by stimulus, is demonstrably smaller than a stated margin. Both scores are on the scale that all metrics
share: 0 is chance and 1 all that is reliable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number
from brainbench.core.records import Interval, Score, Status
from brainbench.core.statistics import (
    FEWEST_ANIMALS,
    FEWEST_STIMULI,
    paired_differences,
    student_tail,
    two_factor_error,
    two_factor_interval,
)

MARGIN = 0.1
"""Difference on the common scale below which model and animals count as alike."""
ALPHA = 0.05
"""Level of each one-sided test; the interval has level 1 − 2α."""


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


def equivalence_test(differences: ArrayLike, without_stimulus: ArrayLike, *, margin: float = MARGIN) -> EquivalenceTest:
    """Test whether a model equals the animals' consistency with one another up to ``margin``.

    Args:
        differences: [A] score of the model on each animal less that of the animal against the others.
        without_stimulus: [K] the mean difference without each stimulus in turn.
        margin: Largest difference that still counts as alike, > 0.

    >>> test = equivalence_test([-0.01, 0.03, -0.02, -0.01, 0.02], [0.0, 0.004] * 6)
    >>> test.verdict, round(test.difference, 3)
    ('equivalent', 0.002)
    """
    check_number("An equivalence margin", margin, above=0)
    difference, without = (np.asarray(part, dtype=np.float64).ravel() for part in (differences, without_stimulus))
    difference, without = difference[np.isfinite(difference)], without[np.isfinite(without)]
    count = len(difference)
    if count < 2 or len(without) < 2:
        reason = "fewer than two animals can be compared with one another"
        if count > 1:
            reason = f"the difference is known without {len(without)} of the stimuli; at least 2 are needed"
        return EquivalenceTest(math.nan, margin, None, math.nan, "undecided", "undefined", reason)
    # Two one-sided t tests (Schuirmann 1987), t = (margin ± mean)/error. Both reject at level α exactly when the
    # interval at level 1 − 2α lies within ±margin.
    mean = float(difference.mean())
    interval = two_factor_interval(mean, difference, without, 1 - 2 * ALPHA)
    error, freedom = (float(found) for found in two_factor_error(difference, without))
    lower, upper = (student_tail(distance, error, freedom) for distance in (mean + margin, margin - mean))
    low, high = (interval.low, interval.high) if interval else (math.nan, math.nan)
    if low > -margin and high < margin:
        verdict = "equivalent"
    else:
        verdict = "worse" if high < -margin else "better" if low > margin else "undecided"
    few = count < FEWEST_ANIMALS or len(without) < FEWEST_STIMULI
    needed = f"at least {FEWEST_ANIMALS} and {FEWEST_STIMULI} are needed"
    reason = f"{count} animals and {len(without)} stimuli; {needed}" if few else ""
    status = "unreliable" if few else "ok"
    return EquivalenceTest(mean, margin, interval, max(lower, upper), verdict, status, reason, count)


def turing_test(score: Score, animal_to_animal: Score, *, margin: float = MARGIN) -> EquivalenceTest:
    """Test a model's score against the animals' consistency with one another, paired by animal and stimulus."""
    if score.estimator != animal_to_animal.estimator:
        raise UsageError(
            f"Model and animals must be scored by one estimator; received {score.estimator!r} and "
            f"{animal_to_animal.estimator!r}."
        )
    found = equivalence_test(*paired_differences(score, animal_to_animal), margin=margin)
    doubtful = [one.name for one in (score, animal_to_animal) if one.status != "ok"]
    if found.status == "undefined" or not doubtful:
        return found
    # A verdict is no better than the scores behind it.
    told = f"the score of {' and of '.join(doubtful)} is unreliable"
    return replace(found, status="unreliable", reason="; ".join(filter(None, (told, found.reason))))
