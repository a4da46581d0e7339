"""Triangle meshes: loading with units, diagnosis, scaling, convex hull and content hash. Metres inside."""

from __future__ import annotations

import io
import os
import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError, UsageError, brief, check_name, unknown_name
from brainbench.core.reading.ranges import check_number
from brainbench.core.reading.regular import MOST_PART, check_file, part_of, readable

if TYPE_CHECKING:
    import trimesh

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
"""Length units of mesh files in metres."""


WRITABLE = (".obj", ".stl", ".ply", ".glb", ".off")
"""Mesh formats that :func:`save_mesh` writes; :func:`load_mesh` reads more."""


@dataclass(frozen=True)
class Diagnosis:
    """Faults of a mesh as a solid."""

    open_edges: int
    """Edges that do not join exactly two triangles; 0 for a watertight surface."""
    degenerate_faces: int
    """Triangles without area."""
    bodies: int
    """Connected pieces."""
    inconsistent: bool
    """True where neighbouring triangles disagree on which side is out."""
    duplicate_faces: int = 0
    """Triangles that another triangle with the same corners repeats."""
    inside_out: bool = False
    """True for a closed surface that faces inward."""
    folded_edges: int = 0
    """Edges whose two triangles lie back to back: a concave polygon of the file was cut into a fan."""

    @property
    def watertight(self) -> bool:
        """True when the surface encloses a volume."""
        return self.open_edges == 0

    def __str__(self) -> str:
        faults = {
            f"{self.open_edges} open edges (not watertight)": self.open_edges,
            f"{self.degenerate_faces} triangles without area": self.degenerate_faces,
            f"{self.bodies} separate pieces": self.bodies > 1,
            f"{self.duplicate_faces} duplicate triangles": self.duplicate_faces,
            "triangles that disagree on inside and outside": self.inconsistent,
            "a surface that is inside out": self.inside_out,
            f"{self.folded_edges} edges with triangles back to back (export polygons as triangles)": self.folded_edges,
        }
        return ", ".join(text for text, found in faults.items() if found) or "watertight"


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh."""

    vertices: NDArray[np.float64]
    """[V, 3] m."""
    faces: NDArray[np.int64]
    """[F, 3] vertex indices, counter-clockwise seen from outside."""
    name: str = field(default="mesh", compare=False)

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.array(self.faces, dtype=np.int64).reshape(-1, 3)
        if not len(faces):
            raise DataError(f"The mesh {self.name!r} has no faces.")
        if not np.isfinite(vertices).all():
            raise DataError(f"The mesh {self.name!r} has vertices that are not finite numbers.")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise DataError(f"The mesh {self.name!r} has faces that name missing vertices.")
        for name, array in (("vertices", vertices), ("faces", faces)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [2, 3] (m) of the used vertices."""
        used = self.vertices[np.unique(self.faces)]
        corners = np.stack([used.min(axis=0), used.max(axis=0)])
        corners.setflags(write=False)
        return corners

    @property
    def diagonal(self) -> float:
        """Length of the bounding-box diagonal [m]."""
        low, high = self.bounds
        return float(np.linalg.norm(high - low))

    @cached_property
    def boxes(self) -> NDArray[np.float64]:
        """Axis-aligned boxes [k, 2, 3] of at most 64 patches of neighbouring triangles: together they hold all of it.

        They follow a concave surface much closer than its bounds do.
        """
        corners = self.vertices[self.faces]
        low, high = corners.min(axis=1), corners.max(axis=1)
        middle = (low + high) / 2
        patches = [np.arange(len(corners))]
        while len(patches) < 64 and len(patches[0]) > 1:
            # Each is split where its longest side is halved by number.
            axes = [np.ptp(middle[patch], axis=0).argmax() for patch in patches]
            ordered = [p[np.argsort(middle[p, axis], kind="stable")] for p, axis in zip(patches, axes, strict=True)]
            patches = [half for p in ordered for half in (p[: len(p) // 2], p[len(p) // 2 :]) if len(half)]
        return np.array([[low[patch].min(axis=0), high[patch].max(axis=0)] for patch in patches])

    @cached_property
    def diagnosis(self) -> Diagnosis:
        """Faults of this mesh as a solid."""
        solid = self.to_trimesh()
        edges = solid.edges_sorted.astype(np.int64)
        # Both vertices of an edge make one integer, so that one sort counts all edges.
        counts = np.unique(edges[:, 0] * len(self.vertices) + edges[:, 1], return_counts=True)[1]
        open_edges = int((counts != 2).sum())
        consistent = bool(solid.is_winding_consistent)
        # Corners sorted: copies of a triangle count whichever way they are turned.
        distinct = len(np.unique(np.sort(self.faces, axis=1), axis=0))
        return Diagnosis(
            open_edges=open_edges,
            degenerate_faces=int((solid.area_faces <= 1e-12 * self.diagonal**2).sum()),
            bodies=len(np.unique(face_owners(self))),
            inconsistent=not consistent,
            duplicate_faces=len(self.faces) - distinct,
            inside_out=open_edges == 0 and consistent and self.volume < 0,
            folded_edges=_folded_edges(self, solid.face_adjacency) if consistent else 0,
        )

    @cached_property
    def volume(self) -> float:
        """Signed volume inside a closed surface [m³]; negative when it is inside out, meaningless when open."""
        # Divergence theorem: signed tetrahedra a·(b × c)/6, seen from the middle, since a far origin would cost digits.
        a, b, c = np.moveaxis(self.vertices[self.faces] - self.bounds.mean(axis=0), 1, 0)
        return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6)

    @cached_property
    def content_hash(self) -> str:
        """Hash of vertices and faces; the name does not count."""
        from brainbench.core.files import content_hash, without_last_digits

        return content_hash(without_last_digits(self.vertices), self.faces)

    def scaled(self, factor: float) -> Mesh:
        """Return the mesh scaled about its origin."""
        check_number("The scale of a mesh", factor, above=0)
        return Mesh(self.vertices * factor, self.faces, self.name)

    def transformed(self, rotation: ArrayLike, translation: ArrayLike = (0.0, 0.0, 0.0)) -> Mesh:
        """Return the mesh rotated by a matrix [3, 3] and then moved by ``translation`` [3] (m)."""
        turn = np.asarray(rotation, dtype=float)
        # Orthonormal up to the rounding of single precision; a reflection has determinant -1.
        if turn.shape != (3, 3) or not np.allclose(turn @ turn.T, np.eye(3), atol=1e-5) or np.linalg.det(turn) < 0:
            raise UsageError(
                "A mesh is turned by a rotation matrix [3, 3], orthonormal with determinant 1; "
                f"received {brief(turn.tolist())}."
            )
        return Mesh(self.vertices @ turn.T + np.asarray(translation), self.faces, self.name)

    def hull(self) -> Mesh:
        """Return the convex hull; a flat mesh, which has none, is a :class:`DataError`."""
        return convex_hull(self.vertices, self.name)

    def pieces(self) -> tuple[Mesh, ...]:
        """Return the connected pieces of the surface, in the order of their first faces."""
        owner = face_owners(self)
        parts = []
        for piece in dict.fromkeys(owner.tolist()):
            used, faces = np.unique(self.faces[owner == piece], return_inverse=True)
            parts.append(Mesh(self.vertices[used], faces.reshape(-1, 3), self.name))
        return tuple(parts)

    def to_trimesh(self) -> trimesh.Trimesh:
        """Return a :class:`trimesh.Trimesh` with the same vertices and faces."""
        import trimesh

        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def convex_hull(points: NDArray[np.float64], name: str = "mesh") -> Mesh:
    """Return the convex hull of points [n, 3] as a closed outward mesh; points in a plane are a :class:`DataError`."""
    # The third singular value of centred points is their extent across the plane that fits them best.
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if spread[2] < 1e-9 * spread[0]:
        raise DataError(f"The mesh {name!r} has no volume: its points lie in a plane.")
    used, renumbered = np.unique(hull_faces(points), return_inverse=True)
    return Mesh(points[used], renumbered.reshape(-1, 3), name)


def hull_faces(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return the outward faces [F, 3] of the convex hull of points [n, 3], as indices of these."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(points)
    faces = np.array(hull.simplices)
    # Qhull orders the corners of a facet as it likes; its equations know the way out.
    first, second, third = (points[faces[:, corner]] for corner in range(3))
    inward = np.einsum("fi,fi->f", np.cross(second - first, third - first), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces


def face_owners(mesh: Mesh) -> NDArray[np.int64]:
    """Return the number [F] of the connected piece that each face belongs to."""
    from trimesh.graph import connected_component_labels

    # Two edges of a triangle join its three vertices; pieces are the components of that graph.
    edges = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    return connected_component_labels(edges, node_count=len(mesh.vertices))[mesh.faces[:, 0]]


def _folded_edges(mesh: Mesh, pairs: NDArray[np.int64]) -> int:
    """Count pairs [n, 2] of neighbouring faces with an area whose normals are opposite within .08°."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    doubled = np.linalg.norm(normals, axis=1)
    units = normals / np.maximum(doubled, np.finfo(float).tiny)[:, None]
    wide = (doubled > 2e-12 * mesh.diagonal**2)[pairs].all(axis=1)
    return int((wide & (np.einsum("pi,pi->p", units[pairs[:, 0]], units[pairs[:, 1]]) < -1 + 1e-6)).sum())


def load_mesh(path: str | os.PathLike[str], *, unit: str, apart: bool = False) -> Mesh:
    """Read a mesh file (OBJ, STL, PLY, GLB, OFF, …); equal vertices are merged, nothing else is repaired.

    A scene with several meshes is joined into one. ``unit`` is that of the file's numbers, one of :data:`UNITS` (most
    formats carry none). With ``apart``, closed bodies that touch keep vertices of their own, so that
    :meth:`Mesh.pieces` tells them apart.
    """
    import trimesh

    check_name("length unit", unit, UNITS)
    path = check_file(path, "mesh file", most=MOST_PART)
    with readable(path, "mesh"):
        loaded: Any = _scene(path).to_mesh()
        if not isinstance(loaded, trimesh.Trimesh) or not len(loaded.faces):
            raise DataError(f"{os.fspath(path)!r} holds no triangles.")
        # Exactly equal vertices only: a tolerance would depend on the unit.
        vertices, merged = np.unique(np.asarray(loaded.vertices, dtype=np.float64), axis=0, return_inverse=True)
        faces = np.asarray(loaded.faces)
        if faces.min() < 0 or faces.max() >= len(merged.reshape(-1)):
            raise DataError(f"{os.fspath(path)!r} has faces that name missing vertices.")
        mesh = Mesh(vertices, merged.reshape(-1)[faces], path.stem)
        if apart and (bodies := _bodies(path)) is not None and len(bodies.pieces()) > len(mesh.pieces()):
            mesh = bodies
        return mesh.scaled(UNITS[unit])


class _Beside:
    """Gives trimesh the buffers and materials that a mesh file names; pictures, which have no shape, are left out."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, name: str) -> bytes:
        if Path(name).suffix.lower() not in (".bin", ".glbin", ".mtl", ".ply", ".stl"):
            raise DataError(f"{brief(name)} holds no part of a mesh's shape.")
        return part_of(self.folder, name, "part of a mesh").read_bytes()

    __getitem__ = get

    def keys(self) -> tuple[str, ...]:
        return ()


def _scene(path: Path, **options: Any) -> Any:
    """Read a file by trimesh; indices of an OBJ that count back from their line are made absolute first."""
    import trimesh

    options["resolver"] = _Beside(path.parent)
    if path.suffix.lower() == ".obj":
        text = path.read_text(errors="replace")
        if re.search(r"^f\b.*[\s/]-\d", text, re.MULTILINE):
            text = _absolute(text)
            return trimesh.load_scene(io.StringIO(text), file_type="obj", process=False, **options)
    return trimesh.load_scene(path, process=False, **options)


def _absolute(text: str) -> str:
    """Return the text of an OBJ file with the indices of its faces counted from the first vertex."""
    seen = dict.fromkeys(("v", "vt", "vn"), 0)
    lines = []
    for line in text.splitlines():
        kind, *words = line.split() or [""]
        if kind in seen:
            seen[kind] += 1
        elif kind == "f":
            corners = [
                "/".join(
                    str(total + int(index) + 1) if index.startswith("-") else index
                    for index, total in zip(word.split("/"), seen.values(), strict=False)
                )
                for word in words
            ]
            line = " ".join(["f", *corners])
        lines.append(line)
    return "\n".join(lines)


def _bodies(path: Path) -> Mesh | None:
    """Return a file's bodies with vertices of their own, if its indices, or else its objects, make closed ones."""
    import trimesh

    scene = _scene(path, **({"split_objects": True} if path.suffix.lower() == ".obj" else {}))
    parts = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    joined: Any = trimesh.util.concatenate(parts)
    mesh = Mesh(joined.vertices, joined.faces, path.stem)
    objects = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    for owner in (face_owners(mesh), objects):
        rows = np.column_stack([mesh.vertices[mesh.faces].reshape(-1, 3), np.repeat(owner, 3)])
        keys, merged = np.unique(rows, axis=0, return_inverse=True)
        bodies = Mesh(np.asarray(keys[:, :3], float), merged.reshape(-1, 3), path.stem)
        if bodies.diagnosis.watertight:
            return bodies
    return None


def save_mesh(path: str | os.PathLike[str], mesh: Mesh, *, unit: str) -> Path:
    """Write a mesh file in the format that its suffix names, so that readers see all of it or nothing.

    An unknown unit or format is a :class:`UsageError`.
    """
    from brainbench.core.files import atomic_path

    check_name("length unit", unit, UNITS)
    path = Path(path)
    if path.suffix.lower() not in WRITABLE:
        raise unknown_name("mesh format", path.suffix or path.name, WRITABLE, hint="The suffix of the file chooses it.")
    with atomic_path(path) as temporary:
        mesh.scaled(1 / UNITS[unit]).to_trimesh().export(temporary, file_type=path.suffix[1:].lower())
    return path
