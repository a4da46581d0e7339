"""One board of a recovery: animals drawn from a candidate, and the score of every candidate against them.

Scores are those of the engine, :func:`brainbench.metrics.score.score_layers`, with few orders of the stimuli: the
value, chance and what is attainable need no p. Letters: A animal, C candidate, K stimulus.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from brainbench.core.records import Score
from brainbench.core.statistics import compare_scores
from brainbench.metrics.inference.multiple import adjust
from brainbench.metrics.measures.metric import get_metric
from brainbench.metrics.rdms.pairs import Ints
from brainbench.metrics.score import score_layers
from brainbench.scoring.recovery.candidates import Candidate
from brainbench.scoring.recovery.design import RecoveryDesign

LEVEL = 0.05
"""False discovery rate over all pairs of a board."""


@dataclass(frozen=True)
class RecoveryBoard:
    """Result of one board that a recovery keeps."""

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
    def of(cls, data: Mapping[str, Any]) -> RecoveryBoard:
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


def make_board(candidates: Sequence[Candidate], design: RecoveryDesign, true: int, number: int) -> RecoveryBoard:
    """Draw the animals of a board from candidate ``true`` and score all candidates, by the arguments alone."""
    layer, rows, animals = draw_board(candidates, design, true, number)
    scores = score_board(candidates, rows, animals, design)
    scaled, told = tuple(one.scaled for one in scores), tuple(told_apart(scores)[true].tolist())
    return RecoveryBoard(true, number, layer, scaled, told, scores[true].reliability)


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
    metric, animals = get_metric(design.metric), []
    for subject, sessions in draw_animals(candidates[true].geometry(layer, rows), design.population, stream).items():
        trials = [replace(item, responses=item.responses[:, 0]) for item in sessions]
        animals.append(metric.animal(subject, trials, shown, seed=design.seed, splits=design.splits))
    return layer, rows, tuple(animals)


def score_board(
    candidates: Sequence[Candidate], rows: Ints, animals: Sequence[Any], design: RecoveryDesign
) -> list[Score]:
    """Return the score of every candidate against prepared animals, over the stimuli ``rows`` [K]."""
    metric = copy.copy(get_metric(design.metric))
    # Metrics may be frozen; the copy is ours.
    object.__setattr__(metric, "orders", design.orders)
    scores = []
    for item in candidates:
        layers = {name: metric.take(layer, rows) for name, layer in item.layers(metric).items()}
        labels = [item.stimuli[row] for row in rows]
        scores.append(score_layers(metric, layers, animals, name=item.name, stimuli=labels, seed=design.seed)[0])
    return scores


def told_apart(scores: Sequence[Score]) -> Ints:
    """Return [C, C]: 1 where a candidate is told apart above another, −1 below, 0 where they tie.

    By the test of a board (:func:`brainbench.core.statistics.compare_scores`: differences of scaled scores
    over animals and stimuli), false discovery rate 5 % over all pairs.
    """
    result = np.zeros((len(scores), len(scores)), dtype=np.int64)
    places = list(combinations(range(len(scores)), 2))
    tests = [compare_scores(scores[first], scores[second]) for first, second in places]
    for (first, second), test, p in zip(places, tests, adjust([test.p for test in tests], "fdr"), strict=True):
        if p <= LEVEL:
            result[first, second] = 1 if test.difference > 0 else -1
            result[second, first] = -result[first, second]
    return result
