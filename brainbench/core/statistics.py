"""Intervals of means, proportions and their differences, and the paired test of two scores: for the whole project."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeGuard

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, check_number
from brainbench.core.lazy import lazy_module
from brainbench.core.records import Interval, Score

if TYPE_CHECKING:
    from scipy import special, stats
else:
    special, stats = lazy_module("scipy.special"), lazy_module("scipy.stats")

LEVEL = 0.95  # confidence level of all intervals


def t_interval(values: ArrayLike, *, over: str = "values") -> Interval | None:
    """Return Student's t interval of the mean of independent values [n]; None below two values or with missing ones.

    Args:
        values: [n], any unit.
        over: What the values are, for the method's name: ``animals``, ``seeds``.
    """
    # scipy.stats has the same quantile, but takes most of a second to import.
    array = np.asarray(values, dtype=np.float64)
    if len(array) < 2 or not np.isfinite(array).all():
        return None
    half = float(special.stdtrit(len(array) - 1, (1 + LEVEL) / 2) * array.std(ddof=1) / math.sqrt(len(array)))
    mean = float(array.mean())
    return Interval(mean - half, mean + half, LEVEL, f"t over {len(array)} {over}")


FEWEST_ANIMALS = 4  # fewest animals over which a difference of models is tested
FEWEST_STIMULI = 10  # fewest stimuli over which a difference of models is tested


def two_factor_error(
    animals: ArrayLike, without_stimulus: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the standard error of a mean over animals and stimuli, both sampled, and its degrees of freedom.

    The variances over animals (of the mean) and over stimuli (jackknife: (K − 1)/K Σ(θ₍ₖ₎ − θ̄)²) are added, which is
    a little too much since both hold their interaction; the degrees of freedom are Welch and Satterthwaite's.

    Args:
        animals: [..., A] values of single animals; NaN where an animal has none.
        without_stimulus: [..., K] the mean over animals without each stimulus in turn; NaN where undefined.

    Returns:
        Standard errors [...] and degrees of freedom [...]; NaN with fewer than two animals or stimuli.
    """
    parts = np.asarray(animals, dtype=np.float64), np.asarray(without_stimulus, dtype=np.float64)
    return error_of_spreads(*map(_spread, parts), *(np.isfinite(values).sum(axis=-1) for values in parts))


def error_of_spreads(
    animals: NDArray[np.float64], stimuli: NDArray[np.float64], animal_count: ArrayLike, stimulus_count: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what :func:`two_factor_error` does, from the squared deviations [...] over animals and over stimuli."""
    count, left_out = np.asarray(animal_count), np.asarray(stimulus_count)
    with np.errstate(invalid="ignore", divide="ignore"):
        over_animals = animals / (count * (count - 1))
        over_stimuli = stimuli * (left_out - 1) / left_out
        total = over_animals + over_stimuli
        freedom = total**2 / (over_animals**2 / (count - 1) + over_stimuli**2 / (left_out - 1))
    usable = (count > 1) & (left_out > 1)
    return np.where(usable, np.sqrt(total), np.nan), np.where(usable, freedom, np.nan)


def two_factor_interval(value: float, animals: ArrayLike, without_stimulus: ArrayLike) -> Interval | None:
    """Return the t interval of a mean over animals and stimuli; None for fewer than two of either.

    ``animals`` [A] are the values of single animals, ``without_stimulus`` [K] the mean without each stimulus in turn.
    """
    error, freedom = (float(found) for found in two_factor_error(animals, without_stimulus))
    if not math.isfinite(error):
        return None
    half = float(special.stdtrit(freedom, (1 + LEVEL) / 2)) * error if error > 0 else 0.0
    count, stimuli = (np.isfinite(np.asarray(part, dtype=np.float64)).sum() for part in (animals, without_stimulus))
    return Interval(value - half, value + half, LEVEL, f"t over {count} animals and {stimuli} stimuli (jackknife)")


def _spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum [...] of squared deviations from the mean of the finite values [..., N]."""
    finite = np.isfinite(values)
    filled = np.where(finite, values, 0.0)
    mean = filled.sum(axis=-1, keepdims=True) / np.maximum(finite.sum(axis=-1, keepdims=True), 1)
    return (np.where(finite, values - mean, 0.0) ** 2).sum(axis=-1)


def wilson_interval(successes: float, count: int, *, over: str = "trials", level: float = LEVEL) -> Interval:
    """Return Wilson's score interval of a proportion of independent trials (Wilson 1927)."""
    check_number("The number of observations of a proportion", count, least=1, whole=True)
    # A share times a count may lie beyond by its last digit.
    if not -1e-9 <= successes <= count + 1e-9:
        raise UsageError(f"Of {count:,} observations {successes} cannot be successes.")
    z = float(special.ndtri(0.5 + level / 2))
    share = min(max(successes / count, 0.0), 1.0)
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    # Rounding leaves neither end short of all or none.
    low, high = max(0.0, middle - half) if share else 0.0, min(1.0, middle + half) if share < 1 else 1.0
    return Interval(low, high, level, f"Wilson score over {count} {over}")


_CONFOUNDED, _CONFOUNDED_BY_WAVES = (0.1, 1e-4), (0.5, 1e-7)
"""Share of the variance of trial times, or of a slow wave, beyond that of shuffled labels, from which label and time
are confounded, and its largest p: of some hundred sessions none may be suspected by chance. Runs in changing order
explain a quarter of a wave and more, and the F test takes its values, of which many are equal, for more."""
_WAVES, _SLOW = 8, 6  # most half waves of slow changes in a session, and fewest trials of each


@dataclass(frozen=True)
class PresentationOrder:
    """How much of the variance of the times (ranks) of a session's trials, or of a slow wave, their label explains."""

    share: float
    expected: float
    """The same of shuffled labels, mean."""
    p: float
    """Of a share as large for shuffled labels (F test of ranks)."""
    waves: int = 0
    """Half waves over the session; 0 for the times themselves."""

    @property
    def confounded(self) -> bool:
        """True where slow changes over the session tell labels apart without any tuning."""
        least, level = _CONFOUNDED_BY_WAVES if self.waves else _CONFOUNDED
        return self.p <= level and self.share - self.expected >= least * (1 - self.expected)

    def __str__(self) -> str:
        share, expected = round(100 * self.share), round(100 * self.expected)
        what = f"slow changes ({self.waves} half waves over the session)" if self.waves else "trial times"
        return f"the label explains {share} % of the variance of {what} ({expected} % if shuffled)"


def presentation_order(times: ArrayLike, labels: ArrayLike) -> PresentationOrder | None:
    """Return what labels [R] explain of the times [R] of a session's trials; None below three labels of two trials.

    Blocks that come again in the same or the reverse order have much the same mean times: where labels are confounded
    with a slow wave instead, it is what they explain of that.

    >>> presentation_order([1, 2, 3, 4, 5, 6, 7, 8, 9], list("aaabbbccc")).share
    0.9
    """
    names, codes = np.unique(np.asarray(labels), return_inverse=True)
    order = np.asarray(times, dtype=np.float64)
    counts = np.bincount(codes)
    if len(names) < 3 or counts.min() < 2 or not np.isfinite(order).all() or not np.ptp(order):
        return None
    between, within, orders = len(names) - 1, len(order) - len(names), []
    for waves, course in slow_courses(order).items():
        course = course - course.mean()
        share = float((np.bincount(codes, weights=course) ** 2 / counts).sum() / (course**2).sum())
        p = float(special.fdtrc(between, within, share / max(1 - share, 1e-300) * within / between))
        orders.append(PresentationOrder(share, between / (between + within), p, waves))
    return max(orders, key=lambda each: (each.confounded, each.share if each.confounded else -each.waves))


def slow_courses(times: NDArray[np.float64]) -> dict[int, NDArray[np.float64]]:
    """Return the ranks of the times [R] of trials and, by their number of half waves, slow waves over the session."""
    # Trials that begin together have the mean of their ranks.
    ranks = stats.rankdata(times)
    waves = range(2, min(_WAVES, len(ranks) // _SLOW) + 1)
    return {0: ranks} | {number: np.cos(np.pi * number * (ranks - 0.5) / len(ranks)) for number in waves}


def is_finite(interval: Interval | None) -> TypeGuard[Interval]:
    """Return whether there is an interval and both its ends are numbers."""
    return interval is not None and math.isfinite(interval.low) and math.isfinite(interval.high)


@dataclass(frozen=True)
class PairTest:
    """Two models on the same animals and stimuli."""

    first: str
    second: str
    difference: float
    """The first's value minus the second's, on the common scale."""
    interval: Interval | None
    """Interval of the difference, over animals and stimuli."""
    p: float
    """Two-sided, by Student's t of the difference over its two-factor standard error."""
    p_corrected: float
    """Corrected for the number of pairs."""
    reason: str = ""
    """Reason for a missing p; empty otherwise."""

    @property
    def verdict(self) -> str:
        """``Above``, ``Below`` or ``Not told apart from`` the second; empty where it is not tested."""
        if math.isnan(self.p) or self.interval is None:
            return ""
        return "Above" if self.interval.low > 0 else "Below" if self.interval.high < 0 else "Not told apart from"


def compare_scores(first: Score, second: Score) -> PairTest:
    """Test the difference of two scores over the animals and the stimuli that both have.

    Fewer than :data:`FEWEST_ANIMALS` animals or :data:`FEWEST_STIMULI` stimuli give no p.
    """
    animals, without = paired_differences(first, second)
    names = first.name, second.name
    if len(animals) < 2:
        why = "fewer than two animals have a value for both models"
        return PairTest(*names, float(animals.mean()) if len(animals) else math.nan, None, math.nan, math.nan, why)
    difference = float(animals.mean())
    interval = two_factor_interval(difference, animals, without)
    stimuli = int(np.isfinite(without).sum())
    if len(animals) < FEWEST_ANIMALS or stimuli < FEWEST_STIMULI:
        why = f"{len(animals)} animals and {stimuli} stimuli; at least {FEWEST_ANIMALS} and {FEWEST_STIMULI} are needed"
        return PairTest(*names, difference, interval, math.nan, math.nan, why)
    error, freedom = two_factor_error(animals, without)
    # Without spread the t statistic is infinite, or there is no difference.
    p = 2 * float(special.stdtr(freedom, -abs(difference) / float(error))) if error > 0 else float(difference == 0)
    return PairTest(*names, difference, interval, p, math.nan)


def paired_differences(first: Score, second: Score) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the differences of two scores on the common scale: of animals [A], and without each stimulus [K].

    Animals are those that both could use with status ``ok`` (else with any value).
    """
    pairs = []
    for wanted in (("ok",), ("ok", "unreliable")):
        left, right = ({s.subject: s.value for s in x.subjects if s.status in wanted} for x in (first, second))
        pairs = [
            first.on_scale(left[name]) - second.on_scale(right[name]) for name in sorted(left.keys() & right.keys())
        ]
        if pairs := [difference for difference in pairs if math.isfinite(difference)]:
            break
    without = []
    if set(first.stimuli) == set(second.stimuli):
        left, right = (dict(zip(x.stimuli, x.without_stimulus, strict=False)) for x in (first, second))
        without = [first.on_scale(left[k]) - second.on_scale(right[k]) for k in left if k in right]
    return np.array(pairs, dtype=np.float64), np.array(without, dtype=np.float64)
