"""From jobs to the arrays of the kernel: chains, motions, shapes and lanes. mg, mm, ms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.stimuli.backends._engines import MICRO, MILLI
from brainbench.stimuli.backends.rod._limits import LIGHT
from brainbench.stimuli.backends.rod._shapes import BOX, CAPSULE, CYLINDER, MESH, SPHERE
from brainbench.stimuli.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere, TriangleMesh

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from brainbench.stimuli.backends.protocol import Follicle
    from brainbench.stimuli.chain import Chain

KNOT = 1e-3
"""Spacing of the knots of a motion (s); cubic pieces between them follow whisking at 20 Hz to 1e-7 of its way."""
CAPACITIES = (12, 24, 48, 100)
"""Links for which kernels are compiled; a chain takes the smallest that holds it."""
_SIDE = 1e-5
"""Distance (s) of the instants whose difference is a velocity."""


@dataclass
class Tracks:
    """Motions as cubic pieces: knots of all tracks one behind the other."""

    first: list[int] = field(default_factory=list)
    count: list[int] = field(default_factory=list)
    start: list[float] = field(default_factory=list)
    spacing: list[float] = field(default_factory=list)
    knots: list[NDArray[np.float64]] = field(default_factory=list)
    """Per track [count, 16]: place, velocity, quaternion, angular velocity, angular acceleration (mm, ms)."""

    def add(self, knots: NDArray[np.float64], start: float, spacing: float) -> int:
        """Append a track and return its index; ``start`` and ``spacing`` in ms."""
        self.first.append(self.first[-1] + self.count[-1] if self.first else 0)
        self.count.append(len(knots))
        self.start.append(start)
        self.spacing.append(spacing)
        self.knots.append(knots)
        return len(self.first) - 1

    def arrays(self) -> dict[str, NDArray]:
        """Return what the kernel's ``Tracks`` hold."""
        knots = np.concatenate(self.knots)
        return {
            "first": np.array(self.first, dtype=np.int32),
            "count": np.array(self.count, dtype=np.int32),
            "start": np.array(self.start),
            "spacing": np.array(self.spacing),
            "place": knots[:, :3],
            "velocity": knots[:, 3:6],
            "turn": knots[:, 6:10],
            "spin": knots[:, 10:13],
            "surge": knots[:, 13:16],
        }


def capacity_for(links: int) -> int:
    """Return the smallest compiled capacity that holds a chain."""
    return next(capacity for capacity in CAPACITIES if capacity >= links)


def still_knots(position: NDArray, quaternion: NDArray) -> NDArray[np.float64]:
    """Return the one knot [1, 16] of a body at rest; position in metres."""
    knot = np.zeros((1, 16))
    knot[0, :3] = np.asarray(position) * MILLI
    knot[0, 6:10] = quaternion
    return knot


def follicle_knots(follicle: Follicle, start: float, stop: float) -> tuple[NDArray[np.float64], float]:
    """Return the knots [n, 16] of a follicle between two times (s), and their spacing (ms)."""
    from brainbench.stimuli.backends.protocol import base_rotation

    times, spacing = _knot_times(start, stop)
    position, euler = (np.asarray(values, dtype=float) for values in follicle.pose(times))
    if np.ptp(position, axis=0).max() == 0 and np.ptp(euler, axis=0).max() == 0:
        return still_knots(position[0], quaternions(base_rotation(euler[:1]))[0]), spacing
    around = []
    for side in (-_SIDE, 0.0, _SIDE):
        place, angles = follicle.pose(np.maximum(times + side, 0.0) if start >= 0 else times + side)
        around.append((np.asarray(place, dtype=float), base_rotation(np.asarray(angles, dtype=float))))
    return _knots(around, times, start), spacing


def body_knots(obstacle: Obstacle, start: float, stop: float) -> tuple[NDArray[np.float64], float]:
    """Return the knots [n, 16] of an obstacle between two times (s), and their spacing (ms)."""
    from brainbench.stimuli.obstacle import rotation_matrix

    if obstacle.motion is None:
        return still_knots(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])), KNOT * MILLI
    times, spacing = _knot_times(start, stop)
    around = []
    for side in (-_SIDE, 0.0, _SIDE):
        place, turn = obstacle.motion(np.maximum(times + side, 0.0) if start >= 0 else times + side)
        around.append((np.asarray(place, dtype=float), rotation_matrix(np.asarray(turn, dtype=float))))
    knots = _knots(around, times, start)
    straight = np.abs(np.diff(knots[:, 3:6], axis=0)).max(initial=0) < 1e-9 and not knots[:, 10:13].any()
    return (knots[:1], spacing) if straight else (knots, spacing)


def _knot_times(start: float, stop: float) -> tuple[NDArray[np.float64], float]:
    # One knot beyond the end: the last step looks at the pose behind it.
    count = max(2, int(np.ceil((stop - start) / KNOT - 1e-9)) + 2)
    return np.asarray(start + KNOT * np.arange(count), dtype=np.float64), KNOT * MILLI


def _knots(around: list[tuple[NDArray, NDArray]], times: NDArray[np.float64], start: float) -> NDArray[np.float64]:
    """Knots [n, 16] from places and rotations just before, at and just after the knot times."""
    (place0, turn0), (place, turn), (place1, turn1) = around
    # At the very start there may be no instant before: the difference is then one-sided.
    clipped = start >= 0
    back = np.where(clipped & (times < _SIDE), times, _SIDE)[:, None]
    span = back + _SIDE
    spin0, spin1 = _spin(turn0, turn) / np.maximum(back, 1e-12), _spin(turn, turn1) / _SIDE
    spin0 = np.where(back > 0, spin0, spin1)
    knots = np.empty((len(times), 16))
    knots[:, :3] = place * MILLI
    knots[:, 3:6] = (place1 - place0) / span
    knots[:, 6:10] = _continuous(quaternions(turn))
    knots[:, 10:13] = _spin(turn0, turn1) / span / MILLI
    knots[:, 13:16] = (spin1 - spin0) / (span / 2) / MILLI**2
    return knots


def _spin(before: NDArray, after: NDArray) -> NDArray[np.float64]:
    """Rotation vectors [n, 3] (rad, world) between rotations [n, 3, 3]; small angles."""
    turn = after @ np.swapaxes(before, -1, -2)
    return np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=-1
    ) / 2  # fmt: skip


def quaternions(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions [n, 4] (w, x, y, z) of rotation matrices [n, 3, 3]."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(matrices).as_quat(), 1, axis=-1)


def _continuous(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Choose signs so that neighbours never jump to the antipode."""
    flips = np.cumprod(np.where(np.sum(quaternion[1:] * quaternion[:-1], axis=1) < 0, -1.0, 1.0))
    return quaternion * np.concatenate([[1.0], flips])[:, None]


@dataclass
class Chains:
    """Whiskers as chains, [whisker, link] with room for ``capacity`` links."""

    capacity: int
    chains: list[Chain] = field(default_factory=list)
    quasistatic: bool = False

    def arrays(self) -> dict[str, NDArray]:
        """Return what the kernel's ``Chains`` hold."""
        count = len(self.chains)
        mass = LIGHT if self.quasistatic else 1.0
        build, inertia, taper = (np.zeros((self.capacity, count, 4)) for _ in range(3))
        for w, chain in enumerate(self.chains):
            n = chain.links
            lengths = chain.lengths * MILLI
            build[:n, w] = np.stack(
                [lengths, np.cos(chain.rest_angles), np.sin(chain.rest_angles), chain.masses * (mass * MICRO)],
                axis=1,
            )
            inertia[:n, w] = np.stack(
                [chain.centres * MILLI, *(chain.inertias.T * (mass * MICRO * MILLI**2)), chain.stiffness * MICRO],
                axis=1,
            )
            radii = chain.whisker.radius(chain.nodes) * MILLI
            taper[:n, w] = np.stack(
                [radii[:-1], radii[1:], chain.nodes[:-1] * MILLI, np.diff(chain.nodes) * MILLI], axis=1
            )
        beta = [
            0 if self.quasistatic else 2 * c.whisker.damping_ratio / c.frequencies()[0] * MILLI for c in self.chains
        ]
        return {
            "links": np.array([c.links for c in self.chains], dtype=np.int32),
            "beta": np.array(beta),
            "friction": np.array([c.whisker.friction for c in self.chains]),
            "length": np.array([c.whisker.arc_length * MILLI for c in self.chains]),
            "build": build,
            "inertia": inertia,
            "taper": taper,
        }


@dataclass
class Shapes:
    """Shapes of all scenes, and the meshes among them."""

    device: Any
    rows: list[dict[str, Any]] = field(default_factory=list)
    first: list[int] = field(default_factory=lambda: [0])
    meshes: list[Any] = field(default_factory=list)
    """Warp meshes; they live as long as this object."""
    corners: list[NDArray[np.float64]] = field(default_factory=list)
    outwards: list[NDArray[np.float64]] = field(default_factory=list)
    triangles: int = 0
    _known: dict[int, tuple[int, int]] = field(default_factory=dict)

    def add_scene(self, obstacles: Sequence[Obstacle], tracks: Tracks, start: float, stop: float) -> int:
        """Append the shapes of one scene and return its index."""
        for obstacle in obstacles:
            knots, spacing = body_knots(obstacle, start, stop)
            track = tracks.add(knots, start * MILLI, spacing)
            solids = obstacle.parts if obstacle.surface is None else (obstacle.surface,)
            for solid in solids:
                row = self._row(solid)
                reach = float(np.linalg.norm(np.abs(solid.bounds()).max(axis=0))) * MILLI
                speed = np.linalg.norm(knots[:, 3:6], axis=1) + np.linalg.norm(knots[:, 10:13], axis=1) * reach
                row |= {"radius": reach, "speed": float(speed.max()), "track": track}
                row["friction"] = -1.0 if obstacle.friction is None else obstacle.friction
                self.rows.append(row)
        self.first.append(len(self.rows))
        return len(self.first) - 2

    def _row(self, solid: ConvexPart | Sphere | Capsule | Cylinder | Box | TriangleMesh) -> dict[str, Any]:
        row: dict[str, Any] = {"size": np.ones(3), "place": np.zeros(3), "turn": np.array([1.0, 0, 0, 0])}
        row |= {"scale": 1.0, "mesh": 0, "face": 0}
        match solid:
            case Sphere():
                return row | {"kind": SPHERE, "size": np.full(3, solid.radius * MILLI), "place": _mm(solid.centre)}
            case Box():
                box = {"kind": BOX, "size": _mm(solid.half_sizes), "place": _mm(solid.centre)}
                return row | box | {"turn": np.array(solid.quaternion)}
            case Capsule() | Cylinder():
                ends = _mm(solid.start), _mm(solid.end)
                half = float(np.linalg.norm(ends[1] - ends[0])) / 2
                kind = CAPSULE if isinstance(solid, Capsule) else CYLINDER
                size = np.array([solid.radius * MILLI, half, 0.0])
                turn = _turn_z_to((ends[1] - ends[0]) / (2 * half))
                return row | {"kind": kind, "size": size, "place": (ends[0] + ends[1]) / 2, "turn": turn}
            case _:
                mesh, face = self._mesh(solid)
                return row | {"kind": MESH, "mesh": mesh, "face": face}

    def _mesh(self, solid: ConvexPart | TriangleMesh) -> tuple[int, int]:
        if id(solid) in self._known:
            return self._known[id(solid)]
        vertices, faces = (solid.vertices, solid.faces) if isinstance(solid, TriangleMesh) else hull_faces(solid)
        known = self.add_mesh(vertices * MILLI, faces)
        self._known[id(solid)] = known
        return known

    def add_mesh(self, vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> tuple[int, int]:
        """Build the search tree of a mesh (mm); return its identifier and its first triangle."""
        import warp as wp

        mesh = wp.Mesh(
            points=wp.array(vertices.astype(np.float32), dtype=wp.vec3f, device=self.device),
            indices=wp.array(np.ascontiguousarray(faces.ravel(), dtype=np.int32), dtype=wp.int32, device=self.device),
        )
        self.meshes.append(mesh)
        first = self.triangles
        self.corners.append(vertices[faces])
        self.outwards.append(pseudo_normals(vertices, faces))
        self.triangles += len(faces)
        return int(mesh.id), first

    @property
    def needs(self) -> int:
        """What the kernel must be able to touch."""
        from brainbench.stimuli.backends.rod._limits import MESHES, NOTHING, PRIMITIVES

        return MESHES if self.meshes else PRIMITIVES if self.rows else NOTHING

    def arrays(self) -> dict[str, NDArray]:
        """Return what the kernel's ``Bodies`` hold."""

        def column(name: str, dtype: Any, shape: tuple[int, ...] = ()) -> NDArray:
            return np.array([row[name] for row in self.rows], dtype=dtype).reshape(-1, *shape)

        empty = np.zeros((1, 3, 3)), np.zeros((1, 7, 3))
        return {
            "first": np.array(self.first, dtype=np.int32),
            "kind": column("kind", np.int32),
            "size": column("size", float, (3,)),
            "place": column("place", float, (3,)),
            "turn": column("turn", float, (4,)),
            "scale": column("scale", float),
            "radius": column("radius", float),
            "speed": column("speed", float),
            "friction": column("friction", float),
            "track": column("track", np.int32),
            "mesh": column("mesh", np.uint64),
            "face": column("face", np.int32),
            "corner": np.concatenate(self.corners) if self.corners else empty[0],
            "outward": np.concatenate(self.outwards) if self.outwards else empty[1],
        }


def hull_faces(part: ConvexPart) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Vertices and outward faces of the convex hull of a part."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(part.vertices)
    faces = hull.simplices.copy()
    corners = part.vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normals, hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return part.vertices, faces.astype(np.int32)


def pseudo_normals(vertices: NDArray[np.float64], faces: NDArray[np.int32]) -> NDArray[np.float64]:
    """Outward directions [face, 7, 3] of each face, its corners and the edges opposite to them.

    Angle-weighted (Baerentzen & Aanaes 2005): their sign tells inside from outside at every closest point.
    """
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals / np.where(size > 0, size, 1.0)
    at_vertex = np.zeros_like(vertices)
    for k in range(3):
        to_next, to_last = corners[:, (k + 1) % 3] - corners[:, k], corners[:, (k + 2) % 3] - corners[:, k]
        angle = np.arctan2(np.linalg.norm(np.cross(to_next, to_last), axis=1), np.sum(to_next * to_last, axis=1))
        for axis in range(3):
            at_vertex[:, axis] += np.bincount(faces[:, k], normals[:, axis] * angle, len(vertices))
    edges = np.sort(np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1), axis=2)
    names = edges[..., 0].astype(np.int64) * len(vertices) + edges[..., 1]
    _, which = np.unique(names, return_inverse=True)
    which = which.reshape(-1, 3)
    spread = np.repeat(normals, 3, axis=0)
    at_edge = np.stack([np.bincount(which.ravel(), spread[:, axis]) for axis in range(3)], axis=1)
    found = np.concatenate([normals[:, None], at_vertex[faces], at_edge[which]], axis=1)
    length = np.linalg.norm(found, axis=2, keepdims=True)
    return found / np.where(length > 0, length, 1.0)


def _mm(vector: Any) -> NDArray[np.float64]:
    return np.asarray(vector, dtype=float) * MILLI


def _turn_z_to(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternion that turns the z axis to a unit vector."""
    x, y, z = direction
    if z < -1 + 1e-12:
        return np.array([0.0, 1.0, 0.0, 0.0])
    q = np.array([1 + z, -y, x, 0.0])
    return q / np.linalg.norm(q)
