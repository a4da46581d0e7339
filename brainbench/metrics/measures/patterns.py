"""Metrics of patterns: models' features [K, F] against animals' mean responses [K, U].

Their base, linear CKA, the Procrustes distance, and ridge encoding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from brainbench.core.errors import UsageError
from brainbench.core.provenance import UniquePart
from brainbench.metrics.evaluation import most_chosen
from brainbench.metrics.inference.permutation import canonical_order
from brainbench.metrics.measures.metric import Metric
from brainbench.metrics.measures.unique import lacking, parted
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.noise_correction import Corrected, gated
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


PENALTIES = tuple(10.0**power for power in range(-3, 4))
"""Ridge penalties, relative to the mean square of the centred training features."""

FOLDS = 10


class RidgeEncoding(PatternMetric):
    """Ridge encoding: how much of the responses to a stimulus a model predicts from the other stimuli.

    A tenth of the stimuli (at least one) is left out in turn; responses of all units are predicted by ridge
    regression on the model's features, with the penalty chosen by leaving each training stimulus out. The corrected
    value is the share of explainable variance

        1 − (Σ (y − ŷ)² − N) / (Σ (y − ȳ)² − N)

    over left-out stimuli and units, where ȳ is the training mean and N the noise of the left-out means estimated from
    trials: 0 for a model that predicts no better than the training mean, negative for a worse one. Nothing is clamped.
    The raw value is that times the explainable share of an animal's variance. No model of few stimuli reaches 1, since
    what is special to a stimulus cannot be predicted from others: ``attainable`` is what an animal's own noiseless
    responses reach.
    """

    # Residuals are combinations of the responses, so their squares are linear in the K × K products of the responses:
    # units are never touched again, and all orders of the stimuli cost one matrix product.

    name = "ridge"
    title = "share of explainable variance that ridge regression predicts for stimuli left out"
    orders_between = 39
    of_unique_parts = True

    def correction(self, animal: SubjectRDM, estimator: str) -> Corrected:
        """Return the ratio of all variance to that without noise."""
        share = float(_explainable([animal])[0])
        if not share > 0:
            reason = "the variance between stimuli is no larger than trial noise explains"
            return Corrected(np.nan, "undefined", reason, reliability=animal.reliability)
        return gated(1 / share, animal.reliability)

    def compare_orders(self, model: Floats, animals: Sequence[SubjectRDM], orders: Ints) -> Floats:
        """Return raw values [N, A] with the model's stimuli in each order [N, K]."""
        error, base = _errors(model, animals, orders, _folds(len(model)))
        return _share(error, base, animals) * _explainable(animals)

    def compare_without(self, layers: Sequence[Floats], animals: Sequence[SubjectRDM]) -> Floats:
        """Return raw values [K, L, A] without each stimulus in turn; the others keep their folds and penalties.

        A stimulus also leaves the training of the others: without that, intervals of 14 stimuli were a quarter too
        narrow.
        """
        parts = [
            _banded(animals, np.zeros_like(kernel), [kernel], ONE_BAND) for kernel in map(centred_products, layers)
        ]
        return np.stack([without[0] for _, without, _ in parts]).T.swapaxes(1, 2) * _explainable(animals)

    def unique(
        self,
        layers: Mapping[str, Floats],
        controls: Mapping[str, Floats],
        animals: Sequence[SubjectRDM],
        factors: Floats,
        *,
        attainable: float = 1.0,
        committed: str | None = None,
        seed: int = 0,
    ) -> UniquePart:
        """Return what layers predict of left-out stimuli beyond controls, by banded ridge (Nunez-Elizalde 2019).

        Controls make one band and a layer the other. Layer, weight of the bands and penalty are chosen on the training
        stimuli of every fold, by leaving each of them out; the layer is that of all animals.
        """
        layers = {name: layer for name, layer in layers.items() if committed in (None, name) and self._complete(layer)}
        controls = {name: part for name, part in controls.items() if self._complete(part)}
        if reason := lacking(layers, controls, animals[0].count):
            return UniquePart("undefined", (reason,), controls=tuple(controls))
        order = canonical_order(np.stack([animal.rdm for animal in animals]))
        control = np.mean([unit_products(part[order], np.trace) for part in controls.values()], axis=0)
        kernels = [unit_products(layer[order], np.trace) for layer in layers.values()]
        shares, without, chosen = _banded([animal.take(order) for animal in animals], control, kernels)
        unique = (without[0] - without[1]).mean(axis=0) / attainable
        return parted(shares / attainable, unique, controls, list(layers)[most_chosen(chosen)], 0.0)

    def _complete(self, layer: Floats) -> bool:
        return bool(np.isfinite(layer).all()) and self.varies(layer)


BANDS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
"""Weights of a layer's kernel beside that of the controls, both of unit trace, from which both together choose."""
ONE_BAND = (1.0,)


def _banded(
    animals: Sequence[SubjectRDM], control: Floats, kernels: Sequence[Floats], bands: Sequence[float] = BANDS
) -> tuple[Floats, Floats, Ints]:
    """Return shares [3, A] by both bands, controls and layer, those without each stimulus [3, A, K], and the layers."""
    count, folds, weights = len(control), _folds(len(control)), np.array(bands)[:, None, None]
    products = np.stack([centred_products(animal.patterns) for animal in animals])
    flat, size = products.reshape(len(animals), -1), np.trace(products, axis1=1, axis2=2)
    last = len(PENALTIES)
    candidates = np.arange(len(bands) * last)
    sides = (candidates, candidates[:last], candidates[-last:])
    # Sums of squared errors: all, and without each stimulus; the last side is the training mean.
    sums, chosen = np.zeros((len(sides) + 1, len(animals), 1 + count)), []
    for fold in np.unique(folds):
        test, train = np.flatnonzero(folds == fold), np.flatnonzero(folds != fold)
        fits = [_fits((1 - weights) * control + weights * kernel, train, test) for kernel in kernels]
        losses = [
            (residuals.swapaxes(1, 2) @ residuals).reshape(len(residuals), -1) @ flat.T / size for residuals, _ in fits
        ]
        # Rounding chooses between no two layers that are equal.
        totals = np.array([loss.min(axis=0).sum() for loss in losses])
        layer = int(np.flatnonzero(totals <= totals.min() * (1 + _TIE))[0])
        chosen.append(layer)
        (residuals, combinations), loss = fits[layer], losses[layer]
        mean = np.zeros((count, count))
        mean[train] = _means(count, train, train) * len(train) / (len(train) - 1)
        for index, product in enumerate(products):
            best = [side[int(np.argmin(loss[side, index]))] for side in sides]
            pairs = [(residuals[place], combinations[place]) for place in best] + [(mean, _means(count, train, test))]
            for side, pair in enumerate(pairs):
                sums[side, index] += _errors_without(*pair, product, test)
    noise = np.array([animal.noise.sum(axis=1) for animal in animals])
    noise = noise.sum(axis=1, keepdims=True) - np.concatenate([np.zeros((len(noise), 1)), noise], axis=1)
    sums -= noise
    shares = 1 - sums[:-1] / np.where(sums[-1] > 0, sums[-1], np.nan)
    return shares[..., 0], shares[..., 1:], np.array(chosen)


_TIE = 1e-9


def _errors_without(residuals: Floats, combinations: Floats, products: Floats, test: Ints) -> Floats:
    """Return the squared error [1 + K] of left-out stimuli, of all and without each stimulus in turn.

    A training stimulus leaves a fit of a given penalty by its own residual [K, K] when it is predicted from the others.
    """
    moved = products @ combinations.T
    errors = (combinations.T * moved).sum(axis=0)
    size = ((residuals @ products) * residuals).sum(axis=1)
    without = errors - 2 * combinations.T * (residuals @ moved) + combinations.T**2 * size[:, None]
    without[test, np.arange(len(test))] = 0.0
    return np.concatenate([errors.sum(keepdims=True), without.sum(axis=1)])


def _share(error: Floats, base: Floats, animals: Sequence[SubjectRDM]) -> Floats:
    """Return the share [..., A] of the explainable variance that is predicted, of squared errors [..., A, K]."""
    noise = np.array([animal.noise.sum() for animal in animals])
    with np.errstate(invalid="ignore", divide="ignore"):
        explainable = base.sum(axis=-1) - noise
        return 1 - (error.sum(axis=-1) - noise) / np.where(explainable > 0, explainable, np.nan)


def _explainable(animals: Sequence[SubjectRDM]) -> Floats:
    """Return the share [A] of each animal's variance between stimuli that is not noise, whatever the folds."""
    # Deviations from the mean of the K − 1 other stimuli are K/(K − 1) of those from the mean of all.
    count = animals[0].count
    total = np.array([np.trace(centred_products(animal.patterns)) for animal in animals]) * (count / (count - 1)) ** 2
    noise = np.array([animal.noise.sum() for animal in animals])
    return 1 - noise * count / (count - 1) / np.where(total > 0, total, np.nan)


def _folds(count: int) -> Ints:
    """Return the fold [K] of each stimulus: every tenth, in the order that the animals give them, is of one fold."""
    return np.arange(count) % min(count, FOLDS)


def _errors(model: Floats, animals: Sequence[SubjectRDM], orders: Ints, folds: Ints) -> tuple[Floats, Floats]:
    """Return squared errors of the prediction and of the training mean [N, A, K], by the stimulus of the model."""
    count, kernel = len(model), centred_products(model)
    # Brain stimulus i stands at the model's stimulus order[i]: products are moved to the model's places.
    place = np.argsort(orders, axis=1)
    products = np.stack([centred_products(animal.patterns) for animal in animals])
    moved = products[:, place[:, :, None], place[:, None, :]].swapaxes(0, 1)
    flat = moved.reshape(-1, count * count)
    error, base = np.empty((len(flat), count)), np.empty((len(flat), count))
    for fold in np.unique(folds):
        test, train = np.flatnonzero(folds == fold), np.flatnonzero(folds != fold)
        residuals, combinations = _fits(kernel[None], train, test)
        inner = residuals.swapaxes(1, 2) @ residuals
        # The penalty with the least squared error over left-out training stimuli serves the fold, chosen anew for
        # every order.
        chosen = np.argmin(flat @ inner.reshape(len(PENALTIES), -1).T, axis=1)
        for index in np.unique(chosen):
            rows = np.flatnonzero(chosen == index)
            outer = np.einsum("ti,tj->tij", combinations[index], combinations[index]).reshape(len(test), -1)
            error[np.ix_(rows, test)] = flat[rows] @ outer.T
        means = _means(count, train, test)
        base[:, test] = flat @ np.einsum("ti,tj->tij", means, means).reshape(len(test), -1).T
    shape = (len(orders), len(animals), count)
    return error.reshape(shape), base.reshape(shape)


def _means(count: int, train: Ints, test: Ints) -> Floats:
    """Return combinations [test, K] that give a stimulus less the training mean."""
    combination = np.zeros((len(test), count))
    combination[np.arange(len(test)), test] = 1.0
    combination[:, train] -= 1 / len(train)
    return combination


def _fits(kernels: Floats, train: Ints, test: Ints) -> tuple[Floats, Floats]:
    """Return the combinations [M · Λ, K, K] and [M · Λ, test, K] that give residuals, per kernel [M, K, K] and penalty.

    The first are of training stimuli, each predicted from the others, the second of left-out ones.
    """
    count, size = kernels.shape[-1], len(train)
    # Centring by the training mean is the intercept, which is not penalised.
    centre = np.eye(size) - 1 / size
    square = kernels[:, train[:, None], train]
    inside = centre @ square @ centre
    across = (kernels[:, test[:, None], train] - square.mean(axis=1, keepdims=True)) @ centre
    # ŷ = k (K + λ·1)⁻¹ y: one eigendecomposition of a kernel serves all penalties.
    values, vectors = (part[:, None] for part in np.linalg.eigh(inside))
    values = np.maximum(values, 0)
    scale = np.maximum(np.trace(inside, axis1=1, axis2=2) / size, np.finfo(float).tiny)
    penalties = values + np.array(PENALTIES)[:, None] * scale[:, None, None]
    # Leaving one training stimulus out: its residual is that of the whole fit over 1 − its leverage.
    rest = np.eye(size) - 1 / size - (vectors * (values / penalties)[..., None, :]) @ vectors.swapaxes(-1, -2)
    residuals = np.zeros((*rest.shape[:2], count, count))
    residuals[:, :, train[:, None], train] = rest / np.diagonal(rest, axis1=-2, axis2=-1)[..., None]
    weights = across[:, None] @ (vectors / penalties[..., None, :]) @ vectors.swapaxes(-1, -2) @ centre
    combinations = np.tile(_means(count, train, test), (*rest.shape[:2], 1, 1))
    combinations[..., train] -= weights
    return residuals.reshape(-1, count, count), combinations.reshape(-1, len(test), count)
