"""Measure error and cost of tactile queries over their settings: the data behind ``Fidelity.auto``.

Three parts, each against a reference in double precision:

- ``mesh``: a force field of 20 × 20 kinematic taxels on a torus of 4,608 triangles, over query and resolution,
  against exact distances to all triangles; ``primitive`` is a sphere, whose error is that of single precision alone;
- ``points``: the force on 6 × 6 proximity taxels over the number of surface points, against 200,000 points;
- ``taxels``: the total force on a pad over its number of taxels (stiffness per area kept), against the integral.

``error`` is the relative root-mean-square error over poses, ``cost`` microseconds per environment and update on
the processor that measured.
"""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.triangles import closest_point

from brainbench.core.figures.style import panels, save_figure
from brainbench.core.files import write_json
from brainbench.core.progress import Progress, track
from brainbench.geometry import Mesh, winding_number
from robotics_bridge.physics import Geometry, HandState, TouchScene
from robotics_bridge.sensors.probes.placement import Probes
from robotics_bridge.sensors.queries.surface_points import surface_points
from robotics_bridge.sensors.sensor import Sensor
from robotics_bridge.sensors.suite import SensorSuite
from robotics_bridge.sensors.taxels.sensors import KinematicTaxel, ProximityTaxel

RESOLUTIONS = (16, 32, 64, 128)
POINTS = (250, 500, 1000, 2000, 4000, 16_000)
TAXELS = (5, 10, 20, 40, 80)
HEIGHTS = {"mesh": 0.010, "primitive": 0.017}
"""Height (m) above the pad at which the torus and the sphere touch it."""
_POSES = 12
_CYLINDER = Geometry(name="o", link="object", kind="cylinder", size=(0.008, 0.012))
_PAD = Geometry(name="pad", link="hand", kind="box", size=(0.03, 0.03, 0.005))


def measure_tradeoff(path: Path | None = None, *, progress: Progress | None = None) -> list[dict[str, Any]]:
    """Measure every setting; with ``path`` write them as a table (JSON).

    Returns:
        One row per setting: ``part``, what was set, ``error`` and ``cost``.
    """
    jobs = [partial(_mesh_point, "mesh", "sdf", n) for n in RESOLUTIONS]
    jobs += [partial(_mesh_point, "mesh", "raycast", None), partial(_mesh_point, "primitive", "sdf", None)]
    jobs += [partial(_points_point, n) for n in POINTS] + [partial(_taxels_point, n) for n in TAXELS]
    rows = [job() for job in track(jobs, "settings", progress)]
    if path is not None:
        about = {
            "error": "relative RMS of forces against double precision",
            "cost": "microseconds per environment and update",
            "machine": f"{platform.machine()}, {os.cpu_count()} processors",
            "made_by": "brainbench tradeoff tactile",
        }
        write_json(path, {**about, "points": rows})
    return rows


def triangle_distance(mesh: Mesh, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return signed distance [n] and outward direction [n, 3] of points to a closed mesh, over all its triangles.

    The inside is where the winding number exceeds one half.
    """
    corners = mesh.vertices[mesh.faces]
    # All triangles by brute force in double precision: an own reference that shares no code with the kernels.
    sign = np.where(winding_number(mesh, points) > 0.5, -1.0, 1.0)
    # In millimetres: trimesh 5.2 takes parts of triangles of that size in metres for edges.
    grown = 1e3 * corners
    every = (x - 1e-3 * closest_point(grown, np.tile(1e3 * x, (len(grown), 1))) for x in points)
    away = np.array([vectors[np.linalg.norm(vectors, axis=1).argmin()] for vectors in every])
    length = np.linalg.norm(away, axis=1)
    return sign * length, (sign / np.maximum(length, 1e-15))[:, None] * away


def _run(solid: Geometry, sensor: Sensor, places: NDArray, resolution: int = 64) -> tuple[NDArray, float]:
    """Return readings over places [n, 3] of an object, and the cost of an update per environment (µs)."""
    scene = TouchScene(("world", "hand", "object"), (_PAD, solid))
    count = len(places)
    suite = SensorSuite(scene, {"s": sensor}, num_envs=count, resolution=resolution)
    state = HandState.empty(count, 3, count)
    pose = np.zeros((count, 3, 7))
    pose[..., 3] = 1
    pose[:, 2, :3] = places
    state.set_pose(pose)
    state.set_contacts(np.arange(count), [(0, 1)] * count)
    suite.update(state)
    seconds = []
    for _ in range(15):
        start = time.perf_counter()
        suite.update(state)
        seconds.append(time.perf_counter() - start)
    return suite.read("s").numpy().astype(float).copy(), float(np.median(seconds)) / count * 1e6


def _places(height: float) -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-4e-3, 4e-3, (_POSES, 2)), height - rng.uniform(0, 2e-3, _POSES)])


def _error(read: NDArray, exact: NDArray) -> float:
    # Relative RMSE over all taxels and places together: places without contact would have no relative error of their
    # own.
    return float(np.sqrt(((read - exact) ** 2).sum() / (exact**2).sum()))


def _grid() -> Probes:
    return Probes.grid(20, 20, size=(0.04, 0.04), center=(0, 0, 0.005), radius=0.003)


@cache
def _torus() -> Geometry:
    torus = trimesh.creation.torus(0.012, 0.005, major_sections=72, minor_sections=32)
    return Geometry(name="o", link="object", kind="mesh", mesh=Mesh(torus.vertices, torus.faces))


@cache
def _exact_field(part: str) -> NDArray[np.float64]:
    """Return the forces [n, 400, 3] of the taxels in double precision."""
    grid, places = _grid(), _places(HEIGHTS[part])
    exact = np.zeros((len(places), len(grid), 3))
    for row, place in zip(exact, places, strict=True):
        local = np.array(grid.position) - place
        if part == "primitive":
            near = np.arange(len(local))
            far = np.linalg.norm(local, axis=1)
            distance, normal = far - 0.012, local / far[:, None]
        else:
            # Only taxels that can touch: the facets cut off less than a tenth of a millimetre.
            smooth = np.hypot(np.hypot(local[:, 0], local[:, 1]) - 0.012, local[:, 2]) - 0.005
            near = np.flatnonzero(smooth < 0.0032)
            distance, normal = triangle_distance(cast("Mesh", _torus().mesh), local[near])
        depth = np.maximum(0.003 - distance, 0)
        # Spring term of 4.8 with the published stiffness and exponent (4.10); the scene is at rest.
        row[near] = 500 * (depth**1.2)[:, None] * normal
    return exact


def _mesh_point(part: str, query: str, resolution: int | None) -> dict[str, Any]:
    solid = _torus() if part == "mesh" else Geometry(name="o", link="object", kind="sphere", size=(0.012,))
    taxel = KinematicTaxel(link="hand", probes=_grid(), query=query)  # type: ignore[arg-type]
    read, cost = _run(solid, taxel, _places(HEIGHTS[part]), resolution or 64)
    exact = _exact_field(part)
    error = _error(read[..., :3].reshape(exact.shape), exact)
    return {"part": part, "query": query, "resolution": resolution, "error": error, "cost": cost}


@cache
def _exact_proximity() -> NDArray[np.float64]:
    """Return the normal forces [n, 36] from 200,000 points in double precision."""
    dense, places, grid = surface_points(_CYLINDER, 200_000), _places(0.019), _pads()
    exact = np.zeros((len(places), len(grid)))
    for row, place in zip(exact, places, strict=True):
        for index, q in enumerate(np.array(grid.position) - place):
            # Normal force of 4.15 with many points: stands for the integral over the surface.
            overlap = np.maximum(0.008 - np.linalg.norm(dense - q, axis=1), 0)
            row[index] = -300 * 100 / len(dense) * overlap.sum()
    return exact


def _pads() -> Probes:
    return Probes.grid(6, 6, size=(0.02, 0.02), center=(0, 0, 0.005), radius=0.008)


def _points_point(points: int) -> dict[str, Any]:
    read, cost = _run(_CYLINDER, ProximityTaxel(link="hand", probes=_pads(), points=points), _places(0.019))
    exact = _exact_proximity()
    return {"part": "points", "points": points, "error": _error(read[..., 2].reshape(exact.shape), exact), "cost": cost}


def _taxels_point(side: int) -> dict[str, Any]:
    solid = Geometry(name="o", link="object", kind="sphere", size=(0.012,))
    places, pitch = _places(0.017), 0.03 / side
    grid = Probes.grid(side, side, size=(0.03 - pitch, 0.03 - pitch), center=(0, 0, 0.005), radius=1e-6)
    read, cost = _run(solid, KinematicTaxel(link="hand", probes=grid, stiffness=1e7 * pitch**2), places)
    error = _error(read[..., 2].sum((1, 2)), _integral(places))
    return {"part": "taxels", "taxels": side * side, "error": error, "cost": cost}


def _integral(places: NDArray) -> NDArray[np.float64]:
    """Return the total force of the continuous pad, by a rule of 600 × 600 points in double precision."""
    side = (np.arange(600) + 0.5) / 600 * 0.03 - 0.015
    x, y = np.meshgrid(side, side)
    exact = []
    for place in places:
        away = np.stack([x - place[0], y - place[1], np.full_like(x, 0.005 - place[2])])
        far = np.linalg.norm(away, axis=0)
        # Midpoint rule over the pad: force density times the z part of the normal.
        exact.append((1e7 * (0.03 / 600) ** 2 * np.maximum(0.012 - far, 0) ** 1.2 * away[2] / far).sum())
    return np.array(exact)


def plot_tradeoff(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw error against cost of every part."""
    figure, axes = panels(1, 3, (10.5, 3.6))
    titles = {
        "mesh": "distance to 4,608 triangles,\nby cells of the distance field",
        "points": "proximity taxels,\nby number of surface points",
        "taxels": "pad of taxels,\nby number of taxels",
    }
    for (part, title), axis in zip(titles.items(), axes[0], strict=True):
        chosen = [row for row in rows if row["part"] == part]
        axis.loglog([r["cost"] for r in chosen], [r["error"] for r in chosen], "o", markersize=5)
        for number, row in enumerate(chosen):
            cells = f"{row['resolution']}³" if row.get("resolution") else "no field: each triangle"
            label = f"{row.get('points') or row.get('taxels') or 0:,}" if part != "mesh" else cells
            # On alternate sides, because neighbours are close: beside a column of points, else above and below.
            side = 1 if number % 2 else -1
            beside = part == "mesh"
            left = side < 0 or number == len(chosen) - 1
            place = {"xytext": (-7 if left else 7, 0) if beside else (0, -12 * side), "textcoords": "offset points"}
            align = ("right" if left else "left") if beside else "center"
            axis.annotate(label, (row["cost"], row["error"]), ha=align, va="center", fontsize=8.5, **place)
        axis.set_title(title)
        axis.set_xlabel("time per environment and update (µs)")
        axis.set_ylabel("relative error of the force (RMS)")
        axis.margins(0.3)
    save_figure(figure, path, dpi=150)
