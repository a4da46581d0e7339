"""Boards with a known truth: animals that share a geometry, and models that hold a known share of it.

Every job here is one simulated study, with its own seed, drawn by ``datasets.synthetic`` and scored by the metrics as a
user's would be; :mod:`benchmarks.scores.calibration` runs many of them on all processors.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats

from brainbench.core.contracts import Trials
from brainbench.core.records import Interval, Score
from brainbench.core.statistics import two_factor_error
from brainbench.datasets.synthetic import PopulationDesign, ResponseGeometry
from brainbench.datasets.synthetic.populations import draw_sessions
from brainbench.metrics import get_metric, rdm
from brainbench.metrics.evaluation import gather
from brainbench.metrics.measures.patterns import RidgeEncoding
from brainbench.metrics.measures.rsa import RSA, unique_part
from brainbench.metrics.rdms.comparison import compare_all
from brainbench.metrics.reliability.subject_rdm import SubjectRDM
from brainbench.scoring.over_time import AnimalMovie, score_over_time

DIMENSIONS = 10
RULES = ("animals alone", "two factors")
BOARDS = {"unrelated": (0.0,) * 8, "equally good": (0.6,) * 8, "one better": (0.9,) + (0.4,) * 7}
"""Shares of the models of three boards."""
BIN = 0.05


@dataclass(frozen=True)
class Study:
    """One simulated study."""

    seed: int
    stimuli: int
    animals: int
    shares: tuple[float, ...] = ()
    """Of each model, the correlation of its geometry with the shared one (about its true score on the common scale)."""
    metric: str = "rsa"
    quick: bool = True
    """Chance from 199 orders of the stimuli in place of 1,999; for RSA alone."""
    layers: int = 1
    """Layers of each model; the first has the share, the others know nothing."""


class FewOrders(RSA):
    """RSA whose p is coarse, which intervals and comparisons of models do not use."""

    orders = 199


def mixed(shared: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    """Return features [K, 2D] whose squared distances correlate by ``share`` with those of shared features [K, D]."""
    # Squared distances add up over features: w of the shared ones and 1 − w of others correlate by
    # w/√(w² + (1 − w)²) with the shared ones.
    weight = 1.0 if share >= 1 else 1 / (1 + math.sqrt(1 / share**2 - 1)) if share > 0 else 0.0
    other = rng.normal(size=shared.shape)
    return np.concatenate([math.sqrt(weight) * shared, math.sqrt(1 - weight) * other], axis=1)


def score_study(study: Study) -> tuple[list[Score], np.ndarray]:
    """Return the score of every model, and its comparison with the animals' noiseless RDMs, mean over animals."""
    rng = np.random.default_rng([study.seed, study.stimuli, study.animals])
    shared = rng.normal(size=(study.stimuli, DIMENSIONS))
    geometry = ResponseGeometry.from_activations(shared)
    names = [f"{'ab'[index % 2]}-{index // 2}" for index in range(study.stimuli)]
    metric: Any = get_metric(study.metric)
    if study.quick and isinstance(metric, RSA):
        metric = FewOrders(**{item.name: getattr(metric, item.name) for item in fields(metric)})
    prepared, noiseless = [], []
    for drawn in draw_sessions(geometry, PopulationDesign(animals=study.animals), study.seed):
        block = drawn.trials
        block = type(block)(block.responses.mean(axis=1), block.labels, block.keys)
        prepared.append(metric.animal(drawn.subject, [block], study.stimuli, stimuli=names, seed=0))
        noiseless.append(rdm(drawn.expected, method="sqeuclidean"))
    scores, truths = [], []
    for index, share in enumerate(study.shares):
        layers = {"0": mixed(shared, share, rng)}
        layers |= {str(layer): rng.normal(size=(study.stimuli, DIMENSIONS)) for layer in range(1, study.layers)}
        scores.append(metric.score(layers, prepared, name=str(index), stimuli=names, seed=study.seed))
        own = rdm(layers["0"], method="sqeuclidean")
        truths.append(compare_all(own[None], np.stack(noiseless), method="whitened-cosine").mean())
    return scores, np.array(truths)


@dataclass(frozen=True)
class NoisyStudy:
    """Animals whose RDMs have one reliability: eight of 60 linear units, with Gaussian noise of trials."""

    seed: int
    stimuli: int
    trials: int
    reliability: float

    def noise(self, patterns: np.ndarray) -> float:
        """Return the variance of a trial at which the RDM of patterns [K, U] has the reliability."""
        centred = patterns - patterns.mean(axis=0)
        (count, units), n = centred.shape, self.trials
        # Variance of unbiased products: σ²/n (|x|² + |y|²) + U σ⁴/n², on the diagonal 4σ²/n |x|² + 2U σ⁴/(n(n − 1)).
        square = float((centred**2).sum())
        linear = (2 * (count - 1) + 4) * square / n
        quadratic = count * (count - 1) * units / n**2 + 2 * count * units / (n * (n - 1))
        wanted = float(((centred @ centred.T) ** 2).sum()) * (1 / self.reliability - 1)
        return (math.sqrt(linear**2 + 4 * quadratic * wanted) - linear) / (2 * quadratic)


class FewSplits(RSA):
    """RSA with few splits and orders, whose p and chance are coarse."""

    orders = 19


SHARES_OF_NOISY = (0.0, 0.5, 1.0)


def noisy_study(study: NoisyStudy) -> list[tuple[float, ...]]:
    """Return ok, value, low, high, the noiseless comparison and the reliability, for models of three shares."""
    rng = np.random.default_rng([study.seed, study.stimuli, study.trials, round(100 * study.reliability)])
    shared, metric = rng.normal(size=(study.stimuli, DIMENSIONS)), FewSplits(splits=20)
    names, animals, noiseless = [f"s{index}" for index in range(study.stimuli)], [], []
    for index in range(8):
        patterns = shared @ rng.normal(size=(DIMENSIONS, 60))
        animals.append(_noisy_animal(study, metric, patterns, index, rng))
        noiseless.append(rdm(patterns, method="sqeuclidean"))
    found = []
    for share in SHARES_OF_NOISY:
        layer = {"0": mixed(shared, share, rng)}
        score = metric.score(layer, animals, name="", stimuli=names)
        own = rdm(layer["0"], method="sqeuclidean")
        truth = compare_all(own[None], np.stack(noiseless), method="whitened-cosine").mean()
        ok = float(score.status == "ok")
        found.append((ok, score.value, *_ends(score.interval), float(truth), score.reliability))
    return found


def _noisy_animal(study: NoisyStudy, metric: Any, patterns: np.ndarray, index: int, rng: np.random.Generator) -> Any:
    """Return an animal whose trials of patterns [K, U] have the noise of the study."""
    labels = np.repeat(np.arange(study.stimuli), study.trials)
    trials = patterns[labels] + math.sqrt(study.noise(patterns)) * rng.normal(size=(len(labels), patterns.shape[1]))
    keys = [f"{study.seed}/{index}/{trial}" for trial in range(len(labels))]
    return metric.animal(f"m{index}", [Trials(trials, labels, keys)], study.stimuli)


UNIQUE_CASES = (("hidden", 1.0), ("hidden", 0.5), ("hidden", 0.2), ("raw", 0.5), ("unrelated", 0.5))
"""What the network has, and the share of the animals' features that the raw input lacks."""


def unique_study(study: NoisyStudy) -> list[tuple[float, float, float, float]]:
    """Return the unique part, its interval, and that of the same study without noise, for each of the cases.

    Animals mix features of the raw input and hidden ones; networks have six layers, one of which says something.
    """
    metric, results = FewSplits(splits=20), []
    for patterns, animals, layers, raw in _unique_cases(study, metric):
        gathered = gather(metric, animals, study.stimuli)
        factors = gathered.factors(gathered.scored)
        scored = [gathered.subjects[index] for index in gathered.scored]
        if not scored:
            results.append((math.nan,) * 4)
            continue
        without = metric.factors_without(scored, factors)
        sides = [{name: metric.layer(part) for name, part in side.items()} for side in (layers, {"raw input": raw})]
        how: dict[str, Any] = {"comparison": metric.comparison}
        part = unique_part(*sides, scored, factors=factors, factors_without=without, **how)
        rdms = [rdm(each, method="sqeuclidean") for each in patterns]
        noiseless = [SubjectRDM("animal", each, np.empty(0), np.empty((0, 2, len(each)))) for each in rdms]
        truth = unique_part(*sides, noiseless, factors=np.ones(len(noiseless)), **how)
        results.append((part.unique, part.low, part.high, truth.unique))
    return results


def _unique_cases(study: NoisyStudy, metric: Any) -> Iterator[tuple[list[np.ndarray], list[Any], dict, np.ndarray]]:
    """Yield noiseless patterns [K, U], animals, layers [K, F] and the raw input [K, D] of each of the cases."""
    rng = np.random.default_rng([study.seed, study.stimuli, study.trials, round(100 * study.reliability)])
    raw, hidden = rng.normal(size=(2, study.stimuli, DIMENSIONS))
    for kind, share in UNIQUE_CASES:
        felt, every, animals = np.hstack([math.sqrt(1 - share) * raw, math.sqrt(share) * hidden]), [], []
        for index in range(8):
            patterns = felt @ rng.normal(size=(2 * DIMENSIONS, 60))
            animals.append(_noisy_animal(study, metric, patterns, index, rng))
            every.append(patterns)
        layers = [rng.normal(size=(study.stimuli, 20)) for _ in range(6)]
        if kind != "unrelated":
            layers[0] = (hidden if kind == "hidden" else raw) @ rng.normal(size=(DIMENSIONS, 40))
        yield every, animals, {str(place): layer for place, layer in enumerate(layers)}, raw


def ridge_study(study: NoisyStudy) -> list[tuple[float, float, float, float]]:
    """Return scaled score and unique part of ridge, with interval and truth, for each of the cases; NaN if not ok.

    The truth is on the scale on which 1 is what the animals' responses without noise reach.
    """
    metric, results, order = RidgeEncoding(), [], np.arange(study.stimuli)[None]
    metric.orders, metric.splits = 19, 20  # p and chance are coarse
    for patterns, animals, layers, raw in _unique_cases(study, metric):
        score = metric.score(layers, animals, name="", stimuli=list(map(str, order[0])), controls={"raw input": raw})
        part, span = score.provenance.unique, score.scaled_interval
        if score.status != "ok" or part is None or span is None:
            results += 2 * [(math.nan,) * 4]
            continue
        true = [
            metric.compare_orders(*pair, order).item() for pair in zip(patterns, [[a] for a in animals], strict=True)
        ]
        reached = np.mean(np.array(true) * [metric.correction(animal, "default").value for animal in animals])
        truth = (score.value - score.chance) / (reached - score.chance)
        results.append((score.scaled, span.low, span.high, float(truth)))
        results.append((part.unique, part.low, part.high, float(part.unique * score.attainable / reached)))
    return results


def null_p(study: Study) -> float:
    """Return p of a model that knows nothing."""
    return score_study(study)[0][0].p


def interval_found(study: Study) -> list[tuple[float, ...]]:
    """Return value, low, high, scaled value and the noiseless comparison of every model."""
    return [
        (score.value, *_ends(score.interval), score.scaled, float(truth))
        for score, truth in zip(*score_study(study), strict=True)
    ]


def _ends(interval: Interval | None) -> tuple[float, float]:
    return (interval.low, interval.high) if interval else (math.nan, math.nan)


def pairs_told_apart(study: Study) -> dict[str, dict[str, tuple[float, float, float]]]:
    """Return the result of :func:`tested_pairs` for every board of :data:`BOARDS`, all against the same animals."""
    scores, _ = score_study(replace(study, shares=sum(BOARDS.values(), ())))
    found, start = {}, 0
    for board, shares in BOARDS.items():
        found[board] = tested_pairs(scores[start : start + len(shares)])
        start += len(shares)
    return found


def tested_pairs(scores: list[Score]) -> dict[str, tuple[float, float, float]]:
    """Return, for each rule, three shares of pairs of models.

    Pairs with p ≤ .05; pairs told apart at a false discovery rate of 5 % over all pairs of the board; of the pairs
    with the first model, those told apart with the first one better.
    """
    pairs = np.array(list(combinations(range(len(scores)), 2)))
    animals = np.array([[score.on_scale(one.value) for one in score.subjects] for score in scores])
    without = np.array([[score.on_scale(value) for value in score.without_stimulus] for score in scores])
    difference = animals[pairs[:, 0]] - animals[pairs[:, 1]]
    # An animal that is not reliable has no part in the scores.
    difference = difference[:, np.isfinite(difference).all(axis=0)]
    mean, count = difference.mean(axis=1), difference.shape[1]
    error, freedom = two_factor_error(difference, without[pairs[:, 0]] - without[pairs[:, 1]])
    alone = difference.std(axis=1, ddof=1) / math.sqrt(count)
    shares = {}
    for rule, spread, degrees in (("animals alone", alone, count - 1), ("two factors", error, freedom)):
        p = 2 * stats.t.sf(np.abs(mean) / spread, degrees)
        apart = stats.false_discovery_control(p) <= 0.05
        better = apart & (mean > 0)
        shares[rule] = (float((p <= 0.05).mean()), float(apart.mean()), float(better[pairs[:, 0] == 0].mean()))
    return shares


def study_over_time(seed: int) -> tuple[float, float, float, float, float]:
    """Return p of an unrelated model, p of its layers, and latency, low and high of a related one (true: two bins)."""
    rng = np.random.default_rng([11, seed])
    stimuli, bins, dimensions, units = 16, 12, 4, 40
    paths = rng.normal(size=(4, bins + 20, stimuli, dimensions))
    for step in range(1, bins + 20):
        paths[:, step] = 0.7 * paths[:, step - 1] + math.sqrt(0.51) * paths[:, step]
    followed, *others = paths[:, 20:]
    late = np.zeros_like(followed)
    late[3:] = followed[1:-2]

    def movie(path: np.ndarray, count: int, noise: float) -> np.ndarray:
        patterns = path @ rng.normal(size=(dimensions, count)) + noise * rng.normal(size=(bins, stimuli, count))
        return np.stack([rdm(one, method="sqeuclidean") for one in patterns])

    animals = [AnimalMovie(str(index), movie(late, units, 1.0), np.full(bins, 0.9)) for index in range(6)]
    layers = {str(index): movie(path, 40, 0.0) for index, path in enumerate(others)}
    null = score_over_time(layers, animals, width=BIN, permutations=199, seed=seed)
    related = score_over_time({"followed": movie(followed, 40, 0.0)}, animals, width=BIN, permutations=99, seed=seed)
    (found,) = related.latencies
    return null.p, min(item.p for item in null.latencies), found.latency, *_ends(found.interval)
