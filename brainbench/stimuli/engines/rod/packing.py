"""Whiskers, motions, jobs and shapes as the arrays of the kernel. mg, mm, ms.

Shapes are primitives, and triangle surfaces with their search trees.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core import rotations
from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.geometry.mesh import Mesh, hull_faces
from brainbench.stimuli.engines.motion_pieces import Cutting, MotionPieces, Pose, carried_pose, side_of
from brainbench.stimuli.engines.rod import limits
from brainbench.stimuli.engines.rod.limits import LIGHT, WIDE
from brainbench.stimuli.motion.jobs import MICRO, MILLI, Follicle, Load
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere
from brainbench.stimuli.whiskers.whisker import Chain, quadrature

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
    # Looking for motion takes as long as simulating a short whisker; nothing finer than any time is rest or drift.
    if getattr(follicle, "finest", None) == math.inf:
        seen = np.linspace(cutting.start, cutting.stop, 5)
        place, euler = (np.asarray(values, dtype=float) for values in follicle.pose(seen))
        if (place == place[0]).all() and (euler == euler[0]).all():
            return still_track(place[0], _still_quaternion(*euler[0].tolist()))
    return _track(follicle.pose, base_rotation, cutting.follicle(follicle, size), cutting.start)


@lru_cache(256)
def _still_quaternion(*euler: float) -> NDArray[np.float64]:
    return rotations.from_matrices(base_rotation(euler))


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
        place, rotation = pose(np.linspace(*span, 17))
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
    before = np.maximum(times - sides, times[0]) if early else times - sides
    # All in one call: calls of a motion cost more than its values.
    values, turns = pose(np.concatenate([before, times, times + sides, times[: int(early)] + 2 * sides[: int(early)]]))
    borders = np.arange(1, 4) * len(times)
    place0, place, place1, place2 = np.split(np.asarray(values, dtype=float), borders)
    rotation0, rotation, rotation1, rotation2 = np.split(to_matrices(np.asarray(turns, dtype=float)), borders)
    span = sides[:, None]
    spin0, spin1 = rotation_vectors(rotation0, rotation) / span, rotation_vectors(rotation, rotation1) / span
    # Central differences, whose error is of second order; m per s are mm per ms.
    velocity = (place1 - place0) / (2 * span)
    if early:
        there = (place2 - place1[:1]) / sides[0]
        beyond = rotation_vectors(rotation1[:1], rotation2) / sides[0]
        velocity[0] = (3 * (place1[0] - place[0]) / sides[0] - there[0]) / 2
        spin0[0] = 2 * spin1[0] - beyond[0]
    knots = np.empty(len(times), dtype=KNOT)
    knots["place"] = place * MILLI
    knots["velocity"] = velocity
    quaternion = rotations.from_matrices(rotation)
    # q and −q are the same rotation, but a cubic from one to the other would turn all the way round or vanish.
    flips = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0, -1.0, 1.0))
    knots["quaternion"] = quaternion * np.append(1.0, flips)[:, None]
    knots["spin"] = (spin0 + spin1) / 2 / MILLI
    knots["surge"] = (spin1 - spin0) / span / MILLI**2
    return knots


def rotation_vectors(before: NDArray, after: NDArray) -> NDArray[np.float64]:
    """Return the rotation vectors [n, 3] (rad, world) between rotations [n, 3, 3]; small angles."""
    relative = after @ np.swapaxes(before, -1, -2)
    # Antisymmetric part of the relative rotation, sin(angle) times the axis; angles between neighbours are tiny.
    return np.stack([relative[:, k, j] - relative[:, j, k] for j, k in ((1, 2), (2, 0), (0, 1))], axis=-1) / 2


def pack_chains(
    capacity: int, chains: Sequence[Chain], quasistatic: bool, hinges: int, *, rolls: bool = False, smooth: bool = False
) -> dict[str, NDArray]:
    """Return what the kernel's ``ChainArrays`` hold: whiskers as chains, [link, whisker] of ``capacity`` links."""
    count = len(chains)
    mass = LIGHT if quasistatic else 1.0
    springs = ("stiffness", "torsion")[: hinges - 1]
    turns = ("roll_cosine", "roll_sine") if rolls else ()
    build = _links(capacity, count, "length", "bend_cosine", "bend_sine", "mass", *turns)
    inertia = _links(capacity, count, "centre", "axial", "transverse", *springs)
    taper = _links(capacity, count, "start_radius", "end_radius", "arc", "arc_length")
    for w, chain in enumerate(chains):
        n = chain.links
        # A joint that twists does so between two halves of its rest bend.
        bends = chain.rest_angles / np.where((chain.torsion > 0) & (hinges == 3), 2, 1)
        build["length"][:n, w] = chain.lengths * MILLI
        build["bend_cosine"][:n, w], build["bend_sine"][:n, w] = np.cos(bends), np.sin(bends)
        for name, law in zip(turns, (np.cos, np.sin), strict=False):
            build[name][:n, w] = law(chain.rest_rolls)
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
    beta = [0 if quasistatic else 2 * c.whisker.damping_ratio / c.first_frequency * MILLI for c in chains]
    return {
        "links": np.array([c.links for c in chains], dtype=np.int32),
        "beta": np.array(beta),
        "friction": np.array([c.whisker.friction for c in chains]),
        "length": np.array([c.whisker.arc_length * MILLI for c in chains]),
        "build": build,
        "inertia": inertia,
        "taper": taper,
        **({"beam": _pack_beams(capacity, chains)} if smooth else {}),
    }


def _pack_beams(capacity: int, chains: Sequence[Chain]) -> NDArray[np.void]:
    names = "near_turn", "there_turn", "near_deflection", "there_deflection"
    beams = np.zeros((capacity, len(chains)), dtype=[(name, "f8", 4) for name in names])
    for w, chain in enumerate(chains):
        for name, values in zip(names, beam_compliance(chain), strict=True):
            beams[name][: chain.links, w] = values / MICRO
    return beams


@lru_cache(256)
def beam_compliance(chain: Chain) -> NDArray[np.float64]:
    """Return [4, link, 4] how the rod turns and deflects from the start of each link to 0, 1/3, 2/3 and 1 along it.

    Turns ∫ M/(E I) dx (rad/(N·m)) of a moment M that falls linearly from 1 at the start to 0 at the place, and that
    grows from 0 to 1; then the deflections ∫ M (s − x)/(E I) dx of both, in lengths of the link (Euler-Bernoulli).
    """
    nodes, compliance = chain.nodes, np.zeros((4, chain.links, 4))
    for link, k in np.ndindex(chain.links, 4):
        start, length = float(nodes[link]), float(nodes[link + 1] - nodes[link])
        s = start + length * k / 3
        x, weights = quadrature(start, s, chain.whisker.breaks)
        weights = weights / chain.whisker.bending_stiffness(x)
        share = (x - start) / max(s - start, 1e-30)
        moments = np.stack([1 - share, share])
        compliance[:, link, k] = np.concatenate([moments @ weights, moments @ (weights * (s - x) / length)])
    return compliance


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


EMPTY = 1e30  # coordinate of children that a node lacks: further away than any search goes


def spatial_order(corners: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the order [triangle] of triangles [triangle, 3, 3] in which aligned runs of 8, 16, 32, … lie together.

    Runs are halved along the longest side of the box of their middles, from the whole down to leaves.
    """
    middles = corners.mean(axis=1)
    count = len(middles)
    order = np.arange(count)
    run = WIDE
    while run < count:
        run *= 2
    while run > WIDE:
        here = middles[order]
        begins = np.arange(0, count, run)
        # All runs of one level at once: boxes by reduceat, then one sort whose keys hold the run and the place along
        # its side.
        low, high = np.minimum.reduceat(here, begins), np.maximum.reduceat(here, begins)
        axis = np.argmax(high - low, axis=1)
        which = np.arange(count) // run
        rows = np.arange(len(begins))
        base, side = low[rows, axis], (high - low)[rows, axis]
        along = (here[np.arange(count), axis[which]] - base[which]) / np.maximum(side, 1e-300)[which]
        order = order[np.argsort(which + 0.999 * along.clip(0, 1), kind="stable")]
        run //= 2
    return order


def tree_boxes(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the nodes [node, 6, 8] above ordered triangles: boxes (lowest, highest corner) of eight children each.

    Children of the first nodes are leaves, of the next ones these nodes, and so on; the last node is the top. A level
    above ``n`` boxes has ⌈n / 8⌉ nodes.
    """
    low, high = corners.min(axis=1), corners.max(axis=1)
    levels = []
    while not levels or len(low) > WIDE:
        begins = np.arange(0, len(low), WIDE)
        # Parents from the boxes of their children, level by level.
        low, high = np.minimum.reduceat(low, begins), np.maximum.reduceat(high, begins)
        levels.append(in_eights(np.concatenate([low, high], axis=1)))
    return np.concatenate(levels)


def in_eights(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rows [row, number] as runs of eight [run, number, 8]: a processor reads a number of all eight at once."""
    missing = np.full((-len(rows) % WIDE, rows.shape[1]), EMPTY)
    return np.concatenate([rows, missing]).reshape(-1, WIDE, rows.shape[1]).swapaxes(1, 2)


SLIVER = 1e-6
"""Height over longest side below which a triangle has no direction of its own: vertices are rounded to some 1e-9."""
SLIVER_ROUNDS = 32  # slivers beside one another that are looked through


@dataclass(frozen=True, eq=False)
class PackedSurface:
    """A triangle surface as the kernels take it: triangles in the order of their search tree."""

    triangles: int
    corners: NDArray[np.float64]
    """[leaf, 9, 8] of the eight triangles of each leaf; the last may lack some."""
    outward: NDArray[np.float64]
    """[triangle, 7, 3] as :func:`pseudo_normals` returns it; up to the last place of the last leaf."""
    boxes: NDArray[np.float64]
    """[node, 6, 8] as :func:`tree_boxes` returns it."""
    outline: NDArray[np.float64]
    """[corner, 2] of the convex hull of its shadow along z: how far it reaches when it is turned about z."""
    radius: float
    """Distance of its farthest point from the origin."""

    @classmethod
    def of(cls, vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> PackedSurface:
        """Order the triangles of a surface; its unit of length stays.

        Those without a width, which hulls of flat faces hold, are left out: their neighbours hold all of their points.
        """
        from scipy.spatial import ConvexHull

        faces = faces[spatial_order(vertices[faces])]
        corners = vertices[faces]
        wide = ~slivers(corners)
        if not wide.any():
            wide[:] = True
        corners = corners[wide]
        outline = vertices[ConvexHull(vertices[:, :2]).vertices, :2]
        radius = float(np.linalg.norm(vertices, axis=1).max())
        outward = pseudo_normals(vertices, faces)[wide]
        outward = np.concatenate([outward, np.zeros((-len(outward) % WIDE, 7, 3))])
        leaves = in_eights(corners.reshape(-1, 9))
        return cls(len(corners), leaves, outward, tree_boxes(corners), outline, radius)


@dataclass(frozen=True, eq=False)
class TrackedObstacle:
    """An obstacle and the track of a point of it, about which its shapes are kept."""

    obstacle: Obstacle
    anchor: NDArray[np.float64]
    """[3] (m) in the frame of the obstacle."""
    track: Track


@dataclass
class PackedShapes:
    """Shapes of all scenes, and the surfaces among them."""

    columns: list[dict[str, Any]] = field(default_factory=list)
    """Columns of the kernel's ``ShapeArrays``, some shapes at a time, [shape, …]."""
    first: list[int] = field(default_factory=lambda: [0])
    surfaces: list[PackedSurface] = field(default_factory=list)
    leaves: int = 0
    nodes: int = 0
    _packed: dict[int, dict[str, Any]] = field(default_factory=dict)

    def add_scene(self, bodies: Sequence[TrackedObstacle], motions: PackedMotions) -> int:
        """Append the shapes of one scene and return its index."""
        rows: list[dict[str, Any]] = []
        tracks: dict[int, tuple[int, NDArray, NDArray]] = {}
        for body in bodies:
            obstacle, knots = body.obstacle, body.track.knots
            if id(knots) not in tracks:
                speeds = (np.linalg.norm(knots[name], axis=1) for name in ("velocity", "spin"))
                tracks[id(knots)] = motions.add(body.track), *speeds
            track, linear, angular = tracks[id(knots)]
            friction = -1.0 if obstacle.friction is None else obstacle.friction
            for solid in obstacle.parts if obstacle.surface is None else (obstacle.surface,):
                row = self._row(solid) | {"track": track, "friction": friction, "anchor": body.anchor, "speed": 0.0}
                if len(knots) > 1 or linear[0]:
                    # Fastest that any point can be: speed of the anchor plus spin times the farthest distance from it.
                    far = math.dist(row["place"], body.anchor * MILLI) + row["radius"]
                    row["speed"] = (linear + angular * far).max()
                rows.append(row)
        if rows:
            columns = {name: np.array([row[name] for row in rows]) for name in rows[0]}
            columns["place"] = columns["place"] - columns.pop("anchor") * MILLI
            self.columns.append(columns)
        self.first.append(self.first[-1] + len(rows))
        return len(self.first) - 2

    def add_placed(self, surface: PackedSurface, **columns: Any) -> None:
        """Append scenes of one shape each, all of the same surface.

        ``columns`` are what the kernel's ``ShapeArrays`` hold that differs, [shape, …]; of all ``track``,
        ``quaternion``, ``scale``, ``radius`` and ``speed``.
        """
        count = len(columns["track"])
        still = {"size": np.ones(3), "place": np.zeros(3), "quaternion": np.array([1.0, 0, 0, 0])}
        alike = still | {"kind": limits.MESH, "friction": -1.0} | self.add_mesh(surface)
        self.columns.append({name: np.tile(value, (count, *[1] * np.ndim(value))) for name, value in alike.items()})
        self.columns[-1] |= columns
        self.first.extend(range(self.first[-1] + 1, self.first[-1] + count + 1))

    def _row(self, solid: ConvexPart | Sphere | Capsule | Cylinder | Box | Mesh) -> dict[str, Any]:
        """Return the columns of a solid in its body, but for those that its motion and friction give."""
        row: dict[str, Any] = {"size": np.ones(3), "place": np.zeros(3), "quaternion": np.array([1.0, 0, 0, 0])}
        row |= {"scale": 1.0, "face": 0, "faces": 0, "box": 0}
        match solid:
            case Sphere():
                radius = solid.radius * MILLI
                sphere = {"kind": limits.SPHERE, "size": np.full(3, radius), "place": _mm(solid.centre)}
                return row | sphere | {"radius": radius}
            case Box():
                box = {"kind": limits.BOX, "size": _mm(solid.half_sizes), "place": _mm(solid.centre)}
                return row | box | {"quaternion": np.array(solid.quaternion), "radius": math.hypot(*box["size"])}
            case Capsule() | Cylinder():
                ends = _mm(solid.start), _mm(solid.end)
                # Half length, middle and a rotation from z: the kernel measures in their frame.
                half = float(np.linalg.norm(ends[1] - ends[0])) / 2
                kind = limits.CAPSULE if isinstance(solid, Capsule) else limits.CYLINDER
                size = np.array([solid.radius * MILLI, half, 0.0])
                quaternion = rotations.from_z_axis((ends[1] - ends[0]) / (2 * half))
                place, radius = (ends[0] + ends[1]) / 2, math.hypot(size[0], half)
                radius = size[0] + half if kind == limits.CAPSULE else radius
                return row | {"kind": kind, "size": size, "place": place, "quaternion": quaternion, "radius": radius}
            case _:
                if id(solid) not in self._packed:
                    faces = solid.faces if isinstance(solid, Mesh) else hull_faces(solid.vertices)
                    # About its own middle, where single precision is finest.
                    middle = middle_of(solid.vertices) * MILLI
                    surface = PackedSurface.of(solid.vertices * MILLI - middle, faces)
                    self._packed[id(solid)] = self.add_mesh(surface) | {"place": middle, "radius": surface.radius}
                return row | self._packed[id(solid)] | {"kind": limits.MESH}

    def add_mesh(self, surface: PackedSurface) -> dict[str, int]:
        """Append a surface; return where its triangles and boxes are."""
        place = {"face": self.leaves * WIDE, "faces": surface.triangles, "box": self.nodes}
        self.surfaces.append(surface)
        self.leaves += len(surface.corners)
        self.nodes += len(surface.boxes)
        return place

    @property
    def needs(self) -> int:
        """Kinds of shapes that the kernel must be able to touch."""
        return limits.MESHES if self.surfaces else limits.PRIMITIVES if self.columns else limits.NOTHING

    def arrays(self) -> dict[str, NDArray]:
        """Return what the kernel's ``ShapeArrays`` hold."""

        def _column(name: str, dtype: Any, shape: tuple[int, ...] = ()) -> NDArray:
            some = [np.asarray(columns[name], dtype=dtype).reshape(-1, *shape) for columns in self.columns]
            return np.concatenate(some or [np.zeros((0, *shape), dtype=dtype)])

        return {
            "first": np.array(self.first, dtype=np.int32),
            **{name: _column(name, np.int32) for name in ("kind", "track", "face", "faces", "box")},
            **{name: _column(name, float) for name in ("scale", "radius", "speed", "friction")},
            **{name: _column(name, float, (width,)) for name, width in (("size", 3), ("place", 3), ("quaternion", 4))},
            "boxes": np.concatenate([surface.boxes for surface in self.surfaces] or [np.zeros((1, 6, WIDE))]),
            "corners": np.concatenate([surface.corners for surface in self.surfaces] or [np.zeros((1, 9, WIDE))]),
            "outward": np.concatenate([surface.outward for surface in self.surfaces] or [np.zeros((1, 7, 3))]),
        }


def pseudo_normals(vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
    """Return the outward directions [face, 7, 3] of each face, its corners and the edges opposite to them.

    Angle-weighted (Baerentzen & Aanaes 2005): their sign tells inside from outside at every closest point.
    """
    corners = vertices[faces]
    # Each edge gets one number from its two corners: both faces at it add to the same sum.
    edges = np.sort(np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1), axis=2)
    _, which = np.unique(edges[..., 0].astype(np.int64) * len(vertices) + edges[..., 1], return_inverse=True)
    which = which.reshape(-1, 3)
    at_corner, across = _face_normals(corners, which)
    at_vertex = np.zeros_like(vertices)
    for k in range(3):
        to_next, to_last = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        # Angle of the face at the corner by atan2, which keeps its digits at slim triangles where an arc cosine does
        # not.
        angle = np.arctan2(np.linalg.norm(np.cross(to_next, to_last), axis=1), np.sum(to_next * to_last, axis=1))
        for axis in range(3):
            at_vertex[:, axis] += np.bincount(faces[:, k], at_corner[:, axis] * angle, len(vertices))
    at_edge = np.stack([np.bincount(which.ravel(), across[..., axis].ravel()) for axis in range(3)], axis=1)
    outward = np.concatenate([at_corner[:, None], at_vertex[faces], at_edge[which]], axis=1)
    length = np.linalg.norm(outward, axis=2, keepdims=True)
    return outward / np.where(length > 0, length, 1.0)


def slivers(corners: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which triangles [face, 3, 3] have no width, so that their direction is rounding."""
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return area < SLIVER * np.max(np.sum((corners - np.roll(corners, 1, axis=1)) ** 2, axis=2), axis=1)


def _face_normals(
    corners: NDArray[np.float64], which: NDArray[np.integer]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return what each face adds to the directions at its corners [face, 3] and at its edges [face, 3, 3].

    Both are the face's own normal, but for :func:`slivers`. Where one of them lies in a sharp edge, the faces on its
    two sides are the neighbours: through its longest edge one sees what lies at the others, and the other way round.

    Args:
        corners: [face, 3, 3].
        which: [face, 3] number of the edge opposite to each corner.
    """
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(size > 0, size, 1.0)
    across = np.repeat(normals[:, None], 3, axis=1)
    slim = np.flatnonzero(slivers(corners))
    rows = np.arange(len(slim))
    edges = np.roll(corners[slim], -1, axis=1) - np.roll(corners[slim], 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).argmax(axis=1)
    across[slim] = normals[slim] = 0.0
    # Neighbours may be slivers themselves: what lies beyond them comes nearer by one in every round.
    for _ in range(SLIVER_ROUNDS if len(slim) else 0):
        sums = np.stack([np.bincount(which.ravel(), across[..., axis].ravel()) for axis in range(3)], axis=1)
        seen = sums[which[slim]] - across[slim]
        beyond = seen[rows, longest]
        before = seen.sum(axis=1) - beyond
        passed = np.repeat(beyond[:, None], 3, axis=1)
        passed[rows, longest] = before / np.maximum(np.linalg.norm(before, axis=1, keepdims=True), 1e-12)
        if np.array_equal(passed, across[slim]):
            break
        across[slim], normals[slim] = passed, beyond
    return normals, across


def middle_of(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the middle [3] of the bounds of points [n, 3]."""
    return np.stack([points.min(axis=0), points.max(axis=0)]).mean(axis=0)


def _mm(vector: Any) -> NDArray[np.float64]:
    return np.asarray(vector, dtype=float) * MILLI
