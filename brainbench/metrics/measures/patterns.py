"""Metrics of patterns: models' features [K, F] against animals' mean responses [K, U].

:class:`PatternMetric` holds what all of them share: the choice of layer on the other animals, the
permutation of stimuli with that choice in every order, the interval over animals, and the animals
against one another (each predicted from the joined units of the others). A subclass says how two
patterns compare.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.core.records import LayerScore, Provenance, Score
from brainbench.metrics.inference.intervals import t_interval
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI
from brainbench.metrics.layers import most_chosen
from brainbench.metrics.measures.animal_patterns import AnimalPatterns, OfMeanResponses
from brainbench.metrics.measures.pattern_scores import (
    check_features,
    chosen_layers,
    few_stimuli,
    gather_patterns,
    pattern_orders,
    permutation_method,
    permutation_p,
    subject_scores,
    undefined_reasons,
    verdict,
)
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.score import layer_table
from brainbench.metrics.stimulus_labels import response_matrix


class PatternMetric(OfMeanResponses):
    """Base of metrics that compare patterns. Subclasses set ``name``, ``title`` and write ``similarity``.

    A subclass whose comparison is corrected for noise sets ``corrected`` and overrides :meth:`compare`,
    or :meth:`compare_orders` where all orders can be computed at once.
    """

    name = ""
    title = ""
    corrected = False
    """Whether values are corrected for noise, so that animals below the reliability gate do not count."""

    def similarity(self, model: Floats, brain: Floats) -> float:
        """Return how alike features [K, F] and mean responses [K, U] are; larger is more alike.

        Raises:
            UsageError: the metric does not define it.
        """
        raise UsageError(f"The metric {self.name or type(self).__name__!r} does not define similarity(model, brain).")

    def compare(self, model: Floats, brain: AnimalPatterns) -> float:
        """Return the value for one layer and one animal; NaN where there is none."""
        return float(self.similarity(model, brain.patterns))

    def compare_orders(self, model: Floats, animals: Sequence[AnimalPatterns], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        return np.array([[self.compare(model[order], animal) for animal in animals] for order in orders])

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
        check_features(self.name, features, stimuli, estimator)
        found = gather_patterns(animals, self.corrected)
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
            return Score(
                value=math.nan, status="undefined", reasons=undefined_reasons(found, usable, len(stimuli)), **common
            )
        orders = pattern_orders(len(stimuli), seed)
        scored = [found.animals[i] for i in found.scored]
        values = np.stack([self.compare_orders(layers[layer], scored, orders) for layer in usable], axis=1)
        known = np.isfinite(values[0]).all(axis=0)
        if not known.any():
            reason = "the metric has no value for any animal"
            return Score(value=math.nan, status="undefined", reasons=(reason, *found.reasons), **common)
        values, scored = values[..., known], [animal for animal, keep in zip(scored, known, strict=True) if keep]
        chosen, held, rule = chosen_layers(values)
        statistic = held.mean(axis=-1)
        status, reasons = verdict(found, len(scored), self.corrected)
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
            p=permutation_p(statistic),
            p_method=permutation_method(len(stimuli), len(orders), len(usable), statistic),
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
            subjects=subject_scores(found, by_subject),
            provenance=Provenance.of(
                {
                    "statistics": {"layer_tests": layer_table(usable, values.mean(axis=-1))}
                    | self.statistics(layers[usable[most_chosen(chosen)]], scored, seed),
                    "seed": seed,
                }
            ),
            **common,
        )

    def statistics(self, model: Floats, animals: Sequence[Any], seed: int) -> dict[str, Any]:
        """Return what else a record keeps of the chosen layer's features [K, F]; nothing unless overridden."""
        return {}

    def score_animals(
        self, animals: Sequence[AnimalPatterns], *, stimuli: Sequence[str], estimator: str = "default", seed: int = 0
    ) -> Score:
        """Score each animal against the joined units of the others.

        Raises:
            UsageError: no animals, or a published estimator.
        """
        check_features(self.name, {"others": None}, stimuli, estimator)
        found = gather_patterns(animals, self.corrected)
        scored = [found.animals[i] for i in found.scored]
        common: dict[str, Any] = {
            "name": "animal-to-animal",
            "estimator": estimator,
            "metric": f"{self.name}: {self.title}; each animal against the joined units of the others",
            "stimuli": tuple(map(str, stimuli)),
            "layer_rule": "no layers: each animal against the others",
        }
        if len(scored) < 2 or len(stimuli) < SMALLEST_STIMULI:
            reason = "fewer than two animals can be used" if len(scored) < 2 else few_stimuli(len(stimuli))
            return Score(value=math.nan, status="undefined", reasons=(reason, *found.reasons), **common)
        orders = pattern_orders(len(stimuli), seed)
        columns = []
        for animal in scored:
            others = np.concatenate([other.patterns for other in scored if other is not animal], axis=1)
            columns.append(self.compare_orders(others, [animal], orders))
        values = np.concatenate(columns, axis=1)
        by_subject = {animal.subject: (float(v), None) for animal, v in zip(scored, values[0], strict=True)}
        statistic = values.mean(axis=-1)
        status, reasons = verdict(found, len(scored), self.corrected)
        if not np.isfinite(statistic[0]):
            return Score(value=math.nan, status="undefined", reasons=("the metric has no value", *reasons), **common)
        return Score(
            value=float(statistic[0]),
            status=status,
            reasons=reasons,
            r=float(statistic[0]),
            reliability=float(np.mean([animal.reliability for animal in scored])),
            interval=t_interval(values[0]) if len(scored) > 2 else None,
            p=permutation_p(statistic),
            p_method=permutation_method(len(stimuli), len(orders), 1, statistic),
            p_smallest=1 / len(orders),
            subjects=subject_scores(found, by_subject),
            provenance=Provenance.of({"statistics": {}, "seed": seed}),
            **common,
        )
