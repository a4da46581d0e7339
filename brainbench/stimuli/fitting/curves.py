"""Distances of traced points from the smooth curve through the nodes of a simulated whisker.

Letters: n instant, N link, k traced point, m sample along the curve, d = 1 direction across a curve in a plane, 2 in
space.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
PER_LINK = 8
"""Samples of the curve in each link."""


def normal_offsets(nodes: Array, joints: Array, points: Array) -> Array:
    """Return the signed distances [n, k, d] (m) of a simulated curve from traced points, across the curve.

    Nodes lie on the whisker's curve, so a cubic spline through them is within its fourth order of it, where the chords
    of the links are off by their sagitta (10 µm for 1 mm links of a bent whisker, as much as the noise of tracks). From
    the nearest sample the foot of each point is found to second order, so that the distance is smooth in the shape.

    Args:
        nodes: arc lengths [N + 1] (m) of joints and tip.
        joints: their positions [n, N + 1, 3] (m).
        points: traced points [n, k, 2 or 3] (m); two axes are x and y of the same frame. NaN where missing.
    """
    from scipy.interpolate import CubicSpline

    # Frames behind the failure of a simulation are missing; a straight line stands for their curve.
    lost = ~np.asarray(np.isfinite(joints).all(axis=(1, 2)))[:, None, None]
    straight = np.outer(nodes, np.eye(points.shape[-1])[0])
    spline = CubicSpline(nodes, np.where(lost, straight, joints[..., : points.shape[-1]]), axis=1)
    s = np.linspace(nodes[0], nodes[-1], PER_LINK * (len(nodes) - 1) + 1)
    # Arc lengths of the nodes parametrise the curve nearly by arc: derivatives are normalised below all the same.
    place, along, bend = spline(s), spline(s, 1), spline(s, 2)
    return np.where(lost, np.nan, offsets_of_samples(place, along, bend, points))


def offsets_of_samples(place: Array, along: Array, bend: Array, points: Array) -> Array:
    """Return the signed distances [n, k, d] (m) of dense samples of a curve from points, across the curve.

    ``place``, ``along`` and ``bend`` [n, m, 2 or 3] are positions and their first and second derivatives by any
    parameter that runs along the curve; ``points`` are as for :func:`normal_offsets`.
    """
    between = points[:, :, None, :] - place[:, None]
    squares = np.nan_to_num(np.einsum("nkmi,nkmi->nkm", between, between), nan=np.inf)
    nearest = np.argmin(squares, axis=-1)[..., None]
    q, t, c = (np.take_along_axis(values, nearest, axis=1) for values in (place, along, bend))
    gap = points - q
    # Newton step on (p − r(s))·r′(s) = 0 with r ≈ q + t σ + c σ²/2.
    step = _dot(gap, t) / (_dot(t, t) - _dot(gap, c))
    foot, tangent = q + t * step + c * step**2 / 2, t + c * step
    tangent = tangent / np.sqrt(_dot(tangent, tangent))
    gap = foot - points
    if points.shape[-1] == 2:
        return (tangent[..., :1] * gap[..., 1:]) - (tangent[..., 1:] * gap[..., :1])
    first, second = _normals(tangent)
    return np.concatenate([_dot(gap, first), _dot(gap, second)], axis=-1)


def _dot(a: Array, b: Array) -> Array:
    return np.sum(a * b, axis=-1, keepdims=True)


def _normals(tangent: Array) -> tuple[Array, Array]:
    """Return two unit vectors [n, k, 3] across each tangent, the second nearest to the z axis."""
    axis = np.zeros_like(tangent)
    axis[..., 2] = 1.0
    # A tangent along z takes y instead.
    axis = np.where(np.abs(tangent[..., 2:]) > 0.9, np.roll(axis, -1, axis=-1), axis)
    second = axis - tangent * _dot(axis, tangent)
    second = second / np.sqrt(_dot(second, second))
    return np.cross(second, tangent), second
