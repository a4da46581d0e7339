"""Surface points of geometries, in neighbourly blocks that a query can skip as a whole. Geometry frame, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import to_struct
from robotics_bridge.physics.scene import Geometry
from robotics_bridge.sensors.kernels.proximity import BLOCK, CellArrays, CloudArrays
from robotics_bridge.sensors.probes.placement import cover_evenly, face_areas
from robotics_bridge.sensors.queries.solids import Solids, tessellate


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
        areas = {g: surface_area(shape) for g, shape in shapes.items()}
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


def surface_area(geometry: Geometry) -> float:
    """Return the surface area of a geometry [m²]."""
    mesh = tessellate(geometry)
    return float(face_areas(mesh.vertices[mesh.faces])[0].sum())


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
