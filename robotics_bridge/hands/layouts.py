"""Probe layouts: which links carry how many probes, at three resolutions and four placements (thesis, table 4.11)."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import mujoco_module
from brainbench.core.errors import DataError, brief, check_name
from brainbench.core.files import file_hash, read_json, write_json
from brainbench.core.reading.regular import reason
from robotics_bridge.sensors.probes.placement import Probes

RESOLUTIONS = ("low", "med", "high")
PLACEMENTS = ("hand", "tips", "fingers", "palm")  # `fingers` includes the tips; `hand` is fingers and palm
Layout = dict[str, Probes]
"""Link → its probes, in the link's frame."""


@dataclass(frozen=True)
class Pad:
    """The sensing surface of a link, on its first solid.

    On a capsule, columns run along the axis and on over the round end, rows around it. On a box, they fill one face.
    """

    facing: tuple[float, float, float]
    """Out of the middle of the surface: along an axis of a box, across the axis of a capsule."""
    along: tuple[float, float]
    """Capsule: from, to on the meridian, counted from the start of the axis [m]. Box: half extent of rows and
    columns [m]."""
    grids: Mapping[str, tuple[int, int, float] | tuple[int, int, float, int]]
    """Resolution → rows, columns, sensing radius [m] and, where the far corners are fillers, the probes that sense."""
    over_end: float = 0.0
    """Capsule: share of the meridian of the round end by which columns run on beyond ``along``."""
    around: float = 0.9
    """Capsule: half angle that the rows cover [rad]."""


def pad_probes(solid: Any, pad: Pad, resolution: str) -> Probes:
    """Lay a grid of a pad on its solid, a box or capsule of a ``mujoco.MjSpec``."""
    rows, columns, radius, *active = pad.grids[resolution]
    on_box = solid.type == mujoco_module().mjtGeom.mjGEOM_BOX
    position, normal = (_on_box if on_box else _on_capsule)(solid, pad, rows, columns)
    keep = np.ones(rows * columns, dtype=bool)
    if active:
        keep[fillers(rows, columns, rows * columns - int(active[0]))] = False
    return Probes(position, normal, np.where(keep, radius, 0.0), (rows, columns))


def fillers(rows: int, columns: int, count: int) -> NDArray[np.int64]:
    """Return the cells [count] of a grid that stay empty: those at its far corners (last columns) first.

    >>> fillers(3, 3, 2).tolist()
    [2, 8]
    """
    row, column = np.divmod(np.arange(rows * columns), columns)
    # Rank by distance from the middle row and the first column: symmetric pairs of corners are left out together.
    off = np.abs(row - (rows - 1) / 2) / max(rows - 1, 1) + column / max(columns - 1, 1)
    return np.sort(np.lexsort((row, -off))[:count])


def _centred(count: int, half: float) -> NDArray[np.float64]:
    return np.linspace(-half, half, count) if count > 1 else np.zeros(1)


def _on_capsule(solid: Any, pad: Pad, rows: int, columns: int) -> tuple[NDArray, NDArray]:
    """Return positions and normals [N, 3] of a grid on a capsule."""
    start, end, radius = solid.fromto[:3], solid.fromto[3:], float(solid.size[0])
    length = np.linalg.norm(end - start)
    axis = (end - start) / length
    # Frame of the pad: along the axis, across it towards the facing side, and sideways.
    up = np.array(pad.facing, dtype=float) - axis * np.dot(pad.facing, axis)
    up /= np.linalg.norm(up)
    side = np.cross(axis, up)
    last = pad.along[1] + pad.over_end * (radius * (math.pi / 2))
    arcs = np.linspace(pad.along[0], last, columns)
    angle, arc = (item.ravel() for item in np.meshgrid(_centred(rows, pad.around), arcs, indexing="ij"))
    # Beyond the end of the axis the meridian runs over the round end.
    tilt = np.maximum(arc - length, 0) / radius
    across = np.cos(angle)[:, None] * up + np.sin(angle)[:, None] * side
    normal = np.cos(tilt)[:, None] * across + np.sin(tilt)[:, None] * axis
    return start + np.minimum(arc, length)[:, None] * axis + radius * normal, normal


def _on_box(solid: Any, pad: Pad, rows: int, columns: int) -> tuple[NDArray, NDArray]:
    """Return positions and normals [N, 3] of a grid on a face of a box."""
    normal = np.array(pad.facing, dtype=float)
    face = int(np.argmax(np.abs(normal)))
    # Columns run along z where the face has one, rows across.
    rows_axis, columns_axis = {0: (1, 2), 1: (0, 2), 2: (0, 1)}[face]
    sides = (_centred(rows, pad.along[0]), _centred(columns, pad.along[1]))
    y, x = (item.ravel() for item in np.meshgrid(*sides, indexing="ij"))
    position = np.tile(np.array(solid.pos), (len(y), 1))
    # From the middle of the box to the face that looks along the normal.
    position[:, face] += normal[face] * solid.size[face]
    position[:, rows_axis] += y
    position[:, columns_axis] += x
    return position, np.tile(normal, (len(y), 1))


def select(layout: Mapping[str, Probes], links: tuple[str, ...]) -> Layout:
    """Return the part of a layout on some links, in the layout's order."""
    return {link: probes for link, probes in layout.items() if link in links}


def active_count(layout: Mapping[str, Probes]) -> int:
    """Return the number of probes that sense."""
    return int(sum(np.count_nonzero(probes.active) for probes in layout.values()))


def is_probe_file(resolution: str) -> bool:
    """Return whether what names a resolution is a probe file, which may stand for one."""
    return resolution.endswith(".json")


def check_names(resolution: str, placement: str) -> None:
    """Raise UsageError for an unknown resolution or placement; a probe file (.json) stands for a resolution."""
    if not is_probe_file(resolution):
        check_name("resolution", resolution, RESOLUTIONS)
    check_name("placement", placement, PLACEMENTS)


def check_probes(resolution: str, trained: str | None) -> None:
    """Raise DataError for a probe file that is no longer what it was, by its hash, when a policy was trained."""
    if trained is not None and file_hash(resolution) != trained:
        raise DataError(
            f"The probe file {resolution!r} has changed since the policy was trained with it, so taxels would lie "
            "elsewhere: bring back that file, or train again."
        )


def read_probes(path: str | os.PathLike[str]) -> Layout:
    """Read probes in the published JSON form: a list of links with a grid of {radius, pos, normal}."""
    document = read_json(path, "probe file")
    name = Path(path).name
    if not isinstance(document, list):
        raise DataError(f"{name} is no probe file: a list of links is expected, each with 'link_name' and 'probes'.")
    layout: Layout = {}
    for entry in document:
        try:
            link, rows = entry["link_name"], entry["probes"]
            cells = [cell for row in rows for cell in row]
            shape = (len(rows), len(rows[0]))
            if not isinstance(link, str) or any(len(row) != shape[1] for row in rows):
                raise DataError(f"{name}: link {brief(link)} needs a name and rows of equal length.")
            position, normal, radius = ([cell[key] for cell in cells] for key in ("pos", "normal", "radius"))
            probes = Probes(np.array(position, float), np.array(normal, float), np.array(radius, float), shape)
        except DataError:
            raise
        except (LookupError, TypeError, ValueError) as error:
            raise DataError(f"{name} is no probe file (link {len(layout) + 1}: {reason(error)}).") from error
        if link in layout:
            raise DataError(f"{name}: link {brief(link)} appears twice.")
        layout[link] = probes
    return layout


def write_probes(path: str | os.PathLike[str], layout: Mapping[str, Probes]) -> None:
    """Write probes in the published JSON form."""
    document = []
    for link, probes in layout.items():
        rows, columns = probes.shape if len(probes.shape) == 2 else (1, len(probes))
        cells = [
            {"radius": float(r), "pos": p.tolist(), "normal": n.tolist()}
            for r, p, n in zip(probes.radius, probes.position, probes.normal, strict=True)
        ]
        grid = [cells[row * columns : (row + 1) * columns] for row in range(rows)]
        document.append({"link_name": link, "kind": "grid", "probes": grid})
    write_json(path, document)
