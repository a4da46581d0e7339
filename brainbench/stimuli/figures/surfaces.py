"""Surfaces to draw: objects as triangles with creased normals, whiskers as tapered tubes. Metres, world axes.

Letters: F triangle, V vertex, n ring of a tube, k corner of a ring.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.rotations import euler_matrix, to_matrices
from brainbench.geometry import Mesh, convex_hull
from brainbench.stimuli.figures.rays import Triangles
from brainbench.stimuli.motion.trajectories import Path, Spin
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Part, RigidMotion, Sphere
from brainbench.stimuli.objects.placed_object import PlacedObject
from brainbench.stimuli.objects.procedural.bodies import transported_normals

CREASE = math.radians(35)
"""Neighbouring triangles at a smaller angle [rad] are shaded as one smooth surface."""
SIDES = 7
"""Corners of a whisker's cross-section."""
ROUND = 64
"""Corners of a circle of an object."""


@dataclass(frozen=True, eq=False)
class DrawnSurface:
    """The surface of one object."""

    corners: NDArray[np.float64]
    """[F, 3, 3] m, in the frame that ``motion`` moves; in the world without."""
    normals: NDArray[np.float64]
    """[F, 3, 3] unit vectors."""
    motion: RigidMotion | None
    """Motion of the object from there; None when it stands still."""

    def at(self, time: float, color: ArrayLike) -> Triangles:
        """Return the triangles at ``time`` (s) in one colour (red, green, blue)."""
        colors = np.broadcast_to(np.asarray(color, dtype=float), (len(self.corners), 3))
        if self.motion is None:
            return Triangles(self.corners, self.normals, colors)
        positions, quaternions = self.motion(np.array([time]))
        turn = to_matrices(quaternions)[0]
        return Triangles(self.corners @ turn.T + positions[0], self.normals @ turn.T, colors)


def object_surface(placed: PlacedObject) -> DrawnSurface:
    """Return the surface of an object: its mesh, or what whiskers touch when it has none."""
    obstacle = placed.obstacle()
    if placed.solid.mesh is None and obstacle.surface is not None:
        meshes = [obstacle.surface]
    elif placed.solid.mesh is None:
        meshes = [part_mesh(part) for part in obstacle.parts]
    else:
        place = (0.0, 0.0, 0.0) if isinstance(placed.motion, (Spin, Path)) else placed.position
        meshes = [placed.solid.mesh.transformed(euler_matrix(placed.rotation), place)]
    corners = np.concatenate([mesh.vertices[mesh.faces] for mesh in meshes])
    normals = np.concatenate([corner_normals(mesh) for mesh in meshes])
    return DrawnSurface(corners, normals, obstacle.motion)


def part_mesh(part: Part) -> Mesh:
    """Return the surface of one convex part; round shapes have :data:`ROUND` corners a turn."""
    from trimesh import creation
    from trimesh.geometry import align_vectors

    match part:
        case Sphere():
            solid = creation.icosphere(subdivisions=4, radius=part.radius)
            solid.apply_translation(part.centre)
        case Box():
            place = np.eye(4)
            place[:3, :3], place[:3, 3] = to_matrices(part.quaternion), part.centre
            solid = creation.box(2 * np.array(part.half_sizes), transform=place)
        case Cylinder():
            solid = creation.cylinder(part.radius, sections=ROUND, segment=[part.start, part.end])
        case Capsule():
            along = np.subtract(part.end, part.start)
            # At radius 1 and scaled afterwards: trimesh merges points by an absolute tolerance.
            solid = creation.capsule(float(np.linalg.norm(along)) / part.radius, 1.0, count=[ROUND // 2, ROUND])
            solid.apply_translation(-solid.bounds.mean(axis=0))
            solid.apply_scale(part.radius)
            solid.apply_transform(align_vectors([0.0, 0.0, 1.0], along))
            solid.apply_translation(np.add(part.start, part.end) / 2)
        case ConvexPart():
            return convex_hull(part.vertices)
    return Mesh(solid.vertices, solid.faces)


def corner_normals(mesh: Mesh) -> NDArray[np.float64]:
    """Return unit normals [F, 3, 3] at the corners: area-weighted means over each smooth patch of the mesh."""
    from trimesh import Trimesh
    from trimesh.graph import connected_component_labels

    solid = Trimesh(mesh.vertices, mesh.faces, process=False)
    smooth = solid.face_adjacency[solid.face_adjacency_angles < CREASE]
    patch = connected_component_labels(smooth, node_count=len(mesh.faces))
    # A vertex has one normal in each patch that meets there.
    _, place = np.unique(patch[:, None] * len(mesh.vertices) + mesh.faces, return_inverse=True)
    place = place.reshape(-1)
    corners = mesh.vertices[mesh.faces]
    area = np.repeat(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), 3, axis=0)
    total = np.stack([np.bincount(place, area[:, axis]) for axis in range(3)], axis=-1)
    unit = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return unit[place].reshape(-1, 3, 3)


def tube(line: NDArray[np.float64], radii: NDArray[np.float64], colors: NDArray[np.float64]) -> Triangles:
    """Return a closed tube around points [n, 3] (m, world), with radii [n] (m) and colours [n, 3] from 0 to 1."""
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    across = transported_normals(along)
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    spokes = np.cos(angle)[:, None] * across[:, None] + np.sin(angle)[:, None] * np.cross(along, across)[:, None]
    rings = line[:, None] + radii[:, None, None] * spokes
    # A hemisphere would be invisible at these sizes: the ends are closed by a point.
    caps = np.stack([line[0] - radii[0] * along[0], line[-1] + radii[-1] * along[-1]])
    rings = np.concatenate([np.broadcast_to(caps[0], (1, SIDES, 3)), rings, np.broadcast_to(caps[1], (1, SIDES, 3))])
    normals = np.concatenate([spokes[:1], spokes, spokes[-1:]])
    shades = np.tile(np.repeat(np.concatenate([colors, colors[-1:]]), SIDES, axis=0), (2, 1))
    return Triangles(_strips(rings), _strips(normals), shades)


def ball(centre: ArrayLike, radius: float, color: ArrayLike) -> Triangles:
    """Return a small ball (m, world)."""
    from trimesh import creation

    unit = creation.icosphere(subdivisions=2)
    normals = np.asarray(unit.vertices)[np.asarray(unit.faces)]
    return Triangles(radius * normals + np.asarray(centre), normals, np.broadcast_to(color, (len(normals), 3)))


def smoothed(values: NDArray[np.float64], per_link: int) -> NDArray[np.float64]:
    """Return values [n, k] along a smooth curve from those at the joints [N + 1, k] of a chain.

    A quadratic B-spline: it begins and ends with the chain, and touches each inner link at its middle, where
    a link lies on a round object. A curve through the joints would bulge into the object there.
    """
    from scipy.interpolate import BSpline

    degree = min(2, len(values) - 1)
    last = len(values) - degree
    knots = np.concatenate([np.zeros(degree), np.arange(last + 1), np.full(degree, last)])
    return BSpline(knots, values, degree)(np.linspace(0, last, (len(values) - 1) * per_link + 1))


def _strips(rings: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the corner values [F, 3, 3] of the triangles between successive rings [n, k, 3]."""
    following = np.roll(rings, -1, axis=1)
    a, b, c, d = rings[:-1], following[:-1], following[1:], rings[1:]
    return np.concatenate([np.stack(item, axis=2).reshape(-1, 3, 3) for item in ((a, b, c), (a, c, d))])
