"""Objects that whiskers meet: primitives, the Rodgers solid, procedural shapes and meshes from files. Metres.

A :class:`Solid` stands in its own frame; :class:`PlacedObject` puts it into a scene.
"""

from __future__ import annotations

import functools
import logging
import math
import os
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.errors import UsageError, unknown_name
from brainbench.files import content_hash, to_plain
from brainbench.geometry import DecompositionSettings, Mesh, decompose, deviation, load_mesh, repair
from brainbench.stimuli.motion import Still, Translation
from brainbench.stimuli.obstacle import (
    Box,
    Capsule,
    ConvexPart,
    Cylinder,
    Obstacle,
    Part,
    Sphere,
    TriangleMesh,
    rotation_matrix,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping

    from numpy.typing import ArrayLike, NDArray

    from brainbench.stimuli.shapes import Shape

_LOG = logging.getLogger(__name__)

Vector = tuple[float, float, float]

COLLISIONS = ("exact", "hull", "pieces", "decomposition")
"""What whiskers touch of a mesh. ``exact``: the surface itself; a concave one without known convex parts can be
touched by the backend ``rod`` only, because ``mujoco`` and ``bullet`` collide convex bodies. ``hull``: the convex
hull. ``pieces``: the hull of each connected piece, for files that bring a convex decomposition along.
``decomposition``: convex pieces cut by CoACD or V-HACD."""

RODGERS_CONTROL = ((-0.720943, 0.195148), (-0.167777, 0.219684), (0.235608, -0.057831), (0.631506, -0.409149))
"""Control points (x, y) of the cubic Bézier curve that is the convex face of the Rodgers solid, in the
units of the published mesh (1 unit = 34.324 mm at a diagonal of 55 mm). Fitted by us; the curve passes
through all 101 published vertices of that face within 6e-7."""
RODGERS_OFFSET = (-0.020447, -0.046006)
"""Displacement (x, y) from the convex to the concave face: the profile is the curve swept along it."""
RODGERS_SPAN = (-0.256589, 0.251290)
"""Lowest and highest z of the extruded profile."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A rigid shape in its own frame."""

    name: str
    parts: tuple[Part, ...]
    """Convex parts whose union is what whiskers touch [m]; empty for a concave surface that is not cut into any."""
    mesh: Mesh | None = None
    """Surface for pictures and measurements; None for primitives."""
    notes: tuple[str, ...] = ()
    """What a user should know, such as a concavity lost to the convex hull."""
    origin: Mapping[str, Any] | None = None
    """What the parts were computed from, where their last digits depend on the machine; :meth:`config` has it."""
    surface: TriangleMesh | None = None
    """The exact surface [m], for engines that collide meshes; None where the parts are exact by themselves
    (primitives) or stand for the solid (``pieces``, ``decomposition``)."""

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [2, 3] (m)."""
        if self.mesh is not None:
            return self.mesh.bounds
        bodies = self.parts if self.surface is None else (self.surface,)
        corners = np.stack([body.bounds() for body in bodies])
        return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])

    @property
    def diagonal(self) -> float:
        """Length of the bounding-box diagonal [m]."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    def scaled(self, factor: float) -> Solid:
        """Return the solid scaled about its origin."""
        if not (math.isfinite(factor) and factor > 0):
            raise UsageError(f"A solid is scaled by a positive factor; received {factor!r}.")
        parts = tuple(scale_part(part, factor) for part in self.parts)
        surface = self.surface and self.surface.scaled(factor)
        return replace(self, parts=parts, mesh=self.mesh and self.mesh.scaled(factor), surface=surface)

    def to_diagonal(self, diagonal: float) -> Solid:
        """Return the solid scaled about its origin to a bounding-box diagonal [m]."""
        return self.scaled(diagonal / self.diagonal)

    def config(self) -> dict[str, Any]:
        """Plain values that determine the physics; the parts count by a hash of their numbers or their origin."""
        parts = [{"kind": type(part).__name__, **to_plain(part)} for part in self.parts]
        summary = {"name": self.name, "parts": len(parts), "diagonal": self.diagonal, "notes": list(self.notes)}
        if self.origin is not None:
            return {**summary, "hash": content_hash(self.origin, round(self.diagonal, 12))}
        told = () if self.surface is None or _through_corners(self.surface, self.parts) else (self.surface,)
        return {**summary, "hash": content_hash(parts, *map(to_plain, told))}


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """A solid in a scene (world frame)."""

    solid: Solid
    position: Vector = (0.0, 0.0, 0.0)
    """Where the solid's origin lies [m]."""
    rotation: Vector = (0.0, 0.0, 0.0)
    """Angles [rad] about the world's x, then y, then z axis."""
    motion: Still | Translation = field(default_factory=Still)
    friction: float | None = None
    """Coulomb coefficient of its contacts; None takes each whisker's own."""

    def obstacle(self, frame: tuple[ArrayLike, ArrayLike] | None = None) -> Obstacle:
        """Return what the physics sees.

        Args:
            frame: rotation [3, 3] and origin [3] (m) of the frame, in the world, in which the
                obstacle is expressed; the world itself when None.
        """
        axes, origin = (np.eye(3), np.zeros(3)) if frame is None else (np.asarray(frame[0]), np.asarray(frame[1]))
        rotation = axes.T @ euler_matrix(self.rotation)
        translation = axes.T @ (np.asarray(self.position) - origin)
        parts = tuple(move_part(part, rotation, translation) for part in self.solid.parts)
        surface = self.solid.surface and self.solid.surface.moved(rotation, translation)
        if isinstance(self.motion, Still):
            return Obstacle(parts=parts, friction=self.friction, surface=surface)
        motion = self.motion

        def path(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            identity = np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
            return motion.displacement(times) @ axes, identity

        return Obstacle(parts=parts, motion=path, friction=self.friction, surface=surface)

    def config(self) -> dict[str, Any]:
        """Plain values that determine the physics."""
        return {
            "solid": self.solid.config(),
            "position": list(self.position),
            "rotation": list(self.rotation),
            "motion": self.motion.config(),
            "friction": self.friction,
        }


def sphere(radius: float) -> Solid:
    """Return a ball about the origin; ``radius`` in metres."""
    return Solid("sphere", (Sphere((0.0, 0.0, 0.0), radius),))


def box(size: Vector) -> Solid:
    """Return a box about the origin with edge lengths ``size`` [m]."""
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Solid("box", (Box((0.0, 0.0, 0.0), half),))


def cylinder(radius: float, height: float) -> Solid:
    """Return an upright (z) cylinder about the origin, such as a pole; metres."""
    return Solid("cylinder", (Cylinder((0.0, 0.0, -height / 2), (0.0, 0.0, height / 2), radius),))


def capsule(radius: float, length: float) -> Solid:
    """Return an upright (z) capsule about the origin; ``length`` [m] between the centres of its caps."""
    return Solid("capsule", (Capsule((0.0, 0.0, -length / 2), (0.0, 0.0, length / 2), radius),))


def rodgers_solid(diagonal: float = 0.055, *, segments: int = 24) -> Solid:
    """Return the crescent of the shape-discrimination task (Rodgers 2022), in the published mesh's frame.

    A cubic Bézier profile of constant offset, extruded along z. Each segment between two points of
    the curve is a parallelogram prism, so the parts are exactly convex, their union is exactly the
    polygonal solid and the concave face stays concave. The concave face looks towards −y.

    Args:
        diagonal: bounding-box diagonal [m]; 55 mm in the published simulation.
        segments: prisms along the curve; 24 leave a sagitta below 0.02 mm at 55 mm.
    """
    if segments < 2:
        raise UsageError(f"The Rodgers solid needs at least 2 segments along its curve; received {segments}.")
    t = np.linspace(0.0, 1.0, segments + 1)[:, None]
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    convex = weights @ np.array(RODGERS_CONTROL)
    concave = convex + np.array(RODGERS_OFFSET)
    # Rings of four corners along the curve: convex low, convex high, concave high, concave low.
    low, high = (np.full(segments + 1, height) for height in RODGERS_SPAN)
    profile = ((convex, low), (convex, high), (concave, high), (concave, low))
    rings = np.stack([np.column_stack([side, height]) for side, height in profile], axis=1)
    corner, following = np.arange(4), np.roll(np.arange(4), -1)
    near = 4 * np.arange(segments)[:, None]
    quads = np.stack([near + corner, near + corner + 4, near + following + 4, near + following], axis=-1).reshape(-1, 4)
    last = 4 * segments
    quads = np.vstack([quads, [[0, 1, 2, 3]], [[last + 3, last + 2, last + 1, last]]])
    faces = np.vstack([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]])
    mesh = Mesh(rings.reshape(-1, 3), faces, "rodgers")
    parts = tuple(ConvexPart(np.vstack([rings[i], rings[i + 1]])) for i in range(segments))
    return Solid("rodgers", parts, mesh, surface=_surface(mesh)).to_diagonal(diagonal)


def mesh_solid(
    path: str | os.PathLike[str],
    *,
    unit: str,
    diagonal: float | None = None,
    collision: str = "hull",
    decomposition: DecompositionSettings | None = None,
) -> Solid:
    """Return a mesh file as a solid, repaired where that needs no guessing (see :func:`brainbench.geometry.repair`).

    Args:
        path: any format :func:`brainbench.geometry.load_mesh` reads.
        unit: length unit of the file (``m``, ``mm``, …).
        diagonal: scale to this bounding-box diagonal [m]; None keeps the size.
        collision: what whiskers touch, one of :data:`COLLISIONS`.
        decomposition: how ``decomposition`` cuts; its defaults when None.

    Raises:
        UsageError: ``collision`` or the unit is unknown, or ``exact`` is asked of a mesh that is not closed.
        DataError: the file is missing, unreadable or flat, or the decomposition passed its limits.
        MissingDependencyError: the decomposition needs a package that is not installed.
    """
    _check_collision(collision)
    repaired = repair(load_mesh(path, unit=unit))
    solid = _touchable(repaired.mesh, collision, decomposition)
    # Separate bodies are what "pieces" is for.
    expected = collision == "pieces" and repaired.mesh.diagnosis.watertight
    solid = replace(solid, notes=(*repaired.done, *solid.notes, *(() if expected else repaired.remaining)))
    for note in solid.notes:
        _LOG.warning("%s: %s", os.fspath(path), note)
    return solid if diagonal is None else solid.to_diagonal(diagonal)


def shape_solid(
    shape: Shape,
    *,
    diagonal: float = 0.04,
    collision: str | None = None,
    decomposition: DecompositionSettings | None = None,
) -> Solid:
    """Return a procedural shape (:func:`brainbench.stimuli.shapes.make`) as a solid.

    Args:
        shape: any member of a family.
        diagonal: bounding-box diagonal [m]; the thesis used 40 mm.
        collision: one of :data:`COLLISIONS`; None takes the convex parts that the family knows (``exact``), or
            the ``hull`` where it knows none, and a note says which.
        decomposition: how ``decomposition`` cuts; its defaults when None.

    Raises:
        UsageError: ``collision`` is unknown.
        DataError: the decomposition passed its limits.
        MissingDependencyError: the decomposition needs a package that is not installed.
    """
    if collision is None:
        collision = "exact" if shape.part_points else "hull"
    _check_collision(collision)
    name = f"{shape.label}-{shape.seed}"
    mesh = Mesh(shape.mesh.vertices, shape.mesh.faces, name)
    if collision != "exact" or not shape.part_points:
        return _touchable(mesh, collision, decomposition).to_diagonal(diagonal)
    notes: tuple[str, ...] = ()
    if len(shape.parts) > 1:
        found = deviation(mesh, shape.parts, samples=1000)
        notes = (
            f"whiskers touch {len(shape.parts)} convex parts of the shape, which stand out from its mesh by at most"
            f" {found.outward:.2%} and fall short of it by at most {found.inward:.2%} of its diagonal (sampled)",
        )
    parts = tuple(ConvexPart(part.vertices) for part in shape.parts)
    origin = {"mesh": mesh.content_hash, "parts": content_hash([*shape.part_points])}
    return Solid(name, parts, mesh, notes, origin, _surface(mesh)).to_diagonal(diagonal)


def shape_solids(
    families: Iterable[str] | None = None,
    *,
    members: int = 1,
    diagonal: float = 0.04,
    detail: int = 4_000,
    collision: str | None = None,
) -> dict[str, Callable[[], Solid]]:
    """Return, by name (``torus-0``), functions that make procedural solids when they are needed, as sweeps take them.

    Args:
        families: names from :func:`brainbench.stimuli.shapes.list_families`; all of them when None.
        members: shapes of each family, with the seeds 0, 1, ….
        diagonal, collision: as for :func:`shape_solid`.
        detail: as for :func:`brainbench.stimuli.shapes.make`.

    Raises:
        UsageError: a family is unknown, or there is less than one member.
    """
    from brainbench.stimuli import shapes

    if members < 1:
        raise UsageError(f"A family needs at least one member; received {members!r}.")
    chosen = shapes.list_families() if families is None else tuple(families)
    for family in chosen:
        shapes.describe_family(family)

    def load(family: str, seed: int) -> Solid:
        return shape_solid(shapes.make(family, seed, detail=detail), diagonal=diagonal, collision=collision)

    return {f"{family}-{seed}": functools.partial(load, family, seed) for family in chosen for seed in range(members)}


def _check_collision(collision: str) -> None:
    if collision not in COLLISIONS:
        raise unknown_name("collision geometry", collision, COLLISIONS)


def _touchable(mesh: Mesh, collision: str, settings: DecompositionSettings | None) -> Solid:
    """Make the parts of a solid from its mesh."""
    if collision == "decomposition":
        cut = decompose(mesh, settings)
        origin = {"mesh": mesh.content_hash, "decomposition": cut.key}
        return Solid(mesh.name, tuple(ConvexPart(piece.vertices) for piece in cut.pieces), mesh, cut.notes, origin)
    if collision == "exact":
        return _exact(mesh)
    pieces = mesh.pieces() if collision == "pieces" else (mesh,)
    hulls = [piece.hull() for piece in pieces]
    notes: tuple[str, ...] = ()
    if any(_is_concave(piece, hull) for piece, hull in zip(pieces, hulls, strict=True)):
        what = "the mesh" if collision == "hull" else "its pieces"
        notes = (f"whiskers touch the convex hull of {what}: concavities are filled",)
    surface = _surface(hulls[0]) if collision == "hull" else None
    return Solid(mesh.name, tuple(ConvexPart(hull.vertices) for hull in hulls), mesh, notes, surface=surface)


def _exact(mesh: Mesh) -> Solid:
    """Make a solid that is touched at its surface, and at its hull by other engines if it is convex."""
    if not mesh.diagnosis.watertight:
        raise UsageError(
            f"The mesh {mesh.name!r} is not closed ({mesh.diagnosis}), so it has no inside to keep whiskers out of; use"
            " collision = 'hull' (its concavities filled), or close it."
        )
    # The parts of a convex mesh do not tell a shallow dent, which the surface has.
    origin, hull = {"mesh": mesh.content_hash, "collision": "exact"}, mesh.hull()
    if not _is_concave(mesh, hull):
        return Solid(mesh.name, (ConvexPart(hull.vertices),), mesh, (), origin, _surface(mesh))
    notes = (
        f"whiskers touch the {len(mesh.faces)} triangles of this concave mesh themselves: that takes the backend 'rod'",
    )
    return Solid(mesh.name, (), mesh, notes, origin, _surface(mesh))


def _surface(mesh: Mesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces.astype(np.int32))


def _through_corners(surface: TriangleMesh, parts: tuple[Part, ...]) -> bool:
    """Whether the surface runs through corners of the convex parts alone, so that the parts tell it."""
    corners = {tuple(corner) for part in parts if isinstance(part, ConvexPart) for corner in part.vertices.tolist()}
    return all(tuple(vertex) in corners for vertex in surface.vertices.tolist())


def euler_matrix(angles: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrix [3, 3] of ``angles`` [rad] about the fixed x, then y, then z axis."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def move_part(part: Part, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Part:
    """Return ``part`` rotated by a matrix [3, 3] about the origin, then translated by [3] (m)."""

    def place(point: ArrayLike) -> Any:
        return tuple(map(float, rotation @ np.asarray(point) + translation))

    if isinstance(part, ConvexPart):
        return ConvexPart(part.vertices @ rotation.T + translation)
    if isinstance(part, Sphere):
        return replace(part, centre=place(part.centre))
    if isinstance(part, Box):
        from scipy.spatial.transform import Rotation

        turned = Rotation.from_matrix(rotation @ rotation_matrix(part.quaternion)).as_quat(scalar_first=True)
        return replace(part, centre=place(part.centre), quaternion=tuple(map(float, turned)))
    return replace(part, start=place(part.start), end=place(part.end))


def scale_part(part: Part, factor: float) -> Part:
    """Return ``part`` scaled about the origin."""

    def times(vector: ArrayLike) -> Any:
        return tuple(float(value) * factor for value in np.asarray(vector))

    if isinstance(part, ConvexPart):
        return ConvexPart(part.vertices * factor)
    if isinstance(part, Sphere):
        return Sphere(times(part.centre), part.radius * factor)
    if isinstance(part, Box):
        return replace(part, centre=times(part.centre), half_sizes=times(part.half_sizes))
    return replace(part, start=times(part.start), end=times(part.end), radius=part.radius * factor)


def _is_concave(mesh: Mesh, hull: Mesh) -> bool:
    if not mesh.diagnosis.watertight:
        return True
    return mesh.volume < 0.999 * hull.volume
