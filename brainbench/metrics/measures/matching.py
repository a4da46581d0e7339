"""Metrics of single units: each of an animal's units is matched with features of the model by its tuning.

Distances between stimuli are the same for a network whose features are mixtures of the units. These metrics are not:
they ask whether the network has units like those of the animal. The likeness of a unit and a feature is the Pearson
correlation of their responses over the stimuli. *Soft matching* (Khosla & Williams 2023) moves equal masses of units to
equal masses of features, so that features unlike any unit count against a network; *one to one*, each unit gets a
feature of its own. What each unit adds is in the record, by area, layer and cell type where the recordings name them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from brainbench.core.statistics import t_interval
from brainbench.metrics.measures.patterns import PatternMetric
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.subject_rdm import SubjectRDM

MOST_FEATURES = 128  # features that soft matching takes of a layer, at random; as many as units, where these are more


class UnitMatching(PatternMetric):
    """Base of both: the mean correlation of matched units and features."""

    orders = 199
    orders_between = 39

    def pairs(self, likeness: Floats) -> tuple[Ints, Ints]:
        """Return the units [M] and the features [M] that are matched, from their likeness [U, F]."""
        from scipy.optimize import linear_sum_assignment

        units, features = linear_sum_assignment(likeness, maximize=True)
        return np.asarray(units), np.asarray(features)

    def chosen(self, features: int, units: int) -> Ints:
        """Return the features of a layer that take part."""
        return np.arange(features)

    def compare_orders(self, model: Floats, animals: Sequence[SubjectRDM], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        values = np.empty((len(orders), len(animals)))
        for index, animal in enumerate(animals):
            left, right = self._tunings(model, animal)
            for row, order in enumerate(orders):
                likeness = right.T @ left[order]
                values[row, index] = likeness[self.pairs(likeness)].mean() if likeness.size else np.nan
        return values

    def compare_without(self, layers: Sequence[Floats], animals: Sequence[SubjectRDM]) -> Floats:
        """Return values [K, L, A] without each stimulus in turn, of the pairs that all stimuli match."""
        count = animals[0].count
        values = np.full((count, len(layers), len(animals)), np.nan)
        if count <= 3:
            return values
        # Of unit vectors over K stimuli, without one: their product, and the length of each, centred anew.
        share = count / (count - 1)
        for row, layer in enumerate(layers):
            for column, animal in enumerate(animals):
                left, right = self._tunings(layer, animal)
                units, features = self.pairs(right.T @ left)
                a, b = right[:, units], left[:, features]
                length = (1 - share * a**2) * (1 - share * b**2)
                product = (a * b).sum(axis=0) - share * a * b
                part = np.divide(product, np.sqrt(np.maximum(length, 0.0)), out=np.zeros_like(a), where=length > 1e-12)
                values[:, row, column] = part.mean(axis=1) if a.size else np.nan
        return values

    def contributions(self, model: Floats, animal: SubjectRDM) -> Floats:
        """Return the mean correlation [U] of each unit with the features that it is matched with; NaN without any."""
        left, right = self._tunings(model, animal)
        likeness = right.T @ left
        units, features = self.pairs(likeness)
        number = np.bincount(units, minlength=len(likeness))
        total = np.bincount(units, weights=likeness[units, features], minlength=len(likeness))
        return np.divide(total, number, out=np.full(len(likeness), np.nan), where=number > 0)

    def statistics(self, layer: Floats, animals: Sequence[SubjectRDM], seed: int) -> dict[str, Any]:
        """Return what each unit adds, and the means of each area, layer and cell type over the animals that have it."""
        parts = {animal.subject: self.contributions(layer, animal) for animal in animals}
        values = {subject: [float(f"{value:.4g}") for value in part] for subject, part in parts.items()}
        stated: dict[str, Any] = {"animals": values}
        columns = sorted({name for animal in animals for name in animal.columns})
        for column in columns:
            texts = {animal.subject: animal.columns.get(column, np.full(0, "")) for animal in animals}
            groups = {}
            for group in sorted({str(text) for part in texts.values() for text in part} - {""}):
                inside = [parts[name][part == group] for name, part in texts.items() if (part == group).any()]
                means = np.array([np.nanmean(part) for part in inside if np.isfinite(part).any()])
                if not len(means):
                    continue
                span = t_interval(means, over="animals")
                groups[group] = {
                    "value": float(means.mean()),
                    "interval": None if span is None else [span.low, span.high],
                    "units": sum(map(len, inside)),
                    "animals": len(means),
                }
            if groups:
                stated.setdefault("groups", {})[column] = groups
        return {"units": stated}

    def _tunings(self, model: Floats, animal: SubjectRDM) -> tuple[Floats, Floats]:
        """Return the tunings of features [K, F] and of units [K, U], centred and of unit length; silent ones are 0."""
        units = animal.patterns
        features = model[:, self.chosen(model.shape[1], units.shape[1])]
        return _unit_tunings(features), _unit_tunings(units)


def _unit_tunings(patterns: Floats) -> Floats:
    centred = patterns - patterns.mean(axis=0)
    length = np.linalg.norm(centred, axis=0)
    # What rounding leaves of a constant response is no tuning.
    floor = 64 * np.finfo(float).eps * np.abs(patterns).max(axis=0, initial=0.0) * np.sqrt(len(patterns))
    return np.divide(centred, length, out=np.zeros_like(centred), where=length > floor)


class OneToOne(UnitMatching):
    """Each unit has a feature of its own, so that the mean correlation is the largest (an assignment)."""

    name = "one-to-one"
    title = "mean correlation over stimuli of units with features of their own, matched one to one"


class SoftMatching(UnitMatching):
    """Equal masses of all units go to equal masses of all features, so that the mean correlation is the largest.

    This is the optimal transport between both. Where one side has a multiple of the other's number its solution is an
    assignment of copies; so the features of a larger layer are a random sample of a multiple of the units' number. Of a
    smaller layer each unit gets one feature, and each feature at most a unit more than its share.
    """

    name = "soft-matching"
    title = "mean correlation over stimuli of units and features of equal masses, matched by optimal transport"

    def chosen(self, features: int, units: int) -> Ints:
        """Return a sample of the features, a multiple of the units in number where there are as many."""
        if features <= units or not units:
            return np.arange(features)
        size = units * (min(features, max(MOST_FEATURES, units)) // units)
        return np.sort(np.random.default_rng(features).permutation(features)[:size])

    def pairs(self, likeness: Floats) -> tuple[Ints, Ints]:
        """Return the units [M] and the features [M] that share mass; all shares are equal."""
        units, features = likeness.shape
        if not likeness.size:
            return super().pairs(likeness)
        copies = np.array([max(1, -(-features // units)), max(1, -(-units // features))])
        rows, columns = super().pairs(likeness.repeat(copies[0], axis=0).repeat(copies[1], axis=1))
        return rows // copies[0], columns // copies[1]
