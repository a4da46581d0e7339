"""Whiskers, their motions and their jobs as the arrays of the kernel. mg, mm, ms."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core import rotations
from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.motion_pieces import Cutting, MotionPieces, Pose, carried_pose, side_of
from brainbench.stimuli.engines.rod.limits import LIGHT
from brainbench.stimuli.engines.units import MICRO, MILLI
from brainbench.stimuli.motion.jobs import Follicle, Load
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.whiskers.chain import Chain

CAPACITIES = (12, 24, 48, 100)
"""Links for which kernels are compiled; a chain takes the smallest that holds it."""
GRID = 32.0
"""Knots are kept as a multiple of this (mm), exact in single precision up to kilometres, and the rest."""


KNOT = np.dtype(
    [("place", "f8", 3), ("velocity", "f8", 3), ("quaternion", "f8", 4), ("spin", "f8", 3), ("surge", "f8", 3)]
)
"""A knot of a track: place (mm), velocity, quaternion, angular velocity (rad/ms), angular acceleration."""


@dataclass
class PackedMotions:
    """Motions as cubic pieces, all from the start of the launch: knots and cells of all tracks one behind the other."""

    first: list[int] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    cells: list[NDArray[np.int32]] = field(default_factory=list)
    """Per moving track the first knot of each cell, and the last knot of all."""
    knots: list[NDArray[np.void]] = field(default_factory=list)
    """[knot] of :data:`KNOT` per track."""
    _sizes: list[int] = field(default_factory=lambda: [0, 0])
    """Knots and entries of ``cells`` so far."""

    def add(self, track: Track) -> int:
        """Append a track and return its index."""
        if len(track.knots) == 1:
            return int(self.add_straight(track.knots)[0])
        self.first.append(self._sizes[1])
        self.count.append(len(track.cells))
        self.cells.append(track.cells + np.int32(self._sizes[0]))
        self._append(track.knots)
        self._sizes[1] += len(track.cells)
        return len(self.first) - 1

    def add_straight(self, knots: NDArray[np.void]) -> NDArray[np.int32]:
        """Append bodies of one knot each [body], which stand or move straight; return their tracks [body]."""
        new = np.arange(len(self.first), len(self.first) + len(knots), dtype=np.int32)
        self.first.extend(range(self._sizes[0], self._sizes[0] + len(knots)))
        self.count.extend([1] * len(knots))
        self._append(knots)
        return new

    def _append(self, knots: NDArray[np.void]) -> None:
        self.knots.append(knots)
        self._sizes[0] += len(knots)

    def arrays(self) -> dict[str, NDArray]:
        """Return what the kernel's ``MotionArrays`` hold."""
        knots = np.concatenate(self.knots)
        coarse = np.round(knots["place"] / GRID) * GRID
        return {
            "first": np.array(self.first, dtype=np.int32),
            "count": np.array(self.count, dtype=np.int32),
            "cell": np.concatenate(self.cells or [np.zeros(1, dtype=np.int32)]),
            "coarse": coarse,
            "place": knots["place"] - coarse,
            **{name: knots[name] for name in ("velocity", "quaternion", "spin", "surge")},
        }


def capacity_for(links: int) -> int:
    """Return the smallest compiled capacity that holds a chain."""
    return next(capacity for capacity in CAPACITIES if capacity >= links)


def still_knots(position: NDArray, quaternion: ArrayLike) -> NDArray[np.void]:
    """Return the one knot [1] of a body at rest; position in metres."""
    knot = np.zeros(1, dtype=KNOT)
    knot["place"] = np.asarray(position) * MILLI
    knot["quaternion"] = quaternion
    return knot


@dataclass(frozen=True, eq=False)
class Track:
    """Motion of a base or a body as cubic pieces, from the start of a launch."""

    knots: NDArray[np.void]
    """[knot] of :data:`KNOT`; one for a body that stands or moves straight."""
    cells: NDArray[np.int32]
    """[cell + 1] first knot of each cell, and the last knot."""
    times: NDArray[np.float64]
    """[n] s at which anything may change: those of the knots."""
    pieces: MotionPieces | None = None
    """None for a body that stands still."""


def follicle_track(follicle: Follicle, size: float, cutting: Cutting) -> Track:
    """Return the track of a follicle whose whisker has the arc length ``size`` (m)."""
    # Looking for motion takes as long as simulating a short whisker.
    if getattr(follicle, "finest", None) == math.inf:
        place, euler = (np.asarray(values, dtype=float) for values in follicle.pose(np.array([cutting.start])))
        return still_track(place[0], rotations.from_matrices(base_rotation(euler))[0])
    return _track(follicle.pose, base_rotation, cutting.follicle(follicle, size), cutting.start)


def body_track(obstacle: Obstacle, anchor: NDArray[np.float64], cutting: Cutting) -> Track:
    """Return the track of the point ``anchor`` [3] (m) of an obstacle that moves."""
    pose = carried_pose(obstacle.motion, anchor)
    return _track(pose, np.asarray, cutting.obstacle(obstacle, anchor), cutting.start)


def still_track(place: NDArray[np.float64], quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0)) -> Track:
    """Return the track of what stands at ``place`` [3] (m)."""
    return Track(still_knots(place, quaternion), np.zeros(1, dtype=np.int32), np.zeros(0))


def knots_alike(
    track: Track, pose: Pose, to_matrices: Callable[[NDArray], NDArray], span: tuple[float, float], what: str
) -> NDArray[np.void]:
    """Return the knots [knot] of another pose, where a track that begins and ends at ``span`` (s) has its own."""
    if track.pieces is None:
        seen = np.linspace(*span, 17)
        place, rotation = pose(seen)
        place, rotation = np.asarray(place, dtype=float), to_matrices(np.asarray(rotation, dtype=float))
        if max(np.ptp(place, axis=0).max(), np.ptp(rotation, axis=0).max()) > 1e-12:
            raise UsageError(
                f"A parameter moves {what}, which stands still at the given values; give values at which it moves."
            )
        knots = still_knots(place[0], rotations.from_matrices(rotation[:1])[0])
    else:
        times, _ = track.pieces.times(span[0])
        knots = _knots(pose, to_matrices, times, _sides(track.pieces))
        if len(track.knots) == 1:
            if not _is_straight(knots):
                raise UsageError(
                    f"A parameter bends the way of {what}, which is straight at the given values; give others."
                )
            knots = knots[:1]
    # Both signs of a quaternion are the same rotation.
    if knots["quaternion"][0] @ track.knots["quaternion"][0] < 0:
        knots["quaternion"] *= -1.0
    return knots


def _sides(pieces: MotionPieces) -> NDArray[np.float64]:
    return side_of(np.append(np.repeat(pieces.count, pieces.count), pieces.count[-1]))


def _is_straight(knots: NDArray[np.void]) -> bool:
    # All velocities together: from one knot to the next that of a very slow motion hardly changes.
    straight = np.ptp(knots["velocity"], axis=0).max() < 1e-9 and not knots["spin"].any()
    # Further away one straight piece would lose digits.
    return bool(straight and np.linalg.norm(knots["place"][-1] - knots["place"][0]) < 10 * GRID)


def _track(pose: Pose, to_matrices: Callable[[NDArray], NDArray], pieces: MotionPieces, start: float) -> Track:
    times, cells = pieces.times(start)
    if not pieces.moves:
        place, rotation = (np.asarray(values, dtype=float) for values in pose(times[:1]))
        return still_track(place[0], rotations.from_matrices(to_matrices(rotation))[0])
    knots = _knots(pose, to_matrices, times, _sides(pieces))
    return Track(knots[:1] if _is_straight(knots) else knots, cells, times, pieces)


def _knots(pose: Pose, to_matrices: Callable[[NDArray], NDArray], times: NDArray, sides: NDArray) -> NDArray[np.void]:
    """Return knots [n] of a pose from its places and rotations ``sides`` [n] (s) before, at and after the knots."""
    # At the very start there is no instant before: values there are those of the line through two differences.
    early = times[0] >= 0 and times[0] < sides[0]
    around = []
    for side in (-sides, 0.0, sides):
        place, rotation = pose(np.maximum(times + side, times[0]) if early else times + side)
        around.append((np.asarray(place, dtype=float), to_matrices(np.asarray(rotation, dtype=float))))
    (place0, rotation0), (place, rotation), (place1, rotation1) = around
    span = sides[:, None]
    spin0, spin1 = rotation_vectors(rotation0, rotation) / span, rotation_vectors(rotation, rotation1) / span
    # Central differences, whose error is of second order; m per s are mm per ms.
    velocity = (place1 - place0) / (2 * span)
    if early:
        place2, rotation2 = pose(times[:1] + 2 * sides[:1])
        there = (np.asarray(place2, dtype=float) - place1[:1]) / sides[0]
        beyond = rotation_vectors(rotation1[:1], to_matrices(np.asarray(rotation2, dtype=float))) / sides[0]
        velocity[0] = (3 * (place1[0] - place[0]) / sides[0] - there[0]) / 2
        spin0[0] = 2 * spin1[0] - beyond[0]
    knots = np.empty(len(times), dtype=KNOT)
    knots["place"] = place * MILLI
    knots["velocity"] = velocity
    knots["quaternion"] = _continuous(rotations.from_matrices(rotation))
    knots["spin"] = (spin0 + spin1) / 2 / MILLI
    knots["surge"] = (spin1 - spin0) / span / MILLI**2
    return knots


def rotation_vectors(before: NDArray, after: NDArray) -> NDArray[np.float64]:
    """Return the rotation vectors [n, 3] (rad, world) between rotations [n, 3, 3]; small angles."""
    relative = after @ np.swapaxes(before, -1, -2)
    # Antisymmetric part of the relative rotation, sin(angle) times the axis; angles between neighbours are tiny.
    return np.stack([relative[:, k, j] - relative[:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))], axis=-1) / 2


def _continuous(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Choose signs so that neighbours never jump to the antipode."""
    # q and −q are the same rotation, but a cubic from one to the other would turn all the way round or vanish.
    flips = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0, -1.0, 1.0))
    return quaternion * np.concatenate([[1.0], flips])[:, None]


def pack_chains(capacity: int, chains: Sequence[Chain], quasistatic: bool, hinges: int) -> dict[str, NDArray]:
    """Return what the kernel's ``ChainArrays`` hold: whiskers as chains, [link, whisker] of ``capacity`` links."""
    count = len(chains)
    mass = LIGHT if quasistatic else 1.0
    springs = ("stiffness", "torsion")[: hinges - 1]
    build = _links(capacity, count, "length", "bend_cosine", "bend_sine", "mass")
    inertia = _links(capacity, count, "centre", "axial", "transverse", *springs)
    taper = _links(capacity, count, "start_radius", "end_radius", "arc", "arc_length")
    for w, chain in enumerate(chains):
        n = chain.links
        # A joint that twists does so between two halves of its rest bend.
        bends = chain.rest_angles / np.where((chain.torsion > 0) & (hinges == 3), 2, 1)
        build["length"][:n, w] = chain.lengths * MILLI
        build["bend_cosine"][:n, w], build["bend_sine"][:n, w] = np.cos(bends), np.sin(bends)
        # kg to mg, kg·m² to mg·mm², N·m to µN·m.
        build["mass"][:n, w] = chain.masses * (mass * MICRO)
        inertia["centre"][:n, w] = chain.centres * MILLI
        inertia["axial"][:n, w], inertia["transverse"][:n, w] = chain.inertias.T * (mass * MICRO * MILLI**2)
        for name in springs:
            inertia[name][:n, w] = getattr(chain, name) * MICRO
        radii = chain.whisker.radius(chain.nodes) * MILLI
        taper["start_radius"][:n, w], taper["end_radius"][:n, w] = radii[:-1], radii[1:]
        taper["arc"][:n, w], taper["arc_length"][:n, w] = chain.nodes[:-1] * MILLI, np.diff(chain.nodes) * MILLI
    # Damping ratio ζ of the first mode ω₁ as stiffness-proportional damping, β = 2 ζ / ω₁.
    beta = [0 if quasistatic else 2 * c.whisker.damping_ratio / c.frequencies()[0] * MILLI for c in chains]
    return {
        "links": np.array([c.links for c in chains], dtype=np.int32),
        "beta": np.array(beta),
        "friction": np.array([c.whisker.friction for c in chains]),
        "length": np.array([c.whisker.arc_length * MILLI for c in chains]),
        "build": build,
        "inertia": inertia,
        "taper": taper,
    }


def pack_follicles(chains: Sequence[Chain], quasistatic: bool) -> NDArray[np.void]:
    """Return the kernel's ``FollicleConstants`` [whisker]; N/m are mN/mm, N·m become µN·m."""
    names = "slide_stiffness", "slide_damping", "turn_stiffness", "turn_damping"
    springs = np.zeros(len(chains), dtype=[(name, "f8", 3) for name in names])
    for w, chain in enumerate(chains):
        if chain.whisker.follicle is not None:
            stiffness, damping = chain.whisker.follicle.constants.T * np.array([[1.0], [0.0 if quasistatic else MILLI]])
            springs["slide_stiffness"][w], springs["turn_stiffness"][w] = stiffness[:3], stiffness[3:] * MICRO
            springs["slide_damping"][w], springs["turn_damping"][w] = damping[:3], damping[3:] * MICRO
    return springs


def _links(capacity: int, count: int, *names: str) -> NDArray[np.void]:
    """Return records [link, whisker] of numbers with these names, all zero."""
    return np.zeros((capacity, count), dtype=[(name, "f8") for name in names])


@dataclass
class PackedJobs:
    """Jobs of a launch: the whisker and the scene of each, and the place of its results. Letters: job."""

    whisker: NDArray[np.int32]
    """[job] index of the chain."""
    scene: NDArray[np.int32]
    """[job] index of the shapes."""
    base: NDArray[np.int32]
    """[job] motion of the base."""
    row: NDArray[np.int32]
    """[job] first index of the results."""
    column: NDArray[np.int32]
    """[job] second index of the results."""
    finer: NDArray[np.integer]
    """[job] what divides the time steps."""
    loads: Sequence[Sequence[Load]] = ()
    """[job] point forces; none for any when empty."""
    limits: Sequence[NDArray[np.float64] | None] = ()
    """[job] longest step (s) from each cell of the motions on; None for any, for all when empty."""

    def __len__(self) -> int:
        return len(self.whisker)

    def arrays(self, chains: Sequence[Chain], step: NDArray[np.float64], start: float) -> dict[str, NDArray]:
        """Return what the kernel's ``JobArrays`` hold.

        ``step`` [job] (ms) is the longest of each job, before it is divided; the launch begins at ``start`` (s).
        """
        counts = [len(loads) for loads in self.loads] or [0] * len(self)
        loads = [(load, chains[which]) for which, some in zip(self.whisker, self.loads, strict=False) for load in some]
        places = [chain.locate(load.arc) for load, chain in loads]
        some = zip(self.limits, self.finer, strict=True) if self.limits else ()
        limits = [np.zeros(0) if limit is None else limit * MILLI / finer for limit, finer in some]
        limits = limits or [np.zeros(0)] * len(self)
        return {
            **{name: getattr(self, name) for name in ("whisker", "scene", "base", "row", "column")},
            "step": step / self.finer,
            "limit_first": np.cumsum([0, *map(len, limits)], dtype=np.int32),
            "limit": np.concatenate(limits),
            "load_first": np.cumsum([0, *counts], dtype=np.int32),
            "load_link": np.array([link for link, _ in places], dtype=np.int32),
            "load_share": np.array([share for _, share in places]),
            "load_force": np.array([np.multiply(load.force, MILLI) for load, _ in loads]).reshape(-1, 3),
            "load_stop": np.minimum([(load.stop - start) * MILLI for load, _ in loads], 1e30),
        }
