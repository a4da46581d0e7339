"""Noise covariance between units, estimated from trials, and products with its inverse.

Every estimator gives C = S (α·1 + β ZᵀZ) S with a diagonal S [U] and residuals Z [R, U] in its units, so
products a·C⁻¹·b need no matrix of units × units where trials are fewer than units: by Woodbury's identity
they are (ã·b̃ − v_a·v_b)/α with ã = a S⁻¹, v = L⁻¹ Z ã and L Lᵀ = α/β·1 + Z Zᵀ [R, R].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import DataError, check_name
from brainbench.metrics.arrays import Array, cholesky, fetch, find_device, is_tensor, library, place, solve_lower
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.stimulus_labels import labelled_trials, stimulus_means

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
        return trials < units and self.ridge >= _DUAL_RIDGE * (self.ridge + self.weight * self._power)

    @property
    def _power(self) -> float:
        return float((self.trials * self.trials).mean()) * len(self.trials)

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
    return _METHODS[method](residuals if device is None else place(residuals, device), freedom)


def _full(residuals: Array, freedom: int) -> NoiseModel:
    ones = library(residuals).ones_like(residuals[0])
    return NoiseModel("full", ones, 0.0, residuals, 1.0 / freedom)


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


_METHODS: dict[str, Callable[[Array, int], NoiseModel]] = {
    "shrinkage_diag": _shrinkage_diag,
    "shrinkage_eye": _shrinkage_eye,
    "diag": lambda residuals, freedom: NoiseModel("diag", _deviation(residuals, freedom), 1.0, residuals, 0.0),
    "full": _full,
}

NOISE_METHODS = tuple(_METHODS)
