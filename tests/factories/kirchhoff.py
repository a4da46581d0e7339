"""Static equilibria of a Kirchhoff rod in space: bending and twist, intrinsic curvature, inextensible, no shear.

With the centre line r(s), the cross-section's axes R(s) (first column the tangent t), force N and moment M in it::

    r' = t,   R' = R [u]×,   u = (τ₀ + M₁/GJ, M₂/EI, κ₀ + M₃/EI),   N' = 0,   M' = N × t

where Mᵢ are the components of M along the axes (Antman, Nonlinear Problems of Elasticity, 2005, chapter 8; Audoly &
Pomeau, Elasticity and Geometry, 2010, chapter 3). The base is clamped along x, the rest shape lies in the x-y plane. No
engine and no chain of links is used: SciPy integrates the equations and shoots for the unknown base moment, force and
place of contact. SI units. The tests hold it against closed forms.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError
from brainbench.stimuli.whiskers.whisker import Whisker

OfArc = Callable[[float], float]
Array = NDArray[np.float64]
_STAGES = 8
"""Steps in which a load grows from nothing: each starts from the equilibrium before."""


@dataclass(frozen=True, eq=False)
class KirchhoffRod:
    """Properties of a rod along its arc length s (m)."""

    length: float
    """Arc length [m]."""
    curvature: OfArc
    """Curvature κ₀(s) of the rest shape in the x-y plane [1/m]."""
    bending: OfArc
    """Flexural rigidity E I(s) [N·m²]."""
    torsion: OfArc
    """Torsional rigidity G J(s) [N·m²]."""
    twist: OfArc = lambda s: 0.0
    """Torsion τ₀(s) of the rest shape [1/m]; 0 where that lies in the x-y plane."""
    radius: OfArc = lambda s: 0.0
    """Radius [m], by which a contact stands off the centre line."""

    @classmethod
    def of(cls, whisker: Whisker) -> KirchhoffRod:
        """Return the rod that a whisker stands for."""
        from scipy.interpolate import CubicSpline

        s = np.linspace(0, whisker.arc_length, 401)
        # Of the parabola y = A x²: κ₀ = 2A cos³ψ with the tangent's angle ψ.
        if whisker.bends:
            arcs, bends, turns = np.transpose(whisker.bends)
            curvature, twist = (lambda s: np.interp(s, arcs, bends)), (lambda s: np.interp(s, arcs, turns))
        else:
            curvature, twist = (
                CubicSpline(s, 2 * whisker.curvature * np.cos(whisker.tangent_angle(s)) ** 3),
                np.zeros_like,
            )
        bending = whisker.bending_stiffness
        laws = (curvature, bending, lambda s: whisker.torsion_ratio * bending(s), twist, whisker.radius)
        return cls(whisker.arc_length, *(lambda s, law=law: float(law(s)) for law in laws))


@dataclass(frozen=True, eq=False)
class RodEquilibrium:
    """Equilibrium of a rod under one force."""

    force: NDArray[np.float64]
    """[3] force on the rod (N), equal to its action on the base."""
    moment: NDArray[np.float64]
    """[3] moment of the rod on its base about the base point (N·m)."""
    arc: float
    """Arc length of the point where the force acts (m)."""
    point: NDArray[np.float64]
    """[3] that point of the centre line (m)."""

    @property
    def wrench(self) -> NDArray[np.float64]:
        """Action of the rod on its base [6]: force (N), then moment (N·m)."""
        return np.concatenate([self.force, self.moment])


def load_rod(rod: KirchhoffRod, arc: float, force: ArrayLike) -> RodEquilibrium:
    """Return the equilibrium under a force [3] (N) that acts at arc length ``arc`` (m)."""
    force = np.asarray(force, dtype=float)
    unit, moment = rod.bending(0.0) / rod.length, np.zeros(3)
    for share in np.linspace(0, 1, _STAGES + 1)[1:]:

        def residual(z: NDArray, share: float = float(share)) -> NDArray:
            return _integrate(rod, share * force, z * unit, arc)[2] / unit

        moment = _solve(residual, moment)
    point, _, _ = _integrate(rod, force, moment * unit, arc)
    return RodEquilibrium(force, moment * unit, arc, point)


def press_rod(
    rod: KirchhoffRod, arc: float, axis: ArrayLike, way: ArrayLike, travel: float, peg_radius: float
) -> RodEquilibrium:
    """Return the equilibrium against a long frictionless round peg.

    The peg's axis [3] is perpendicular to the unbent rod at arc length ``arc`` (m), where the peg first touches it; it
    then moves by ``travel`` (m) in the direction ``way`` [3], perpendicular to both, and the rod may slide over it.
    """
    axis, way = (np.asarray(vector, dtype=float) / np.linalg.norm(vector) for vector in (axis, way))
    touch, _, _ = _integrate(rod, np.zeros(3), np.zeros(3), arc)
    unit = rod.bending(0.0) / rod.length
    scale = np.repeat([unit / rod.length, unit, rod.length], [3, 3, 1])
    z, before = np.array([*np.zeros(6), arc / rod.length]), None
    for share in np.linspace(0, 1, _STAGES + 1)[1:]:
        centre = touch + way * (share * travel - peg_radius - rod.radius(arc))

        def residual(z: NDArray, centre: NDArray = centre) -> NDArray:
            force, moment, at = np.split(z * scale, [3, 6])
            point, tangent, rest = _integrate(rod, force, moment, float(at[0]))
            offset = point - centre
            offset = offset - axis * (offset @ axis)
            # The moment ends at the contact; no friction: the force is normal to peg and rod; the rod's nearest point
            # lies at the distance of both radii.
            gap = np.copysign(np.linalg.norm(offset), offset @ way) - peg_radius - rod.radius(float(at[0]))
            return np.array([*(rest / unit), *(force @ np.stack([axis, tangent], 1) * rod.length / unit),
                             offset @ tangent / peg_radius, gap / rod.length])  # fmt: skip

        found = _solve(residual, z if before is None else 2 * z - before)
        before, z = z, found
    force, moment, at = np.split(z * scale, [3, 6])
    if not 0 < at[0] <= rod.length:
        raise DataError(f"The rod slips off a peg that moves by {travel:g} m at arc length {arc:g} m.")
    return RodEquilibrium(force, moment, float(at[0]), _integrate(rod, force, moment, float(at[0]))[0])


def _solve(residual: Callable[[NDArray], NDArray], start: NDArray) -> NDArray[np.float64]:
    from scipy.optimize import root

    found = root(residual, start, method="hybr", options={"xtol": 1e-11})
    if not np.abs(residual(found.x)).max() < 1e-8:
        raise DataError(f"No equilibrium of the rod was found ({found.message}); choose a smaller load.")
    return found.x


def _integrate(rod: KirchhoffRod, force: Array, moment: Array, arc: float) -> tuple[Array, Array, Array]:
    """Return point, tangent and moment [3] at ``arc`` of the rod with this moment at its base; NaN beyond its ends."""
    if not 0 < arc <= rod.length:
        nowhere = np.full(3, np.nan)
        return nowhere, nowhere, nowhere
    points, frames, moments = rod_paths(rod, force, moment, np.array([arc]))
    return points[-1], frames[-1, :, 0], moments[-1]


def rod_paths(rod: KirchhoffRod, force: Array, moment: Array, arcs: Array) -> tuple[Array, Array, Array]:
    """Return points [n, 3], axes [n, 3, 3] and moments [n, 3] at ``arcs`` [n]."""
    from scipy.integrate import solve_ivp

    unit, most = rod.bending(0.0) / rod.length, 100 / rod.length
    pull = force * rod.length / unit

    def slope(s: float, y: NDArray) -> NDArray:
        # Lengths in units of the rod's, moments in units of EI/L at the base.
        turn, held = y[3:12].reshape(3, 3), y[12:]
        local = held @ turn * unit
        at = s * rod.length
        torsion, bending = rod.torsion(at), rod.bending(at)
        # What shooting tries may coil a soft tip up without end.
        rates = (rod.twist(at) + local[0] / torsion, local[1] / bending, rod.curvature(at) + local[2] / bending)
        u1, u2, u3 = (max(-most, min(most, rate)) for rate in rates)
        t, n, b = turn.T
        change = np.stack([u3 * n - u2 * b, u1 * b - u3 * t, u2 * t - u1 * n], axis=1)
        return np.concatenate([t, (change * rod.length).ravel(), np.cross(pull, t)])

    start = np.concatenate([np.zeros(3), np.eye(3).ravel(), moment / unit])
    places = arcs / rod.length
    path = solve_ivp(slope, (0.0, places[-1]), start, method="DOP853", rtol=1e-9, atol=1e-11, t_eval=places).y.T
    return path[:, :3] * rod.length, path[:, 3:12].reshape(-1, 3, 3), path[:, 12:] * unit
