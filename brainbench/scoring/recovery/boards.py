"""One board of a recovery: animals drawn from a candidate, and the score of every candidate against them.

Scores are those of the engine, :func:`brainbench.metrics.score.score_layers`, with few orders of the stimuli: the
value, chance and what is attainable need no p. Letters: A animal, C candidate, K stimulus.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from brainbench.core.records import Score
from brainbench.core.statistics import FEWEST_ANIMALS, FEWEST_STIMULI, two_factor_error
from brainbench.metrics.inference.multiple import adjust
from brainbench.metrics.measures.registry import get_metric
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.score import score_layers
from brainbench.scoring.recovery.candidates import Candidate
from brainbench.scoring.recovery.design import RecoveryDesign

LEVEL = 0.05
"""False discovery rate over all pairs of a board."""


@dataclass(frozen=True)
class RecoveryBoard:
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
    return RecoveryBoard(
        true,
        number,
        layer,
        tuple(one.scaled for one in scores),
        tuple(told_apart(scores)[true].tolist()),
        scores[true].reliability,
    )


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

    Two-factor t tests of the differences of scaled scores, false discovery rate 5 % over all pairs.
    """
    from scipy.special import stdtr

    result = np.zeros((len(scores), len(scores)), dtype=np.int64)
    given = [place for place, one in enumerate(scores) if np.isfinite(one.scaled)]
    if len(given) < 2:
        return result
    value = np.array([scores[place].scaled for place in given])
    animals = np.array([[scores[place].on_scale(part.value) for part in scores[place].subjects] for place in given])
    without = np.array([[scores[place].on_scale(one) for one in scores[place].without_stimulus] for place in given])
    if animals.shape[1] < FEWEST_ANIMALS or without.shape[1] < FEWEST_STIMULI:
        return result
    first, second = np.triu_indices(len(given), 1)
    difference: Floats = value[first] - value[second]
    error, freedom = two_factor_error(animals[first] - animals[second], without[first] - without[second])
    with np.errstate(invalid="ignore", divide="ignore"):
        p = 2 * stdtr(freedom, -np.abs(difference) / error)
    found = (adjust(p, "fdr") <= LEVEL) * np.sign(difference).astype(np.int64)
    places = np.array(given)
    result[places[first], places[second]], result[places[second], places[first]] = found, -found
    return result
