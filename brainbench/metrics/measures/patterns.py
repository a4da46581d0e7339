"""Metrics of patterns: models' features [K, F] against animals' mean responses [K, U].

Their base, linear CKA, the Procrustes distance, ridge encoding, matched units (one to one, and soft matching by Khosla
and Williams 2023), and RDMs without what contacts, licks and choices explain.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.contracts import Trials
from brainbench.core.errors import DataError, UsageError
from brainbench.core.provenance import UniquePart
from brainbench.core.statistics import t_interval
from brainbench.metrics.arrays import Floats, Ints
from brainbench.metrics.evaluation import most_chosen
from brainbench.metrics.hooks import Layers
from brainbench.metrics.inference.permutation import SMALLEST_STIMULI, canonical_order, label_orders, tail_p
from brainbench.metrics.measures.metric import Metric
from brainbench.metrics.measures.rsa import lacking, parted
from brainbench.metrics.rdms.comparison import permuted_pairs, rdm_stack, stimulus_count, upper
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.reliability.noise_correction import Corrected, gated
from brainbench.metrics.reliability.subject_rdm import SubjectRDM, unit_order
from brainbench.metrics.stimulus_labels import stimulus_codes, stimulus_means


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
    chooses_anew = True

    def correction(self, animal: SubjectRDM, estimator: str) -> Corrected:
        """Return the ratio of all variance to that without noise."""
        share = float(_explainable([animal])[0])
        if not share > 0:
            reason = "the variance between stimuli is no larger than trial noise explains"
            return Corrected(np.nan, "undefined", reason, reliability=animal.reliability)
        return gated(1 / share, animal.reliability)

    def compare_orders(self, model: Floats, animals: Sequence[SubjectRDM], orders: Ints) -> Floats:
        """Return raw values [N, A] with the model's stimuli in each order [N, K]."""
        count, kernel, folds = len(model), centred_products(model), _folds(len(model))
        # Brain stimulus i stands at the model's stimulus order[i]: products are moved to the model's places.
        place = np.argsort(orders, axis=1)
        products = np.stack([centred_products(animal.patterns) for animal in animals])
        flat = products[:, place[:, :, None], place[:, None, :]].swapaxes(0, 1).reshape(-1, count * count)
        # Squared errors of the prediction and of the training mean.
        error, base = np.zeros((2, len(flat)))
        for fold in np.unique(folds):
            test, train = np.flatnonzero(folds == fold), np.flatnonzero(folds != fold)
            residuals, combinations = _fits(kernel[None], train, test)
            inner = residuals.swapaxes(1, 2) @ residuals
            # The penalty with the least squared error over left-out training stimuli serves the fold, chosen anew for
            # every order.
            chosen = np.argmin(flat @ inner.reshape(len(PENALTIES), -1).T, axis=1)
            for index in np.unique(chosen):
                rows = np.flatnonzero(chosen == index)
                error[rows] += flat[rows] @ (combinations[index].T @ combinations[index]).ravel()
            means = _means(count, train, test)
            base += flat @ (means.T @ means).ravel()
        noise = np.array([animal.noise.sum() for animal in animals])
        error, base = (part.reshape(len(orders), -1) - noise for part in (error, base))
        return (1 - error / np.where(base > 0, base, np.nan)) * _explainable(animals)

    def compare_without(self, layers: Sequence[Floats], animals: Sequence[SubjectRDM]) -> Floats:
        """Return raw values [K, L, A] without each stimulus in turn; the others keep their folds.

        A stimulus also leaves the training of the others and the choice of their penalties: intervals of given ones are
        too narrow where little is to be found.
        """
        parts = [
            _banded(animals, np.zeros_like(kernel), [kernel], BANDS[-1:]) for kernel in map(centred_products, layers)
        ]
        return np.stack([without[0] for _, without, _ in parts]).T.swapaxes(1, 2) * _explainable(animals)

    def unique(
        self, layers: Layers, controls: Layers, animals: Sequence[SubjectRDM], factors: Floats, **options: Any
    ) -> UniquePart:
        """Return what layers predict of left-out stimuli beyond controls, by banded ridge (Nunez-Elizalde 2019).

        Controls make one band and a layer the other. Layer, weight of the bands and penalty are chosen on the training
        stimuli of every fold, by leaving each of them out; the layer is that of all animals.
        """
        attainable, committed = options.get("attainable", 1.0), options.get("committed")
        layers, controls = (
            {name: part for name, part in side.items() if np.isfinite(part).all() and self.varies(part)}
            for side in ({committed: layers[committed]} if committed is not None else layers, controls)
        )
        no_scale = "" if attainable > 0 else "a perfect model could not be told from chance"
        if reason := lacking(layers, controls, animals[0].count) or no_scale:
            return UniquePart("undefined", (reason,), controls=tuple(controls))
        order = canonical_order(np.stack([animal.rdm for animal in animals]))
        control = np.mean([unit_products(part[order], np.trace) for part in controls.values()], axis=0)
        kernels = [unit_products(layer[order], np.trace) for layer in layers.values()]
        shares, without, chosen = _banded([animal.take(order) for animal in animals], control, kernels)
        unique = (without[0] - without[1]).mean(axis=0) / attainable
        return parted(shares / attainable, unique, controls, list(layers)[most_chosen(chosen)], 0.0)


BANDS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
"""Weights of a layer's kernel beside that of the controls, both of unit trace, from which both together choose."""
_TIE = 1e-9


def _banded(
    animals: Sequence[SubjectRDM], control: Floats, kernels: Sequence[Floats], bands: Sequence[float] = BANDS
) -> tuple[Floats, Floats, Ints]:
    """Return shares [3, A] by both bands, controls and layer, those without each stimulus [3, A, K], and the layers."""
    count, folds, weights = len(control), _folds(len(control)), np.array(bands)[:, None, None]
    products = np.stack([centred_products(animal.patterns) for animal in animals])
    size = np.trace(products, axis1=1, axis2=2)
    last = len(PENALTIES)
    candidates = np.arange(len(bands) * last)
    sides = (candidates, candidates[:last], candidates[-last:])
    # Sums of squared errors: all, and without each stimulus; the last side is the training mean.
    sums, chosen = np.zeros((len(sides) + 1, len(animals), 1 + count)), []
    for fold in np.unique(folds):
        test, train = np.flatnonzero(folds == fold), np.flatnonzero(folds != fold)
        fits = [_fits((1 - weights) * control + weights * kernel, train, test) for kernel in kernels]
        losses = np.stack([_losses_without(residuals, products) for residuals, _ in fits]) / size[:, None, None]
        # Rounding chooses between no two layers that are equal.
        totals = losses.min(axis=2).sum(axis=1)
        layer = np.argmax(totals <= totals.min(axis=0) * (1 + _TIE), axis=0)
        chosen.append(layer[0])
        mean = np.zeros((count, count))
        mean[train] = _means(count, train, train) * len(train) / (len(train) - 1)
        for index, product in enumerate(products):
            sums[-1, index] += _errors_without(mean, _means(count, train, test), product, test)
            for side, some in enumerate(sides):
                best = losses[layer, index, :, np.arange(1 + count)][:, some].argmin(axis=1) + some[0]
                for winner in {*zip(layer.tolist(), best.tolist(), strict=True)}:
                    rows = np.flatnonzero((layer == winner[0]) & (best == winner[1]))
                    residuals, combinations = (part[winner[1]] for part in fits[winner[0]])
                    sums[side, index, rows] += _errors_without(residuals, combinations, product, test)[rows]
    # The noise of all stimuli, and of all but each.
    sums -= np.stack([animal.noise.sum(axis=1) for animal in animals]) @ (1 - np.eye(count, 1 + count, 1))
    shares = 1 - sums[:-1] / np.where(sums[-1] > 0, sums[-1], np.nan)
    return shares[..., 0], shares[..., 1:], np.array(chosen)


def _losses_without(residuals: Floats, products: Floats) -> Floats:
    """Return squared errors [A, M, 1 + K] of training stimuli, each predicted from the others, of all and without each.

    Left out in pairs, stimulus i has the residual (rᵢ − Rᵢₖ rₖ) / (1 − Rᵢₖ Rₖᵢ) by residuals R of single ones.
    """
    places = np.arange(residuals.shape[-1])
    weights = 1 - residuals * residuals.swapaxes(1, 2)
    weights[:, places, places] = np.inf
    weights = weights**-2.0
    crossed, turned = residuals * weights, residuals.swapaxes(1, 2)
    squares, losses = (residuals * crossed).sum(axis=1), []
    for product in products:
        moved = residuals @ product @ turned
        size = np.diagonal(moved, axis1=1, axis2=2)
        pairs = (size[:, None] @ weights)[:, 0] - 2 * np.einsum("mik,mik->mk", crossed, moved) + squares * size
        losses.append(np.concatenate([size.sum(axis=1, keepdims=True), pairs], axis=1))
    return np.stack(losses)


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
        values = np.full(animal.patterns.shape[1], np.nan)
        values[_tuned(animal.patterns)] = np.divide(total, number, out=np.full(len(total), np.nan), where=number > 0)
        return values

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
        """Return the tunings of features [K, F] and of units [K, U], centred and of unit length.

        What never varies has no tuning that could be matched: silent units and features take no part.
        """
        features, units = (side[:, _tuned(side)] for side in (model, animal.patterns))
        features = features[:, self.chosen(features.shape[1], units.shape[1])]
        centred = (side - side.mean(axis=0) for side in (features, units))
        first, second = (side / np.linalg.norm(side, axis=0) for side in centred)
        return first, second


def _tuned(patterns: Floats) -> np.ndarray:
    """Return which columns [U] of patterns [K, U] vary by more than rounding leaves of a constant."""
    length = np.linalg.norm(patterns - patterns.mean(axis=0), axis=0)
    floor = 64 * np.finfo(float).eps * np.abs(patterns).max(axis=0, initial=0.0) * np.sqrt(len(patterns))
    return np.asarray(length > floor)


def _ordered(patterns: Floats) -> Floats:
    """Return units or features in an order that follows from their responses alone, for a sample of them is taken."""
    finite = patterns[np.isfinite(patterns).all(axis=1)]
    # Whatever the order of the stimuli; of equal values, what each has in common with all of them decides.
    common = finite.mean(axis=1) @ finite
    return patterns[:, unit_order(np.sort(finite, axis=0), np.stack([finite @ common**2 @ finite, common]))]


class OneToOne(UnitMatching):
    """Each unit has a feature of its own, so that the mean correlation is the largest (an assignment)."""

    name = "one-to-one"
    title = "mean correlation over stimuli of units with features of their own, matched one to one"


class SoftMatching(UnitMatching):
    """Equal masses of all units go to equal masses of all features, so that the mean correlation is the largest.

    This is the optimal transport between both. Where one side has a multiple of the other's number its solution is an
    assignment of copies; so the features of a larger layer are a random sample of a multiple of the units' number. Of a
    smaller layer there are as many copies as units: the rest after whole copies of all features is drawn at random, for
    a choice that suits the units is worth more than equal masses (.78 for .73 of 40 features and 60 units).
    """

    name = "soft-matching"
    title = "mean correlation over stimuli of units and features of equal masses, matched by optimal transport"
    value_error = math.nan  # features of large layers are drawn

    def layer(self, features: ArrayLike) -> Floats:
        """Return a layer's features [K, F] in an order of their own."""
        return _ordered(super().layer(features))

    def partner(self, animal: SubjectRDM, others: Sequence[SubjectRDM]) -> Floats:
        """Return the others' units in an order of their own."""
        return _ordered(super().partner(animal, others))

    def chosen(self, features: int, units: int) -> Ints:
        """Return a sample of the features, or copies of all and a sample: a multiple of the units in number."""
        if not features or not units:
            return np.arange(features)
        order = np.random.default_rng(features).permutation(features)
        if features < units:
            return np.concatenate([np.tile(np.arange(features), units // features), order[: units % features]])
        return np.sort(order[: units * (min(features, max(MOST_FEATURES, units)) // units)])

    def pairs(self, likeness: Floats) -> tuple[Ints, Ints]:
        """Return the units [M] and the features [M] that share mass; all shares are equal."""
        if not likeness.size:
            return super().pairs(likeness)
        copies = max(1, likeness.shape[1] // len(likeness))
        rows, columns = super().pairs(likeness.repeat(copies, axis=0))
        return rows // copies, columns


@dataclass(frozen=True)
class VariancePartition:
    """Shares of the variance of animals' RDMs, averaged over animals; they add up to ``total``."""

    total: float
    """R² of model and nuisances together."""
    unique_model: float
    """R² that is lost without the model, never negative in a fit to the same pairs."""
    unique_nuisance: float
    """R² that is lost without the nuisances."""
    shared: float
    """R² that either explains; negative where one hides the other (suppression)."""
    partial_r: float
    """Mean correlation of model and animals, both without what the nuisances explain linearly."""
    p: float
    """P(partial r under permuted stimuli of the model ≥ observed); NaN below 4 stimuli."""
    chance: float
    """Mean unique share of the model under permutation: what fitting few pairs gives for nothing."""
    nuisances: tuple[str, ...]
    reason: str = ""
    """Reason for an undefined p; empty otherwise."""


def variance_partition(
    model_rdm: ArrayLike, nuisance_rdms: Mapping[str, ArrayLike], brain_rdms: ArrayLike, *, seed: int = 0
) -> VariancePartition:
    """Partition the variance of animals' RDMs [A, P] between a model's RDM [P] and nuisance RDMs.

    Ordinary least squares per animal, with an intercept; the R² are averaged over animals. The p-value permutes the
    model's stimuli, as in :func:`permutation_test`, and tests the partial correlation.
    """
    if not nuisance_rdms:
        raise UsageError("There are no nuisances; give the RDM of at least one, or use permutation_test.")
    model = rdm_stack(model_rdm, "model_rdm")
    brain = np.atleast_2d(rdm_stack(brain_rdms, "brain_rdms"))
    rivals = np.stack([rdm_stack(given, f"The nuisance {name!r}") for name, given in nuisance_rdms.items()])
    pairs = brain.shape[1]
    if model.shape != (pairs,) or rivals.shape[1:] != (pairs,):
        raise UsageError(f"RDMs have different numbers of stimuli: {model.shape}, {rivals.shape[1:]} and {(pairs,)}.")
    if not all(np.isfinite(part).all() for part in (model, brain, rivals)):
        raise DataError("An RDM has missing pairs; variance can be partitioned over complete RDMs only.")
    if pairs < len(rivals) + 3:
        raise DataError(f"{pairs} pairs are too few to fit {len(rivals)} nuisances and a model; use fewer nuisances.")
    stimuli = stimulus_count(pairs)
    # In an order of the stimuli that the data fix, random permutations do not depend on how stimuli were listed.
    order = permuted_pairs(canonical_order(brain)[None])[0]
    model, brain, rivals = model[order], brain[:, order], rivals[:, order]
    rest = _without(rivals)
    residual = brain @ rest
    scale = ((brain - brain.mean(axis=1, keepdims=True)) ** 2).sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        # R² of each model from sums of squares: residual after the nuisances, and the projection on the model alone.
        by_nuisance = 1 - (residual**2).sum(axis=1) / scale
        partial, unique = _partial(model[None], rest, residual, scale)
        centred = model - model.mean()
        by_model = (brain @ centred) ** 2 / (centred @ centred) / scale
    # R² of both = R² of the nuisances + unique share of the model; the other shares are differences.
    total = by_nuisance + unique[0]
    reason, p, chance = "", math.nan, math.nan
    if stimuli < SMALLEST_STIMULI:
        reason = f"{stimuli} stimuli are too few to permute; at least {SMALLEST_STIMULI} are needed"
    elif not np.isfinite(partial).all():
        reason = "the model or an animal varies no more than the nuisances explain"
    else:
        chunks = [
            _partial(model[permuted_pairs(orders)], rest, residual, scale)
            for orders in label_orders(stimuli, seed, step=4096)
        ]
        null = np.concatenate([item[0] for item in chunks]).mean(axis=1)
        p = float(tail_p(null))
        chance = float(np.concatenate([item[1] for item in chunks]).mean())
    return VariancePartition(
        total=float(total.mean()),
        unique_model=float(unique[0].mean()),
        unique_nuisance=float((total - by_model).mean()),
        shared=float((by_model - unique[0]).mean()),
        partial_r=float(partial[0].mean()),
        p=p,
        chance=chance,
        nuisances=tuple(nuisance_rdms),
        reason=reason,
    )


def partial_correlations(models: Floats, nuisances: Floats, brain: Floats) -> Floats:
    """Return correlations [N] of models [N, P] with an animal [P], both without what nuisances [J, P] explain linearly.

    NaN where nothing is left of either, or where the pairs are too few for so many nuisances.
    """
    # Intercept, nuisances and model must leave one degree of freedom.
    if len(brain) < len(nuisances) + 3:
        return np.full(len(models), np.nan)
    rest = _without(nuisances)
    residual = (brain @ rest)[None]
    centred = brain - brain.mean()
    if not (residual**2).sum() > 1e-20 * (centred**2).sum():
        return np.full(len(models), np.nan)
    return _partial(models, rest, residual, np.array([(centred**2).sum()]))[0][:, 0]


def _without(rivals: Floats) -> Floats:
    """Return the symmetric projection [P, P] that takes away an intercept and the nuisances."""
    pairs = rivals.shape[1]
    basis = np.concatenate([np.ones((1, pairs)), rivals - rivals.mean(axis=1, keepdims=True)])
    basis /= np.maximum(np.linalg.norm(basis, axis=1, keepdims=True), np.finfo(float).tiny)
    # 1 − UUᵀ with an orthonormal basis U of intercept and nuisances; the SVD drops collinear ones.
    left, values, _ = np.linalg.svd(basis.T, full_matrices=False)
    left = left[:, values > values[0] * 1e-10]
    return np.eye(pairs) - left @ left.T


def _partial(models: Floats, rest: Floats, residual: Floats, scale: Floats) -> tuple[Floats, Floats]:
    """Return partial correlations and unique shares [N, A] of models [N, P] with animals' residuals [A, P]."""
    # With residuals a, b: r = a·b/(|a||b|), and R² grows by (a·b)²/(|a|² Σ(y − ȳ)²) when the model is added.
    left = models @ rest
    size = (left**2).sum(axis=1)[:, None]
    size = np.where(size > 1e-20 * (models**2).sum(axis=1)[:, None], size, np.nan)
    product = left @ residual.T
    return product / np.sqrt(size * (residual**2).sum(axis=1)), product**2 / size / scale


class PartialRSA(PatternMetric):
    """Partial correlation between RDMs of correlation distances, given nuisance RDMs."""

    name = "rsa-partial"
    title = "correlation between RDMs without what contacts, licks and choices explain"

    brain_method = "correlation"
    comparison = "pearson"
    of_covariates = True

    def animal(self, subject: str, blocks: Sequence[Trials], n_stimuli: int, **options: Any) -> SubjectRDM:
        """Return the animal with its nuisance RDMs; without any it cannot be used."""
        animal = super().animal(subject, blocks, n_stimuli, **options)
        nuisances, lacking = _nuisances(blocks, n_stimuli)
        if animal.problem is None and not nuisances:
            absent = f" ({', '.join(lacking)} do not)" if lacking else ""
            return replace(animal, problem=f"no contacts, licks or choices that differ between stimuli{absent}")
        return replace(animal, nuisances=nuisances)

    def compare_orders(self, model: Floats, animals: Sequence[SubjectRDM], orders: Ints) -> Floats:
        """Return values [N, A] with the model's stimuli in each order [N, K]."""
        permuted = rdm(model)[permuted_pairs(orders)]
        values = np.full((len(orders), len(animals)), np.nan)
        for column, animal in enumerate(animals):
            brain = rdm(animal.patterns)
            # Nothing is known of what else animals felt whose units were joined.
            if animal.nuisances and np.isfinite(brain).all():
                values[:, column] = partial_correlations(permuted, np.stack(list(animal.nuisances.values())), brain)
        return values

    def statistics(self, layer: Floats, animals: Sequence[SubjectRDM], seed: int) -> dict[str, Any]:
        """Return the shares of variance of the chosen layer, averaged over animals."""
        if not np.isfinite(layer).all():
            return {}
        parts = [variance_partition(rdm(layer), one.nuisances, rdm(one.patterns), seed=seed) for one in animals]
        names = ("total", "unique_model", "unique_nuisance", "shared", "chance")
        nuisances = sorted({name for part in parts for name in part.nuisances})
        shares = {name: float(np.mean([getattr(part, name) for part in parts])) for name in names}
        return {"variance_partition": {**shares, "nuisances": nuisances}}


def _nuisances(blocks: Sequence[Trials], count: int) -> tuple[dict[str, Floats], list[str]]:
    """Return the RDM of every covariate with a value for all stimuli and a difference between some, and the others."""
    # Sessions without two trials of each stimulus are no part of the animal's RDM either.
    blocks = [block for block in blocks if np.bincount(block.labels, minlength=count).min() > 1]
    labels = [stimulus_codes(block.labels, count)[0] for block in blocks]
    rdms, lacking = {}, []
    for name in dict.fromkeys(name for block in blocks for name in block.covariates):
        values = [
            np.asarray(block.covariates.get(name, np.full(len(codes), math.nan)), dtype=np.float64)
            for block, codes in zip(blocks, labels, strict=True)
        ]
        means = stimulus_means(np.concatenate(values)[:, None], np.concatenate(labels), count)[:, 0]
        if np.isfinite(means).all() and np.ptp(means) > 0:
            rdms[name] = upper(np.abs(means[:, None] - means))
        else:
            lacking.append(name)
    return rdms, lacking
