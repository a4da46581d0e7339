"""Mend what can be mended without guessing a shape, and say what was done and what remains."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.errors import DataError
from brainbench.geometry.distance import winding_number
from brainbench.geometry.mesh import Mesh, face_owners

if TYPE_CHECKING:
    from numpy.typing import NDArray

MERGE = 1e-6
"""Vertices of an open mesh that lie closer than this part of its diagonal are taken for one."""
CRACK = 1e-3
"""Largest part of the surface that a triangle closing a crack may have."""


@dataclass(frozen=True, eq=False)
class Repair:
    """A mesh as mended, with what was done and what is still wrong, in words."""

    mesh: Mesh
    done: tuple[str, ...]
    """Repairs, such as "3 duplicate triangles were removed"."""
    remaining: tuple[str, ...]
    """Faults that no repair here mends."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Repairs and remaining faults."""
        return (*self.done, *self.remaining)


def repair(mesh: Mesh) -> Repair:
    """Remove broken triangles, close cracks and turn every surface outward; nothing is invented.

    Triangles that name a vertex twice and copies of a triangle are removed; on an open mesh, vertices
    within :data:`MERGE` of the diagonal are merged and tiny cracks of three or four edges are closed;
    neighbours are made to agree on the outside; closed bodies that are inside out are turned. Larger
    holes stay: their shape is unknown.

    Raises:
        DataError: no triangle is left.
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
    if not diagnosis.watertight or diagnosis.inconsistent:
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
    first = np.sort(np.unique(ordered, axis=0, return_index=True)[1])
    if len(first) < len(faces):
        done.append(f"{_count(len(faces) - len(first), 'duplicate triangle')} removed")
        faces = faces[first]
    return mesh if faces is mesh.faces else Mesh(mesh.vertices, faces, mesh.name)


def _close(mesh: Mesh, done: list[str]) -> Mesh:
    """Merge nearly equal vertices and close small cracks, if that leaves fewer open edges."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    pairs = KDTree(mesh.vertices).query_pairs(MERGE * mesh.diagonal, output_type="ndarray")
    if len(pairs):
        size = len(mesh.vertices)
        links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(size, size))
        group = connected_components(links, directed=False)[1]
        representative = np.unique(group, return_index=True)[1]
        merged = _drop(Mesh(mesh.vertices[representative], group[mesh.faces], mesh.name), [])
        if merged.diagnosis.open_edges < mesh.diagnosis.open_edges:
            closed = f"{mesh.diagnosis.open_edges} open edges became {merged.diagnosis.open_edges}"
            done.append(f"vertices closer than {MERGE:g} of the diagonal merged: {closed}")
            mesh = merged
    if mesh.diagnosis.watertight:
        return mesh
    import trimesh

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
    owner = np.unique(face_owners(mesh), return_inverse=True)[1].reshape(-1)
    volumes = _volumes(mesh, owner)
    if (volumes >= 0).all():
        return mesh
    bounds = _bounds(mesh, owner)
    outer = [body for body in np.flatnonzero(volumes < 0) if not _within_another(mesh, owner, bounds, body)]
    if not outer:
        return mesh
    # When whatever points outward is a cavity of a body to be turned, the whole file is inside out.
    whole = all(_within_another(mesh, owner, bounds, body) for body in np.flatnonzero(volumes > 0))
    turned = np.ones(len(owner), bool) if whole else np.isin(owner, outer)
    faces = np.array(mesh.faces)
    faces[turned] = faces[turned][:, ::-1]
    if len(volumes) == 1:
        done.append("the surface was inside out and was turned")
    else:
        done.append(f"{len(np.unique(owner[turned]))} of {len(volumes)} bodies were inside out and were turned")
    return Mesh(mesh.vertices, faces, mesh.name)


def _volumes(mesh: Mesh, owner: NDArray[np.int64]) -> NDArray[np.float64]:
    """Signed volume of each closed body; ``owner`` [F] counts bodies from 0."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces] - mesh.bounds.mean(axis=0), 1, 0)
    parts = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
    return np.asarray(np.bincount(owner, weights=parts), dtype=np.float64)


def _bounds(mesh: Mesh, owner: NDArray[np.int64]) -> NDArray[np.float64]:
    """Lowest and highest corner [bodies, 2, 3]."""
    corners = mesh.vertices[mesh.faces]
    low = np.full((owner.max() + 1, 3), np.inf)
    high = -low
    np.minimum.at(low, owner, corners.min(axis=1))
    np.maximum.at(high, owner, corners.max(axis=1))
    return np.stack([low, high], axis=1)


def _within_another(mesh: Mesh, owner: NDArray[np.int64], bounds: NDArray[np.float64], body: np.intp) -> bool:
    """Whether a body lies inside an odd number of others."""
    corner = mesh.vertices[mesh.faces[np.argmax(owner == body), 0]]
    around = ((corner > bounds[:, 0]) & (corner < bounds[:, 1])).all(axis=1)
    around = np.flatnonzero(around & (np.arange(len(bounds)) != body))
    wraps = [winding_number(Mesh(mesh.vertices, mesh.faces[owner == other]), corner) for other in around]
    return sum(abs(float(wrap[0])) > 0.5 for wrap in wraps) % 2 == 1


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"
