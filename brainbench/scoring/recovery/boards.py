"""One board of a recovery: animals drawn from a candidate, and the score of every candidate against them.

For RSA the values are those of :func:`brainbench.metrics.score.score_rdms`, made from the same functions without its
permutations and bootstraps: RDMs of the candidates are computed once for all boards. Any other metric makes its
whole score. Letters: A animal, C candidate, K stimulus, L layer, P pair.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, two_factor_error
from brainbench.metrics.inference.multiple import adjust
from brainbench.metrics.inference.permutation import label_orders
from brainbench.metrics.layers import held_out
from brainbench.metrics.measures.registry import get_metric
from brainbench.metrics.measures.rsa import RSA
from brainbench.metrics.rdms.comparison import compare_all, permuted_comparisons
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.noise_correction import noise_corrected
from brainbench.metrics.reliability.subject_rdm import SubjectRDM
from brainbench.scoring.recovery.candidates import Candidate
from brainbench.scoring.recovery.design import RecoveryDesign

LEVEL = 0.05
"""False discovery rate over all pairs of a board."""


@dataclass(frozen=True)
class BoardScores:
    """Scores of all candidates against one set of animals."""

    values: Floats
    """[C] noise-corrected scores; NaN where undefined."""
    chance: Floats
    """[C] mean score under permuted stimuli."""
    animals: Floats
    """[C, A] scores of single animals."""
    without_stimulus: Floats
    """[C, K] scores without each stimulus in turn."""
    attainable: Floats
    """[C] score of a model that explains all that is reliable."""
    reliability: float
    """Mean split-half reliability of the animals."""

    def scaled(self, values: Floats) -> Floats:
        """Return values [C, …] between chance (0) and all that is reliable (1)."""
        extra = (slice(None), *[None] * (values.ndim - 1))
        return (values - self.chance[extra]) / (self.attainable - self.chance)[extra]

    def told_apart(self) -> Ints:
        """Return [C, C]: 1 where a candidate is told apart above another, −1 below, 0 where they tie.

        Two-factor t tests of the differences of scaled scores, false discovery rate 5 % over all pairs.
        """
        from scipy.special import stdtr

        count = len(self.values)
        result = np.zeros((count, count), dtype=np.int64)
        stimuli = self.without_stimulus.shape[1]
        if self.animals.shape[1] < FEWEST_ANIMALS or stimuli < FEWEST_STIMULI or count < 2:
            return result
        first, second = np.triu_indices(count, 1)
        value, animals, without = map(self.scaled, (self.values, self.animals, self.without_stimulus))
        difference = value[first] - value[second]
        error, freedom = two_factor_error(animals[first] - animals[second], without[first] - without[second])
        with np.errstate(invalid="ignore", divide="ignore"):
            p = 2 * stdtr(freedom, -np.abs(difference) / error)
        found = (adjust(p, "fdr") <= LEVEL) * np.sign(np.nan_to_num(difference)).astype(np.int64)
        result[first, second], result[second, first] = found, -found
        return result


@dataclass(frozen=True)
class Board:
    """What a recovery keeps of one board."""

    true: int
    """Candidate from which the animals were drawn."""
    number: int
    layer: str
    """Layer whose units they mix."""
    scaled: tuple[float, ...]
    """[C] scores between chance (0) and all that is reliable (1)."""
    told: tuple[int, ...]
    """[C] 1 where the true candidate is told apart above this one, −1 below, 0 where they tie."""
    reliability: float
    """Mean split-half reliability of the animals."""

    @classmethod
    def of(cls, data: Mapping[str, Any]) -> Board:
        """Rebuild a board from its JSON, where a missing number is null."""
        scaled = tuple(math.nan if value is None else float(value) for value in data["scaled"])
        reliability = math.nan if data["reliability"] is None else float(data["reliability"])
        return cls(data["true"], data["number"], data["layer"], scaled, tuple(data["told"]), reliability)

    @property
    def first(self) -> int | None:
        """Candidate with the highest score; None where no score is defined or the highest is shared."""
        values = np.array(self.scaled)
        if not np.isfinite(values).any():
            return None
        best = np.flatnonzero(values == np.nanmax(values))
        return int(best[0]) if len(best) == 1 else None


def make_board(candidates: Sequence[Candidate], design: RecoveryDesign, true: int, number: int) -> Board:
    """Draw the animals of a board from candidate ``true`` and score all candidates, by the arguments alone."""
    layer, rows, animals = draw_board(candidates, design, true, number)
    scores = score_board(candidates, rows, animals, design)
    scaled = scores.scaled(scores.values)
    told = scores.told_apart()[true]
    return Board(true, number, layer, tuple(scaled.tolist()), tuple(told.tolist()), scores.reliability)


def draw_board(
    candidates: Sequence[Candidate], design: RecoveryDesign, true: int, number: int
) -> tuple[str, Ints, tuple[Any, ...]]:
    """Return the true layer, the stimuli [K] that are shown, and the animals as the metric prepares them."""
    from brainbench.datasets.synthetic.populations import draw_animals

    stream = (design.seed, true, number)
    random = np.random.default_rng(stream)
    pool = len(candidates[true].stimuli)
    shown = design.stimuli or pool
    rows = np.sort(random.permutation(pool)[:shown]) if shown < pool else np.arange(pool)
    layer = candidates[true].choose(design.layer, random)
    metric = get_metric(design.metric)
    fast = {"splits": design.splits} if isinstance(metric, RSA) else {}
    animals = []
    for subject, sessions in draw_animals(candidates[true].geometry(layer, rows), design.population, stream).items():
        trials = [replace(item, responses=item.responses[:, 0]) for item in sessions]
        animals.append(metric.animal(subject, trials, shown, seed=design.seed, **fast))
    return layer, rows, tuple(animals)


def score_board(
    candidates: Sequence[Candidate], rows: Ints, animals: Sequence[Any], design: RecoveryDesign
) -> BoardScores:
    """Score all candidates against prepared animals, over the stimuli ``rows`` [K]."""
    metric = get_metric(design.metric)
    if isinstance(metric, RSA):
        pairs = pairs_of(rows, len(candidates[0].stimuli))
        rdms = [item.rdms(metric.model_method)[:, pairs] for item in candidates]
        return _rsa_scores(rdms, len(rows), animals, metric.comparison, design)
    found = []
    for item in candidates:
        features = {layer: values[rows] for layer, values in item.features.items()}
        labels = [item.stimuli[row] for row in rows]
        found.append(metric.score(features, animals, name=item.name, stimuli=labels, seed=design.seed))
    return BoardScores(
        np.array([one.value for one in found]),
        np.array([one.chance for one in found]),
        np.array([[subject.value for subject in one.subjects] or [np.nan] * len(animals) for one in found]),
        np.array([one.without_stimulus or [np.nan] * len(rows) for one in found]),
        np.array([one.attainable for one in found]),
        float(np.nanmean([one.reliability for one in found])),
    )


def pairs_of(rows: Ints, pool: int) -> Ints:
    """Return the places, in an RDM of ``pool`` stimuli, of the pairs of the stimuli ``rows`` [K], which increase."""
    first, second = np.triu_indices(len(rows), 1)
    low, high = rows[first], rows[second]
    return low * (2 * pool - low - 1) // 2 + high - low - 1


def _rsa_scores(
    rdms: Sequence[Floats], stimuli: int, animals: Sequence[SubjectRDM], comparison: str, design: RecoveryDesign
) -> BoardScores:
    corrections = [noise_corrected(math.nan if one.problem else 1.0, one.split_half_by(comparison)) for one in animals]
    usable = [place for place, one in enumerate(corrections) if one.status != "undefined"]
    # As in a score: the reliable animals, else (the score is then unreliable) all that have a value.
    scored = [place for place in usable if corrections[place].status == "ok"] or usable
    count = len(rdms)
    by_animal, without = np.full((count, len(animals)), np.nan), np.full((count, stimuli), np.nan)
    chance = np.full(count, np.nan)
    if not scored:
        return BoardScores(chance, chance, by_animal, without, np.ones(count), math.nan)
    brain = np.stack([animals[place].rdm for place in scored])
    factors = np.array([corrections[place].value for place in scored])
    layers, ends = np.concatenate(rdms), np.cumsum([0, *map(len, rdms)])
    orders = np.concatenate(list(label_orders(stimuli, design.seed, exact=1, draws=design.orders)))[1:]
    null = np.concatenate(list(permuted_comparisons(layers, brain, iter([orders]), comparison)))
    everything = np.arange(stimuli)
    left = [pairs_of(np.delete(everything, one), stimuli) for one in everything]
    less = np.stack([compare_all(layers[:, pairs], brain[:, pairs], method=comparison) for pairs in left])
    r = compare_all(layers, brain, method=comparison)
    for place, (start, end) in enumerate(pairwise(ends)):
        if not np.isfinite(r[start:end]).all(axis=1).any():
            continue
        by_animal[place, scored] = _chosen(r[start:end]) * factors
        chance[place] = (_chosen(null[:, start:end]) @ factors).mean() / len(scored)
        without[place] = _chosen(less[:, start:end]) @ factors / len(scored)
    reliability = float(np.mean([corrections[place].reliability for place in scored]))
    return BoardScores(by_animal[:, scored].mean(axis=1), chance, by_animal, without, np.ones(count), reliability)


def _chosen(r: Floats) -> Floats:
    """Return comparisons [..., A] with the layer of r [..., L, A] that is chosen on the other animals."""
    # Comparisons lie above -1: a layer without a value for some animal is never chosen where another has one.
    known = np.where(np.isfinite(r).all(axis=-1, keepdims=True), r, -2.0)
    if r.shape[-2] == 1:
        return known[..., 0, :]
    return held_out(known) if r.shape[-1] > 1 else known.max(axis=-2)
