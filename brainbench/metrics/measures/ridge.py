"""Ridge encoding: how much of the responses to a stimulus a model predicts from the other stimuli.

Every stimulus (or tenth of them) is left out in turn; responses of all units are predicted by ridge
regression on the model's features, with the penalty chosen by a second cross-validation inside the
training stimuli. The value is the share of explainable variance

    1 − (Σ (y − ŷ)² − N) / (Σ (y − ȳ)² − N)

over left-out stimuli and units, where ȳ is the training mean and N the noise of the left-out means
estimated from trials: 1 for a perfect model, 0 for one that predicts no better than the training mean,
negative for a worse one. Nothing is clamped.

Residuals are combinations of the responses, so their squares are linear in the K × K products of the
responses: units are never touched again, and all orders of the stimuli cost one matrix product.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from brainbench.metrics.measures.animal_patterns import AnimalPatterns
from brainbench.metrics.measures.patterns import PatternMetric
from brainbench.metrics.rdms.pairs import Floats, Ints

PENALTIES = tuple(10.0**power for power in range(-3, 4))
"""Ridge penalties, relative to the mean square of the centred training features."""

FOLDS = 10


class RidgeEncoding(PatternMetric):
    """Cross-validated ridge regression from features to units."""

    name = "ridge"
    title = "share of explainable variance that ridge regression predicts for stimuli left out"
    corrected = True

    def compare(self, model: Floats, brain: AnimalPatterns) -> float:
        """Return the share of explainable variance that features [K, F] predict."""
        return float(self.compare_orders(model, [brain], np.arange(len(model))[None])[0, 0])

    def compare_orders(self, model: Floats, animals: Sequence[AnimalPatterns], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        count = len(model)
        folds = np.arange(count) * min(count, FOLDS) // count
        centred = model - model.mean(axis=0)
        kernel = centred @ centred.T
        # Brain stimulus i stands at the model's stimulus order[i]: products are moved to the model's places.
        place = np.argsort(orders, axis=1)
        products = np.stack([animal.patterns @ animal.patterns.T for animal in animals])
        noise = np.stack([animal.noise.sum(axis=1) for animal in animals])
        moved = products[:, place[:, :, None], place[:, None, :]].reshape(len(animals) * len(orders), -1)
        error = np.zeros(len(moved))
        base = np.zeros(len(moved))
        for fold in np.unique(folds):
            test, train = np.flatnonzero(folds == fold), np.flatnonzero(folds != fold)
            # Nested cross-validation: each training stimulus is left out in turn, and the penalty with the least
            # squared error over them serves the outer fold, chosen anew for every order.
            inner = np.stack([_squares(kernel, np.delete(train, t), train[t : t + 1]) for t in range(len(train))])
            chosen = np.argmin(moved @ inner.sum(axis=0).reshape(len(PENALTIES), -1).T, axis=1)
            outer = _squares(kernel, train, test).reshape(len(PENALTIES), -1)
            error += (moved @ outer.T)[np.arange(len(moved)), chosen]
            base += moved @ _residual_squares(_means(count, train, test)).ravel()
        total_noise = np.repeat(noise.sum(axis=1), len(orders))
        # The equation of the module's text; there is no value where noise explains all.
        with np.errstate(invalid="ignore", divide="ignore"):
            explainable = base - total_noise
            value = 1 - (error - total_noise) / np.where(explainable > 0, explainable, np.nan)
        return value.reshape(len(animals), len(orders)).T


def _means(count: int, train: Ints, test: Ints) -> Floats:
    """Return combinations [test, K] that give a stimulus less the training mean."""
    combination = np.zeros((len(test), count))
    combination[np.arange(len(test)), test] = 1.0
    combination[:, train] -= 1 / len(train)
    return combination


def _squares(kernel: Floats, train: Ints, test: Ints) -> Floats:
    """Return, per penalty, the matrix [Λ, K, K] whose product with Y Yᵀ is the squared error on ``test``."""
    count, size = len(kernel), len(train)
    # Centring by the training mean is the intercept, which is not penalised.
    centre = np.eye(size) - 1 / size
    inside = centre @ kernel[np.ix_(train, train)] @ centre
    across = (kernel[np.ix_(test, train)] - kernel[np.ix_(train, train)].mean(axis=0)) @ centre
    # ŷ = k (K + λ·1)⁻¹ y: one eigendecomposition of the kernel serves all penalties.
    values, vectors = np.linalg.eigh(inside)
    scale = max(float(np.trace(inside)) / size, np.finfo(float).tiny)
    found = np.empty((len(PENALTIES), count, count))
    for index, penalty in enumerate(PENALTIES):
        weight = across @ (vectors / (np.maximum(values, 0) + penalty * scale)) @ vectors.T @ centre
        combination = _means(count, train, test)
        combination[:, train] -= weight
        found[index] = _residual_squares(combination)
    return found


def _residual_squares(combination: Floats) -> Floats:
    return combination.T @ combination
