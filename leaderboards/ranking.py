"""Scores that are told apart when animals and stimuli are both samples, the ranks that this leaves open, and standings.

Scores are compared on the scale that all metrics share (:attr:`Score.scaled`). Two models were scored on the same
animals and stimuli, so the test is paired: the difference of every animal, and the difference without each stimulus
in turn, give the standard error (:func:`brainbench.core.statistics.two_factor_error`); seeds of weights add their
own variance. A standing says in words what a score is worth. Letters: N models, A animals, K stimuli.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core.records import Interval, ResultRecord, Score
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, LEVEL, error_of_spreads, two_factor_error

FALSE_DISCOVERY_RATE = 0.05
"""Largest expected share of wrong statements among all pairs of a board that are told apart."""
CHANCE_LEVEL = 0.05  # a score with a permutation p above this is not told apart from chance


@dataclass(frozen=True)
class Sample:
    """The scaled score of a model, as the tests read it."""

    value: float
    """Mean over seeds."""
    animals: dict[str, float]
    """Value of each reliable animal, mean over seeds."""
    without_stimulus: NDArray[np.float64]
    """[K] value without each stimulus in turn, mean over seeds."""
    seeds: tuple[float, ...]
    """Value of each seed."""

    @classmethod
    def of(cls, scores: Sequence[Score]) -> Sample:
        """Return the sample of one model's scores, which differ in the seed of the weights alone."""
        reliable = [[item for item in score.subjects if item.status == "ok"] for score in scores]
        both = zip(scores, reliable, strict=True)
        by_seed = [{item.subject: score.on_scale(item.value) for item in items} for score, items in both]
        shared = [name for name in by_seed[0] if all(math.isfinite(seed.get(name, math.nan)) for seed in by_seed)]
        left_out = [[score.on_scale(value) for value in score.without_stimulus] for score in scores]
        alike = len({len(values) for values in left_out}) == 1
        seeds = tuple(score.scaled for score in scores)
        animals = {name: float(np.mean([seed[name] for seed in by_seed])) for name in shared}
        return cls(float(np.mean(seeds)), animals, np.mean(left_out, axis=0) if alike else np.empty(0), seeds)

    @property
    def seed_variance(self) -> tuple[float, float]:
        """Variance of the mean over seeds, and its degrees of freedom; zeros for one seed."""
        count = len(self.seeds)
        return (float(np.var(self.seeds, ddof=1)) / count, count - 1.0) if count > 1 else (0.0, 0.0)

    @property
    def error(self) -> tuple[Any, Any]:
        """Standard error over animals, stimuli and seeds, and its degrees of freedom."""
        return _with_seeds(*two_factor_error([*self.animals.values()], self.without_stimulus), [self.seed_variance])

    @property
    def interval(self) -> Interval | None:
        """95 % interval over animals, stimuli and seeds; None where a variance is unknown."""
        from scipy.special import stdtrit

        error, freedom = self.error
        if not math.isfinite(error) or not math.isfinite(self.value):
            return None
        half = float(stdtrit(freedom, (1 + LEVEL) / 2) * error)
        over = f"{len(self.animals)} animals, {np.isfinite(self.without_stimulus).sum()} stimuli"
        over += f" and {len(self.seeds)} seeds" if len(self.seeds) > 1 else ""
        return Interval(self.value - half, self.value + half, LEVEL, f"t over {over}")


Row = Callable[[int], "tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]"]
"""Model i → differences i − j, their standard errors and degrees of freedom, each of the models j > i."""


def told_apart(samples: Sequence[Sample]) -> NDArray[np.bool_]:
    """Return [N, N] for each pair whether model j is told apart above model i."""
    return apart(len(samples), differences(samples)) if samples else np.zeros((0, 0), dtype=bool)


def apart(count: int, row: Row) -> NDArray[np.bool_]:
    """Return [N, N] for each difference i − j whether j is above i; NaN is not tested.

    The false discovery rate over all pairs is :data:`FALSE_DISCOVERY_RATE` (Benjamini & Hochberg 1995). Of models of
    one seed each the test is that of :func:`brainbench.core.statistics.compare_scores`. Of thousands of models only the
    p of each pair is kept, negative where the difference is.
    """
    from scipy.special import ndtri, stdtr

    rows: list[NDArray[np.float64]] = []
    for place in range(count):
        difference, error, freedom = row(place)
        t = np.divide(np.abs(difference), error, out=np.where(difference == 0, 0.0, math.inf), where=error > 0)
        p = np.where(np.isnan(difference), math.nan, 1.0)
        large = (t > -ndtri(FALSE_DISCOVERY_RATE / 2)) & (p == 1)  # tails of t are heavier than the normal's
        p[large] = 2 * stdtr(np.where(error > 0, freedom, 1.0)[large], -t[large])
        rows.append(np.where(difference < 0, -p, p))
    pairs, limit, passed = sum(int(np.isfinite(p).sum()) for p in rows), FALSE_DISCOVERY_RATE, -1
    # The largest k with k values of p up to k/pairs of the rate: from above, each step takes those that are too large.
    while pairs and passed != (passed := sum(int((np.abs(p) <= limit).sum()) for p in rows)):
        limit = FALSE_DISCOVERY_RATE * passed / pairs
    above = np.zeros((count, count), dtype=bool)
    for place, p in enumerate(rows):
        close = np.abs(p) <= limit
        above[place, place + 1 :] = close & np.signbit(p)
        above[place + 1 :, place] = close & ~np.signbit(p)
    return above


def rank_ranges(above: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the best and the worst rank of each model, from :func:`told_apart`.

    The best is one more than the number of models told apart above it; the worst leaves out those told apart below.

    >>> rank_ranges(np.array([[False, False, False], [False, False, False], [True, True, False]]))
    [(1, 2), (1, 2), (3, 3)]
    """
    best, worst = 1 + above.sum(axis=1), len(above) - above.sum(axis=0)
    return [(int(first), int(last)) for first, last in zip(best, worst, strict=True)]


def rank_in_print(first: int | None, last: int | None) -> str:
    """Write a rank: ``2``, ``2–5``, or a dash where there is none."""
    return "–" if first is None else f"{first}" if first == last else f"{first}–{last}"


def lacking(animals: int, stimuli: int) -> str:
    """Return what a design lacks for ranks, in words; empty when it has enough animals and stimuli.

    >>> lacking(10, 6)
    'at least 10 stimuli (here 6)'
    """
    rules = (("animals", FEWEST_ANIMALS, animals), ("stimuli", FEWEST_STIMULI, stimuli))
    return " and ".join(f"at least {fewest} {what} (here {n})" for what, fewest, n in rules if n < fewest)


def differences(samples: Sequence[Sample]) -> Row:
    """Return the differences of each model to those after it; NaN: not tested."""
    from scipy.spatial.distance import cdist

    names = sorted({name for sample in samples for name in sample.animals})
    size = max(len(sample.without_stimulus) for sample in samples)
    table = np.array([[sample.animals.get(name, math.nan) for name in names] for sample in samples])
    table = table.reshape(len(samples), -1)
    left_out = np.full((len(samples), size), math.nan)
    for row, sample in zip(left_out, samples, strict=True):
        if len(sample.without_stimulus) == size:
            row[:] = sample.without_stimulus
    variances = np.array([sample.seed_variance for sample in samples])
    whole = len(names) >= FEWEST_ANIMALS and size >= FEWEST_STIMULI
    centred = [values - values.mean(axis=1, keepdims=True) for values in (table, left_out)] if whole else []
    whole = whole and np.isfinite([*map(np.sum, centred)]).all()

    def row_of(place: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the differences of one model to those after it, their standard errors and degrees of freedom."""
        after = slice(place + 1, None)
        if whole:  # without an array of the differences, which took most of the time of a large board
            animals, stimuli = (cdist(values[[place]], values[after], "sqeuclidean")[0] for values in centred)
            seeds = [variances[place], variances[after].T]
            error = _with_seeds(*error_of_spreads(animals, stimuli, len(names), size), seeds)
            return table[place].mean() - table[after].mean(axis=1), *error
        animals, stimuli = table[place] - table[after], left_out[place] - left_out[after]
        enough = np.isfinite(animals).sum(axis=1) >= FEWEST_ANIMALS
        enough &= np.isfinite(stimuli).sum(axis=1) >= FEWEST_STIMULI
        difference, errors, freedoms = (np.full(len(enough), math.nan) for _ in range(3))
        if enough.any():
            mean = np.nanmean(animals[enough], axis=1)
            error, freedom = two_factor_error(animals[enough], stimuli[enough])
            error, freedom = _with_seeds(error, freedom, [variances[place], variances[after][enough].T])
            difference[enough], errors[enough], freedoms[enough] = mean, error, freedom
        return difference, errors, freedoms

    return row_of


def _with_seeds(error: NDArray[np.float64], freedom: NDArray[np.float64], seeds: Sequence[Any]) -> tuple:
    """Add (variance, degrees of freedom) of seeds to a standard error, after Welch and Satterthwaite."""
    total = error**2 + sum(variance for variance, _ in seeds)
    with np.errstate(invalid="ignore", divide="ignore"):
        spent = np.where(error > 0, error**4 / freedom, 0.0)
        for variance, count in seeds:
            spent = spent + np.where(np.asarray(count) > 0, np.square(variance) / np.maximum(count, 1.0), 0.0)
        return np.sqrt(total), total**2 / spent


Standing = Literal[
    "above raw input", "above chance", "not told apart from chance", "not tested", "unreliable", "undefined"
]
MEANINGS: dict[Standing, str] = {
    "above raw input": "Told apart from chance, and above the raw input of the models.",
    "above chance": "Told apart from chance, but not above the raw input of the models.",
    "not told apart from chance": "A model that knows nothing of these stimuli could score as high.",
    "not tested": "The record states no test against chance.",
    "unreliable": "Computed, but not to be trusted: the data are too noisy or too few.",
    "undefined": "No number exists.",
}
"""Statements about a score, from the most to the least: every page uses these words and no others."""
STANDINGS = tuple(MEANINGS)
DOUBTFUL: tuple[Standing, ...] = ("unreliable", "undefined")  # standings of scores that no conclusion is drawn from
BUILT_IN_METRICS = (
    "rsa", "rsa-correlation", "rsa-crossnobis", "rsa-partial", "cka", "decoding", "procrustes", "ridge",
    "soft-matching", "one-to-one",
)  # fmt: skip
"""Names of the metrics that come with the package (this package cannot import them)."""


def standing_of(score: Score, *, above_raw: bool) -> Standing:
    """Return what can be said of a score, given whether it is told apart above the raw input."""
    if score.status != "ok":
        return score.status
    if math.isnan(score.p):
        return "not tested"
    if score.p > CHANCE_LEVEL:
        return "not told apart from chance"
    return "above raw input" if above_raw else "above chance"


def not_repeatable(record: ResultRecord) -> str:
    """Return why a record cannot be computed again from this package alone, empty when it can.

    >>> from brainbench.core.records import ModelCard
    >>> not_repeatable(ResultRecord(Score("features", 0.9, "ok"), card=ModelCard("features", family="user module")))
    'its code is not in the registry'
    """
    card, name = record.card, record.score.name
    if card is None or card.family in ("", "features computed elsewhere"):
        return "its features were computed elsewhere"
    if card.family == "user module":
        return "its code is not in the registry"
    metric = record.score.provenance.settings.get("metric")
    if card.family != "policy" and metric is not None and metric not in BUILT_IN_METRICS:
        return "its metric does not come with the package"
    return "its weights do not come with the package" if name.startswith(("local-dir:", "hf-hub:")) else ""
