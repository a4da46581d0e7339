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

from brainbench.core.records import Score
from brainbench.metrics.inference.intervals import t_interval
from brainbench.metrics.inference.permutation import tail_p
from brainbench.metrics.measures.animal_patterns import PatternAnimals, subject_scores
from brainbench.metrics.measures.classifier import Decoder
from brainbench.metrics.measures.patterns import (
    PatternMetric,
    layer_scores,
    make_score,
    pattern_orders,
    undefined,
)
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.score import layer_table

ORDERS = 199
"""Random orders of the stimuli above six."""


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


class LabelDecoding(PatternMetric):
    """Accuracy of decoding the labels' properties, leaving one stimulus out."""

    name = "decoding"
    title = "accuracy of logistic regression for properties of stimuli left out, mean over properties"

    def score_layers(
        self, layers: Mapping[str, Floats], found: PatternAnimals, about: dict[str, Any], seed: int
    ) -> Score:
        """Decode from the features of every layer; the value is that of the best, and so is every permutation's."""
        stimuli = about["stimuli"]
        usable = [layer for layer, values in layers.items() if np.isfinite(values).all()]
        properties = label_properties(stimuli)
        if not usable or not properties:
            reason = "activations of every layer are not finite" if properties else _no_property(stimuli)
            return Score(value=math.nan, status="undefined", reasons=(reason,), **about)
        orders = _orders(len(stimuli), seed)
        # [N, L, properties]: every layer meets the same assignments of classes.
        values = np.stack([_accuracies(layers[layer], properties, orders) for layer in usable], axis=1)
        # The maximum over layers is taken in every order too, so p accounts for it.
        means = values.mean(axis=-1)
        best = int(np.argmax(means[0]))
        optimistic = "largest over layers (optimistic; the permutation takes the same maximum)"
        return make_score(
            about,
            means.max(axis=1),
            seed,
            {
                "layer_tests": layer_table(usable, means),
                "decoding": _by_property(properties, values[:, best]),
            },
            smallest=_smallest_p(properties, orders),
            status="ok",
            reasons=("accuracy of the model alone, no likeness: the animals' own stands beside it", *found.reasons),
            layer=usable[best],
            layer_rule="only layer" if len(usable) == 1 else optimistic,
            layers=layer_scores(layers, dict(zip(usable, means[0].tolist(), strict=True))),
        )

    def score_agreement(self, found: PatternAnimals, about: dict[str, Any], seed: int) -> Score:
        """Decode from the mean responses of each animal."""
        stimuli = about["stimuli"]
        about["layer_rule"] = "no layers: each animal by itself"
        scored, properties = [found.animals[i] for i in found.scored], label_properties(stimuli)
        if not scored or not properties:
            return undefined(about, "no animal can be used" if properties else _no_property(stimuli), found)
        orders = _orders(len(stimuli), seed)
        values = np.stack([_accuracies(animal.patterns, properties, orders) for animal in scored], axis=1)
        each = values.mean(axis=-1)
        by_subject: dict[str, tuple[float, str | None]] = {
            animal.subject: (value, None) for animal, value in zip(scored, each[0].tolist(), strict=True)
        }
        return make_score(
            about,
            values.mean(axis=(1, 2)),
            seed,
            {"decoding": _by_property(properties, values.mean(axis=1))},
            smallest=_smallest_p(properties, orders),
            status="ok",
            reasons=("each animal's own accuracy, from its mean responses", *found.reasons),
            reliability=float(np.mean([animal.reliability for animal in scored])),
            interval=t_interval(each[0]) if len(scored) > 2 else None,
            subjects=subject_scores(found, by_subject),
        )


def _orders(stimuli: int, seed: int) -> Ints:
    # Every order is a decoder of its own above six stimuli, where few orders share a partition.
    return pattern_orders(stimuli, seed, ORDERS - 1)


def _accuracies(patterns: Floats, properties: Mapping[str, Ints], orders: Ints) -> Floats:
    """Return accuracies [N, properties] with the classes given to the stimuli in each order [N, K]."""
    # Classes are permuted over stimuli; the folds of patterns stay and are prepared once.
    decoder = Decoder(patterns, np.arange(len(patterns)))
    return np.array([[float(np.mean(decoder(codes[order]))) for codes in properties.values()] for order in orders])


def _smallest_p(properties: Mapping[str, Ints], orders: Ints) -> float:
    """Return the share of orders that leave together what is together, which no test can tell apart."""
    # Orders that give the same partition of the stimuli into classes give the same accuracy.
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
            "p": float(tail_p(column)),
        }
        for (name, codes), column in zip(properties.items(), values.T, strict=True)
    ]


def _no_property(stimuli: Sequence[str]) -> str:
    return (
        "the labels name no property that at least two stimuli of each class share, as 'convex-far' and 'convex-close' "
        f"do: {', '.join(map(str, stimuli[:4]))}"
    )
