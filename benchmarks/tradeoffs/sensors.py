"""Error and cost of tactile queries over their settings: the data behind ``Fidelity.auto``.

Three parts, each against a reference in double precision:

- ``mesh``: a force field of 20 × 20 kinematic taxels on a torus of 4,608 triangles, over query and resolution,
  against exact distances to all triangles; ``primitive`` is a sphere, whose error is that of single precision alone;
- ``points``: the force on 6 × 6 proximity taxels over the number of surface points, against 200,000 points;
- ``taxels``: the total force on a pad over its number of taxels (stiffness per area kept), against the integral.

``error`` is the relative root-mean-square error over poses, ``cost`` microseconds per environment and update on
the processor that measured.
"""

from __future__ import annotations

import math
import time
from functools import cache
from typing import Any, cast

import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.triangles import closest_point

from brainbench.geometry import Mesh, winding_number
from robotics_bridge.physics import Geometry, HandState, TouchScene
from robotics_bridge.sensors.probes.placement import Probes
from robotics_bridge.sensors.queries.solids import surface_points
from robotics_bridge.sensors.sensor import Sensor
from robotics_bridge.sensors.suite import SensorSuite
from robotics_bridge.sensors.taxels.sensors import KinematicTaxel, ProximityTaxel

Row = dict[str, Any]
RESOLUTIONS = (16, 32, 64, 128)
POINTS = (250, 500, 1000, 2000, 4000, 16_000)
TAXELS = (5, 10, 20, 40, 80)
HEIGHTS = {"mesh": 0.010, "primitive": 0.017}  # height (m) above the pad at which the torus and the sphere touch it
WITHOUT_CELLS = {"mesh": "raycast", "primitive": "sdf"}  # query of the parts that need no distance field
ABOUT = {
    "error": "relative RMS of forces against double precision", "cost": "microseconds per environment and update",
}  # fmt: skip
FIXED: dict[str, Any] = {}
_POSES = 12
_CYLINDER = Geometry(name="o", link="object", kind="cylinder", size=(0.008, 0.012))
_PAD = Geometry(name="pad", link="hand", kind="box", size=(0.03, 0.03, 0.005))


def settings() -> list[Row]:
    """Return every setting: ``part``, and what is set in it."""
    rows: list[Row] = [{"part": "mesh", "query": "sdf", "resolution": cells} for cells in RESOLUTIONS]
    rows += [{"part": part, "query": query, "resolution": None} for part, query in WITHOUT_CELLS.items()]
    rows += [{"part": "points", "points": count} for count in POINTS]
    return rows + [{"part": "taxels", "taxels": side * side} for side in TAXELS]


def measure(row: Row) -> Row:
    """Return ``error`` and ``cost`` of a setting."""
    return {"mesh": _field, "primitive": _field, "points": _proximity, "taxels": _pad}[row["part"]](row)


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


def _field(row: Row) -> Row:
    part, resolution = row["part"], row["resolution"]
    solid = _torus() if part == "mesh" else Geometry(name="o", link="object", kind="sphere", size=(0.012,))
    taxel = KinematicTaxel(link="hand", probes=_grid(), query=row["query"])
    read, cost = _run(solid, taxel, _places(HEIGHTS[part]), resolution or 64)
    exact = _exact_field(part)
    return {"error": _error(read[..., :3].reshape(exact.shape), exact), "cost": cost}


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


def _proximity(row: Row) -> Row:
    read, cost = _run(_CYLINDER, ProximityTaxel(link="hand", probes=_pads(), points=row["points"]), _places(0.019))
    exact = _exact_proximity()
    return {"error": _error(read[..., 2].reshape(exact.shape), exact), "cost": cost}


def _pad(row: Row) -> Row:
    side = math.isqrt(row["taxels"])
    solid = Geometry(name="o", link="object", kind="sphere", size=(0.012,))
    places, pitch = _places(0.017), 0.03 / side
    grid = Probes.grid(side, side, size=(0.03 - pitch, 0.03 - pitch), center=(0, 0, 0.005), radius=1e-6)
    read, cost = _run(solid, KinematicTaxel(link="hand", probes=grid, stiffness=1e7 * pitch**2), places)
    return {"error": _error(read[..., 2].sum((1, 2)), _integral(places)), "cost": cost}


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
