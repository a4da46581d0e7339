"""Closed forms and reference solutions of whisker mechanics, free of any physics engine.

A whisker is an Euler-Bernoulli rod clamped at its base (inextensible, no shear, no twist). Frame: base
point at the origin, x along the whisker, bending in the x-y plane. SI units. All results were checked
against published tables and independent quadrature in the tests.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_number
from brainbench.stimuli.whiskers.whisker import Whisker

# Runge-Kutta steps along the rod, and finite elements of the frequencies.
_STEPS = 400
_ELEMENTS = 160


@dataclass(frozen=True)
class Contact:
    """Equilibrium of a rod pressed by a frictionless peg, in the plane of bending."""

    force: tuple[float, float]
    """Force of the peg on the rod (Fx, Fy) [N]; equal to the action of the whisker on its base."""
    moment: float
    """Moment Mz of the whisker on its base about the base point [N·m]."""
    arc: float
    """Arc length of the contact [m]."""
    slope: float
    """Angle of the rod against x at the contact [rad]."""
    point: tuple[float, float]
    """Centre-line point at the contact [m]."""

    @property
    def wrench(self) -> NDArray[np.float64]:
        """Action of the whisker on its base [6]: force (N), then moment (N·m)."""
        return np.array([*self.force, 0.0, 0.0, 0.0, self.moment])


def point_load_deflection(whisker: Whisker, force: float, at: float) -> float:
    """Return the deflection [m] under a transverse point load F at arc length a of a straight cone, small bending.

    δ = F a³/(3 E I_b) · r_b/r(a), exact for a linear taper.
    """
    _check_at(whisker, at)
    if not whisker.straight:
        raise UsageError(
            f"This closed form is for a straight whisker; this one has curvature {whisker.curvature:g} 1/m; "
            "use elastica, which takes any curvature."
        )
    if whisker.radii or whisker.moduli:
        raise UsageError(
            "This closed form is for a cone of one material; use elastica, which takes tables along a whisker."
        )
    stiffness = float(whisker.bending_stiffness(0.0))
    return force * at**3 / (3 * stiffness) * whisker.base_radius / float(whisker.radius(at))


@lru_cache(maxsize=256)
def natural_frequencies(whisker: Whisker, count: int = 3) -> NDArray[np.float64]:
    """Return the lowest bending frequencies [count] (Hz), base clamped, tip free, any taper and density gradient.

    Euler-Bernoulli finite elements (cubic Hermite, 4-point quadrature of the exact E I(s) and mass).
    For uniform density f_n = λ_n r_b √(E/ρ)/(4π L²), with λ_n depending on r_t/r_b alone. Callers share the result.
    """
    from scipy.linalg import eigh

    stiffness, mass = beam_matrices(whisker)
    # Rotations scaled by the length make the matrices well conditioned; the base node is clamped.
    scale = np.tile([1.0, 1 / whisker.arc_length], _ELEMENTS + 1)[2:]
    stiffness = stiffness[2:, 2:] * np.outer(scale, scale)
    mass = mass[2:, 2:] * np.outer(scale, scale)
    # M a = ω⁻² K a: the modes wanted are the largest eigenvalues, which are resolved best.
    size = len(mass)
    inverse = eigh(mass, stiffness, eigvals_only=True, subset_by_index=[size - count, size - 1])[::-1]
    frequencies = 1 / np.sqrt(inverse) / (2 * np.pi)
    frequencies.setflags(write=False)
    return frequencies


def beam_matrices(whisker: Whisker) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return stiffness and mass [2 n, 2 n] of a whisker as a straight free beam of finite elements between n nodes.

    Unknowns are deflection (m) and slope of each node, evenly spaced from the base on; elements as in
    :func:`natural_frequencies`.
    """
    size = 2 * _ELEMENTS + 2
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    length = whisker.arc_length / _ELEMENTS
    nodes, weights = np.polynomial.legendre.leggauss(4)
    elements = np.arange(_ELEMENTS)
    for node, weight in zip((nodes + 1) / 2, weights / 2, strict=True):
        # Cubic Hermite shape functions of deflection and slope at both ends, and their second derivatives.
        near, far = 1 - 3 * node**2 + 2 * node**3, 3 * node**2 - 2 * node**3
        shape = np.array([near, length * (node - 2 * node**2 + node**3), far, length * (node**3 - node**2)])
        bend = np.array([-6 + 12 * node, length * (-4 + 6 * node), 6 - 12 * node, length * (6 * node - 2)]) / length**2
        s = (elements + node) * length
        # K = ∫ E I w″ w″ ds and M = ∫ ρ π r² w w ds of one element, summed over elements that share nodes.
        for matrix, law, w in ((stiffness, whisker.bending_stiffness, bend), (mass, whisker.linear_density, shape)):
            blocks = ((weight * length * law(s))[:, None, None] * np.outer(w, w)).reshape(-1, 2, 2, 2, 2)
            by_node = matrix.reshape(size // 2, 2, size // 2, 2)
            for i, j in ((1, 1), (0, 1), (1, 0), (0, 0)):
                by_node[elements + i, :, elements + j] += blocks[:, i, :, j]
    return stiffness, mass


@lru_cache(maxsize=256)
def elastica(whisker: Whisker, at: float, offset: float, peg_radius: float | None = None) -> Contact:
    """Return the equilibrium of large bending by a frictionless point peg at the point (``at``, ``offset``) [m].

    With a ``peg_radius`` [m] the axis of a round peg is there, a sum of both radii from the centre line of the rod.

    Solves x' = cos θ, y' = sin θ, E I(s)(θ' − κ₀(s)) = (a − x) Fy − (d − y) Fx with F normal to the rod at
    the contact, on the branch that starts from the undeformed rod. The peg pushes towards +y when
    ``offset`` lies above the rest shape, else towards −y.
    """
    _check_at(whisker, at)
    return _Branch(whisker, at, 1 if offset >= whisker.curvature * at**2 else -1, peg_radius).reach(offset)


def peg_centre(whisker: Whisker, contact: Contact, peg_radius: float) -> tuple[float, float]:
    """Return the axis [m] of the round peg of radius ``peg_radius`` [m] that holds ``contact``.

    It lies one peg radius plus the local rod radius from the centre line, along the rod's normal.
    """
    # The peg lies on the side from which it pushes; a push to +y has a positive moment.
    gap = math.copysign(peg_radius + float(whisker.radius(contact.arc)), contact.moment)
    return contact.point[0] + gap * math.sin(contact.slope), contact.point[1] - gap * math.cos(contact.slope)


def slip_off_offset(whisker: Whisker, at: float, *, peg_radius: float | None = None) -> float:
    """Return the offset [m] at which a frictionless peg at distance ``at`` [m], pushed to +y, loses the whisker.

    Beyond it no equilibrium exists: the contact has run to the tip, or the rod yields without limit. The offset
    is that of the centre-line point at the contact of a point peg, or of the axis of a round peg of ``peg_radius`` [m].
    """
    _check_at(whisker, at)
    return _Branch(whisker, at, 1, peg_radius).limit()


class _Branch:
    """Equilibria with one peg, ordered by the slope θc of the rod at the contact.

    Given θc, the force f and the contact arc follow from integrating backwards from the contact
    (:func:`bent_by_contact`). Everything is mirrored to a push to +y.
    """

    _STRIDE = math.radians(2.0)

    def __init__(self, whisker: Whisker, at: float, side: int, peg_radius: float | None = None) -> None:
        self.whisker, self.at, self.side, self.peg_radius = whisker, at, side, peg_radius
        self.curvature = side * whisker.curvature

    def reach(self, offset: float) -> Contact:
        """Return the equilibrium with the peg at ``offset`` (signed)."""
        from scipy.optimize import brentq

        target = self.side * offset
        before = None
        for slope, guess, height in self._walk():
            if height >= target:
                if before is None:
                    if math.isclose(height, target, abs_tol=1e-12 * self.at):
                        return self._contact(slope, guess)
                    raise UsageError(f"A peg at ({self.at:g}, {offset:g}) m does not touch the undeformed whisker.")
                low = before

                def _miss(angle: float, low: tuple = low) -> float:
                    return self._height(angle, self._solve(angle, low[1])) - target

                root = cast("float", brentq(_miss, low[0], slope, xtol=1e-13))
                return self._contact(root, self._solve(root, guess))
            before = (slope, guess)
        raise UsageError(
            f"A peg at ({self.at:g}, {offset:g}) m has no equilibrium with this whisker: it slips off at an offset "
            f"of {self.side * self.limit():.4g} m; choose a smaller offset."
        )

    def limit(self) -> float:
        """Return the largest offset (signed) that holds the whisker."""
        from scipy.optimize import minimize_scalar

        # The largest offset lies within one stride of the highest sample.
        points = list(self._walk())
        top = max(range(len(points)), key=lambda k: points[k][2])
        low = points[max(top - 1, 0)]

        def _fall(angle: float) -> float:
            solution = self._solve(angle, low[1])
            return -self._height(angle, solution) if self._valid(solution) else 0.0

        span = low[0], points[top][0] + self._STRIDE
        optimum = minimize_scalar(_fall, bounds=span, method="bounded", options={"xatol": 1e-9})
        return self.side * max(points[top][2], -float(optimum.fun))

    def _walk(self):  # noqa: ANN202
        """Yield (slope, (force, arc), peg offset) from the first touch on, while equilibria exist."""
        rest = math.atan(2 * self.curvature * self.at)
        slope, previous = rest, None
        # Arc length of the parabola up to x = at, where the undeformed rod would touch.
        u = 2 * self.curvature * self.at
        arc = self.at if abs(u) < 1e-9 else (u * math.sqrt(1 + u * u) + math.asinh(u)) / (4 * self.curvature)
        guess = np.array([0.0, arc])
        # Near the fold the rod turns back over the peg: slopes beyond 90° are equilibria too.
        while slope < math.pi + rest:
            solution = self._solve(slope, guess)
            height = self._height(slope, solution)
            if not self._valid(solution):
                return
            yield slope, solution, height
            # Linear extrapolation along the branch keeps Newton's method from jumping to another one.
            guess = solution if previous is None else 2 * solution - previous
            previous, slope = solution, slope + self._STRIDE

    def _valid(self, solution: NDArray) -> bool:
        return bool(np.isfinite(solution).all()) and solution[1] <= self.whisker.arc_length

    def _solve(self, slope: float, guess: NDArray) -> NDArray[np.float64]:
        """Return (force, arc) at one contact slope by Newton's method; NaN when it finds none."""
        # E I/a² and a make both unknowns and both residuals numbers near one.
        force_scale = float(self.whisker.bending_stiffness(0.0)) / self.at**2
        scale = np.array([force_scale, self.at])
        z = guess / scale
        for _ in range(40):
            residual = self._residual(slope, *(z * scale))
            jacobian = np.stack(
                [(self._residual(slope, *((z + e) * scale)) - residual) / 1e-7 for e in 1e-7 * np.eye(2)], axis=1
            )
            if not np.isfinite(jacobian).all() or abs(np.linalg.det(jacobian)) < 1e-14:
                return np.full(2, math.nan)
            # Near a fold the Jacobian is almost singular; a whole step would leave the branch.
            step = np.linalg.solve(jacobian, residual)
            z = z - step * min(1.0, 0.3 / max(float(np.abs(step).max()), 1e-300))
            if np.abs(step).max() < 1e-12:
                return z * scale
        return np.full(2, math.nan)

    def _residual(self, slope: float, force: float, arc: float) -> NDArray[np.float64]:
        # The base is clamped along x, and the centre line passes the peg at a distance of both radii along its normal.
        angle, x, _, _ = self._integrate(slope, force, arc)
        return np.array([angle, (x - self.at + self._gap(arc) * math.sin(slope)) / self.at])

    def _height(self, slope: float, solution: NDArray) -> float:
        """Return the offset of the peg that belongs to an equilibrium."""
        if not np.isfinite(solution).all():
            return math.nan
        return self._integrate(slope, *solution)[2] - self._gap(solution[1]) * math.cos(slope)

    def _gap(self, arc: float) -> float:
        return 0.0 if self.peg_radius is None else self.peg_radius + float(self.whisker.radius(arc))

    def _contact(self, slope: float, solution: NDArray) -> Contact:
        size, arc = map(float, solution)
        _, x, y, moment = self._integrate(slope, size, arc)
        # Without friction the force is normal to the rod.
        force = (-size * math.sin(slope), self.side * size * math.cos(slope))
        return Contact(force, self.side * moment, arc, self.side * slope, (x, self.side * y))

    def _integrate(self, slope: float, force: float, arc: float) -> tuple[float, float, float, float]:
        """Return base angle, contact point (x, y) and base moment: Runge-Kutta steps from contact to base."""
        half = np.linspace(arc, 0.0, 2 * _STEPS + 1)
        flexibility = 1 / np.maximum(self.whisker.bending_stiffness(half), 1e-300)
        rest = self.side * rest_curvature(self.whisker, np.abs(half))
        *_, (turn, moment, x, y) = bent_by_contact(flexibility.tolist(), rest.tolist(), -arc / _STEPS, force, math)
        cosine, sine = math.cos(slope), math.sin(slope)
        return slope + turn, sine * y - cosine * x, -sine * x - cosine * y, moment


def rest_curvature(whisker: Whisker, s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the curvature (1/m) at rest at arcs s (m): of the parabola y = A x², 2 A cos³ψ with tan ψ = y′."""
    return 2 * whisker.curvature * np.cos(whisker.tangent_angle(s)) ** 3


def bent_by_contact(flexibility: Any, rest: Any, step: Any, force: Any, xp: Any = np) -> Iterator[tuple[Any, ...]]:
    """Yield angle ψ (rad), moment (N·m) and place (m) of a rod in steps (m, negative) from its contact to the base.

    Against its direction at the contact, where all are 0, dψ/ds = κ₀ + M/(E I) and dM/ds = −f cos ψ (Antman 2005,
    Nonlinear Problems of Elasticity, chapter 4), with a force f (N) normal to the rod. ``flexibility`` 1/(E I) and
    ``rest`` κ₀ are at ends and middles of the steps: numbers, for which ``xp`` is ``math``, or arrays of several rods.
    """
    angle = moment = x = y = 0.0 * force
    yield angle, moment, x, y
    for k in range(0, len(rest) - 1, 2):
        # Classical Runge-Kutta step; positions are integrated with its weights.
        (f0, f1, f2), (c0, c1, c2) = flexibility[k : k + 3], rest[k : k + 3]
        a1, m1 = c0 + moment * f0, -force * xp.cos(angle)
        p2 = angle + step / 2 * a1
        a2, m2 = c1 + (moment + step / 2 * m1) * f1, -force * xp.cos(p2)
        p3 = angle + step / 2 * a2
        a3, m3 = c1 + (moment + step / 2 * m2) * f1, -force * xp.cos(p3)
        p4 = angle + step * a3
        a4, m4 = c2 + (moment + step * m3) * f2, -force * xp.cos(p4)
        x = x + step / 6 * (xp.cos(angle) + 2 * xp.cos(p2) + 2 * xp.cos(p3) + xp.cos(p4))
        y = y + step / 6 * (xp.sin(angle) + 2 * xp.sin(p2) + 2 * xp.sin(p3) + xp.sin(p4))
        angle = angle + step / 6 * (a1 + 2 * a2 + 2 * a3 + a4)
        moment = moment + step / 6 * (m1 + 2 * m2 + 2 * m3 + m4)
        yield angle, moment, x, y


def _check_at(whisker: Whisker, at: float) -> None:
    check_number("at (m), the distance from the base", at, above=0, most=whisker.arc_length)
