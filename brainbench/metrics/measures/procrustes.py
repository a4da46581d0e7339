"""Procrustes similarity: how well the best rotation carries one set of patterns onto another.

Patterns are centred over stimuli and scaled to unit size; the value is the cosine of the angular Procrustes distance of
Williams et al. 2021, ‖XᵀY‖∗ (sum of singular values): 1 when a rotation and a scale make the patterns equal. It is not
corrected for noise and is well above 0 for unrelated patterns (the permutation's mean score stands beside it).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from brainbench.metrics.measures.patterns import PatternMetric, centred_products
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.subject_rdm import SubjectRDM


class Procrustes(PatternMetric):
    """Similarity of patterns up to rotation and scale."""

    name = "procrustes"
    title = "cosine of the angular Procrustes distance between mean patterns"
    orders = 199

    def similarity(self, model: Floats, brain: Floats) -> float:
        """Return ‖XᵀY‖∗ of centred, scaled patterns."""
        if not np.isfinite(model).all() or not np.isfinite(brain).all():
            return math.nan
        return float(_similarities(_unit(model), _unit(brain)[None])[0])

    def compare_orders(self, model: Floats, animals: Sequence[SubjectRDM], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        # Moving the model's stimuli is moving the animals' products [K, K] by the inverse order.
        place = np.argsort(orders, axis=1)
        left = _unit(model)
        columns = [_similarities(left, _unit(a.patterns)[place[:, :, None], place[:, None, :]]) for a in animals]
        return np.stack(columns, axis=1)


def _unit(patterns: Floats) -> Floats:
    """Return the products [K, K] of centred patterns of unit size; NaN for constant ones."""
    products = centred_products(patterns)
    size = float(np.trace(products))
    return products / size if size > 0 else np.full(products.shape, np.nan)


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
