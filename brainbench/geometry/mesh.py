"""Triangle meshes: loading with units, diagnosis, scaling, convex hull and content hash. Metres inside.

Meshes are repaired without guessing a shape; what was done and what remains is said. Distances between surfaces and
between solids are sampled. Letters: n sample, F face.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError, UsageError, brief, check_name, check_number
from brainbench.core.files import atomic_path, content_hash, without_last_digits
from brainbench.core.lazy import lazy_module
from brainbench.core.reading.regular import MOST_PART, check_file, part_of, readable

if TYPE_CHECKING:
    import trimesh
    from scipy import spatial
else:
    trimesh, spatial = lazy_module("trimesh"), lazy_module("scipy.spatial")

MERGE = 1e-6  # vertices of an open mesh that lie closer than this part of its diagonal are taken for one
CRACK = 1e-3  # largest part of the surface that a triangle closing a crack may have


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
    # Neighbours by tree in V log V; chains of near vertices become one by connected components.
    pairs = spatial.KDTree(mesh.vertices).query_pairs(MERGE * mesh.diagonal, output_type="ndarray")
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


UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
"""Length units of mesh files in metres."""


WRITABLE = (".obj", ".stl", ".ply", ".glb", ".off")  # mesh formats that save_mesh writes; load_mesh reads more


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
    hull = spatial.ConvexHull(points)
    faces = np.array(hull.simplices)
    # Qhull orders the corners of a facet as it likes; its equations know the way out.
    first, second, third = (points[faces[:, corner]] for corner in range(3))
    inward = np.einsum("fi,fi->f", np.cross(second - first, third - first), hull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return faces


def face_owners(mesh: Mesh) -> NDArray[np.int64]:
    """Return the number [F] of the piece that each face belongs to: all that are joined by whole edges."""
    # Bodies that meet in one corner are two, each with an inside of its own. Edges are joined by their triangles.
    ends = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges = np.unique(ends[:, 0] * len(mesh.vertices) + ends[:, 1], return_inverse=True)[1].reshape(-1, 3)
    return trimesh.graph.connected_component_labels(edges[:, [0, 1, 1, 2]].reshape(-1, 2), node_count=edges.max() + 1)[
        edges[:, 0]
    ]


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
        """Return the bytes of a file that the mesh names."""
        if Path(name).suffix.lower() not in (".bin", ".glbin", ".mtl", ".ply", ".stl"):
            raise DataError(f"{brief(name)} holds no part of a mesh's shape.")
        return part_of(self.folder, name, "part of a mesh").read_bytes()

    __getitem__ = get

    def keys(self) -> tuple[str, ...]:
        """Return no names: trimesh asks for each by its own."""
        return ()


def _scene(path: Path, **options: Any) -> Any:
    """Read a file by trimesh; indices of an OBJ that count back from their line are made absolute first."""
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
    check_name("length unit", unit, UNITS)
    path = Path(path)
    suffix = path.suffix.lower()
    check_name("mesh format", suffix or path.name, WRITABLE, hint="The suffix of the file chooses it.")
    with atomic_path(path) as temporary:
        mesh.scaled(1 / UNITS[unit]).to_trimesh().export(temporary, file_type=suffix[1:])
    return path


SAMPLES = 4000  # points that are looked at in each direction
_NEIGHBOURS = 24
_SPOTS = 20_000
_BLOCK = 4_000_000


@dataclass(frozen=True)
class Deviation:
    """Largest distances over samples between a solid and its approximation."""

    outward: float
    """Largest distance of a point of the approximation from the solid: matter that was added [m]."""
    inward: float
    """Largest distance of a point of the solid's surface from the approximation: matter that was lost [m]."""
    samples: int
    """Points looked at in each direction; a spike between them is missed."""

    @property
    def largest(self) -> float:
        """The two-sided (Hausdorff) distance [m]."""
        return max(self.outward, self.inward)


def deviation(solid: Mesh, pieces: Sequence[Mesh], *, samples: int = SAMPLES, inside: Mesh | None = None) -> Deviation:
    """Measure how far the union of convex ``pieces`` departs from the solid inside a mesh.

    Sampled Hausdorff distance between the two as filled bodies, so faces that pieces share inside the
    solid do not count, and a hollow that they fill counts by its depth. Points lie on the surfaces and,
    for the pieces, on chords through their inside as well.

    Args:
        solid, pieces: the mesh, inside where its winding number exceeds one half; convex meshes.
        samples: points in each direction, on top of the vertices of the pieces; equal calls give equal numbers.
        inside: a coarser mesh of the same solid that decides what is inside, to save time.
    """
    check_number("The number of samples", samples, least=1, whole=True)
    check_number("The number of pieces", len(pieces), least=1, whole=True)
    rng = np.random.default_rng(0)
    areas = np.array([piece.to_trimesh().area for piece in pieces])
    shares = np.maximum(8, np.ceil(samples * areas / areas.sum())).astype(int)
    points = []
    for piece, share in zip(pieces, shares, strict=True):
        surface = sample_surface(piece, share, rng)[0]
        some = surface[: max(4, share // 4)]
        # A chord between two points of a convex piece lies inside it, so it finds a hollow that the piece fills.
        chords = some - rng.random((len(some), 1)) * (some - rng.permutation(surface)[: len(some)])
        points += [surface, chords, piece.vertices]
    outward = _farthest_outside(solid, inside or solid, np.concatenate(points), rng)
    return Deviation(outward, _farthest_from(pieces, sample_surface(solid, samples, rng)[0]), samples)


def hausdorff(first: Mesh, second: Mesh) -> float:
    """Return the sampled two-sided distance [m] between two surfaces (not the bodies inside them)."""
    rng = np.random.default_rng(0)
    there = _Surface(second, rng).distance(sample_surface(first, SAMPLES, rng)[0])
    back = _Surface(first, rng).distance(sample_surface(second, SAMPLES, rng)[0])
    return float(max(there.max(), back.max()))


def winding_number(mesh: Mesh, points: ArrayLike) -> NDArray[np.float64]:
    """Return how often the surface wraps around each point [n, 3]: 1 inside an outward closed surface, 0 outside.

    The sum of signed solid angles (van Oosterom & Strackee 1983) over 4π; of an open surface it is a
    fraction, so "above one half" is the best guess at inside (Jacobson et al. 2013).
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    triangles = mesh.vertices[mesh.faces]
    total = np.zeros(len(points))
    block = max(1, _BLOCK // len(triangles) // 9)
    for start in range(0, len(points), block):
        # tan(Ω/2) = a·(b × c) / (|a||b||c| + (a·b)|c| + (b·c)|a| + (c·a)|b|), van Oosterom & Strackee 1983; arctan2
        # gives Ω/2 with its sign, so the sum over 2π is that of Ω over 4π. Blocks of points bound the memory.
        a, b, c = np.moveaxis(triangles[None] - points[start : start + block, None, None], 2, 0)
        la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
        ab, bc, ca = (np.einsum("nfi,nfi->nf", u, v) for u, v in ((a, b), (b, c), (c, a)))
        volume = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
        total[start : start + block] = np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1)
    return total / (2 * np.pi)


class _Surface:
    """Distances to a surface: near samples choose candidate triangles, whose distance is exact."""

    def __init__(self, mesh: Mesh, rng: np.random.Generator) -> None:
        self._triangles = mesh.vertices[mesh.faces]
        points, owner = sample_surface(mesh, _SPOTS, rng)
        # Centres as well, so that no small triangle is out of every list.
        self._tree = spatial.KDTree(np.concatenate([points, self._triangles.mean(axis=1)]))
        self._owner = np.concatenate([owner, np.arange(len(mesh.faces))])

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances [n] of points [n, 3]."""
        candidates = self._owner[self._tree.query(points, k=min(_NEIGHBOURS, self._tree.n))[1]]
        best = np.full(len(points), np.inf)
        for column in candidates.T:
            best = np.minimum(best, point_triangle_distance(points, self._triangles[column]))
        return best


def point_triangle_distance(points: NDArray[np.float64], triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances [n] of points [n, 3] from one triangle each [n, 3, 3]."""
    # trimesh compares with tolerances in metres, which are wrong for triangles of a millimetre: each is made one long.
    size = np.ptp(triangles, axis=1).max(axis=1)
    size[size == 0] = 1.0
    origin, scale = triangles[:, :1], size[:, None]
    there, corners = (points - origin[:, 0]) / scale, (triangles - origin) / scale[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.linalg.norm(there - trimesh.triangles.closest_point(corners, there), axis=1)
    # Of a sliver it may answer with a place that is not the nearest, or with none; there an edge is.
    along, away = np.roll(corners, -1, axis=1) - corners, there[:, None] - corners
    length = (along**2).sum(axis=2)
    share = np.clip((away * along).sum(axis=2) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    edge = np.linalg.norm(away - share[..., None] * along, axis=2).min(axis=1)
    return size * np.where((1 - 1e-9) * distance <= edge, distance, edge)


def _farthest_outside(solid: Mesh, inside: Mesh, points: NDArray, rng: np.random.Generator) -> float:
    """Return the largest distance from the solid of those points that lie outside it, as ``inside`` tells."""
    distance = _Surface(solid, rng).distance(points)
    order = np.argsort(-distance)
    # Most far points of a good approximation lie inside, so look at few at a time until one does not.
    for start in range(0, len(order), 256):
        chosen = order[start : start + 256]
        outside = winding_number(inside, points[chosen]) < 0.5
        if outside.any():
            return float(distance[chosen[outside]].max())
    return 0.0


def _farthest_from(pieces: Sequence[Mesh], points: NDArray) -> float:
    """Return the largest distance of points [n, 3] from the union of convex pieces; 0 when all lie inside."""
    # The height over the highest face plane bounds the distance from below, and is it above that face.
    bounds = np.empty((len(points), len(pieces)))
    for index, piece in enumerate(pieces):
        a, b, c = np.moveaxis(piece.vertices[piece.faces], 1, 0)
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1)
        # A face without an area has no plane.
        good = length > 1e-12 * piece.diagonal**2
        normal = normal[good] / length[good, None]
        bounds[:, index] = (points @ normal.T - np.einsum("fi,fi->f", a[good], normal)).max(axis=1)
    size = max(piece.diagonal for piece in pieces)
    left = bounds.min(axis=1) > 1e-7 * size
    if not left.any():
        return 0.0
    points, bounds = points[left], bounds[left]
    best = np.full(len(points), np.inf)
    # Exact distances for the four pieces with the smallest lower bounds alone, among which the nearest is expected.
    for index in np.argsort(bounds, axis=1)[:, : min(4, len(pieces))].T:
        for chosen in np.unique(index):
            mine = np.flatnonzero(index == chosen)
            triangles = pieces[chosen].vertices[pieces[chosen].faces]
            pairs = np.repeat(points[mine], len(triangles), axis=0), np.tile(triangles, (len(mine), 1, 1))
            near = point_triangle_distance(*pairs).reshape(len(mine), -1).min(axis=1)
            best[mine] = np.minimum(best[mine], near)
    return float(best.max())


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points [count, 3] spread evenly by area over a surface, and the faces [count] they lie on."""
    # Faces are drawn by area; (1 − √u, √u (1 − v), √u v) is then uniform on a triangle.
    ends = np.cumsum(mesh.to_trimesh().area_faces)
    face = np.minimum(np.searchsorted(ends, rng.random(count) * ends[-1]), len(ends) - 1)
    u, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[face]], 1, 0)
    return (1 - u) * a + u * (1 - v) * b + u * v * c, face
