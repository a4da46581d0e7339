"""A whisker as a chain of rigid tapered links joined by elastic hinges: two for bending, and some for twist.

Joint i stands at arc length i L/N for the bending of the cell around it, half a cell at the base, so its compliance is
about 1/k = ∫ ds/(E I) over that cell. The virtual work of bending is ∫ M²/(E I) ds; interpolating M² by a parabola
through three joints instead of a constant per cell makes ten links as good as thirty. Joints lie on the rest curve, so
the whole intrinsic curvature survives any number of links. Joints 1, 3, 5 … also twist, each for the cells on both
sides of it: twist is a small part of the deformation, and every second joint makes its error no larger than that of
bending at half the cost. Letters: N link, 0 = base.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.core.reading.ranges import check_number
from brainbench.stimuli.whiskers.whisker import NODES, WEIGHTS, Whisker, quadrature

# Ratio of the radii across a cell from which ``_compliance`` does without its parabola.
_STEEPEST = 1.4


@dataclass(frozen=True, eq=False)
class Chain:
    """Rigid links and elastic joints of one whisker; SI units, link frames with x along the link."""

    whisker: Whisker
    nodes: NDArray[np.float64]
    """[N + 1] arc lengths of the joints and of the tip (m)."""
    points: NDArray[np.float64]
    """[N + 1, 2] rest positions of the nodes in the base frame (m)."""
    lengths: NDArray[np.float64]
    """[N] chord lengths of the links (m)."""
    rest_angles: NDArray[np.float64]
    """[N] rest rotation about z of each link against the one before, the first against the base (rad)."""
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

    def locate(self, arc: float) -> tuple[int, float]:
        """Return the link at an arc length (m), at a joint the one before it, and the share of the link up to there."""
        link = min(max(int(np.searchsorted(self.nodes, arc)) - 1, 0), self.links - 1)
        return link, (arc - self.nodes[link]) / (self.nodes[link + 1] - self.nodes[link])

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
        beta = 2 * self.whisker.damping_ratio / self.frequencies()[0] - time_step
        return max(beta, 0.0) * self.stiffness

    def achieved_damping_ratio(self, time_step: float) -> float:
        """Return the damping ratio of the first mode with this step; too long a step raises it above the whisker's."""
        return max(self.whisker.damping_ratio, float(self.frequencies()[0]) * time_step / 2)

    def _planar_mass(self) -> NDArray[np.float64]:
        """Return the joint-space inertia [N, N] of the straightened chain for small rotations about z."""
        joints = np.concatenate([[0.0], np.cumsum(self.lengths)[:-1]])
        centres = joints + self.centres
        # arm[i, j]: lever of joint j at the centre of mass of link i, which it moves only when j ≤ i.
        arm = np.tril(centres[:, None] - joints[None, :])
        lower = np.tril(np.ones_like(arm))
        # Σ m v² of the centres of mass, and Σ I ω²: every joint up to link i turns that link.
        return (arm * self.masses[:, None]).T @ arm + lower.T @ (lower * self.inertias[:, 1:])


def build_chain(whisker: Whisker, links: int) -> Chain:
    """Cut ``whisker`` into at least two ``links`` of equal arc length."""
    check_number("The number of links", links, least=2, whole=True)
    nodes = np.linspace(0.0, whisker.arc_length, links + 1)
    points = whisker.centre_line(nodes)
    chords = np.diff(points, axis=0)
    angles = np.arctan2(chords[:, 1], chords[:, 0])
    lengths = np.linalg.norm(chords, axis=1)
    rest_angles, radii = np.diff(angles, prepend=0.0), whisker.radius((nodes[:-1] + nodes[1:]) / 2)
    frusta, compliance = _frusta(whisker, nodes, lengths), _compliance(whisker, links)
    stiffness, torsion = 1 / compliance, whisker.torsion_ratio * _shared_stiffness(compliance)
    return Chain(whisker, nodes, points, lengths, rest_angles, radii, *frusta, stiffness, torsion)


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

    def integrate(values: NDArray) -> NDArray:
        return np.bincount(link, half * (values @ WEIGHTS))

    masses, first, second = (integrate(density * along**power) for power in range(3))
    polar = integrate(density * whisker.radius(s) ** 2 / 4)
    # Arc to chord: the mass of an arc is spread along a slightly shorter line.
    ratio = lengths / np.diff(nodes)
    centres = first / masses * ratio
    # Parallel axes: from the joint to the centre of mass. A disc adds m r²/4 about a diameter, m r²/2 about its axis.
    transverse = (second - first**2 / masses) * ratio**2 + polar
    return masses, centres, np.stack([2 * polar, transverse], axis=-1)
