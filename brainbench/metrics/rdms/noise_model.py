"""Noise covariance between units as its estimators make it, and products with its inverse.

Every estimator gives C = S (α·1 + β ZᵀZ) S with a diagonal S [U] and residuals Z [R, U] in its units, so
products a·C⁻¹·b need no matrix of units × units where trials are fewer than units: by Woodbury's identity
they are (ã·b̃ − v_a·v_b)/α with ã = a S⁻¹, v = L⁻¹ Z ã and L Lᵀ = α/β·1 + Z Zᵀ [R, R].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from brainbench.core.errors import DataError
from brainbench.metrics.arrays import Array, cholesky, is_tensor, library, solve_lower

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
        """Whether inner products of trials are fewer numbers than those of units, and good enough."""
        trials, units = self.trials.shape
        return trials < units and self.ridge >= _DUAL_RIDGE * (self.ridge + self.weight * self._power)

    @property
    def _power(self) -> float:
        return float((self.trials * self.trials).mean()) * len(self.trials)

    def sides(self, left: Array, right: Array) -> tuple[Array, Array]:
        """Return vectors [N, V] and [M, V] whose inner products are those of ``left`` and ``right`` with C⁻¹ between.

        Raises:
            DataError: the covariance is singular.
        """
        same = left is right
        left = left / self.scale
        right = left if same else right / self.scale
        if not self.weight:
            return left, right / self.ridge
        if not self.dual:
            factor = self._factor()
            first = solve_lower(factor, left.T).T
            return first, first if same else solve_lower(factor, right.T).T
        xp, factor = library(left), self._dual_factor()
        first = solve_lower(factor, self.trials @ left.T).T
        second = first if same else solve_lower(factor, self.trials @ right.T).T
        join = xp.cat if is_tensor(left) else np.concatenate
        return join([left, first], -1), join([right, -second], -1) / self.ridge

    def precision(self) -> Array:
        """Return C⁻¹ [U, U].

        Raises:
            DataError: the covariance is singular.
        """
        eye = library(self.scale).eye(len(self.scale), **_like(self.scale))
        if not self.weight:
            inner = eye / self.ridge
        elif self.dual:
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


def noise_model(residuals: Array, freedom: int, method: str) -> NoiseModel:
    """Return the covariance that ``method`` estimates from residuals [R, U] with ``freedom`` degrees of freedom."""
    return _METHODS[method](residuals, freedom)


def _diag(residuals: Array, freedom: int) -> NoiseModel:
    return NoiseModel("diag", _deviation(residuals, freedom), 1.0, residuals, 0.0)


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
    own, fourth = squares.sum(0), float((squares * squares).sum())
    signal = max(_pair_sum(scaled) - float((own * own).sum()), 0.0) / (count - 1) ** 2
    together = float((squares.sum(1) ** 2).sum()) - fourth
    spread = count / freedom**2 * (together / (count - 1) - signal)
    amount = min(max(spread / signal, 0.0), 1.0) if signal > 0 else 1.0
    return NoiseModel("shrinkage_diag", deviation, amount, scaled, (1 - amount) / freedom)


def _shrinkage_eye(residuals: Array, freedom: int) -> NoiseModel:
    """Shrink to a multiple of the identity (Ledoit & Wolf 2004)."""
    count, units = residuals.shape
    squares = residuals * residuals
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
    from scipy.linalg import get_lapack_funcs

    (invert,) = get_lapack_funcs(("potri",), (factor,))
    lower, _ = invert(factor, lower=1)
    return np.tril(lower) + np.tril(lower, -1).T


def _like(array: Array) -> dict[str, object]:
    return {"dtype": array.dtype, "device": array.device} if is_tensor(array) else {}


_METHODS: dict[str, Callable[[Array, int], NoiseModel]] = {
    "shrinkage_diag": _shrinkage_diag,
    "shrinkage_eye": _shrinkage_eye,
    "diag": _diag,
    "full": _full,
}

NOISE_METHODS = tuple(_METHODS)
"""Names of the estimators."""
