"""Metrics of patterns: models' features [K, F] against animals' mean responses [K, U].

:class:`PatternMetric` holds what all of them share: the choice of layer on the other animals, the
permutation of stimuli with that choice in every order, the interval over animals, and the animals
against one another (each predicted from the joined units of the others). A subclass says how two
patterns compare.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.errors import UsageError
from brainbench.metrics._animal_patterns import AnimalPatterns, animal_patterns
from brainbench.metrics._labels import response_matrix
from brainbench.metrics._pairs import Floats, Ints
from brainbench.metrics.inference import SMALLEST_STIMULI, TIE, label_orders
from brainbench.metrics.intervals import VERIFIED_ANIMALS, t_interval
from brainbench.metrics.layers import choose_on_others, held_out, most_chosen
from brainbench.metrics.noise import RELIABILITY_GATE
from brainbench.metrics.reliability import TrialBlock
from brainbench.types import LayerScore, Score, Status, SubjectScore

ORDERS = 999
"""Random orders of the stimuli above six; up to six all are taken."""

_EXACT_STIMULI = 6


class PatternMetric:
    """Base of metrics that compare patterns. Subclasses set ``name``, ``title`` and write ``similarity``.

    A subclass whose comparison is corrected for noise sets ``corrected`` and overrides :meth:`compare`,
    or :meth:`compare_orders` where all orders can be computed at once.
    """

    name = ""
    title = ""
    corrected = False
    """Whether values are corrected for noise, so that animals below the reliability gate do not count."""

    def similarity(self, model: Floats, brain: Floats) -> float:
        """Return how alike features [K, F] and mean responses [K, U] are; larger is more alike."""
        raise UsageError(f"The metric {self.name or type(self).__name__!r} does not define similarity(model, brain).")

    def compare(self, model: Floats, brain: AnimalPatterns) -> float:
        """Return the value for one layer and one animal; NaN where there is none."""
        return float(self.similarity(model, brain.patterns))

    def compare_orders(self, model: Floats, animals: Sequence[AnimalPatterns], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        return np.array([[self.compare(model[order], animal) for animal in animals] for order in orders])

    def animal(
        self,
        subject: str,
        blocks: Sequence[TrialBlock],
        n_stimuli: int,
        *,
        stimuli: Sequence[str] | None = None,
        seed: int = 0,
        draws: int = 0,
    ) -> AnimalPatterns:
        """Return the animal's mean responses; nothing here is random."""
        return animal_patterns(subject, blocks, n_stimuli, stimuli=stimuli)

    def score(
        self,
        features: Mapping[str, ArrayLike],
        animals: Sequence[AnimalPatterns],
        *,
        name: str,
        stimuli: Sequence[str],
        estimator: str = "default",
        seed: int = 0,
    ) -> Score:
        """Score a model: each animal with the layer chosen on the others, averaged.

        Raises:
            UsageError: no layers or animals, features of another number of stimuli, or a published estimator.
        """
        _check(self.name, features, stimuli, estimator)
        found = _gather(animals, self.corrected)
        layers = {layer: response_matrix(values, "stimuli").astype(np.float64) for layer, values in features.items()}
        usable = [
            layer for layer, values in layers.items() if np.isfinite(values).all() and np.ptp(values, axis=0).any()
        ]
        common: dict[str, Any] = {
            "name": name,
            "estimator": estimator,
            "metric": f"{self.name}: {self.title}",
            "stimuli": tuple(map(str, stimuli)),
        }
        if not usable or not found.scored or len(stimuli) < SMALLEST_STIMULI:
            return Score(value=math.nan, status="undefined", reasons=_undefined(found, usable, len(stimuli)), **common)
        orders = _orders(len(stimuli), seed)
        scored = [found.animals[i] for i in found.scored]
        values = np.stack([self.compare_orders(layers[layer], scored, orders) for layer in usable], axis=1)
        known = np.isfinite(values[0]).all(axis=0)
        if not known.any():
            reason = "the metric has no value for any animal"
            return Score(value=math.nan, status="undefined", reasons=(reason, *found.reasons), **common)
        values, scored = values[..., known], [animal for animal, keep in zip(scored, known, strict=True) if keep]
        chosen, held, rule = _chosen(values)
        statistic = held.mean(axis=-1)
        status, reasons = _verdict(found, len(scored), self.corrected)
        means = values[0].mean(axis=-1)
        best = int(np.argmax(means))
        by_subject = {a.subject: (float(v), usable[int(c)]) for a, v, c in zip(scored, held[0], chosen, strict=True)}
        return Score(
            value=float(statistic[0]),
            status=status,
            reasons=reasons,
            r=float(statistic[0]),
            reliability=float(np.mean([animal.reliability for animal in scored])),
            interval=t_interval(held[0]),
            p=_p(statistic),
            p_method=_method(len(stimuli), len(orders), len(usable), statistic),
            p_smallest=1 / len(orders),
            layer=usable[most_chosen(chosen)],
            layer_rule=rule,
            best_layer=usable[best],
            best_layer_value=float(means[best]),
            layers=tuple(
                LayerScore(
                    layer,
                    float(means[usable.index(layer)]),
                    float(means[usable.index(layer)]),
                    status,
                    t_interval(values[0][usable.index(layer)]),
                )
                if layer in usable
                else LayerScore(layer, math.nan, math.nan, "undefined")
                for layer in layers
            ),
            subjects=_subject_scores(found, by_subject),
            provenance={"statistics": {}, "seed": seed},
            **common,
        )

    def score_animals(
        self, animals: Sequence[AnimalPatterns], *, stimuli: Sequence[str], estimator: str = "default", seed: int = 0
    ) -> Score:
        """Score each animal against the joined units of the others.

        Raises:
            UsageError: no animals, or a published estimator.
        """
        _check(self.name, {"others": None}, stimuli, estimator)
        found = _gather(animals, self.corrected)
        scored = [found.animals[i] for i in found.scored]
        common: dict[str, Any] = {
            "name": "animal-to-animal",
            "estimator": estimator,
            "metric": f"{self.name}: {self.title}; each animal against the joined units of the others",
            "stimuli": tuple(map(str, stimuli)),
            "layer_rule": "no layers: each animal against the others",
        }
        if len(scored) < 2 or len(stimuli) < SMALLEST_STIMULI:
            reason = "fewer than two animals can be used" if len(scored) < 2 else _few(len(stimuli))
            return Score(value=math.nan, status="undefined", reasons=(reason, *found.reasons), **common)
        orders = _orders(len(stimuli), seed)
        columns = []
        for animal in scored:
            others = np.concatenate([other.patterns for other in scored if other is not animal], axis=1)
            columns.append(self.compare_orders(others, [animal], orders))
        values = np.concatenate(columns, axis=1)
        by_subject = {animal.subject: (float(v), None) for animal, v in zip(scored, values[0], strict=True)}
        statistic = values.mean(axis=-1)
        status, reasons = _verdict(found, len(scored), self.corrected)
        if not np.isfinite(statistic[0]):
            return Score(value=math.nan, status="undefined", reasons=("the metric has no value", *reasons), **common)
        return Score(
            value=float(statistic[0]),
            status=status,
            reasons=reasons,
            r=float(statistic[0]),
            reliability=float(np.mean([animal.reliability for animal in scored])),
            interval=t_interval(values[0]) if len(scored) > 2 else None,
            p=_p(statistic),
            p_method=_method(len(stimuli), len(orders), 1, statistic),
            p_smallest=1 / len(orders),
            subjects=_subject_scores(found, by_subject),
            provenance={"statistics": {}, "seed": seed},
            **common,
        )


@dataclass(frozen=True)
class _Gathered:
    animals: tuple[AnimalPatterns, ...]
    scored: tuple[int, ...]
    reliable: bool
    reasons: tuple[str, ...]


def _gather(animals: Sequence[AnimalPatterns], corrected: bool) -> _Gathered:
    if not animals:
        raise UsageError("There are no animals to score against; give at least one.")
    ordered = tuple(sorted(animals, key=lambda animal: animal.subject))
    least = 0.0 if corrected else -math.inf
    usable = [i for i, animal in enumerate(ordered) if animal.problem is None and animal.reliability > least]
    good = [i for i in usable if ordered[i].reliability >= RELIABILITY_GATE]
    scored = good if good and corrected else usable
    reasons = []
    for index, animal in enumerate(ordered):
        if index not in scored:
            why = animal.problem or f"reliability {animal.reliability:.2f} is below {RELIABILITY_GATE}"
            reasons.append(f"{animal.subject} left out: {why}")
        reasons += [f"{animal.subject}: {note}" for note in animal.notes if index in scored]
    return _Gathered(ordered, tuple(scored), bool(good) or not corrected, tuple(reasons))


def _check(metric: str, features: Mapping[str, Any], stimuli: Sequence[str], estimator: str) -> None:
    if estimator != "default":
        raise UsageError(f"The estimator {estimator!r} is one of RSA; the metric {metric!r} has 'default' only.")
    if not features:
        raise UsageError("There are no layers to score; give the features of at least one layer.")
    for layer, values in features.items():
        rows = len(stimuli) if values is None else len(np.asarray(values))
        if rows != len(stimuli):
            raise UsageError(f"The features of layer {layer!r} have {rows} rows; {len(stimuli)} stimuli are scored.")


def _undefined(found: _Gathered, usable: list[str], stimuli: int) -> tuple[str, ...]:
    if stimuli < SMALLEST_STIMULI:
        reason = _few(stimuli)
    elif not usable:
        reason = "activations of every layer are constant or not finite"
    else:
        reason = "no animal can be used"
    return (reason, *found.reasons)


def _few(stimuli: int) -> str:
    return f"{stimuli} stimuli are too few to leave one out; at least {SMALLEST_STIMULI} are needed"


def _orders(stimuli: int, seed: int) -> Ints:
    if stimuli <= _EXACT_STIMULI:
        return np.concatenate(list(label_orders(stimuli, 1 << 20, seed)))
    random = np.random.default_rng(seed).permuted(np.tile(np.arange(stimuli), (ORDERS, 1)), axis=1)
    return np.concatenate([np.arange(stimuli)[None], random])


def _chosen(values: Floats) -> tuple[Ints, Floats, str]:
    """Return the layers [A] chosen, the values [N, A] held out under every order, and the rule in words."""
    if values.shape[1] == 1:
        return np.zeros(values.shape[2], dtype=np.int64), values[:, 0], "only layer"
    if values.shape[2] == 1:
        rule = "maximum over layers on the only animal (optimistic; the permutation takes the same maximum)"
        return np.argmax(values[0], axis=0), values.max(axis=1), rule
    rule = "chosen on the other animals, evaluated on the animal held out"
    return choose_on_others(values[0]), held_out(values), rule


def _p(statistic: Floats) -> float:
    return float((statistic >= statistic[0] - TIE * max(1.0, abs(statistic[0]))).mean())


def _method(stimuli: int, orders: int, layers: int, statistic: Floats) -> str:
    how = f"all {orders} orders" if stimuli <= _EXACT_STIMULI else f"{orders - 1} random orders, (b+1)/(n+1)"
    choice = "one layer" if layers == 1 else "layer chosen anew in each"
    chance = round(float(np.nanmean(statistic)), 2) + 0.0
    return f"one-sided permutation of stimulus labels, {how}; {choice}; mean score under permutation {chance:.2f}"


def _verdict(found: _Gathered, scored: int, corrected: bool) -> tuple[Status, tuple[str, ...]]:
    reasons = list(found.reasons)
    if not found.reliable:
        reasons.insert(0, "no animal's responses are reliable")
    if not corrected:
        reasons.append("not corrected for noise: compare with the animal-to-animal value, not with 1")
    if scored == 1:
        reasons.append("one animal: no confidence interval, since nothing is known about other animals")
    elif scored < VERIFIED_ANIMALS:
        reasons.append(f"interval from {scored} animals is unreliable: coverage not verified below {VERIFIED_ANIMALS}")
    return "ok" if found.reliable else "unreliable", tuple(reasons)


def _subject_scores(found: _Gathered, values: Mapping[str, tuple[float, str | None]]) -> tuple[SubjectScore, ...]:
    scores = []
    for animal in found.animals:
        value, layer = values.get(animal.subject, (math.nan, None))
        good = animal.subject in values
        status: Status = "undefined" if not good else "ok" if found.reliable else "unreliable"
        scores.append(
            SubjectScore(animal.subject, value, value, animal.reliability, status, animal.units, animal.trials, layer)
        )
    return tuple(scores)
