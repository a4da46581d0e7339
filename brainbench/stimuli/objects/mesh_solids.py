"""Solids from mesh files and procedural shapes. Metres."""

from __future__ import annotations

import logging
import os
from dataclasses import replace

from brainbench.core.errors import UsageError, check_name
from brainbench.core.files import content_hash
from brainbench.geometry import DecompositionSettings, Mesh, decompose, deviation, load_mesh, repair
from brainbench.stimuli.objects.obstacle import ConvexPart
from brainbench.stimuli.objects.procedural import Shape
from brainbench.stimuli.objects.solid import Solid

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
