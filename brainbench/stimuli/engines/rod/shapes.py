"""Shapes of scenes as the arrays of the kernel: primitives, and triangle surfaces with their search trees. mm, ms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core import rotations
from brainbench.geometry.mesh import Mesh, hull_faces
from brainbench.stimuli.engines.rod import limits
from brainbench.stimuli.engines.rod.limits import WIDE
from brainbench.stimuli.engines.rod.packing import PackedMotions, Track
from brainbench.stimuli.engines.units import MILLI
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere

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
    """[node, 6, 8] as :func:`brainbench.stimuli.engines.rod.shapes.tree_boxes` returns it."""
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
                return row | {
                    "kind": limits.SPHERE,
                    "size": np.full(3, radius),
                    "place": _mm(solid.centre),
                    "radius": radius,
                }
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

        def column(name: str, dtype: Any, shape: tuple[int, ...] = ()) -> NDArray:
            some = [np.asarray(columns[name], dtype=dtype).reshape(-1, *shape) for columns in self.columns]
            return np.concatenate(some or [np.zeros((0, *shape), dtype=dtype)])

        return {
            "first": np.array(self.first, dtype=np.int32),
            **{name: column(name, np.int32) for name in ("kind", "track", "face", "faces", "box")},
            **{name: column(name, float) for name in ("scale", "radius", "speed", "friction")},
            **{name: column(name, float, (width,)) for name, width in (("size", 3), ("place", 3), ("quaternion", 4))},
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
    names = edges[..., 0].astype(np.int64) * len(vertices) + edges[..., 1]
    _, which = np.unique(names, return_inverse=True)
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
    spread = across.reshape(-1, 3)
    at_edge = np.stack([np.bincount(which.ravel(), spread[:, axis]) for axis in range(3)], axis=1)
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
