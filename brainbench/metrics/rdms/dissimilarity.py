"""Representational dissimilarity matrices (RDMs).

Conventions are those of rsatoolbox 0.3.2: distances are squared and divided by the number of units,
correlation distance is 1 − r, and the result is the upper triangle [P], row by row.

Responses may be numpy arrays or torch tensors on any device. Tensors are computed where they lie and
numpy arrays on the processor, unless ``device`` says otherwise; everything is float64 in slices of units,
so the numbers are the same and little memory is needed there. RDMs come back as numpy arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import DataError, UsageError, check_name, check_number
from brainbench.metrics.arrays import (
    Array,
    Floats,
    Ints,
    cholesky,
    fetch,
    find_device,
    is_tensor,
    library,
    place,
    slices,
    solve_lower,
)
from brainbench.metrics.rdms.comparison import upper
from brainbench.metrics.stimulus_labels import labelled_trials, response_matrix, stimulus_means, tensor_means

_DUAL_RIDGE = 1e-3
"""Share of the diagonal that must not come from trials for the products by Woodbury to keep their digits."""


@dataclass(frozen=True)
class NoiseModel:
    """The covariance S (α·1 + β ZᵀZ) S."""

    method: str
    scale: Array = field(repr=False)
    """[U] diagonal of S."""
    ridge: float
    """α."""
    trials: Array = field(repr=False)
    """[R, U] Z."""
    weight: float
    """β."""

    @property
    def dual(self) -> bool:
        """True when inner products of trials are fewer numbers than those of units, and good enough."""
        trials, units = self.trials.shape
        power = float((self.trials * self.trials).mean()) * trials
        return trials < units and self.ridge >= _DUAL_RIDGE * (self.ridge + self.weight * power)

    def sides(self, left: Array, right: Array) -> tuple[Array, Array]:
        """Return vectors [N, V] and [M, V] whose inner products are those of both sides with C⁻¹ between them."""
        same = left is right
        left = left / self.scale
        right = left if same else right / self.scale
        if not self.weight:
            return left, right / self.ridge
        if not self.dual:
            # a C⁻¹ b = (L⁻¹a)·(L⁻¹b) with C = L Lᵀ: triangular systems, no inverse is formed.
            factor = self._factor()
            first = solve_lower(factor, left.T).T
            return first, first if same else solve_lower(factor, right.T).T
        # Woodbury's identity of the module's text: a factor [R, R] in place of one [U, U].
        xp, factor = library(left), self._dual_factor()
        first = solve_lower(factor, self.trials @ left.T).T
        second = first if same else solve_lower(factor, self.trials @ right.T).T
        join = xp.cat if is_tensor(left) else np.concatenate
        return join([left, first], -1), join([right, -second], -1) / self.ridge

    def precision(self) -> Array:
        """Return C⁻¹ [U, U]."""
        xp = library(self.scale)
        eye = xp.diag(xp.ones_like(self.scale))
        if not self.weight:
            inner = eye / self.ridge
        elif self.dual:
            # C⁻¹ = (1 − HᵀH)/α with H = L⁻¹Z, by the same identity.
            half = solve_lower(self._dual_factor(), self.trials)
            inner = (eye - half.T @ half) / self.ridge
        else:
            inner = _inverse(self._factor())
        return inner / (self.scale[:, None] * self.scale)

    def _factor(self) -> Array:
        inner = self.weight * (self.trials.T @ self.trials)
        library(inner).einsum("ii->i", inner)[...] += self.ridge
        factor = cholesky(inner)
        # A factor exists for a numerically singular matrix too; its pivots tell.
        pivots = None if factor is None else factor.diagonal()
        limit = np.sqrt(len(inner) * np.finfo(float).eps)
        if factor is None or pivots is None or bool(pivots.min() <= pivots.max() * limit):
            raise DataError(
                f"The noise covariance of {len(inner)} units (method={self.method!r}) is singular: there are too few "
                "trials for this many units; use method='shrinkage_diag'."
            )
        return factor

    def _dual_factor(self) -> Array:
        inner = self.trials @ self.trials.T
        library(inner).einsum("ii->i", inner)[...] += self.ridge / self.weight
        factor = cholesky(inner)
        if factor is None:
            raise DataError(f"The noise covariance (method={self.method!r}) is not positive definite.")
        return factor


def noise_precision(
    responses: ArrayLike, labels: ArrayLike, *, method: str = "shrinkage_diag", device: Any = None
) -> Floats:
    """Return the inverse covariance [U, U] of trial-to-trial noise.

    Residuals are trials minus their stimulus' mean, with R − K degrees of freedom (rsatoolbox's
    ``prec_from_unbalanced``). Trials with a missing entry are left out.

    Args:
        responses: Trials [R, U].
        labels: Stimulus of each trial [R].
        method: ``shrinkage_diag`` towards the diagonal (Schäfer & Strimmer 2005), ``shrinkage_eye``
            towards a multiple of the identity (Ledoit & Wolf 2004), ``diag``, or ``full``.
        device: Torch device to compute on, see :func:`brainbench.metrics.rdm`.
    """
    trials, codes, names = labelled_trials(responses, labels)
    model = estimate_noise(trials, codes, len(names), method, device=find_device(device, responses))
    return fetch(model.precision())


def estimate_noise(trials: Any, codes: Ints, count: int, method: str, *, device: Any = None) -> NoiseModel:
    """Return the covariance of trials [R, U] about the means of their ``count`` stimuli, on the device."""
    check_name("noise covariance method", method, NOISE_METHODS)
    # Residuals are small beside the products of units that follow, so they are always made by numpy.
    trials = np.asarray(fetch(trials), dtype=np.float64)
    # Products between units need both entries of a trial; filling one would invent covariance.
    complete = ~np.isnan(trials).any(axis=1)
    if not complete.all():
        trials, codes = trials[complete], codes[complete]
    # Every stimulus' mean takes one degree of freedom.
    freedom = len(trials) - len(np.unique(codes))
    if freedom < 1:
        raise DataError(
            f"A noise covariance needs more complete trials than stimuli; there are {len(trials)} complete trials of "
            f"{len(np.unique(codes))} stimuli."
        )
    residuals = trials - stimulus_means(trials, codes, count)[codes]
    spread = np.maximum(residuals.max(axis=0), -residuals.min(axis=0))
    largest = np.maximum(trials.max(axis=0), -trials.min(axis=0))
    silent = int((spread <= 8 * np.finfo(float).eps * largest).sum())
    if silent:
        raise DataError(
            f"{silent} of {trials.shape[1]} units never vary between trials of a stimulus, so their noise has no "
            "inverse; remove them first."
        )
    return _ESTIMATES[method](residuals if device is None else place(residuals, device), freedom)


def _shrinkage_diag(residuals: Array, freedom: int) -> NoiseModel:
    """Shrink correlations (Schäfer & Strimmer 2005); sums over pairs of units from products of trials."""
    # rsatoolbox divides by the number of rows less one here, whatever the degrees of freedom.
    count = len(residuals)
    deviation = _deviation(residuals, freedom)
    scaled = residuals / deviation
    squares = scaled * scaled
    variances, fourth = squares.sum(0), float((squares * squares).sum())
    # λ = Σ Var(r_ij) / Σ r_ij² over pairs of units i ≠ j, limited to 0 … 1; both sums come from products of trials.
    signal = max(_pair_sum(scaled) - float((variances * variances).sum()), 0.0) / (count - 1) ** 2
    together = float((squares.sum(1) ** 2).sum()) - fourth
    spread = count / freedom**2 * (together / (count - 1) - signal)
    amount = min(max(spread / signal, 0.0), 1.0) if signal > 0 else 1.0
    return NoiseModel("shrinkage_diag", deviation, amount, scaled, (1 - amount) / freedom)


def _shrinkage_eye(residuals: Array, freedom: int) -> NoiseModel:
    """Shrink to a multiple of the identity (Ledoit & Wolf 2004)."""
    count, units = residuals.shape
    squares = residuals * residuals
    # m = tr S/U, d² = ‖S − m·1‖², b² = mean ‖z zᵀ − S‖²/R; the amount is min(b², d²)/d² (Ledoit & Wolf 2004).
    target = float(squares.sum()) / count / units
    square = _pair_sum(residuals) / count**2
    distance = max(square - units * target**2, 0.0)
    error = (float((squares.sum(1) ** 2).sum()) / count - square) / count
    amount = min(error, distance) / distance if distance > 0 else 1.0
    ones = library(residuals).ones_like(residuals[0])
    return NoiseModel("shrinkage_eye", ones, amount * target * count / freedom, residuals, (1 - amount) / freedom)


def _deviation(residuals: Array, freedom: int) -> Array:
    return library(residuals).sqrt((residuals * residuals).sum(0) / freedom)


def _pair_sum(residuals: Array) -> float:
    """Return ‖XᵀX‖² of residuals [R, U] by the smaller of XᵀX and XXᵀ, which have the same."""
    turned = residuals if residuals.shape[0] <= residuals.shape[1] else residuals.T
    products = turned @ turned.T
    return float((products * products).sum())


def _inverse(factor: Array) -> Array:
    if is_tensor(factor):
        return library(factor).cholesky_inverse(factor)
    # potri inverts from the factor and fills the lower triangle alone.
    from scipy.linalg import get_lapack_funcs

    (invert,) = get_lapack_funcs(("potri",), (factor,))
    lower, _ = invert(factor, lower=1)
    return np.tril(lower) + np.tril(lower, -1).T


_ESTIMATES: dict[str, Callable[[Array, int], NoiseModel]] = {
    "shrinkage_diag": _shrinkage_diag,
    "shrinkage_eye": _shrinkage_eye,
    "diag": lambda residuals, freedom: NoiseModel("diag", _deviation(residuals, freedom), 1.0, residuals, 0.0),
    "full": lambda residuals, freedom: NoiseModel(
        "full", library(residuals).ones_like(residuals[0]), 0.0, residuals, 1.0 / freedom
    ),
}

NOISE_METHODS = tuple(_ESTIMATES)


_SLICE_ELEMENTS = 1 << 22
_ROUNDING = 8 * np.finfo(np.float64).eps
"""A pattern whose spread is below this share of its size is constant up to rounding."""


def correlation_distances(patterns: Array, *, missing: bool = False, device: Any = None) -> Array:
    """Return 1 − Pearson correlation between patterns [..., K, U] as [..., P].

    A constant pattern, and without ``missing`` one with a non-finite entry, has NaN pairs. With
    ``missing`` NaN entries are left out: each pair uses the units present in both patterns.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if missing and not library(patterns).isfinite(patterns).all():
            return _correlation_of_present(place(patterns, device))
        units = patterns.shape[-1]
        total: Any = 0.0
        gram: Any = 0.0
        rest: Any = 0.0
        for _, part in slices(patterns, _SLICE_ELEMENTS, device):
            total = total + part.sum(-1)
        # Two passes, mean first: Σx² − (Σx)²/U in one pass loses the digits of a large offset.
        mean = total / units
        for _, part in slices(patterns, _SLICE_ELEMENTS, device):
            centred = part - mean[..., None]
            rest = rest + centred.sum(-1)
            gram = gram + centred @ centred.swapaxes(-1, -2)
        # The mean of a large offset is rounded; what it missed is a second mean.
        gram -= rest[..., :, None] * rest[..., None, :] / units
        return correlation_from_gram(gram, units * (_ROUNDING * abs(mean)) ** 2)


def correlation_from_gram(gram: Array, floor: Array) -> Array:
    """Return 1 − Pearson correlation [..., P] from products of centred patterns [..., K, K].

    Patterns whose square is not above ``floor`` [..., K] are constant and have NaN pairs.
    """
    xp = library(gram)
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = xp.einsum("...ii->...i", gram)
        length = xp.sqrt(xp.where(squares > floor, squares, np.nan))
        return 1.0 - upper(gram) / upper(length[..., :, None] * length[..., None, :])


def product_distances(left: Array, right: Array, *, missing: bool = False, device: Any = None) -> Array:
    """Return Σ_u (a_i − a_j)(b_i − b_j) / U for patterns a, b [..., K, U] as [..., P].

    With a = b this is the squared Euclidean distance per unit; with b = a·precision Mahalanobis;
    with a, b from two folds crossnobis; with b = log a the symmetrised Poisson divergence.
    """
    xp = library(left)
    with np.errstate(invalid="ignore", over="ignore"):
        units = left.shape[-1]
        present = xp.isfinite(left) & xp.isfinite(right) if missing else None
        if present is not None and not present.all():
            return _products_of_present(place(left, device), place(right, device))
        gram = 0.0
        pairs = zip(slices(left, _SLICE_ELEMENTS, device), slices(right, _SLICE_ELEMENTS, device), strict=True)
        for (_, a), (_, b) in pairs:
            # Differences do not feel a shift per unit, products lose digits to it.
            gram = gram + without_shift(a) @ without_shift(b).swapaxes(-1, -2)
        return products_from_gram(gram, units)


def without_shift(patterns: Array) -> Array:
    """Return patterns [..., K, U] less each unit's mean; a unit with a non-finite entry stays as it is."""
    mean = patterns.mean(-2)[..., None, :]
    xp = library(mean)
    return patterns - xp.where(xp.isfinite(mean), mean, 0.0)


def products_from_gram(gram: Array, units: int) -> Array:
    """Return (g_ii + g_jj − g_ij − g_ji) / U as [..., P] from products g_ij = a_i·b_j [..., K, K]."""
    xp = library(gram)
    squares = xp.einsum("...ii->...i", gram)
    squares = xp.where(xp.isfinite(squares), squares, np.nan)
    total = squares[..., :, None] + squares[..., None, :] - gram - gram.swapaxes(-1, -2)
    return upper(total) / units


def _products_of_present(left: Array, right: Array) -> Array:
    xp = library(left)
    present = xp.isfinite(left) & xp.isfinite(right)
    weight = xp.where(present, xp.ones_like(left), 0.0)
    a = xp.where(present, left - _unit_mean(left, present, weight), 0.0)
    b = xp.where(present, right - _unit_mean(right, present, weight), 0.0)
    turned = weight.swapaxes(-1, -2)
    # Σ (a_i − a_j)(b_i − b_j) over the units of both = own_ij + own_ji − cross_ij − cross_ji, over their number.
    both, sums, cross = weight @ turned, (a * b) @ turned, a @ b.swapaxes(-1, -2)
    total = sums + sums.swapaxes(-1, -2) - cross - cross.swapaxes(-1, -2)
    return upper(xp.where(both > 0, total / xp.where(both > 0, both, 1.0), np.nan))


def _unit_mean(patterns: Array, present: Array, weight: Array) -> Array:
    filled = library(patterns).where(present, patterns, 0.0)
    return (filled.sum(-2) / weight.sum(-2).clip(1.0))[..., None, :]


def _correlation_of_present(patterns: Array) -> Array:
    xp = library(patterns)
    present = xp.isfinite(patterns)
    filled = xp.where(present, patterns, 0.0)
    weight = xp.where(present, xp.ones_like(patterns), 0.0)
    mean = (filled.sum(-1) / weight.sum(-1).clip(1.0))[..., None]
    x = xp.where(present, patterns - mean, 0.0)
    turned = weight.swapaxes(-1, -2)
    # Over the units that a pair shares: n, Σx, Σx² − (Σx)²/n and Σxy − Σx Σy/n, all pairs by matrix products.
    both = weight @ turned
    sums = x @ turned
    scatter = (x * x) @ turned - sums**2 / both
    product = x @ x.swapaxes(-1, -2) - sums * sums.swapaxes(-1, -2) / both
    floor = both * (_ROUNDING * xp.amax(abs(filled), -1))[..., :, None] ** 2
    scatter = xp.where((both >= 2) & (scatter > floor), scatter, np.nan)
    return upper(1.0 - product / xp.sqrt(scatter * scatter.swapaxes(-1, -2)))


POISSON_PRIOR_MEAN = 1.0
POISSON_PRIOR_WEIGHT = 0.1  # gamma prior that keeps the logarithm of a silent unit finite (rsatoolbox's defaults)

_ASYMMETRY = 1e-6  # largest difference across the diagonal of a noise precision, as a share of its largest number


@dataclass(frozen=True)
class _Responses:
    """Responses of K stimuli as given, and for labelled trials the codes of their stimuli."""

    responses: Array
    count: int
    codes: Ints | None
    """Of trials, whose NaN means not recorded; a NaN activation makes its pattern useless instead."""
    folds: ArrayLike | None
    precision: ArrayLike | str | None
    device: Any  # torch device, or None for numpy

    def patterns(self) -> Array:
        """Return patterns [K, U], unlabelled ones as given."""
        return self.responses if self.codes is None else self.means(self.codes, self.count)

    def means(self, cells: Ints, count: int) -> Array:
        """Return the mean response [count, U] to the trials of each cell."""
        if self.device is None:
            return stimulus_means(self.responses, cells, count)
        return tensor_means(self.responses, cells, count, self.device)

    def sides(self, left: Array, right: Array) -> tuple[Array, Array]:
        """Return vectors whose inner products are those of ``left`` and ``right`` with the precision between."""
        if self.precision is None:
            return left, right
        if isinstance(self.precision, str):
            if self.codes is None:
                raise UsageError(
                    f"The noise covariance {self.precision!r} is estimated from trials: give labels, or a matrix as "
                    "precision."
                )
            noise = estimate_noise(self.responses, self.codes, self.count, self.precision, device=self.device)
            return noise.sides(left, right)
        units = left.shape[-1]
        shape = tuple(np.shape(self.precision))
        if shape != (units, units):
            raise UsageError(f"The noise precision of {units} units has shape ({units}, {units}); received {shape}.")
        precision = place(self.precision, self.device)
        scale = abs(precision).max()
        if not (abs(precision - precision.T).max() <= _ASYMMETRY * scale and (precision.diagonal() > 0).all()):
            raise UsageError("A noise precision is a symmetric matrix of numbers with a positive diagonal.")
        return left, right @ precision


def rdm(
    responses: ArrayLike,
    labels: ArrayLike | None = None,
    *,
    method: str = "correlation",
    folds: ArrayLike | None = None,
    precision: ArrayLike | str | None = None,
    device: Any = None,
) -> Floats:
    """Return the RDM of stimulus patterns, upper triangle [P].

    Without ``labels`` each row of ``responses`` [K, U] is one stimulus' complete pattern. With
    ``labels`` [R] the rows are trials [R, U], averaged per stimulus; NaN is a missing entry, and a
    pair of stimuli uses the units that have a value for both (with ``precision`` a stimulus that lacks
    a unit has NaN pairs). Integer labels are positions 0 … K−1, strings are sorted.

    Args:
        responses: [K, U] or [R, U], any real type; computed in float64.
        labels: Stimulus of each trial, or None.
        method: ``correlation`` 1 − Pearson r; ``sqeuclidean``; ``mahalanobis`` (with ``precision``;
            squared Euclidean without); ``crossnobis`` cross-validated Mahalanobis distance, mean over
            pairs of folds (Walther 2016; unbiased, can be negative); ``poisson`` symmetrised
            Kullback-Leibler divergence of Poisson rates (Schütt 2023).
        folds: Cross-validation fold of each trial [R]; needed by ``crossnobis`` only. Every fold weighs
            the same; fold pairs in which a stimulus is missing are left out of its pairs.
        precision: Inverse noise covariance [U, U] between units, symmetric, or the name of an estimator of
            :func:`noise_precision`, which then takes these trials. By name is faster by far: no matrix of
            units × units is inverted, nor made at all where trials are fewer than units.
        device: Torch device to compute on (``"cuda"``, ``"cpu"``); by default where ``responses`` lie.

    Returns:
        Distances [P], float64. A pair that has no distance (constant pattern, non-finite entry, no trials) is NaN.

    >>> rdm([[1, 2, 3], [2, 4, 6], [3, 2, 1]]).round(3).tolist()
    [0.0, 2.0, 2.0]
    >>> rdm([[1, 2], [3, 2], [5, 5]], ["b", "b", "a"], method="sqeuclidean").tolist()
    [9.0]
    """
    check_name("RDM method", method, _METHODS)
    if folds is not None and method != "crossnobis":
        raise UsageError(f"folds are for method='crossnobis'; method={method!r} averages all trials; leave them out.")
    if precision is not None and method not in ("mahalanobis", "crossnobis"):
        raise UsageError(f"A noise precision is for 'mahalanobis' and 'crossnobis'; method={method!r} does not use it.")
    if isinstance(precision, str):
        check_name("noise covariance method", precision, NOISE_METHODS)
    where = find_device(device, responses, precision)
    if labels is None:
        matrix, codes = response_matrix(responses, "stimuli"), None
        count = len(matrix)
    else:
        matrix, codes, names = labelled_trials(responses, labels)
        count = len(names)
    check_number("The number of stimuli of an RDM", count, least=2, whole=True)
    with np.errstate(invalid="ignore", over="ignore"):
        return fetch(_METHODS[method](_Responses(matrix, count, codes, folds, precision, where)))


def _sqeuclidean(given: _Responses) -> Array:
    patterns = given.patterns()
    return product_distances(patterns, patterns, missing=given.codes is not None, device=given.device)


def _mahalanobis(given: _Responses) -> Array:
    if given.precision is None:
        return _sqeuclidean(given)
    patterns = place(given.patterns(), given.device)
    # The shift per unit must go before the product mixes units.
    centred = without_shift(patterns)
    # (x_i − x_j) C⁻¹ (x_i − x_j) from inner products of vectors whitened by a factor of C⁻¹ (Walther 2016).
    left, right = given.sides(centred, centred)
    return products_from_gram(left @ right.T, patterns.shape[1])


def _crossnobis(given: _Responses) -> Array:
    if given.codes is None or given.folds is None:
        raise UsageError("method='crossnobis' needs labels and folds: a stimulus and a fold for each trial.")
    folds = fetch(given.folds)
    if folds.shape != given.codes.shape:
        raise UsageError(f"There are {len(given.codes)} trials but folds of shape {folds.shape}; give one per trial.")
    names = np.unique(folds)
    check_number("The number of folds of method='crossnobis'", len(names), least=2, whole=True)
    units, count, number = given.responses.shape[1], given.count, len(names)
    # Fold and stimulus together number the cells, so one pass over the trials averages all of them.
    flat = given.means(np.searchsorted(names, folds) * count + given.codes, number * count)
    xp = library(flat)
    if not xp.isfinite(flat).all():
        return _crossnobis_of_present(given, flat.reshape(number, count, units))
    # Mean over folds m ≠ n of (x_i − x_j)_m C⁻¹ (x_i − x_j)_n (Walther 2016): noise of different folds is independent,
    # so its product is zero on average. A shift of all cells cancels, but would cost digits.
    flat = flat - flat.mean(0)
    # Products of all folds with all, less those of each with itself, are those of all pairs of folds.
    if number == 2:
        left, right = given.sides(flat[:count], flat[count:])
        return products_from_gram(left @ right.T, units)
    left, right = (side.reshape(number, count, -1) for side in given.sides(flat, flat))
    gram = left.sum(0) @ right.sum(0).T - (left @ right.swapaxes(-1, -2)).sum(0)
    return products_from_gram(gram, units) / (number * (number - 1))


def _crossnobis_of_present(given: _Responses, means: Array) -> Array:
    """Average over the pairs of folds in which both stimuli have a value."""
    xp, (folds, _, units) = library(means), means.shape
    left = right = means
    if given.precision is not None:
        # A cell that lacks a unit has no product with any other.
        left, right = (s.reshape(*means.shape[:2], -1) for s in given.sides(*[means.reshape(-1, units)] * 2))
    total = number = 0.0
    for first in range(folds):
        for second in range(first + 1, folds):
            if given.precision is None:
                distance = product_distances(left[first], right[second], missing=True)
            else:
                distance = products_from_gram(left[first] @ right[second].T, units)
            finite = xp.isfinite(distance)
            total = total + xp.where(finite, distance, 0.0)
            number = number + xp.where(finite, xp.ones_like(distance), 0.0)
    return xp.where(number > 0, total / xp.where(number > 0, number, 1.0), np.nan)


def _poisson(given: _Responses) -> Array:
    patterns = place(given.patterns(), given.device)
    values = patterns[~library(patterns).isnan(patterns)]
    low = float(values.min()) if len(values) else 0.0
    if low < 0:
        raise DataError(f"method='poisson' needs rates or counts, which are never negative; the smallest is {low:g}.")
    # Σ (λ_i − λ_j)(log λ_i − log λ_j) / U, the divergence in both directions (Schütt 2023).
    rates = poisson_rates(patterns)
    return product_distances(rates, library(rates).log(rates), missing=given.codes is not None)


def poisson_rates(rates: Array) -> Array:
    """Return rates [K, U] under the gamma prior, in the unit given, which are never zero."""
    # Posterior mean after one observation under a gamma prior with this mean and weight.
    return (rates + POISSON_PRIOR_MEAN * POISSON_PRIOR_WEIGHT) / (1 + POISSON_PRIOR_WEIGHT)


_METHODS: dict[str, Callable[[_Responses], Array]] = {
    "correlation": lambda given: correlation_distances(
        given.patterns(), missing=given.codes is not None, device=given.device
    ),
    "sqeuclidean": _sqeuclidean,
    "mahalanobis": _mahalanobis,
    "crossnobis": _crossnobis,
    "poisson": _poisson,
}

RDM_METHODS = tuple(_METHODS)  # names that `method` of rdm takes
