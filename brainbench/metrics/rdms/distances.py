"""Distances between stimulus patterns, batched over leading axes.

Patterns are [..., K, U]; results are upper triangles [..., P]. Everything is accumulated in float64 over slices of
units, so a large float32 input is never copied whole, and centred first, so a large common offset costs no digits.
Patterns may be torch tensors, or be moved to a torch ``device`` slice by slice; the result is a tensor there.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from brainbench.metrics.arrays import Array, library, place, slices
from brainbench.metrics.rdms.pairs import upper

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
            gram = _added(gram, centred @ centred.swapaxes(-1, -2))
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
            gram = _added(gram, without_shift(a) @ without_shift(b).swapaxes(-1, -2))
        return products_from_gram(gram, units)


def without_shift(patterns: Array) -> Array:
    """Return patterns [..., K, U] less each unit's mean; a unit with a non-finite entry stays as it is."""
    mean = patterns.mean(-2)[..., None, :]
    xp = library(mean)
    return patterns - xp.where(xp.isfinite(mean), mean, 0.0)


def products_from_gram(gram: Array, units: int) -> Array:
    """Return (g_ii + g_jj − g_ij − g_ji) / U as [..., P] from products g_ij = a_i·b_j [..., K, K]."""
    xp = library(gram)
    own = xp.einsum("...ii->...i", gram)
    own = xp.where(xp.isfinite(own), own, np.nan)
    total = own[..., :, None] + own[..., None, :] - gram - gram.swapaxes(-1, -2)
    return upper(total) / units


def _added(total: Array, part: Array) -> Array:
    """Return the sum, in place after the first."""
    if isinstance(total, float):
        return part
    total += part
    return total


def _products_of_present(left: Array, right: Array) -> Array:
    xp = library(left)
    present = xp.isfinite(left) & xp.isfinite(right)
    weight = _ones(present, left)
    a = xp.where(present, left - _unit_mean(left, present, weight), 0.0)
    b = xp.where(present, right - _unit_mean(right, present, weight), 0.0)
    turned = weight.swapaxes(-1, -2)
    # Σ (a_i − a_j)(b_i − b_j) over the units of both = own_ij + own_ji − cross_ij − cross_ji, over their number.
    both, own, cross = weight @ turned, (a * b) @ turned, a @ b.swapaxes(-1, -2)
    total = own + own.swapaxes(-1, -2) - cross - cross.swapaxes(-1, -2)
    return upper(xp.where(both > 0, total / xp.where(both > 0, both, 1.0), np.nan))


def _ones(present: Array, like: Array) -> Array:
    """Return 1 where a value is present, else 0, in the type and place of ``like``."""
    xp = library(like)
    return xp.where(present, xp.ones_like(like), 0.0)


def _unit_mean(patterns: Array, present: Array, weight: Array) -> Array:
    filled = library(patterns).where(present, patterns, 0.0)
    return (filled.sum(-2) / weight.sum(-2).clip(1.0))[..., None, :]


def _correlation_of_present(patterns: Array) -> Array:
    xp = library(patterns)
    present = xp.isfinite(patterns)
    filled = xp.where(present, patterns, 0.0)
    weight = _ones(present, patterns)
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
