"""From jobs to the arrays of the kernel: chains, motions, shapes and lanes. mg, mm, ms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.stimuli.engines.rod.limits import BOX, CAPSULE, CYLINDER, LIGHT, MESH, SPHERE
from brainbench.stimuli.engines.rod.mesh_bvh import spatial_order, tree_boxes
from brainbench.stimuli.engines.trust import MICRO, MILLI
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere, TriangleMesh

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from brainbench.stimuli.engines.protocol import Follicle
    from brainbench.stimuli.whiskers.chain import Chain

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

    def add_straight(self, knots: NDArray[np.float64]) -> NDArray[np.int32]:
        """Append bodies [body, 16] that stand or move straight from time 0; return their tracks [body]."""
        new = np.arange(len(self.first), len(self.first) + len(knots), dtype=np.int32)
        begin = self.first[-1] + self.count[-1] if self.first else 0
        self.first.extend(range(begin, begin + len(knots)))
        self.count.extend([1] * len(knots))
        self.start.extend([0.0] * len(knots))
        self.spacing.extend([1.0] * len(knots))
        self.knots.append(knots)
        return new

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
    from brainbench.stimuli.engines.protocol import base_rotation

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
    from brainbench.stimuli.objects.obstacle import rotation_matrix

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


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle surface as the kernels take it: triangles in the order of their search tree."""

    corners: NDArray[np.float64]
    """[triangle, 3, 3]"""
    outward: NDArray[np.float64]
    """[triangle, 7, 3] as :func:`pseudo_normals` returns it."""
    boxes: NDArray[np.float64]
    """[box, 2, 3] as :func:`brainbench.stimuli.engines.rod.mesh_bvh.tree_boxes` returns it."""
    outline: NDArray[np.float64]
    """[corner, 2] of the convex hull of its shadow along z: how far it reaches when it is turned about z."""
    radius: float
    """Distance of its farthest point from the origin."""

    @classmethod
    def of(cls, vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> Surface:
        """Order the triangles of a surface; its unit of length stays."""
        from scipy.spatial import ConvexHull

        faces = faces[spatial_order(vertices[faces])]
        corners = vertices[faces]
        outline = vertices[ConvexHull(vertices[:, :2]).vertices, :2]
        radius = float(np.linalg.norm(vertices, axis=1).max())
        return cls(corners, pseudo_normals(vertices, faces), tree_boxes(corners), outline, radius)


@dataclass
class Shapes:
    """Shapes of all scenes, and the surfaces among them."""

    columns: list[dict[str, Any]] = field(default_factory=list)
    """What the kernel's ``Bodies`` hold of each shape, some shapes at a time, [shape, …]."""
    first: list[int] = field(default_factory=lambda: [0])
    surfaces: list[Surface] = field(default_factory=list)
    triangles: int = 0
    boxes: int = 0
    _known: dict[int, dict[str, int]] = field(default_factory=dict)

    def add_scene(self, obstacles: Sequence[Obstacle], tracks: Tracks, start: float, stop: float) -> int:
        """Append the shapes of one scene and return its index."""
        count = 0
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
                self.columns.append({name: np.array([value]) for name, value in row.items()})
                count += 1
        self.first.append(self.first[-1] + count)
        return len(self.first) - 2

    def add_placed(self, surface: Surface, **columns: Any) -> None:
        """Append scenes of one shape each, all of the same surface.

        Args:
            surface: the surface.
            columns: what the kernel's ``Bodies`` hold that differs, [shape, …]; of all ``track``, ``turn``, ``scale``,
                ``radius`` and ``speed``.
        """
        count = len(columns["track"])
        still = {"size": np.ones(3), "place": np.zeros(3), "turn": np.array([1.0, 0, 0, 0])}
        alike = still | {"kind": MESH, "friction": -1.0} | self.add_mesh(surface)
        self.columns.append({name: np.tile(value, (count, *[1] * np.ndim(value))) for name, value in alike.items()})
        self.columns[-1] |= columns
        self.first.extend(range(self.first[-1] + 1, self.first[-1] + count + 1))

    def _row(self, solid: ConvexPart | Sphere | Capsule | Cylinder | Box | TriangleMesh) -> dict[str, Any]:
        row: dict[str, Any] = {"size": np.ones(3), "place": np.zeros(3), "turn": np.array([1.0, 0, 0, 0])}
        row |= {"scale": 1.0, "face": 0, "faces": 0, "box": 0}
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
                if id(solid) not in self._known:
                    mesh = isinstance(solid, TriangleMesh)
                    vertices, faces = (solid.vertices, solid.faces) if mesh else hull_faces(solid)
                    self._known[id(solid)] = self.add_mesh(Surface.of(vertices * MILLI, faces))
                return row | self._known[id(solid)] | {"kind": MESH}

    def add_mesh(self, surface: Surface) -> dict[str, int]:
        """Append a surface; return where its triangles and boxes are."""
        place = {"face": self.triangles, "faces": len(surface.corners), "box": self.boxes}
        self.surfaces.append(surface)
        self.triangles += len(surface.corners)
        self.boxes += len(surface.boxes)
        return place

    @property
    def needs(self) -> int:
        """What the kernel must be able to touch."""
        from brainbench.stimuli.engines.rod.limits import MESHES, NOTHING, PRIMITIVES

        return MESHES if self.surfaces else PRIMITIVES if self.columns else NOTHING

    def arrays(self) -> dict[str, NDArray]:
        """Return what the kernel's ``Bodies`` hold."""

        def column(name: str, dtype: Any, shape: tuple[int, ...] = ()) -> NDArray:
            some = [np.asarray(columns[name], dtype=dtype).reshape(-1, *shape) for columns in self.columns]
            return np.concatenate(some or [np.zeros((0, *shape), dtype=dtype)])

        boxes = np.concatenate([one.boxes for one in self.surfaces] or [np.zeros((1, 2, 3))])
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
            "face": column("face", np.int32),
            "faces": column("faces", np.int32),
            "box": column("box", np.int32),
            "low": boxes[:, 0],
            "high": boxes[:, 1],
            "corner": np.concatenate([one.corners for one in self.surfaces] or [np.zeros((1, 3, 3))]),
            "outward": np.concatenate([one.outward for one in self.surfaces] or [np.zeros((1, 7, 3))]),
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


def pseudo_normals(vertices: NDArray[np.float64], faces: NDArray[np.integer]) -> NDArray[np.float64]:
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
