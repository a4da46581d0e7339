"""Rigid shapes: what whiskers touch of them, from primitives, mesh files and families, and where they stand. Metres."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, check_name, check_number
from brainbench.core.files import content_hash, portable
from brainbench.core.limits import NotNegative, limited
from brainbench.core.rotations import Angles, Point, Vector, euler_matrix, from_matrices
from brainbench.geometry import DecompositionSettings, Mesh, decompose, deviation, load_mesh, repair
from brainbench.stimuli.motion.trajectories import Path, Spin, Still, Translation
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Part, Sphere, bounds_of
from brainbench.stimuli.objects.procedural import Shape


@dataclass(frozen=True, eq=False)
class Solid:
    """A rigid shape in its own frame."""

    name: str
    parts: tuple[Part, ...]
    """Convex parts whose union is what whiskers touch [m]; empty for a concave surface that is not cut into any."""
    mesh: Mesh | None = None
    """Surface for pictures and measurements; None for primitives."""
    notes: tuple[str, ...] = ()
    """Remarks for the user, such as a concavity lost to the convex hull."""
    origin: Mapping[str, Any] | None = None
    """Source of the parts, where their last digits depend on the machine; :meth:`config` has it."""
    surface: Mesh | None = None
    """The exact surface [m], for engines that collide meshes; None where the parts are exact by themselves
    (primitives) or stand for the solid (``pieces``, ``decomposition``)."""

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [2, 3] (m)."""
        return bounds_of(self.parts, self.mesh or self.surface)

    @property
    def diagonal(self) -> float:
        """Length of the bounding-box diagonal [m]."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    def scaled(self, factor: float) -> Solid:
        """Return the solid scaled about its origin."""
        check_number("The scale of a solid", factor, above=0)
        parts = tuple(part.scaled(factor) for part in self.parts)
        surface = self.surface and self.surface.scaled(factor)
        return replace(self, parts=parts, mesh=self.mesh and self.mesh.scaled(factor), surface=surface)

    def to_diagonal(self, diagonal: float) -> Solid:
        """Return the solid scaled about its origin to a bounding-box diagonal [m]."""
        return self.scaled(diagonal / self.diagonal)

    def config(self) -> dict[str, Any]:
        """Return plain values that determine the physics; parts count by a hash of numbers or origin."""
        stated = {"name": self.name, "parts": len(self.parts), "diagonal": self.diagonal, "notes": list(self.notes)}
        return {**stated, "hash": self._hash}

    @cached_property
    def _hash(self) -> str:
        """Hash of the parts; kept, because every whisker's job asks for it and a hull has a thousand corners."""
        if self.origin is not None:
            return content_hash(self.origin, round(self.diagonal, 12))
        parts = [{"kind": type(part).__name__, **portable(part)} for part in self.parts]
        convex = [part for part in self.parts if isinstance(part, ConvexPart)]
        corners = {tuple(corner) for part in convex for corner in part.vertices.tolist()}
        # Parts tell a surface that runs through corners of convex ones alone.
        if self.surface is None or all(tuple(vertex) in corners for vertex in self.surface.vertices.tolist()):
            return content_hash(parts)
        return content_hash(parts, portable({"vertices": self.surface.vertices, "faces": self.surface.faces}))


RODGERS_CONTROL = ((-0.720943, 0.195148), (-0.167777, 0.219684), (0.235608, -0.057831), (0.631506, -0.409149))
"""Control points (x, y) of the cubic Bézier curve that is the convex face of the Rodgers solid, in the
units of the published mesh (1 unit = 34.324 mm at a diagonal of 55 mm). Fitted by us; the curve passes
through all 101 published vertices of that face within 6e-7."""
RODGERS_OFFSET = (-0.020447, -0.046006)
"""Displacement (x, y) from the convex to the concave face: the profile is the curve swept along it."""
RODGERS_SPAN = (-0.256589, 0.251290)  # lowest and highest z of the extruded profile


def sphere(radius: float) -> Solid:
    """Return a ball about the origin; ``radius`` in metres."""
    return Solid("sphere", (Sphere((0.0, 0.0, 0.0), radius),))


def box(size: Vector) -> Solid:
    """Return a box about the origin with edge lengths ``size`` [m]."""
    return Solid("box", (Box((0.0, 0.0, 0.0), (size[0] / 2, size[1] / 2, size[2] / 2)),))


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
    polygonal solid and the concave face stays concave. The concave face looks towards −y. The published simulation has
    a bounding-box diagonal of 55 mm, at which 24 segments leave a sagitta below 0.02 mm.
    """
    check_number("segments of the Rodgers solid", segments, least=2, whole=True)
    t = np.linspace(0.0, 1.0, segments + 1)[:, None]
    # Bernstein polynomials of degree 3.
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
    return Solid("rodgers", parts, mesh, surface=mesh).to_diagonal(diagonal)


_LOG = logging.getLogger(__name__)

COLLISIONS = ("exact", "hull", "pieces", "decomposition")
"""Parts of a mesh that whiskers touch. ``exact``: the surface itself; a concave one without known convex parts can be
touched by the backend ``rod`` only, because ``mujoco`` and ``bullet`` collide convex bodies. ``hull``: the convex
hull. ``pieces``: the hull of each connected piece, for files that bring a convex decomposition along.
``decomposition``: convex pieces cut by CoACD or V-HACD."""

SIZES = 1e-3, 1.0
"""Diagonals [m] of objects beyond which the unit of a mesh file is doubtful: metres and millimetres taken for each
other make an object of 20 mm one of 20 µm, which touches nothing, or of 20 m."""


def mesh_solid(
    path: str | os.PathLike[str],
    *,
    unit: str,
    diagonal: float | None = None,
    collision: str = "hull",
    decomposition: DecompositionSettings | None = None,
) -> Solid:
    """Return a mesh file as a solid, repaired where that needs no guessing (see :func:`brainbench.geometry.repair`).

    The file is of any format that :func:`brainbench.geometry.load_mesh` reads, its lengths in ``unit`` (``m``, ``mm``,
    …); it is scaled to a bounding-box ``diagonal`` [m] where one is given. Whiskers touch its ``collision`` geometry,
    one of :data:`COLLISIONS`.
    """
    check_name("collision geometry", collision, COLLISIONS)
    repaired = repair(load_mesh(path, unit=unit, apart=collision == "pieces"))
    solid = touchable(repaired.mesh, collision, decomposition)
    # Separate bodies are what "pieces" is for.
    expected = collision == "pieces" and repaired.mesh.diagnosis.watertight
    solid = replace(solid, notes=(*repaired.done, *solid.notes, *(() if expected else repaired.remaining)))
    for note in solid.notes:
        _LOG.warning("%s: %s", os.fspath(path), note)
    if diagonal is not None:
        return solid.to_diagonal(diagonal)
    if not SIZES[0] <= solid.diagonal <= SIZES[1]:
        doubt = f"the object is {solid.diagonal * 1e3:.3g} mm across: are its lengths in {unit}?"
        _LOG.warning("%s: %s", os.fspath(path), doubt)
    return solid


def shape_solid(
    shape: Shape,
    *,
    diagonal: float = 0.04,
    collision: str | None = None,
    decomposition: DecompositionSettings | None = None,
) -> Solid:
    """Return a procedural shape (:func:`brainbench.stimuli.objects.procedural.make`) as a solid.

    Args and errors are those of :func:`mesh_solid`; the thesis used a diagonal of 40 mm. Without ``collision`` the
    convex parts that the family knows are taken (``exact``), or the ``hull`` where it knows none, and a note says
    which.
    """
    if collision is None:
        collision = "exact" if shape.part_points else "hull"
    check_name("collision geometry", collision, COLLISIONS)
    name = f"{shape.label}-{shape.seed}"
    mesh = Mesh(shape.mesh.vertices, shape.mesh.faces, name)
    if collision != "exact" or not shape.part_points:
        return touchable(mesh, collision, decomposition).to_diagonal(diagonal)
    notes: tuple[str, ...] = ()
    if len(shape.parts) > 1:
        gap = deviation(mesh, shape.parts, samples=1000)
        notes = (
            f"whiskers touch {len(shape.parts)} convex parts of the shape, which stand out from its mesh by at most"
            f" {gap.outward:.2%} and fall short of it by at most {gap.inward:.2%} of its diagonal (sampled)",
        )
    parts = tuple(ConvexPart(part.vertices) for part in shape.parts)
    origin = {"mesh": mesh.content_hash, "parts": content_hash([*shape.part_points])}
    return Solid(name, parts, mesh, notes, origin, mesh).to_diagonal(diagonal)


def touchable(mesh: Mesh, collision: str, settings: DecompositionSettings | None) -> Solid:
    """Return a mesh as a solid that is touched as ``collision`` says; see :func:`mesh_solid`."""
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
    surface = hulls[0] if collision == "hull" else None
    return Solid(mesh.name, tuple(ConvexPart(hull.vertices) for hull in hulls), mesh, notes, surface=surface)


def _exact(mesh: Mesh) -> Solid:
    """Make a solid that is touched at its surface, and at its hull by other engines if it is convex."""
    if not mesh.diagnosis.watertight or mesh.diagnosis.inconsistent or mesh.diagnosis.folded_edges:
        raise UsageError(
            f"The mesh {mesh.name!r} is not closed ({mesh.diagnosis}), so it has no inside to keep whiskers out of; use"
            " collision = 'hull' (its concavities filled), or close it."
        )
    # The parts of a convex mesh do not tell a shallow dent, which the surface has.
    origin, hull = {"mesh": mesh.content_hash, "collision": "exact"}, mesh.hull()
    if not _is_concave(mesh, hull):
        return Solid(mesh.name, (ConvexPart(hull.vertices),), mesh, (), origin, mesh)
    notes = (
        f"whiskers touch the {len(mesh.faces)} triangles of this concave mesh themselves: that takes the backend 'rod'",
    )
    return Solid(mesh.name, (), mesh, notes, origin, mesh)


def _is_concave(mesh: Mesh, hull: Mesh) -> bool:
    # Bodies that overlap count their common part several times: together they can have the volume of their hull.
    volume = min(mesh.volume, max(piece.volume for piece in mesh.pieces()))
    return not mesh.diagnosis.watertight or volume < 0.999 * hull.volume


@dataclass(frozen=True, eq=False)
class _PlacedMotion:
    """Motion of a placed body in the frame ``axes`` [3, 3], where its origin is at ``place`` [3] (m) at t = 0."""

    motion: Translation | Spin | Path
    axes: NDArray[np.float64]
    place: NDArray[np.float64]

    @property
    def finest(self) -> float:
        """Shortest period of anything in the motion (s)."""
        return self.motion.finest

    def __call__(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [n, 3] (m) and quaternions [n, 4] at times [n] (s)."""
        # World displacements and rotations T seen from the frame: Rᵀ x (for rows, x R) and Rᵀ T R.
        moved = self.motion.displacement(times) @ self.axes
        if isinstance(self.motion, Translation):
            return moved, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
        return self.place + moved, from_matrices(self.axes.T @ self.motion.turn(times) @ self.axes)


@limited(of="{} of an object", eq=False)
class PlacedObject:
    """A solid in a scene (world frame); a friction below 0 or a pose that is not finite is a :class:`UsageError`."""

    solid: Solid
    position: Point = (0.0, 0.0, 0.0)
    """Position of the solid's origin [m]."""
    rotation: Angles = (0.0, 0.0, 0.0)
    """Angles [rad] about the world's x, then y, then z axis."""
    motion: Still | Translation | Spin | Path = field(default_factory=Still)
    """Motion from there; the object turns about its solid's origin."""
    friction: NotNegative | None = None
    """Coulomb coefficient of its contacts; None takes each whisker's own."""

    def obstacle(self, frame: tuple[ArrayLike, ArrayLike] | None = None) -> Obstacle:
        """Return what the physics sees in a frame, given by its rotation [3, 3] and origin [3] (m), or in the world."""
        axes, origin = (np.eye(3), np.zeros(3)) if frame is None else (np.asarray(frame[0]), np.asarray(frame[1]))
        rotation = axes.T @ euler_matrix(self.rotation)
        place = axes.T @ (np.asarray(self.position) - origin)
        # What turns is expressed about its own origin, which stays near it.
        shift = np.zeros(3) if isinstance(self.motion, (Spin, Path)) else place
        motion = None if isinstance(self.motion, Still) else _PlacedMotion(self.motion, axes, place)
        return Obstacle(self.solid.parts, motion, self.friction, self.solid.surface).moved(rotation, shift)

    def config(self) -> dict[str, Any]:
        """Return plain values that determine the physics."""
        place = {"position": list(self.position), "rotation": list(self.rotation)}
        return {"solid": self.solid.config(), **place, "motion": self.motion.config(), "friction": self.friction}
