"""Probes on the surface of any link of a MuJoCo model, by casting a bundle of parallel rays onto it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number, check_numbers
from brainbench.core.rotations import to_matrices
from robotics_bridge.sensors.probes.placement import Probes

mujoco = mujoco_module()


def link_points(model: Any, body: int) -> NDArray[np.float64]:
    """Return points [n, 3] that span a body's solids, in its frame (m): vertices of meshes, corners of the rest."""
    points = []
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    for geom in geoms_of(model, body):
        local = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
        if int(model.geom_type[geom]) == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = int(model.geom_dataid[geom])
            first = int(model.mesh_vertadr[mesh])
            local = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
        points.append(local @ to_matrices(model.geom_quat[geom]).T + model.geom_pos[geom])
    return np.concatenate(points) if points else np.zeros((0, 3))


def geoms_of(model: Any, body: int) -> list[int]:
    """Return the geometries of a body that collide, or all of them where none does."""
    mine = np.flatnonzero(model.geom_bodyid == body).tolist()
    solid = [geom for geom in mine if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    return solid or mine


def cast_grid(
    model: Any, link: str, rows: int, columns: int, *, facing: ArrayLike, radius: float, extent: float = 0.8
) -> Probes:
    """Lay a grid on the side of a link that faces a direction.

    Rays run against ``facing`` over a share ``extent`` of the link; columns run along its longest extent across
    ``facing``. Rays that miss the link leave fillers.
    """
    for name, number in {"rows": rows, "columns": columns}.items():
        check_number(name, number, least=1, whole=True)
    check_number("extent", extent, above=0, most=1)
    check_numbers("facing", facing, 3)
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, link)
    if body < 0:
        raise UsageError(f"The model has no link {link!r}.")
    corners = link_points(model, body)
    if not len(corners):
        raise UsageError(f"Link {link!r} has no geometry, so no probe can lie on it.")
    length = np.linalg.norm(facing)
    if not length:
        raise UsageError("'facing' is a direction of some length; received a zero vector.")
    up = np.asarray(facing, dtype=float) / length
    u, v = _plane(up, corners)
    # Extent of the link across and along the rays: the grid covers its shadow, and rays start just above its top.
    seen = corners @ np.stack([u, v, up], axis=1)
    low, high = seen.min(axis=0), seen.max(axis=0)
    middle, half = (low + high) / 2, (high - low) / 2 * extent
    x = middle[0] + (np.linspace(-1, 1, columns) if columns > 1 else np.zeros(1)) * half[0]
    y = middle[1] + (np.linspace(-1, 1, rows) if rows > 1 else np.zeros(1)) * half[1]
    start = high[2] + 0.01
    position, normal, radii = np.zeros((rows * columns, 3)), np.tile(up, (rows * columns, 1)), np.zeros(rows * columns)
    for index, (row, column) in enumerate(np.ndindex(rows, columns)):
        origin = x[column] * u + y[row] * v + start * up
        hit = _nearest(model, geoms_of(model, body), origin, -up)
        position[index] = origin - up * (hit[0] if hit else start)
        if hit:
            normal[index], radii[index] = hit[1], radius
    if not radii.any():
        raise UsageError(f"Link {link!r} has no surface that faces {tuple(np.round(up, 3))}.")
    return Probes(position, normal, radii, (rows, columns))


def _plane(up: NDArray, corners: NDArray) -> tuple[NDArray, NDArray]:
    """Return the directions of columns and rows across ``up``."""
    # The axis nearest to the rays is no candidate for the direction of columns.
    extent = np.ptp(corners, axis=0)
    extent[np.argmax(np.abs(up))] = -1
    u = np.eye(3)[np.argmax(extent)]
    # Gram–Schmidt: columns run across the rays even if that axis does not.
    u = u - up * (u @ up)
    u = u / np.linalg.norm(u)
    return u, np.cross(up, u)


def _nearest(model: Any, geoms: list[int], origin: NDArray, direction: NDArray) -> tuple[float, NDArray] | None:
    """Return distance and surface normal where a ray first meets one of the geometries (body's frame)."""
    data = mujoco.MjData(model)
    best: tuple[float, NDArray] | None = None
    for geom in geoms:
        matrix, normal = to_matrices(model.geom_quat[geom]).ravel(), np.zeros(3)
        kind = int(model.geom_type[geom])
        if kind == mujoco.mjtGeom.mjGEOM_MESH:
            data.geom_xpos[geom], data.geom_xmat[geom] = model.geom_pos[geom], matrix
            distance = mujoco.mj_rayMesh(model, data, geom, origin, direction, normal)
        else:
            place, size = model.geom_pos[geom], model.geom_size[geom]
            distance = mujoco.mju_rayGeom(place, matrix, size, origin, direction, kind, normal)
        # A ray that misses has the distance −1.
        if distance >= 0 and (best is None or distance < best[0]):
            best = (distance, normal)
    return best
