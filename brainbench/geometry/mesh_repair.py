"""Repair of meshes without guessing a shape; what was done and what remains is said."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from brainbench.core.errors import DataError
from brainbench.geometry.distance import winding_number
from brainbench.geometry.mesh import Mesh, face_owners

MERGE = 1e-6
"""Vertices of an open mesh that lie closer than this part of its diagonal are taken for one."""
CRACK = 1e-3
"""Largest part of the surface that a triangle closing a crack may have."""


@dataclass(frozen=True, eq=False)
class Repair:
    """A repaired mesh, with the repairs and the remaining faults in words."""

    mesh: Mesh
    done: tuple[str, ...]
    """Repairs, such as "3 duplicate triangles were removed"."""
    remaining: tuple[str, ...]
    """Faults that are left."""


def repair(mesh: Mesh) -> Repair:
    """Remove broken triangles, close cracks and turn every surface outward; nothing is invented.

    Triangles that name a vertex twice, copies of a triangle and vertices of no triangle are removed; on an open mesh,
    vertices within :data:`MERGE` of the diagonal are merged and tiny cracks of three or four edges are closed;
    neighbours are made to agree on the outside; closed bodies that are inside out are turned. Larger holes stay: their
    shape is unknown.
    """
    done: list[str] = []
    fixed = _drop(mesh, done)
    if not fixed.diagnosis.watertight:
        fixed = _close(fixed, done)
    if fixed.diagnosis.inconsistent:
        fixed = _agree(fixed, done)
    if fixed.diagnosis.watertight and not fixed.diagnosis.inconsistent:
        fixed = _turn(fixed, done)
    diagnosis = fixed.diagnosis
    remaining = []
    if not diagnosis.watertight or diagnosis.inconsistent or diagnosis.folded_edges:
        remaining.append(f"the mesh is not a closed solid: {diagnosis}")
    elif diagnosis.bodies > 1:
        remaining.append(f"the mesh has {diagnosis.bodies} separate bodies; they are kept as one rigid object")
    return Repair(fixed, tuple(done), tuple(remaining))


def _drop(mesh: Mesh, done: list[str]) -> Mesh:
    faces = mesh.faces
    ordered = np.sort(faces, axis=1)
    whole = (np.diff(ordered, axis=1) > 0).all(axis=1)
    if not whole.all():
        done.append(f"{_count(int((~whole).sum()), 'triangle')} without area removed")
        faces, ordered = faces[whole], ordered[whole]
    if not len(faces):
        raise DataError(f"The mesh {mesh.name!r} has no triangle with an area.")
    # The first of equal triangles stays, and the order of the file is kept.
    first = np.sort(np.unique(ordered, axis=0, return_index=True)[1])
    if len(first) < len(faces):
        done.append(f"{_count(len(faces) - len(first), 'duplicate triangle')} removed")
        faces = faces[first]
    # Hulls and bounds go through every vertex, whether a triangle names it or not.
    used, renumbered = np.unique(faces, return_inverse=True)
    if len(used) < len(mesh.vertices):
        done.append(f"points without a triangle removed: {len(mesh.vertices) - len(used)}")
        return Mesh(mesh.vertices[used], renumbered.reshape(-1, 3), mesh.name)
    return mesh if faces is mesh.faces else Mesh(mesh.vertices, faces, mesh.name)


def _close(mesh: Mesh, done: list[str]) -> Mesh:
    """Merge nearly equal vertices and close small cracks, if that leaves fewer open edges."""
    import trimesh
    from scipy.spatial import KDTree

    # Neighbours by tree in V log V; chains of near vertices become one by connected components.
    pairs = KDTree(mesh.vertices).query_pairs(MERGE * mesh.diagonal, output_type="ndarray")
    if len(pairs):
        group = trimesh.graph.connected_component_labels(pairs, node_count=len(mesh.vertices))
        representative = np.unique(group, return_index=True)[1]
        merged = _drop(Mesh(mesh.vertices[representative], group[mesh.faces], mesh.name), [])
        if merged.diagnosis.open_edges < mesh.diagnosis.open_edges:
            closed = f"{mesh.diagnosis.open_edges} open edges became {merged.diagnosis.open_edges}"
            done.append(f"vertices closer than {MERGE:g} of the diagonal merged: {closed}")
            mesh = merged
    if mesh.diagnosis.watertight:
        return mesh
    solid = mesh.to_trimesh()
    trimesh.repair.fill_holes(solid)
    added = np.asarray(solid.faces)[len(mesh.faces) :]
    # An open box is also a hole of four edges; only slivers are cracks.
    areas = np.asarray(solid.area_faces)
    added = added[areas[len(mesh.faces) :] <= CRACK * areas[: len(mesh.faces)].sum()]
    if not len(added):
        return mesh
    filled = Mesh(np.asarray(solid.vertices), np.vstack([mesh.faces, added]), mesh.name)
    if filled.diagnosis.open_edges >= mesh.diagnosis.open_edges:
        return mesh
    done.append(f"small cracks closed with {_count(len(added), 'triangle')}")
    return filled


def _agree(mesh: Mesh, done: list[str]) -> Mesh:
    import trimesh

    solid = mesh.to_trimesh()
    trimesh.repair.fix_winding(solid)
    fixed = Mesh(mesh.vertices, np.asarray(solid.faces), mesh.name)
    changed = int((fixed.faces != mesh.faces).any(axis=1).sum())
    if not changed or fixed.diagnosis.inconsistent:
        return mesh
    done.append(f"{_count(changed, 'triangle')} turned to agree with the neighbours on the outside")
    return fixed


def _turn(mesh: Mesh, done: list[str]) -> Mesh:
    """Turn closed bodies outward; the wall of a cavity, inside another body, rightly points inward."""
    owner = face_owners(mesh)
    bodies = dict(zip(dict.fromkeys(owner.tolist()), mesh.pieces(), strict=True))
    outer = [label for label, body in bodies.items() if body.volume < 0 and not _within_another(bodies, label)]
    if not outer:
        return mesh
    # When whatever points outward is a cavity of a body to be turned, the whole file is inside out.
    whole = all(_within_another(bodies, label) for label, body in bodies.items() if body.volume > 0)
    turned = np.ones(len(owner), bool) if whole else np.isin(owner, outer)
    faces = np.array(mesh.faces)
    faces[turned] = faces[turned][:, ::-1]
    if len(bodies) == 1:
        done.append("the surface was inside out and was turned")
    else:
        done.append(f"{len(np.unique(owner[turned]))} of {len(bodies)} bodies were inside out and were turned")
    return Mesh(mesh.vertices, faces, mesh.name)


def _within_another(bodies: Mapping[int, Mesh], label: int) -> bool:
    """Return whether a body lies inside an odd number of the others, as a whole."""
    low, high = bodies[label].bounds
    around = [
        body
        for number, body in bodies.items()
        if number != label and (low > body.bounds[0]).all() and (high < body.bounds[1]).all()
    ]
    # Of a body that only overlaps another some corner lies outside; a few hundred corners tell.
    corners = bodies[label].vertices
    corners = corners[:: -(-len(corners) // 300)]
    # A winding number above one half is inside (Jacobson et al. 2013), and shells in shells alternate
    # between wall and cavity.
    return sum(bool((np.abs(winding_number(body, corners)) > 0.5).all()) for body in around) % 2 == 1


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
