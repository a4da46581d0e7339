"""Curves of whiskers: distances of traced points from them, and their shapes under one contact.

Letters: n instant, N link, k traced point, m sample along the curve, d = 1 direction across a curve in a plane, 2 in
space, b shape of a batch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.whiskers.whisker import Whisker

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
    # All points against all samples: some megabytes, and no search.
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


STEPS = 48
"""Runge-Kutta steps from the contact to the base; the force is then within 1e-6 of that of 400."""
BEYOND = 12
"""Samples from the contact to the tip."""


# With the angle ψ of the rod against its direction at the contact, the equations of the elastica (Antman 2005,
# Nonlinear Problems of Elasticity, chapter 4) from the contact at arc a back to the base are
#
#     dψ/ds = κ₀(s) + M/(E I(s)),   dM/ds = −f cos ψ,   ψ(a) = 0,   M(a) = 0
#
# for a force f normal to the rod. They need no angle and no position: those of the base turn and move the finished
# shape, so no boundary-value problem is solved. Beyond the contact the rod has its rest curvature.
@dataclass(frozen=True, eq=False)
class LoadedShapes:
    """Shapes of a whisker under one contact each; sampled from the base to the tip."""

    place: Array
    """[b, m, 2] positions (m)."""
    angle: Array
    """[b, m] angle of the rod against x (rad)."""
    curvature: Array
    """[b, m] its derivative by arc (1/m)."""
    moment: Array
    """[b] moment of the whisker on its base about the base point (N·m)."""

    @property
    def contact(self) -> Array:
        """[b, 2] point of the centre line at the contact (m)."""
        return self.place[:, STEPS]

    @property
    def force(self) -> Array:
        """[b, 2] direction of a positive contact force: the normal on the left of the rod."""
        angle = self.angle[:, STEPS]
        return np.stack([-np.sin(angle), np.cos(angle)], axis=-1)

    @property
    def along(self) -> Array:
        """[b, m, 2] unit tangents."""
        return np.stack([np.cos(self.angle), np.sin(self.angle)], axis=-1)

    @property
    def bend(self) -> Array:
        """[b, m, 2] second derivatives of the position by arc (1/m)."""
        return self.curvature[..., None] * np.stack([-np.sin(self.angle), np.cos(self.angle)], axis=-1)


class LoadedWhisker:
    """A clamped whisker that one frictionless contact bends by any amount, in its plane."""

    def __init__(self, whisker: Whisker) -> None:
        self.whisker = whisker
        self._grid = np.linspace(0.0, whisker.arc_length, 1001)
        self._rest = 2 * whisker.curvature * np.cos(whisker.tangent_angle(self._grid)) ** 3
        self._turn = whisker.tangent_angle(self._grid)
        self._line = whisker.centre_line(self._grid)

    def rest_curvature(self, s: Array) -> Array:
        """Return the curvature κ₀ (1/m) of the rest shape at arcs s (m): of the parabola y = A x²."""
        return np.interp(s, self._grid, self._rest)

    def shapes(self, base: Array, arc: Array, force: Array) -> LoadedShapes:
        """Return the shapes under forces ``force`` [b] (N, positive to the left of the rod) at arcs ``arc`` [b] (m).

        ``base`` [b, 3] is the position (m) and the direction (rad) of the clamped base.
        """
        whisker = self.whisker
        share = np.linspace(1.0, 0.0, 2 * STEPS + 1)
        half = arc[:, None] * share
        flexibility = 1 / whisker.bending_stiffness(half)
        rest = self.rest_curvature(half)
        step = -arc / STEPS
        count = len(arc)
        psi, moment, x, y = (np.zeros((STEPS + 1, count)) for _ in range(4))
        bend = np.empty((STEPS + 1, count))
        for k in range(STEPS):
            # Classical Runge-Kutta step; positions are integrated with its weights.
            (f0, f1, f2), (c0, c1, c2) = flexibility[:, 2 * k : 2 * k + 3].T, rest[:, 2 * k : 2 * k + 3].T
            p, m = psi[k], moment[k]
            bend[k] = c0 + m * f0
            a1, m1 = bend[k], -force * np.cos(p)
            p2 = p + step / 2 * a1
            a2, m2 = c1 + (m + step / 2 * m1) * f1, -force * np.cos(p2)
            p3 = p + step / 2 * a2
            a3, m3 = c1 + (m + step / 2 * m2) * f1, -force * np.cos(p3)
            p4 = p + step * a3
            a4, m4 = c2 + (m + step * m3) * f2, -force * np.cos(p4)
            psi[k + 1] = p + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
            moment[k + 1] = m + step / 6 * (m1 + 2 * m2 + 2 * m3 + m4)
            x[k + 1] = x[k] + step / 6 * (np.cos(p) + 2 * np.cos(p2) + 2 * np.cos(p3) + np.cos(p4))
            y[k + 1] = y[k] + step / 6 * (np.sin(p) + 2 * np.sin(p2) + 2 * np.sin(p3) + np.sin(p4))
        bend[STEPS] = rest[:, -1] + moment[STEPS] * flexibility[:, -1]
        loaded = np.stack([x, y], axis=-1)[::-1].swapaxes(0, 1)
        free = arc[:, None] + (whisker.arc_length - arc)[:, None] * np.linspace(0, 1, BEYOND + 1)[1:]
        # The free end is the rest shape, turned so that it leaves the contact along ψ = 0.
        turn = np.interp(arc, self._grid, self._turn)
        end = self._rest_place(free) - self._rest_place(arc[:, None])
        place = np.concatenate([loaded, _rotated(end, -turn)], axis=1)
        angle = np.concatenate([psi[::-1].T, np.interp(free, self._grid, self._turn) - turn[:, None]], axis=1)
        curvature = np.concatenate([bend[::-1].T, self.rest_curvature(free)], axis=1)
        # Rigid motion that puts the base where it is.
        lift = base[:, 2] - angle[:, 0]
        place = _rotated(place - place[:, :1], lift) + base[:, None, :2]
        return LoadedShapes(place, angle + lift[:, None], curvature, moment[STEPS])

    def _rest_place(self, s: Array) -> Array:
        return np.stack([np.interp(s, self._grid, column) for column in self._line.T], axis=-1)


def _rotated(points: Array, angle: Array) -> Array:
    """Return points [b, m, 2] turned by angles [b] (rad)."""
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
