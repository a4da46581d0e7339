"""One whisker: a tapered, intrinsically curved elastic rod, and the chain of links that engines simulate in its place.

The base frame has its origin at the base point; the whisker leaves along +x and curves in the x-y
plane with its concave side towards +y. Arc length s runs from 0 at the base to L at the tip. SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from functools import cached_property, lru_cache
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, brief, check_each, check_kind, check_number
from brainbench.core.limits import Limit, NotNegative, limited
from brainbench.core.rotations import Length

SOFTEST = 1e3
"""Young's modulus [Pa] below which a number looks like gigapascals."""
LIGHTEST = 10.0
"""Density [kg/m³] below which a number looks like grams per cubic centimetre."""

_Density = Annotated[float, Limit(least=LIGHTEST, unit="kg/m³")]
NODES, WEIGHTS = np.polynomial.legendre.leggauss(8)
"""Gauss-Legendre quadrature on [−1, 1]."""

_Stiffness = Annotated[float, Limit(above=0)]
_Spring = tuple[_Stiffness, _Stiffness]


@limited(of="{} of a follicle")
class FollicleSprings:
    """What holds a follicle that gives way: a spring and a damper of each axis that is not rigid.

    Axes are those of the base frame: x along the whisker, curvature in the x-y plane. No absolute constants are
    published; a first guess is a turn of the size of the whisker's own, k = 3 E I/L.
    """

    along_x: _Spring | None = None
    """Stiffness [N/m] and damping [N·s/m] against slides along an axis; rigid without."""
    along_y: _Spring | None = None
    along_z: _Spring | None = None
    about_x: _Spring | None = None
    """Stiffness [N·m/rad] and damping [N·m·s/rad] against turns about an axis; rigid without."""
    about_y: _Spring | None = None
    about_z: _Spring | None = None

    def __post_init__(self) -> None:
        for axis, pair in ((axis.name, getattr(self, axis.name)) for axis in fields(self)):
            object.__setattr__(self, axis, pair and tuple(map(float, pair)))
        if not self.constants.any():
            raise UsageError("A follicle that gives way has one spring at least, such as about_z = (1e-6, 1e-9).")

    @property
    def constants(self) -> NDArray[np.float64]:
        """[6, 2] stiffness and damping of slides along x, y, z and of turns about them; 0 for rigid axes."""
        return np.array([getattr(self, axis.name) or (0.0, 0.0) for axis in fields(self)])


@limited(of="{} of a whisker", unresolved=("follicle",))
class Whisker:
    """Geometry and material of one whisker.

    Radius and density vary linearly with arc length, unless tables say how radius and Young's modulus run.
    The cross-section is a solid circle. The rest shape is the parabola y = A x² (A = ``curvature``), measured along its
    arc, or what ``bends`` says, in space.
    """

    arc_length: Length
    """Length along the centre line L [m]."""
    base_radius: Length
    """Radius at the base [m]."""
    tip_radius: Length
    """Radius at the tip [m]; positive, because a real tip is cut or worn and a point has no stiffness."""
    young_modulus: Annotated[float, Limit(least=SOFTEST, unit="Pa")]
    """Young's modulus E [Pa]."""
    density: _Density | tuple[_Density, _Density]
    """Mass density [kg/m³], one number or (base, tip)."""
    damping_ratio: NotNegative
    """Fraction of critical damping of the first bending mode (stiffness-proportional damping)."""
    curvature: Annotated[float, Limit(unit="1/m")] = 0.0
    """Coefficient A of the rest shape y = A x² [1/m]; negative bends towards −y."""
    friction: NotNegative = 0.48
    """Coulomb coefficient against objects that bring none of their own; .48 was measured on steel."""
    poisson_ratio: Annotated[float, Limit(above=-1, most=0.5)] = field(default=0.4, metadata={"later": True})
    """Poisson's ratio ν, above −1 and at most .5: the shear modulus is G = E/(2 (1 + ν)). Not measured on whiskers; .4
    is usual for polymers. Along its axis human hair twists more easily still: E = 3.9, G = .9 GPa (Robbins 2012)."""
    radii: tuple[tuple[float, float], ...] = field(default=(), metadata={"later": True})
    """Rows (arc length, radius) [m] from the base, at 0, to the tip, at ``arc_length``, linear in between: as measured,
    with the end where a tip is cut. They take the place of ``base_radius`` and ``tip_radius``."""
    moduli: tuple[tuple[float, float], ...] = field(default=(), metadata={"later": True})
    """Rows (arc length [m], Young's modulus [Pa]) likewise, in place of ``young_modulus``, then that at the base."""
    bends: tuple[tuple[float, float, float], ...] = field(default=(), metadata={"later": True})
    """Rows (arc length [m], curvature κ, torsion τ [1/m]) likewise, in place of ``curvature``: at rest the tangent t,
    normal n and binormal b, first x, y and z, turn by t' = κ n, n' = τ b − κ t, b' = −τ n. κ < 0 bends back."""
    follicle: FollicleSprings | None = field(default=None, metadata={"later": True})
    """What gives way at the base; nothing when None."""

    def __post_init__(self) -> None:
        for name, what, least in (
            ("radii", "radius", 0.0),
            ("moduli", "Young's modulus", SOFTEST),
            ("bends", "curvature, torsion", -np.inf),
        ):
            rows = tuple(tuple(map(float, row)) for row in getattr(self, name))
            object.__setattr__(self, name, rows)
            if rows:
                self._check_table(name, what, least)
        if self.radii:
            object.__setattr__(self, "base_radius", self.radii[0][1])
            object.__setattr__(self, "tip_radius", self.radii[-1][1])
        if self.moduli:
            object.__setattr__(self, "young_modulus", self.moduli[0][1])
        if self.bends and self.curvature:
            raise UsageError("A whisker has a rest shape by its curvature or by its table of bends, not both.")
        if isinstance(self.follicle, dict):
            check_each("follicle axis", self.follicle, [axis.name for axis in fields(FollicleSprings)])
            object.__setattr__(self, "follicle", FollicleSprings(**self.follicle))
        elif self.follicle is not None:
            check_kind("follicle of a whisker", self.follicle, FollicleSprings, "a table of its springs")
        if isinstance(self.density, (tuple, list)):
            object.__setattr__(self, "density", (float(self.density[0]), float(self.density[1])))
        thickest = self.thickest
        if thickest > self.arc_length / 5:
            raise UsageError(
                f"A whisker of arc length {self.arc_length:g} m with radius {thickest:g} m"
                " is no slender rod (radius above a fifth of the length); all lengths are in metres."
            )
        turn = max([2 * abs(self.curvature), *(math.hypot(bend, twist) for _, bend, twist in self.bends)])
        if turn * thickest >= 1:
            raise UsageError(
                f"A whisker with radius {thickest:g} m cannot turn by {turn:g} rad/m at rest, since its sides would"
                " meet; curvature and torsion are in 1/m."
            )

    def _check_table(self, name: str, what: str, least: float) -> None:
        arcs, *values = np.transpose(getattr(self, name))
        ascends = len(arcs) > 1 and (np.diff(arcs) > 0).all()
        if not (ascends and arcs[0] == 0 and math.isclose(arcs[-1], self.arc_length, rel_tol=1e-9)):
            raise UsageError(
                f"{name} of a whisker are rows (arc length, {what}) whose arc lengths (m) ascend from 0 to that of the"
                f" whisker, {self.arc_length:g}; received arc lengths {brief(arcs.tolist())}."
            )
        if not np.greater(values, least).all():
            raise UsageError(
                f"Every {what} in the {name} of a whisker is above {least:g}, in SI units; received"
                f" {brief(np.concatenate(values).tolist())}."
            )

    @property
    def thickest(self) -> float:
        """Largest radius [m]."""
        return max(self.base_radius, self.tip_radius, *(radius for _, radius in self.radii))

    @property
    def straight(self) -> bool:
        """True without any curvature at rest."""
        return self.curvature == 0 and not any(bend for _, bend, _ in self.bends)

    @property
    def breaks(self) -> NDArray[np.float64]:
        """Arc lengths [m], ascending, at which a table bends, so that no polynomial holds on both sides."""
        return np.unique([arc for rows in (self.radii, self.moduli) for arc, _ in rows[1:-1]])

    @property
    def densities(self) -> tuple[float, float]:
        """Density at base and tip [kg/m³]."""
        return self.density if isinstance(self.density, tuple) else (float(self.density), float(self.density))

    @property
    def mass(self) -> float:
        """Mass of the whole whisker [kg], the integral of ρ π r² (exact)."""
        s, weights = quadrature(0.0, self.arc_length, self.breaks)
        return float(self.linear_density(s) @ weights)

    def radius(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the radius [m] at arc length ``s`` [m]."""
        if self.radii:
            return _along(self.radii, s)
        return self.base_radius + (self.tip_radius - self.base_radius) * self._fraction(s)

    def bending_stiffness(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the flexural rigidity E I [N·m²] at arc length ``s`` [m], with the second moment I = π r⁴/4."""
        return (_along(self.moduli, s) if self.moduli else self.young_modulus) * (np.pi * self.radius(s) ** 4 / 4)

    @property
    def torsion_ratio(self) -> float:
        """Torsional over flexural rigidity, G J/(E I) = 1/(1 + ν): J = π r⁴/2 is twice the second moment I."""
        return 1 / (1 + self.poisson_ratio)

    def linear_density(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the mass per length ρ π r² [kg/m] at arc length ``s`` [m]."""
        base, tip = self.densities
        return (base + (tip - base) * self._fraction(s)) * np.pi * self.radius(s) ** 2

    def rest_points(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the rest positions [n, 3] in the base frame [m] at n arc lengths ``s`` [m]."""
        if self.bends:
            return _path(self.bends)(np.asarray(s, dtype=float))[:3].T
        return np.pad(self.centre_line(s), ((0, 0), (0, 1)))

    def centre_line(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the rest positions (x, y) [..., 2] in the base frame [m] at arc length ``s`` [m] of a parabola."""
        x = self._abscissa(s)
        return np.stack([x, self.curvature * x**2], axis=-1)

    def tangent_angle(self, s: ArrayLike) -> NDArray[np.float64]:
        """Return the angle of the rest centre line against +x [rad] at arc length ``s`` [m]."""
        return np.arctan(2 * self.curvature * self._abscissa(s))

    def _abscissa(self, s: ArrayLike) -> NDArray[np.float64]:
        """Invert s(x) = (u √(1+u²) + asinh u)/(4A), u = 2 A x, by Newton's method."""
        if self.bends:
            raise UsageError("Only whiskers whose rest shape is y = A x² can be used here; leave bends out.")
        s = np.asarray(s, dtype=float)
        target = 4 * self.curvature * s
        # So nearly straight, arc and abscissa are equal to rounding, and the end of this function would divide by 0.
        if abs(self.curvature) * self.arc_length < 1e-9:
            return s.copy()
        # Both bounds lie beyond the root of this convex function, so Newton's method descends to it.
        u = np.sign(target) * np.minimum(np.abs(target) / 2, np.sqrt(np.abs(target)))
        for _ in range(50):
            root = np.sqrt(1 + u**2)
            step = (u * root + np.arcsinh(u) - target) / (2 * root)
            u = u - step
            if np.all(np.abs(step) <= 1e-15 * (1 + np.abs(u))):
                break
        return u / (2 * self.curvature)

    def _fraction(self, s: ArrayLike) -> NDArray[np.float64]:
        return np.asarray(s, dtype=float) / self.arc_length


def _along(rows: tuple[tuple[float, float], ...], s: ArrayLike) -> NDArray[np.float64]:
    """Return the values of a table at arc length ``s`` [m]."""
    return np.asarray(np.interp(np.asarray(s, dtype=float), *np.transpose(rows)))


@lru_cache(maxsize=64)
def _path(bends: tuple[tuple[float, float, float], ...]) -> Any:
    """Return the function from arc lengths [n] (m) to place (m), tangent, normal and binormal [12, n] at rest."""
    from scipy.integrate import solve_ivp

    arcs, curvatures, torsions = np.transpose(bends)

    def _slope(s: float, state: NDArray[np.float64]) -> NDArray[np.float64]:
        tangent, normal, binormal = state[3:].reshape(3, 3)
        bend, turn = np.interp(s, arcs, curvatures), np.interp(s, arcs, torsions)
        return np.concatenate([tangent, bend * normal, turn * binormal - bend * tangent, -turn * normal])

    state, pieces = np.concatenate([np.zeros(3), np.eye(3).ravel()]), []
    for ends in pairwise(arcs):  # each by itself, so that rows may lie as near as they like
        solution = solve_ivp(_slope, ends, state, "DOP853", rtol=1e-12, atol=1e-15, dense_output=True)
        state = solution.y[:, -1]
        pieces.append(solution.sol)

    def _along(s: NDArray[np.float64]) -> NDArray[np.float64]:
        rows = np.searchsorted(arcs[1:-1], s, side="right")
        return np.stack([pieces[row](arc) for row, arc in zip(rows.flat, s.flat, strict=True)], -1).reshape(
            12, *s.shape
        )

    return _along


def quadrature(low: float, high: float, breaks: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points and weights that integrate over [low, high] what is smooth between ``breaks`` (Gauss-Legendre)."""
    edges = np.array([low, *breaks[(breaks > low) & (breaks < high)], high])
    first, half = edges[:-1, None], np.diff(edges)[:, None] / 2
    return (first + half * (NODES + 1)).ravel(), (half * WEIGHTS).ravel()


# Ratio of the radii across a cell from which ``_compliance`` does without its parabola.
_STEEPEST = 1.4


@dataclass(frozen=True, eq=False)
class Chain:
    """Rigid links and elastic joints of one whisker; SI units, link frames with x along the link."""

    whisker: Whisker
    nodes: NDArray[np.float64]
    """[N + 1] arc lengths of the joints and of the tip (m)."""
    points: NDArray[np.float64]
    """[N + 1, 3] rest positions of the nodes in the base frame (m)."""
    lengths: NDArray[np.float64]
    """[N] chord lengths of the links (m)."""
    rest_angles: NDArray[np.float64]
    """[N] rest rotation about z of each link against the one before, the first against the base (rad)."""
    rest_rolls: NDArray[np.float64]
    """[N] rotation about the link before, ahead of that, which leads the rest shape out of a plane (rad)."""
    radii: NDArray[np.float64]
    """[N] mean radius of each link (m)."""
    masses: NDArray[np.float64]
    """[N] link masses (kg)."""
    centres: NDArray[np.float64]
    """[N] distance of each centre of mass from the link's joint (m)."""
    inertias: NDArray[np.float64]
    """[N, 2] axial and transverse moment of inertia about the centre of mass (kg·m²)."""
    stiffness: NDArray[np.float64]
    """[N] bending stiffness of each hinge (N·m/rad), the same about both axes."""
    torsion: NDArray[np.float64]
    """[N] stiffness against twist (N·m/rad) of joints 1, 3, 5 …; 0 for the others, which do not twist."""

    @property
    def links(self) -> int:
        """Number of links N."""
        return len(self.lengths)

    @property
    def rest_turns(self) -> NDArray[np.float64]:
        """[N, 3, 3] rest rotation of each link against the one before, the first against the base."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_euler("XZ", np.stack([self.rest_rolls, self.rest_angles], axis=1)).as_matrix()

    def locate(self, arc: float) -> tuple[int, float]:
        """Return the link at an arc length (m), at a joint the one before it, and the share of the link up to there."""
        link = min(max(int(np.searchsorted(self.nodes, arc)) - 1, 0), self.links - 1)
        return link, (arc - self.nodes[link]) / (self.nodes[link + 1] - self.nodes[link])

    @cached_property
    def first_frequency(self) -> float:
        """Lowest angular frequency (rad/s); see :meth:`frequencies`."""
        return float(self.frequencies()[0])

    def frequencies(self, count: int = 1) -> NDArray[np.float64]:
        """Return the lowest angular frequencies [count] (rad/s) of small planar motion, undamped, base fixed."""
        from scipy.linalg import eigh

        wanted = [self.links - min(count, self.links), self.links - 1]
        # K a = ω² M a, solved as M a = ω⁻² K a: the wanted modes are then the largest, best-resolved ones.
        inverse = eigh(self._planar_mass(), np.diag(self.stiffness), eigvals_only=True, subset_by_index=wanted)
        return 1 / np.sqrt(inverse[::-1])

    def mode_shape(self, mode: int) -> NDArray[np.float64]:
        """Return the bend of each joint [N] (rad, largest 1) in one undamped mode of small planar motion, 0 = first."""
        from scipy.linalg import eigh

        index = self.links - 1 - mode
        _, shapes = eigh(self._planar_mass(), np.diag(self.stiffness), subset_by_index=[index, index])
        return shapes[:, 0] / np.abs(shapes[:, 0]).max()

    def damping(self, time_step: float) -> NDArray[np.float64]:
        """Return the damping of each hinge [N] (N·m·s/rad) that gives the first mode the whisker's damping ratio.

        A linearly implicit (backward Euler) step of length ``time_step`` (s) adds the damping of one
        step: stiffness-proportional damping β k behaves as (β + dt) k. So β = max(2 ζ/ω₁ − dt, 0).
        """
        # Damping β k gives a mode ω the ratio β ω/2.
        beta = 2 * self.whisker.damping_ratio / self.first_frequency - time_step
        return max(beta, 0.0) * self.stiffness

    def achieved_damping_ratio(self, time_step: float) -> float:
        """Return the damping ratio of the first mode with this step; too long a step raises it above the whisker's."""
        return max(self.whisker.damping_ratio, self.first_frequency * time_step / 2)

    def _planar_mass(self) -> NDArray[np.float64]:
        """Return the joint-space inertia [N, N] of the straightened chain for small rotations about z."""
        joints = np.concatenate([[0.0], np.cumsum(self.lengths)[:-1]])
        centres = joints + self.centres
        # arm[i, j]: lever of joint j at the centre of mass of link i, which it moves only when j ≤ i.
        arm = np.tril(centres[:, None] - joints[None, :])
        lower = np.tril(np.ones_like(arm))
        # Σ m v² of the centres of mass, and Σ I ω²: every joint up to link i turns that link.
        return (arm * self.masses[:, None]).T @ arm + lower.T @ (lower * self.inertias[:, 1:])


_LEAST_CHORD = math.sin(0.75) / 0.75
"""Length of a link over that of its arc where the rest shape turns by 1.5 rad within the link."""


@lru_cache(maxsize=512)
def build_chain(whisker: Whisker, links: int) -> Chain:
    """Cut ``whisker`` into at least two ``links`` of equal arc length; callers share the result."""
    check_number("The number of links", links, least=2, whole=True)
    nodes = np.linspace(0.0, whisker.arc_length, links + 1)
    points = whisker.rest_points(nodes)
    chords = np.diff(points, axis=0)
    lengths = np.linalg.norm(chords, axis=1)
    if (lengths < _LEAST_CHORD * np.diff(nodes)).any():
        tightest = max(abs(bend) for _, bend, _ in whisker.bends)
        raise UsageError(
            f"{links} links are too few for a whisker that turns by up to {tightest:g} rad/m at rest: more than 1.5 rad"
            f" in one of them; choose {int(tightest * whisker.arc_length / 1.5) + 1} or more."
        )
    rest_rolls, rest_angles = _turns(chords)
    radii = whisker.radius((nodes[:-1] + nodes[1:]) / 2)
    frusta, compliance = _frusta(whisker, nodes, lengths), _compliance(whisker, links)
    stiffness, torsion = 1 / compliance, whisker.torsion_ratio * _shared_stiffness(compliance)
    return Chain(whisker, nodes, points, lengths, rest_angles, rest_rolls, radii, *frusta, stiffness, torsion)


def _turns(chords: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rolls about x and the bends about z [N] (rad) that lead from each chord [N, 3] to the next."""
    if not chords[:, 2].any():
        return np.zeros(len(chords)), np.diff(np.unwrap(np.arctan2(chords[:, 1], chords[:, 0])), prepend=0.0)
    from scipy.spatial.transform import Rotation

    turns, frame = np.zeros((len(chords), 2)), np.eye(3)
    for link, chord in enumerate(chords):
        x, y, z = chord @ frame
        # The nearer of both ways: a plane S bends to either side, without a roll.
        roll = math.atan(z / y) if y else math.copysign(math.pi / 2, z) if z else 0.0
        turns[link] = roll, math.atan2(y * math.cos(roll) + z * math.sin(roll), x)
        frame = frame @ Rotation.from_euler("XZ", turns[link]).as_matrix()
    return turns[:, 0], turns[:, 1]


def _compliance(whisker: Whisker, links: int) -> NDArray[np.float64]:
    """Return the compliance of each joint [N] (rad/(N·m)): the integral of M²/(E I), M² quadratic around each cell."""
    cell = whisker.arc_length / links
    total, breaks = np.zeros(links + 1), whisker.breaks
    for i in range(links + 1):
        low, high = max(0.0, (i - 0.5) * cell), min(whisker.arc_length, (i + 0.5) * cell)
        s, weights = quadrature(low, high, breaks)
        stiffness = whisker.bending_stiffness(s)
        flexibility = weights / stiffness
        if i == links:
            # Next to the free tip the moment of a tip load falls to zero linearly.
            total[i - 1] += flexibility @ (s / cell - i) ** 2
            continue
        steep = whisker.radius(low) > _STEEPEST * whisker.radius(high)
        if steep or (len(breaks) and stiffness.max() > _STEEPEST**4 * stiffness.min()):
            # Across such a steep cell a parabola would take more from a neighbour than that has; keep it whole, with
            # a moment that falls towards the tip as under loads spread along a cone.
            total[i] += flexibility @ ((whisker.arc_length - s) / (whisker.arc_length - i * cell)) ** 3
            continue
        # No joint stands before the base: its half cell takes the parabola of the cell behind it.
        middle = max(i, 1)
        x = s / cell - middle
        # Lagrange polynomials through the three joints around the cell.
        for j, weight in enumerate((x * (x - 1) / 2, 1 - x**2, x * (x + 1) / 2), start=middle - 1):
            total[j] += flexibility @ weight
    # The free tip carries no moment, so what falls on it needs no joint.
    return total[:links]


def _shared_stiffness(compliance: NDArray) -> NDArray[np.float64]:
    """Return the stiffness [N] of joints 1, 3, 5 … that take over half the compliance of each neighbour; 0 of others.

    The base has no neighbour but joint 1, which takes all of it.
    """
    shares = np.concatenate([compliance[:1], compliance, [0.0]])
    whole = compliance + (shares[:-2] + shares[2:]) / 2
    whole[1] += compliance[0] / 2
    whole[::2] = np.inf
    return 1 / whole


def _frusta(whisker: Whisker, nodes: NDArray, lengths: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Return the mass [N], centre of mass [N] and inertia [N, 2] of conical frusta whose density varies linearly.

    The mass of each arc is kept whole and spread along its chord.
    """
    # Smooth pieces of the links: the integrands are polynomials of degree 5, and eight points integrate degree 15.
    edges = np.union1d(nodes, whisker.breaks)
    link, half = np.searchsorted(nodes, edges[:-1], side="right") - 1, np.diff(edges) / 2
    s = edges[:-1, None] + half[:, None] * (NODES + 1)
    density, along = whisker.linear_density(s), s - nodes[link][:, None]

    def _integrate(values: NDArray) -> NDArray:
        return np.bincount(link, half * (values @ WEIGHTS))

    masses, first, second = (_integrate(density * along**power) for power in range(3))
    polar = _integrate(density * whisker.radius(s) ** 2 / 4)
    # Arc to chord: the mass of an arc is spread along a slightly shorter line.
    ratio = lengths / np.diff(nodes)
    centres = first / masses * ratio
    # Parallel axes: from the joint to the centre of mass. A disc adds m r²/4 about a diameter, m r²/2 about its axis.
    transverse = (second - first**2 / masses) * ratio**2 + polar
    return masses, centres, np.stack([2 * polar, transverse], axis=-1)
