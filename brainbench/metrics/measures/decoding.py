"""Decoding of what stimuli have in common, for a model and for each animal (table 3.6 of the work this grew from).

Labels such as ``convex-close`` name properties: the parts between hyphens. Each property that at least two
stimuli per class share is decoded from the patterns of the other stimuli
(:func:`~brainbench.metrics.measures.classifier.decode`),
and the value is the mean accuracy over properties. It is a property of the model alone; the animals' own
accuracy stands beside it as animal to animal. Accuracy without information lies below one over the number
of classes, so the permutation's mean is the chance level to read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.records import LayerScore, Provenance, Score
from brainbench.metrics.arrays import fetch
from brainbench.metrics.inference.intervals import t_interval
from brainbench.metrics.measures.animal_patterns import AnimalPatterns, OfMeanResponses
from brainbench.metrics.measures.classifier import ORDERS, Decoder
from brainbench.metrics.measures.pattern_scores import (
    check_features,
    gather_patterns,
    pattern_orders,
    permutation_method,
    permutation_p,
    subject_scores,
)
from brainbench.metrics.measures.registry import register_metric
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.score import layer_table
from brainbench.metrics.stimulus_labels import response_matrix


def label_properties(stimuli: Sequence[str]) -> dict[str, Ints]:
    """Return the classes [K] of each property that labels name, by the values it takes.

    >>> list(label_properties(["convex-far", "convex-close", "concave-far", "concave-close"]))
    ['concave/convex', 'close/far']
    """
    parts = [str(label).split("-") for label in stimuli]
    if len({len(part) for part in parts}) != 1:
        return {}
    found = {}
    for values in zip(*parts, strict=True):
        names, codes = np.unique(np.asarray(values, dtype=str), return_inverse=True)
        if len(names) > 1 and np.bincount(codes).min() > 1:
            found["/".join(names.tolist())] = codes.astype(np.int64)
    return found


class LabelDecoding(OfMeanResponses):
    """Accuracy of decoding the labels' properties, leaving one stimulus out."""

    name = "decoding"
    title = "accuracy of logistic regression for properties of stimuli left out, mean over properties"

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
        """Decode from the features of every layer; the value is that of the best, and so is every permutation's.

        Raises:
            UsageError: no layers or animals, features of another number of stimuli, or a published estimator.
        """
        check_features(self.name, features, stimuli, estimator)
        found = gather_patterns(animals, corrected=False)
        layers = {layer: fetch(response_matrix(values, "stimuli")).astype(float) for layer, values in features.items()}
        usable = [layer for layer, values in layers.items() if np.isfinite(values).all()]
        properties = label_properties(stimuli)
        common = self._common(name, stimuli, estimator)
        if not usable or not properties:
            reason = "activations of every layer are not finite" if properties else _no_property(stimuli)
            return Score(value=math.nan, status="undefined", reasons=(reason,), **common)
        orders = _orders(len(stimuli), seed)
        values = np.stack([_accuracies(layers[layer], properties, orders) for layer in usable], axis=1)
        means = values.mean(axis=-1)
        statistic, best = means.max(axis=1), int(np.argmax(means[0]))
        table = layer_table(usable, means)
        accuracy = dict(zip(usable, means[0].tolist(), strict=True))
        return Score(
            value=float(statistic[0]),
            status="ok",
            reasons=("accuracy of the model alone, no likeness: the animals' own stands beside it", *found.reasons),
            r=float(statistic[0]),
            p=permutation_p(statistic),
            p_method=permutation_method(len(stimuli), len(orders), len(usable), statistic),
            p_smallest=_smallest_p(properties, orders),
            layer=usable[best],
            layer_rule="only layer"
            if len(usable) == 1
            else "largest over layers (optimistic; the permutation takes the same maximum)",
            best_layer=usable[best],
            best_layer_value=float(statistic[0]),
            layers=tuple(
                LayerScore(layer, accuracy[layer], accuracy[layer])
                if layer in accuracy
                else LayerScore(layer, math.nan, math.nan, "undefined")
                for layer in layers
            ),
            provenance=Provenance.of(
                {
                    "statistics": {"layer_tests": table, "decoding": _by_property(properties, values[:, best])},
                    "seed": seed,
                }
            ),
            **common,
        )

    def score_animals(
        self, animals: Sequence[AnimalPatterns], *, stimuli: Sequence[str], estimator: str = "default", seed: int = 0
    ) -> Score:
        """Decode from the mean responses of each animal.

        Raises:
            UsageError: no animals, or a published estimator.
        """
        check_features(self.name, {"animals": None}, stimuli, estimator)
        found = gather_patterns(animals, corrected=False)
        scored, properties = [found.animals[i] for i in found.scored], label_properties(stimuli)
        common = self._common("animal-to-animal", stimuli, estimator)
        if not scored or not properties:
            reason = "no animal can be used" if properties else _no_property(stimuli)
            return Score(value=math.nan, status="undefined", reasons=(reason, *found.reasons), **common)
        orders = _orders(len(stimuli), seed)
        values = np.stack([_accuracies(animal.patterns, properties, orders) for animal in scored], axis=1)
        each, statistic = values.mean(axis=-1), values.mean(axis=(1, 2))
        by_subject: dict[str, tuple[float, str | None]] = {
            animal.subject: (value, None) for animal, value in zip(scored, each[0].tolist(), strict=True)
        }
        return Score(
            value=float(statistic[0]),
            status="ok",
            reasons=("each animal's own accuracy, from its mean responses", *found.reasons),
            r=float(statistic[0]),
            reliability=float(np.mean([animal.reliability for animal in scored])),
            interval=t_interval(each[0]) if len(scored) > 2 else None,
            p=permutation_p(statistic),
            p_method=permutation_method(len(stimuli), len(orders), 1, statistic),
            p_smallest=_smallest_p(properties, orders),
            layer_rule="no layers: each animal by itself",
            subjects=subject_scores(found, by_subject),
            provenance=Provenance.of(
                {"statistics": {"decoding": _by_property(properties, values.mean(axis=1))}, "seed": seed}
            ),
            **common,
        )

    def _common(self, name: str, stimuli: Sequence[str], estimator: str) -> dict[str, Any]:
        return {
            "name": name,
            "estimator": estimator,
            "metric": f"{self.name}: {self.title}",
            "stimuli": tuple(map(str, stimuli)),
        }


def _orders(stimuli: int, seed: int) -> Ints:
    orders = pattern_orders(stimuli, seed)
    # Every order is a decoder of its own above six stimuli, where few orders share a partition.
    return orders if len(orders) <= math.factorial(6) else orders[:ORDERS]


def _accuracies(patterns: Floats, properties: Mapping[str, Ints], orders: Ints) -> Floats:
    """Return accuracies [N, properties] with the classes given to the stimuli in each order [N, K]."""
    decoder = Decoder(patterns, np.arange(len(patterns)))
    return np.array([[float(np.mean(decoder(codes[order]))) for codes in properties.values()] for order in orders])


def _smallest_p(properties: Mapping[str, Ints], orders: Ints) -> float:
    """Return the share of orders that leave together what is together, which no test can tell apart."""
    same = [(codes[orders][:, :, None] == codes[orders][:, None]) for codes in properties.values()]
    return float(np.mean([all((part[index] == part[0]).all() for part in same) for index in range(len(orders))]))


def _by_property(properties: Mapping[str, Ints], values: Floats) -> list[dict[str, Any]]:
    """Describe accuracies [N, properties], the observed ones first."""
    return [
        {
            "property": name,
            "accuracy": float(column[0]),
            "chance": 1 / (int(codes.max()) + 1),
            "expected": float(column.mean()),
            "p": permutation_p(column),
        }
        for (name, codes), column in zip(properties.items(), values.T, strict=True)
    ]


def _no_property(stimuli: Sequence[str]) -> str:
    return (
        "the labels name no property that at least two stimuli of each class share, as 'convex-far' and 'convex-close' "
        f"do: {', '.join(map(str, stimuli[:4]))}"
    )


register_metric(LabelDecoding())
