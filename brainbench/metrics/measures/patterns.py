"""Metrics of patterns: models' features [K, F] against animals' mean responses [K, U]."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.metrics.measures.metric import Metric
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.subject_rdm import SubjectRDM


class PatternMetric(Metric):
    """Base of metrics that compare patterns. Subclasses set ``name``, ``title`` and write ``similarity``.

    A subclass may override :meth:`compare` to use more of an animal than its mean responses, or
    :meth:`compare_orders` where all orders can be computed at once.
    """

    def similarity(self, model: Floats, brain: Floats) -> float:
        """Return how alike features [K, F] and mean responses [K, U] are; larger is more alike."""
        raise UsageError(f"The metric {self.name or type(self).__name__!r} does not define similarity(model, brain).")

    def compare(self, model: Floats, brain: SubjectRDM) -> float:
        """Return the value for one layer and one animal; NaN where there is none."""
        return float(self.similarity(model, brain.patterns))

    def compare_orders(self, model: Floats, animals: Sequence[SubjectRDM], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        return np.array([[self.compare(model[order], animal) for animal in animals] for order in orders])

    def compare_layers(
        self, layers: Sequence[Floats], animals: Sequence[SubjectRDM], chunks: Iterable[Ints], device: Any = None
    ) -> Iterator[Floats]:
        """Yield raw comparisons [N, L, A] under the orders of each chunk."""
        for orders in chunks:
            yield np.stack([self.compare_orders(layer, animals, orders) for layer in layers], axis=1)


class LinearCKA(PatternMetric):
    """Linear centred kernel alignment (Kornblith 2019): the cosine of centred products over stimuli."""

    name = "cka"
    title = "linear centred kernel alignment of mean patterns"

    def similarity(self, model: Floats, brain: Floats) -> float:
        """Return tr(KL)/√(tr(KK) tr(LL)) of centred linear kernels K and L."""
        return float(np.sum(unit_products(model) * unit_products(brain)))

    def compare_orders(self, model: Floats, animals: Sequence[SubjectRDM], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        left = unit_products(model)
        right = np.stack([unit_products(animal.patterns) for animal in animals]).reshape(len(animals), -1)
        return left[orders[:, :, None], orders[:, None, :]].reshape(len(orders), -1) @ right.T


def centred_products(patterns: Floats) -> Floats:
    """Return the products [K, K] of patterns centred over stimuli."""
    centred = patterns - patterns.mean(axis=0)
    return centred @ centred.T


def unit_products(patterns: Floats, size: Callable[[Floats], Any] = np.linalg.norm) -> Floats:
    """Return the products [K, K] of centred patterns, of unit length or another size; NaN for constant ones."""
    products = centred_products(patterns)
    length = float(size(products))
    return products / length if length > 0 else np.full(products.shape, np.nan)


class Procrustes(PatternMetric):
    """Similarity of patterns up to rotation and scale.

    Patterns are centred over stimuli and scaled to unit size; the value is the cosine of the angular Procrustes
    distance of Williams et al. 2021, ‖XᵀY‖∗ (sum of singular values): 1 when a rotation and a scale make the patterns
    equal. It is not corrected for noise and is well above 0 for unrelated patterns (the permutation's mean score stands
    beside it).
    """

    name = "procrustes"
    title = "cosine of the angular Procrustes distance between mean patterns"
    orders = 199

    def similarity(self, model: Floats, brain: Floats) -> float:
        """Return ‖XᵀY‖∗ of centred, scaled patterns."""
        return float(_similarities(unit_products(model, np.trace), unit_products(brain, np.trace)[None])[0])

    def compare_orders(self, model: Floats, animals: Sequence[SubjectRDM], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        # Moving the model's stimuli is moving the animals' products [K, K] by the inverse order.
        place = np.argsort(orders, axis=1)
        left, *right = (unit_products(part, np.trace) for part in (model, *(animal.patterns for animal in animals)))
        return np.stack([_similarities(left, part[place[:, :, None], place[:, None, :]]) for part in right], axis=1)


def _similarities(left: Floats, right: Floats) -> Floats:
    """Return tr √(√L R √L) [N], the sum of singular values, from products [K, K] and [N, K, K]."""
    if not np.isfinite(left).all() or not np.isfinite(right).all():
        return np.full(len(right), np.nan)
    # With L = XXᵀ and R = YYᵀ the matrices are K × K, however many features and units there are; eigenvalues below zero
    # are rounding.
    values, vectors = np.linalg.eigh(left)
    root = (vectors * np.sqrt(np.maximum(values, 0))) @ vectors.T
    inner = np.linalg.eigvalsh(root @ right @ root)
    return np.sqrt(np.maximum(inner, 0)).sum(axis=-1)
