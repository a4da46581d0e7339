"""The geometries of a scene on a device, with distance fields and triangle trees only where sensors ask for them.

Their surface points come in neighbourly blocks that a query can skip as a whole (geometry frame, metres).
"""

from __future__ import annotations

import warnings
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import to_struct, warp
from brainbench.core.errors import UsageError, check_number
from brainbench.core.files import cache_dir
from brainbench.core.reading.sealed import read_sealed, write_sealed
from brainbench.geometry import Mesh
from brainbench.geometry.mesh import repair, sample_surface
from robotics_bridge.physics.scene import KINDS, Geometry, TouchScene
from robotics_bridge.sensors.kernels import distance
from robotics_bridge.sensors.kernels.distance import OTHER, THIN, WALL, SolidArrays, SolidShape, measure_walls
from robotics_bridge.sensors.kernels.proximity import BLOCK, CellArrays, CloudArrays
from robotics_bridge.sensors.probes.placement import cover_evenly, face_areas

_FORMAT = 3


@dataclass(frozen=True, eq=False)
class Field:
    """Signed distances on a regular grid around a mesh."""

    values: NDArray[np.float32]
    """[nx, ny, nz] (m), negative inside."""
    origin: NDArray[np.float32]
    """Position [3] of the first sample (m)."""
    spacing: float
    """Distance of neighbouring samples (m)."""


def sample_field(mesh: Mesh, resolution: int = 64, device: Any = "cpu") -> Field:
    """Return the distance field of a closed mesh, from the cache if it was sampled before.

    Args:
        mesh: its surface; where it has holes, inside is where its winding number exceeds one half.
        resolution: cells along the longest edge of the bounding box; the grid extends a quarter of that edge beyond the
            box on every side, further out distances are extrapolated.
    """
    check_number("The resolution of a distance field (cells)", resolution, least=4, most=512, whole=True)
    low, high = mesh.bounds
    # A margin of a quarter of the box on each side, so that most probes in reach fall within the samples.
    spacing = float((high - low).max()) / resolution
    counts = np.ceil((high - low) / spacing).astype(int) + 1 + 2 * max(4, -(-resolution // 4))
    # Samples lie symmetrically about the middle of the box, so that a symmetric mesh has a symmetric field.
    origin = (0.5 * (low + high) - 0.5 * spacing * (counts - 1)).astype(np.float32)
    path = cache_dir("fields") / f"{mesh.content_hash}-{resolution}-{_FORMAT}.npz"
    cached = read_sealed(path, "distance field")
    if cached is not None and cached["values"].shape == tuple(counts):
        return Field(cached["values"], origin, spacing)
    wp, tree = warp(), mesh_tree(mesh, device, winding=True)
    samples = wp.zeros(tuple(int(n) for n in counts), dtype=wp.float32, device=device)
    reach = 4 * float(spacing * counts.max())
    inputs = [tree.id, wp.vec3f(*origin.tolist()), spacing, reach, samples]
    wp.launch(distance.sample_field, dim=samples.shape, inputs=inputs, device=device)
    values = samples.numpy()
    write_sealed(path, "distance field", {"values": values})
    return Field(values, origin, spacing)


def mesh_tree(mesh: Mesh, device: Any, *, winding: bool = False) -> Any:
    """Return a ``warp.Mesh``: the triangles with their search tree."""
    wp = warp()
    return wp.Mesh(
        points=wp.array(mesh.vertices.astype(np.float32), dtype=wp.vec3f, device=device),
        indices=wp.array(mesh.faces.astype(np.int32).ravel(), dtype=wp.int32, device=device),
        support_winding_number=winding,
    )


RESOLVED = 4.0  # cells across a wall from which a distance field tells its two sides apart
THINNEST = 3e-3
"""Least width of a solid (m) below which it is thin: engines let bodies overlap by up to about half of it, so that what
touches it may lie past its middle, where the nearest side is the wrong one."""
_FLAT = 1e-6  # mean thickness, as a part of the diagonal, below which a mesh encloses nothing
_SAMPLES = 2000
_SHARE = 0.02  # part of the surface that must lie over thin walls for the mesh to be thin: an edge alone is none


def as_solid(mesh: Mesh) -> Mesh:
    """Return a mesh with its faults mended, as far as that can be; what was done and what is left is warned of."""
    spread = np.linalg.svd(mesh.vertices - mesh.vertices.mean(axis=0), compute_uv=False)
    # A closed surface of area A and thickness t has the volume A t / 2; an open one must at least not be flat.
    empty = 2 * abs(mesh.volume) <= _FLAT * mesh.diagonal * float(mesh.to_trimesh().area)
    if spread[2] <= _FLAT * spread[0] or (mesh.diagnosis.watertight and empty):
        raise UsageError(
            f"The mesh {mesh.name!r} has no thickness, so that no point lies inside it. Give its walls at least 0.1 mm."
        )
    mended = repair(mesh)
    words = [*mended.done, *(text for text in mended.remaining if "closed solid" in text)]
    if words:
        warnings.warn(
            f"The mesh {mesh.name!r} is not a sound solid: {'; '.join(words)}. Near a hole, what is inside is guessed.",
            RuntimeWarning,
            stacklevel=2,
        )
    return mended.mesh


def wall_thickness(mesh: Mesh, below: float, device: Any) -> tuple[float, float]:
    """Return the least and largest thickness (m) of walls of a closed mesh that are thinner than that, or zeros."""
    wp, tree = warp(), mesh_tree(mesh, device)
    points, faces = sample_surface(mesh, _SAMPLES, np.random.default_rng(0))
    normal = face_areas(mesh.vertices[mesh.faces[faces]])[1]
    arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3f, device=device) for a in (points, normal)]
    out = wp.zeros(len(points), dtype=float, device=device)
    inputs = [tree.id, *arrays, 1e-6 * mesh.diagonal, out]
    wp.launch(measure_walls, dim=len(points), inputs=inputs, device=device)
    thickness = out.numpy()
    thin = thickness[(thickness > 0) & (thickness < below)]
    if len(thin) <= _SHARE * len(points):
        return 0.0, 0.0
    return float(np.quantile(thin, 0.1)), float(thin.max())


_UNBOUNDED = 1.0e6
_LARGER = 1024.0
"""Factor at which round solids are made: trimesh leaves out triangles below 1e-8 m², such as those at the poles of a
finger's capsule. A power of two loses no digit."""


def least_width(geometry: Geometry) -> float:
    """Return the least width (m) of a solid without a mesh, or 0 for what has none."""
    size = geometry.size[:1] if geometry.kind in ("sphere", "capsule") else geometry.size
    return 2 * min(size) if size else 0.0


def bounding_sphere(geometry: Geometry) -> NDArray[np.float32]:
    """Return centre and radius (x, y, z, r) [m] of a sphere around a geometry, in its own frame."""
    if geometry.mesh is not None:
        # Middle of the box, not the mean of the vertices, which are dense where the surface is curved.
        center = geometry.mesh.bounds.mean(axis=0)
        radius = np.linalg.norm(geometry.mesh.vertices - center, axis=1).max()
        return np.array([*center, radius], dtype=np.float32)
    size = geometry.size
    radii = {"sphere": max, "ellipsoid": max, "capsule": sum, "cylinder": np.linalg.norm, "box": np.linalg.norm}
    radius = radii[geometry.kind](size) if geometry.kind in radii else _UNBOUNDED
    return np.array([0.0, 0.0, 0.0, radius], dtype=np.float32)


def tessellate(geometry: Geometry) -> Mesh:
    """Return the surface of a geometry as triangles; curved ones lie within 0.1 % of their radius."""
    import trimesh

    if geometry.mesh is not None:
        return geometry.mesh
    size = geometry.size
    if geometry.kind == "box":
        solid = trimesh.creation.box(2 * np.asarray(size))
    elif geometry.kind == "sphere":
        solid = trimesh.creation.icosphere(4, size[0])
    elif geometry.kind == "ellipsoid":
        # Subdivided on the unit ball and then stretched: triangles stay spread over the whole surface.
        solid = trimesh.creation.icosphere(4, 1.0)
        solid.apply_scale(size)
    elif geometry.kind == "cylinder":
        solid = trimesh.creation.cylinder(_LARGER * size[0], _LARGER * 2 * size[1], sections=96)
        solid.apply_scale(1 / _LARGER)
    elif geometry.kind == "capsule":
        solid = trimesh.creation.capsule(_LARGER * 2 * size[1], _LARGER * size[0], count=[96, 48])
        solid.apply_scale(1 / _LARGER)
        solid.apply_translation([0, 0, -solid.bounds.mean(axis=0)[2]])
    else:
        raise UsageError(f"A {geometry.kind} ({geometry.name!r}) has no triangles to query; use query='sdf'.")
    return Mesh(solid.vertices, solid.faces, geometry.name)


class Solids:
    """Device copy of a scene's geometries; those that differ between environments take one row each.

    ``queries`` are ``sdf`` or ``raycast`` and the geometry of all that is asked.
    """

    def __init__(
        self,
        scene: TouchScene,
        num_envs: int,
        device: Any,
        queries: Collection[tuple[str, int]],
        *,
        resolution: int = 64,
    ) -> None:
        self.scene, self.device = scene, device
        self.rows = num_envs if scene.variants else 1
        # One row serves all environments unless shapes differ: kernels take row env % rows.
        solids = np.zeros((self.rows, max(len(scene.geometries), 1)), np.dtype(SolidShape.numpy_dtype()))
        solids["kind"] = OTHER
        self.kinds, self._thickness = solids["kind"], solids["thickness"]
        """[R, G] numbers of the kinds."""
        self._sound: dict[str, Mesh] = {}
        self._fields: dict[str, tuple[int, Field]] = {}
        self._trees: dict[str, Any] = {}
        for index in range(len(scene.geometries)):
            seen: dict[int, dict[str, Any]] = {}
            for row in range(self.rows if index in scene.variants else 1):
                geometry = scene.geometry_in(row, index)
                if id(geometry) not in seen:
                    wanted = ("sdf", index) in queries, ("raycast", index) in queries
                    seen[id(geometry)] = self._describe(geometry, *wanted, resolution)
                for name, value in seen[id(geometry)].items():
                    solids[name][row if index in scene.variants else slice(None), index] = value
        samples = [field.values.ravel() for _first, field in self._fields.values()] or [np.zeros(8, np.float32)]
        arrays = {"solid": solids, "link": scene.link_of, "values": np.concatenate(samples)}
        self.struct: Any = to_struct(SolidArrays, arrays, device)
        """The Warp structure that kernels take."""

    @property
    def sided(self) -> bool:
        """True if any solid is asked from the side of the sensor."""
        return bool((self.kinds == WALL).any() or (self._thickness > 0).any())

    def kinds_of(self, geometries: Iterable[int], *, others: bool = False) -> frozenset[int]:
        """Return the kinds (numbers) that some geometries take in any environment, and the mark of thin ones.

        What has no distance is refused by name, or with ``others`` left out.
        """
        chosen = list(geometries)
        kinds = frozenset(self.kinds[:, chosen].ravel().tolist()) if chosen else frozenset()
        if OTHER in kinds and not others:
            culprit = next(g for g in chosen if (self.kinds[:, g] == OTHER).any())
            raise UsageError(
                f"The geometry {self.scene.geometries[culprit].name!r} is of a kind that has no distance to ask for "
                "(height fields and engine-made surfaces); turn it into a mesh, leave it out of what the sensor "
                "tracks, or feel it by KinematicTaxel(total='engine')."
            )
        thin = chosen and bool((self._thickness[:, chosen] > 0).any())
        return (kinds - {OTHER}) | ({THIN} if thin else set())

    def _describe(self, geometry: Geometry, field: bool, tree: bool, resolution: int) -> dict[str, Any]:
        """Return the fields of ``SolidShape`` for a geometry that sensors ask by its distance field or its tree."""
        kind, size = KINDS.index(geometry.kind), [*geometry.size, 0.0, 0.0, 0.0][:3]
        w, x, y, z = geometry.quaternion
        # Ours are (w, x, y, z), Warp's (x, y, z, w).
        frame = (*geometry.position, x, y, z, w)
        # A field that nobody asks has cells, too.
        solid = {"bound": bounding_sphere(geometry), "frame": frame, "counts": 2, "spacing": 1.0}
        thin = width if (width := least_width(geometry)) < THINNEST else 0.0
        if (geometry.mesh is not None and (field or tree)) or (thin and tree):
            surface = self._solid(geometry.mesh) if geometry.mesh is not None else tessellate(geometry)
            cell = float(np.ptp(surface.bounds, axis=0).max()) / resolution
            below = max(RESOLVED * cell, THINNEST)
            least, thin = (thin, thin) if thin else wall_thickness(surface, below, self.device)
            if thin and (tree or least < RESOLVED * cell):
                # Triangles nearer to one another than a hundredth of the wall are one place, in mean edges for Warp.
                edges = np.diff(surface.vertices[surface.faces[:, [0, 1, 2, 0]]], axis=1)
                size = [0.01 * least / float(np.linalg.norm(edges, axis=2).mean()), least, thin]
                kind, field, tree, thin = WALL, False, True, 0.0
            if field:
                solid |= self._field(surface, resolution)
        if tree and geometry.kind not in ("plane", "other"):
            surface = tessellate(geometry) if geometry.mesh is None else self._solid(geometry.mesh)
            key = surface.content_hash
            if key not in self._trees:
                self._trees[key] = mesh_tree(surface, self.device)
            solid["mesh"] = self._trees[key].id
        return {**solid, "kind": kind, "size": size, "thickness": thin}

    def _field(self, surface: Mesh, resolution: int) -> dict[str, Any]:
        """Return where the distance field of a surface lies; equal surfaces share one."""
        key = surface.content_hash
        if key not in self._fields:
            first = sum(field.values.size for _first, field in self._fields.values())
            self._fields[key] = first, sample_field(surface, resolution, self.device)
            if first + self._fields[key][1].values.size >= 2**31:
                raise UsageError("The distance fields hold more than 2³¹ samples together; lower the resolution.")
        first, field = self._fields[key]
        return {"first": first, "counts": field.values.shape, "origin": field.origin, "spacing": field.spacing}

    def _solid(self, mesh: Mesh) -> Mesh:
        """Return a mesh mended, once for all that share it."""
        if mesh.content_hash not in self._sound:
            self._sound[mesh.content_hash] = as_solid(mesh)
        return self._sound[mesh.content_hash]


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one sensor's tracked geometries, on a device."""

    struct: Any
    """Warp structure ``CloudArrays``."""
    total: int
    """Most points that any environment has."""
    counts: NDArray[np.int64]
    """Points [R] per variant row."""
    shapes: list[NDArray[np.float32]]
    """Points of each geometry that differs from the others, in their order in ``struct``."""
    shape: NDArray[np.int32]
    """Number [R, G] of a geometry among them, −1 for none."""


def surface_points(geometry: Geometry, count: int) -> NDArray[np.float64]:
    """Return evenly spread points [count, 3] on the surface of a geometry (m, its own frame)."""
    mesh = tessellate(geometry)
    corners = mesh.vertices[mesh.faces]
    return cover_evenly(corners, face_areas(corners)[0], count)


def sample_cloud(solids: Solids, geometries: Sequence[int], points: int) -> Cloud:
    """Spread ``points`` over geometries in proportion to their areas, row by row of variants.

    Planes are left out: they have no end.
    """
    scene, rows = solids.scene, solids.rows
    sampled: dict[tuple[int, int], tuple[int, int, NDArray]] = {}
    counts, totals = np.zeros(rows, np.int64), np.zeros(rows, np.int64)
    first, blocks, number = (np.zeros((rows, max(len(scene.geometries), 1)), np.int32) for _ in range(3))
    number[:] = -1
    start = 0
    for row in range(rows):
        shapes = {g: scene.geometry_in(row, g) for g in geometries}
        shapes = {g: shape for g, shape in shapes.items() if shape.kind not in ("plane", "other")}
        surfaces = {g: tessellate(shape) for g, shape in shapes.items()}
        areas = {g: float(face_areas(mesh.vertices[mesh.faces])[0].sum()) for g, mesh in surfaces.items()}
        whole = sum(areas.values()) or 1.0
        for g, shape in shapes.items():
            # The same density of points on all geometries; without a point, a small one could not be felt at all.
            share = max(1, round(points * areas[g] / whole))
            key = (id(shape), share)
            if key not in sampled:
                sampled[key] = (start, len(sampled), _in_blocks(surface_points(shape, share)))
                start += len(sampled[key][2]) // BLOCK
            first[row, g], number[row, g], placed = sampled[key]
            blocks[row, g] = len(placed) // BLOCK
            counts[row] += share
            totals[row] += len(placed)
    clouds = [placed for _start, _number, placed in sampled.values()] or [np.zeros((0, 3), np.float32)]
    arrays = {
        "point": np.concatenate(clouds),
        "sphere": np.concatenate([_spheres(placed) for placed in clouds]),
        "first": first,
        "blocks": blocks,
    }
    return Cloud(to_struct(CloudArrays, arrays, solids.device), int(totals.max()), counts, clouds, number)


def list_by_cells(cloud: Cloud, reach: float, device: Any) -> Any:
    """Return the Warp structure ``CellArrays`` that lists the points within ``reach`` (m) of every cell of a grid."""
    grids: list[dict[str, Any]] = []
    first = point = entry = 0
    for placed in cloud.shapes:
        points = placed[np.isfinite(placed[:, 0])].astype(np.float64)
        low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else (np.zeros(3), np.zeros(3))
        # Rounding of a position must not lose a point at the rim.
        far = reach * (1 + 1e-5) + 1e-6 * (float(np.abs([low, high]).max()) + reach)
        low, high = low - far, high + far
        # About eight cells for a point, and no more than three of them along each axis for its reach.
        edge = max(far, float((np.prod(high - low) / (8 * max(len(points), 1))) ** (1 / 3)))
        counts = np.maximum(np.ceil((high - low) / edge).astype(int), 1)
        cells, numbers = _within(points, far, low, edge, counts)
        start = entry + np.searchsorted(cells, np.arange(int(np.prod(counts)) + 1))
        grids.append({
            "origin": low, "inverse": 1 / edge, "counts": counts, "first": first, "start": start,
            "entry": point + numbers,
        })  # fmt: skip
        first, point, entry = first + len(start), point + len(placed), entry + len(numbers)
    arrays = {name: np.array([grid[name] for grid in grids]) for name in ("origin", "inverse", "counts", "first")}
    arrays |= {name: np.concatenate([grid[name] for grid in grids]) for name in ("start", "entry")}
    return to_struct(CellArrays, {**arrays, "shape": cloud.shape}, device)


def _within(
    points: NDArray, far: float, origin: NDArray, edge: float, counts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return pairs of a cell and a point that lies no further than ``far`` from it, sorted by cell, then point."""
    at = np.floor((points - origin) / edge).astype(np.int64)
    cells, numbers = [], []
    for step in np.ndindex(3, 3, 3):
        cell = at + np.array(step) - 1
        low = origin + cell * edge
        away = np.maximum(np.maximum(low - points, points - low - edge), 0.0)
        inside = ((away**2).sum(axis=1) <= far**2) & (cell >= 0).all(axis=1) & (cell < counts).all(axis=1)
        cells.append(np.ravel_multi_index(cell[inside].T, counts))
        numbers.append(np.nonzero(inside)[0])
    listed, owners = np.concatenate(cells), np.concatenate(numbers)
    order = np.lexsort((owners, listed))
    return listed[order], owners[order]


def _in_blocks(points: NDArray) -> NDArray[np.float32]:
    """Order points along a space-filling curve and fill the last block up with NaN."""
    low, high = points.min(axis=0), points.max(axis=0)
    # Morton code: the bits of three 10-bit coordinates interleaved. Points that follow each other in it lie close
    # together, so that spheres around blocks of them are small.
    cells = ((points - low) / np.maximum((high - low).max(), 1e-12) * 1023).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    ordered = points[np.argsort(code, kind="stable")]
    missing = -len(points) % BLOCK
    return np.concatenate([ordered, np.full((missing, 3), np.nan)]).astype(np.float32)


def _spheres(points: NDArray) -> NDArray[np.float32]:
    grouped = points.reshape(-1, BLOCK, 3)
    # The middle of the bounding box is near the least sphere's and does not follow a crowd of points as the mean does.
    center = 0.5 * (np.nanmin(grouped, axis=1) + np.nanmax(grouped, axis=1))
    radius = np.nanmax(np.linalg.norm(grouped - center[:, None], axis=2), axis=1)
    return np.concatenate([center, radius[:, None]], axis=1).astype(np.float32)
