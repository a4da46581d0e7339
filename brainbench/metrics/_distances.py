"""Distances between stimulus patterns, batched over leading axes.

Patterns are [..., K, U]; results are upper triangles [..., P]. Everything is accumulated in float64
over slices of units, so a large float32 input is never copied whole, and centred first, so a large
common offset costs no digits.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from brainbench.metrics._pairs import Floats, upper

_SLICE_ELEMENTS = 1 << 22
_ROUNDING = 8 * np.finfo(np.float64).eps
"""A pattern whose spread is below this share of its size is constant up to rounding."""


def correlation_distances(patterns: NDArray, *, missing: bool = False) -> Floats:
    """Return 1 − Pearson correlation between patterns [..., K, U] as [..., P].

    A constant pattern, and without ``missing`` one with a non-finite entry, has NaN pairs. With
    ``missing`` NaN entries are left out: each pair uses the units present in both patterns.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if missing and not np.isfinite(patterns).all():
            return _correlation_of_present(patterns)
        units = patterns.shape[-1]
        mean = sum((part.sum(axis=-1) for part in _slices(patterns)), start=np.float64(0)) / units
        gram = np.zeros((*patterns.shape[:-1], patterns.shape[-2]))
        rest = np.zeros(patterns.shape[:-1])
        for part in _slices(patterns):
            centred = part - mean[..., None]
            rest += centred.sum(axis=-1)
            gram += centred @ np.swapaxes(centred, -1, -2)
        # The mean of a large offset is rounded; what it missed is a second mean.
        gram -= rest[..., :, None] * rest[..., None, :] / units
        return correlation_from_gram(gram, units * (_ROUNDING * np.abs(mean)) ** 2)


def correlation_from_gram(gram: Floats, floor: Floats) -> Floats:
    """Return 1 − Pearson correlation [..., P] from products of centred patterns [..., K, K].

    Patterns whose square is not above ``floor`` [..., K] are constant and have NaN pairs.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = np.einsum("...ii->...i", gram)
        length = np.sqrt(np.where(squares > floor, squares, np.nan))
        return 1.0 - upper(gram) / upper(length[..., :, None] * length[..., None, :])


def product_distances(left: NDArray, right: NDArray, *, missing: bool = False) -> Floats:
    """Return Σ_u (a_i − a_j)(b_i − b_j) / U for patterns a, b [..., K, U] as [..., P].

    With a = b this is the squared Euclidean distance per unit; with b = a·precision Mahalanobis;
    with a, b from two folds crossnobis; with b = log a the symmetrised Poisson divergence.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        units = left.shape[-1]
        present = np.isfinite(left) & np.isfinite(right) if missing else None
        if present is not None and not present.all():
            weight = present.astype(np.float64)
            a = np.where(present, left - _unit_mean(left, present), 0.0)
            b = np.where(present, right - _unit_mean(right, present), 0.0)
            both = weight @ np.swapaxes(weight, -1, -2)
            own = (a * b) @ np.swapaxes(weight, -1, -2)
            cross = a @ np.swapaxes(b, -1, -2)
            total = own + np.swapaxes(own, -1, -2) - cross - np.swapaxes(cross, -1, -2)
            return upper(np.where(both > 0, total / np.where(both > 0, both, 1), np.nan))
        gram = np.zeros((*left.shape[:-1], left.shape[-2]))
        for a, b in zip(_slices(left), _slices(right), strict=True):
            # Differences do not feel a shift per unit, products lose digits to it.
            a = a - a.mean(axis=-2, keepdims=True)
            b = b - b.mean(axis=-2, keepdims=True)
            gram += a @ np.swapaxes(b, -1, -2)
        return products_from_gram(gram, units)


def products_from_gram(gram: Floats, units: int) -> Floats:
    """Return (g_ii + g_jj − g_ij − g_ji) / U as [..., P] from products g_ij = a_i·b_j [..., K, K]."""
    own = np.einsum("...ii->...i", gram)
    total = own[..., :, None] + own[..., None, :] - gram - np.swapaxes(gram, -1, -2)
    return upper(total) / units


def _slices(patterns: NDArray) -> Iterator[Floats]:
    rows = max(1, int(np.prod(patterns.shape[:-1])))
    step = max(1, _SLICE_ELEMENTS // rows)
    for start in range(0, patterns.shape[-1], step):
        yield patterns[..., start : start + step].astype(np.float64, copy=False)


def _unit_mean(patterns: NDArray, present: NDArray[np.bool_]) -> Floats:
    count = np.maximum(present.sum(axis=-2, keepdims=True), 1)
    return np.where(present, patterns, 0.0).sum(axis=-2, keepdims=True) / count


def _correlation_of_present(patterns: NDArray) -> Floats:
    present = np.isfinite(patterns)
    weight = present.astype(np.float64)
    filled = np.where(present, patterns, 0.0).astype(np.float64)
    mean = filled.sum(axis=-1, keepdims=True) / np.maximum(weight.sum(axis=-1, keepdims=True), 1)
    x = np.where(present, patterns - mean, 0.0)
    turned = np.swapaxes(weight, -1, -2)
    both = weight @ turned
    sums = x @ turned
    scatter = (x * x) @ turned - sums**2 / both
    product = x @ np.swapaxes(x, -1, -2) - sums * np.swapaxes(sums, -1, -2) / both
    floor = both * (_ROUNDING * np.abs(filled).max(axis=-1))[..., :, None] ** 2
    scatter = np.where((both >= 2) & (scatter > floor), scatter, np.nan)
    return upper(1.0 - product / np.sqrt(scatter * np.swapaxes(scatter, -1, -2)))
