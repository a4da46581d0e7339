"""Differences between networks with their intervals, and the rule that judges a claim by them.

A contrast is the mean of matched comparisons, each the mean of some networks minus that of others. Its variance has
two parts, which are added, with the degrees of freedom of Welch and Satterthwaite:

- *training*: with three comparisons or more their variance over the comparisons; with fewer the variance over seeds,
  pooled over the networks of the same objectives that were trained more than once, or of all objectives where there are
  none (of differences seed by seed where the two networks of a comparison begin from the same initial state), and where
  a side is the mean of several networks the variance between them;
- *test*: of accuracies the binomial variance over test sweeps, as if every network had its own; of fits the variance
  over animals and stimuli (:func:`brainbench.core.statistics.two_factor_error`).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from brainbench.core.records import Interval
from brainbench.core.statistics import LEVEL, is_finite, two_factor_error
from leaderboards.ranking import Sample

Verdict = Literal["holds", "does not hold", "undecided", "not trained yet", "cannot be tested here"]
FEWEST_COMPARISONS = 3
"""Fewest comparisons whose spread is taken as the variance of training."""


@dataclass(frozen=True)
class Observed:
    """One quantity of one network or baseline."""

    name: str
    seeds: Mapping[int, float]
    """Value of each seed of training."""
    objective: str = ""
    """Empty for a baseline, which no seed of training changes."""
    sweeps: int = 0
    """Test sweeps behind an accuracy; 0 for another quantity."""
    sample: Sample | None = None
    """Animals and stimuli behind a fit."""

    @property
    def value(self) -> float:
        """Mean over seeds."""
        return math.fsum(self.seeds.values()) / len(self.seeds)


@dataclass(frozen=True)
class Matched:
    """One comparison: networks on one side, and what they are held against (nothing: against the neutral value)."""

    one: tuple[Observed, ...]
    other: tuple[Observed, ...] = ()

    @property
    def paired_seeds(self) -> list[float]:
        """Differences seed by seed, where each side is one network; else nothing."""
        if len(self.one) != 1 or len(self.other) != 1:
            return []
        first, second = self.one[0].seeds, self.other[0].seeds
        return [first[seed] - second[seed] for seed in sorted(first.keys() & second.keys())]

    def difference(self, *, paired: bool) -> float:
        """Return the mean of one side minus that of the other, over the same seeds where these are paired."""
        if paired and (found := self.paired_seeds):
            return float(np.mean(found))
        one, other = ([item.value for item in side] or [0.0] for side in (self.one, self.other))
        return float(np.mean(one)) - float(np.mean(other))


@dataclass(frozen=True)
class Effect:
    """An estimate with its interval."""

    value: float
    interval: Interval | None
    """None where its variance is unknown: fewer than three comparisons and no network of two seeds."""
    comparisons: int = 1
    positive: int = 0
    """Number of comparisons above the neutral value."""
    detail: str = ""


def contrast(
    comparisons: Sequence[Matched],
    pool: Iterable[Observed] = (),
    *,
    paired: bool = False,
    level: float = LEVEL,
    detail: str = "",
) -> Effect | None:
    """Return the mean of comparisons with its interval of a level, and words beside it; None without any.

    The variance over seeds is pooled over ``pool``; ``paired`` takes differences seed by seed.
    """
    from scipy.special import stdtrit

    if not comparisons:
        return None
    values = [item.difference(paired=paired) for item in comparisons]
    weights: dict[str, float] = defaultdict(float)
    members: dict[str, Observed] = {}
    for item in comparisons:
        for side, sign in ((item.one, 1.0), (item.other, -1.0)):
            for member in side:
                weights[member.name] += sign / (len(side) * len(comparisons))
                members[member.name] = member
    weighed = [(weights[name], member) for name, member in members.items()]
    parts = [_training(comparisons, values, weighed, pool, paired), _test(weighed)]
    mean, interval = float(np.mean(values)), None
    total = sum(variance for variance, _ in parts)
    if math.isfinite(total):
        spent = sum(variance**2 / freedom for variance, freedom in parts if variance > 0)
        factor = float(stdtrit(total**2 / spent, (1 + level) / 2)) if spent > 0 else 1.96
        half = factor * math.sqrt(total)
        over = f"{len(values)} comparisons" if len(values) >= FEWEST_COMPARISONS else "seeds"
        kind = "animals and stimuli" if any(item.sample for item in members.values()) else "test sweeps"
        interval = Interval(mean - half, mean + half, level, f"t over {over} and {kind}")
    return Effect(mean, interval, len(values), sum(value > 0 for value in values), detail)


def judge(effect: Effect | None, direction: int, *, margin: float = 0.0, neutral: float = 0.0) -> Verdict:
    """Return whether a claim holds by the interval of its effect.

    A claimed direction holds when the interval lies beyond the neutral value on that side, and does not hold when it
    lies beyond on the other. A claimed equality (direction 0) holds when the interval lies within ± margin, and does
    not hold when it lies beyond. All else is undecided.

    >>> judge(Effect(0.1, Interval(0.02, 0.18)), 1), judge(Effect(0.1, Interval(0.02, 0.18)), 0, margin=0.2)
    ('holds', 'holds')
    """
    if effect is None:
        return "not trained yet"
    if not is_finite(effect.interval):
        return "undecided"
    low, high = effect.interval.low - neutral, effect.interval.high - neutral
    if direction == 0:
        inside, beyond = -margin < low and high < margin, low > margin or high < -margin
        return "holds" if inside else "does not hold" if beyond else "undecided"
    if direction < 0:
        low, high = -high, -low
    return "holds" if low > 0 else "does not hold" if high < 0 else "undecided"


def _training(
    comparisons: Sequence[Matched],
    values: Sequence[float],
    weighed: Sequence[tuple[float, Observed]],
    pool: Iterable[Observed],
    paired: bool,
) -> tuple[float, float]:
    """Return the variance that training adds to the mean, and its degrees of freedom; NaN where it is unknown."""
    count = len(values)
    if count >= FEWEST_COMPARISONS:
        return float(np.var(values, ddof=1)) / count, count - 1.0
    if paired and all(len(item.paired_seeds) > 1 for item in comparisons):
        groups = [item.paired_seeds for item in comparisons]
        variance, freedom = _pooled(groups)
        return variance * sum(1 / len(group) for group in groups) / count**2, freedom
    trained = [(weight, item) for weight, item in weighed if item.objective]
    if not trained:
        return 0.0, 1.0
    objectives = {item.objective for _, item in trained}
    repeated = [item for item in pool if item.objective and len(item.seeds) > 1]
    same = [item for item in repeated if item.objective in objectives]
    variance, freedom = _pooled([list(item.seeds.values()) for item in same or repeated])
    seeds = variance * sum(weight**2 / len(item.seeds) for weight, item in trained)
    # A mean over several networks speaks of networks like these, so the spread between them counts.
    sides = [side for item in comparisons for side in (item.one, item.other) if len(side) > 1]
    means = [[member.value for member in side] for side in sides]
    between = sum(float(np.var(values, ddof=1)) / len(values) for values in means) / count**2
    return (between, sum(map(len, means)) - len(means)) if between > seeds else (seeds, freedom)


def _pooled(groups: Sequence[Sequence[float]]) -> tuple[float, float]:
    """Return the variance within groups, and its degrees of freedom; NaN without a group of two."""
    freedom = sum(len(group) - 1 for group in groups)
    within = sum(float(np.var(group)) * len(group) for group in groups)
    return (within / freedom, float(freedom)) if freedom else (math.nan, 1.0)


def _test(weighed: Sequence[tuple[float, Observed]]) -> tuple[float, float]:
    """Return the variance that test sweeps, or animals and stimuli, add to the mean, and its degrees of freedom."""
    if samples := [(weight, item.sample) for weight, item in weighed if item.sample is not None]:
        shared = sorted(set.intersection(*({*sample.animals} for _, sample in samples)))
        animals = [sum(weight * sample.animals[animal] for weight, sample in samples) for animal in shared]
        if len({len(sample.without_stimulus) for _, sample in samples}) > 1:
            return math.nan, 1.0
        stimuli = sum(weight * sample.without_stimulus for weight, sample in samples)
        error, freedom = two_factor_error(animals, np.asarray(stimuli))
        return float(error) ** 2, float(freedom)
    parts = [weight**2 * item.value * (1 - item.value) / item.sweeps for weight, item in weighed if item.sweeps]
    return sum(parts), math.inf
