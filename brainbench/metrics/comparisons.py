"""Comparisons of all layers with all animals: as given, under orders of the stimuli, and without each stimulus.

A layer that has no value for some stimuli is compared over the rest, in every order alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from brainbench.metrics.hooks import MetricHooks
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.subject_rdm import SubjectRDM

Orders = Callable[[], Iterable[Ints]]
"""Gives chunks of orders of the stimuli [N, K], the same at every call."""


@dataclass(frozen=True)
class LayerComparisons:
    """Verdict of a metric on the layers of one model and a number of animals."""

    metric: MetricHooks
    layers: Sequence[Floats] = field(repr=False)
    """[L] what :meth:`Metric.layer` made of each."""
    animals: Sequence[SubjectRDM] = field(repr=False)
    """[A]"""
    device: Any = None

    @cached_property
    def known(self) -> np.ndarray:
        """[L, K] where a layer has a value for a stimulus."""
        return np.stack([self.metric.known(layer) for layer in self.layers])

    def among(self, layers: Sequence[Floats], animals: Sequence[SubjectRDM]) -> LayerComparisons:
        """Return the comparisons of some layers with some animals."""
        return LayerComparisons(self.metric, layers, animals, self.device)

    def given(self) -> Floats:
        """Return comparisons [L, A] of the stimuli as they are."""
        return next(self.under(lambda: [np.arange(self.known.shape[1])[None]]))[0]

    def under(self, orders: Orders) -> Iterator[Floats]:
        """Yield comparisons [N, L, A] with the model's stimuli in each order of a chunk [N, K]."""
        if self.known.all():
            yield from self.metric.compare_layers(self.layers, self.animals, orders(), self.device)
            return
        patterns, group = np.unique(self.known, axis=0, return_inverse=True)
        streams = [
            self._some(np.flatnonzero(group.ravel() == index), np.flatnonzero(kept), orders)
            for index, kept in enumerate(patterns)
        ]
        for parts in zip(*streams, strict=True):
            found = np.empty((len(parts[0]), len(self.layers), len(self.animals)))
            for index, part in enumerate(parts):
                found[:, group.ravel() == index] = part
            yield found

    def _some(self, layers: Ints, stimuli: Ints, orders: Orders) -> Iterator[Floats]:
        """Yield comparisons of some layers over the stimuli that they have."""
        count = self.known.shape[1]
        place = np.full(count, -1)
        place[stimuli] = np.arange(len(stimuli))
        # A random order of all stimuli is a random order of those that are left, when the others are passed over.
        kept = (place[chunk][place[chunk] >= 0].reshape(len(chunk), -1) for chunk in orders())
        reps = [self.metric.take(self.layers[layer], stimuli) for layer in layers]
        yield from self.metric.compare_layers(reps, [one.take(stimuli) for one in self.animals], kept, self.device)

    def without_each(self) -> Floats:
        """Return comparisons [K, L, A] without each stimulus in turn."""
        if self.known.all():
            return self.metric.compare_without(self.layers, self.animals)
        found = np.repeat(self.given()[None], self.known.shape[1], axis=0)
        for layer, kept in enumerate(map(np.flatnonzero, self.known)):
            part = [self.metric.take(self.layers[layer], kept)], [one.take(kept) for one in self.animals]
            found[kept, layer] = self.metric.compare_without(*part)[:, 0]
        return found
