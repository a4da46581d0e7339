"""Folders of WHISKiT Physics (Zweifel et al. 2021): parameters read and written, results written.

**Parameters.** Comma-separated tables without headers, one line per whisker, the right side before the left:
``param_name`` (``RC2``), ``param_side_row_col`` (1 right or 0 left; 1–5 for A–E; column from 0), ``param_s_a``
(arc length in mm, curvature A of y = A x² in 1/mm), ``param_bp_pos`` (base point in mm), ``param_bp_angles``
(θ, φ, ζ in rad) and ``param_angles`` (bend of each of 20 links against the one before, rad; the first is 0, so the
second holds the direction of the second link). They hold no diameters and no material.

**Results.** One folder per run: ``whisker_ID.csv`` (one name per line); ``dynamics/Fx.csv`` … ``Mz.csv`` (line: time,
column: whisker); ``kinematics/x|y|z/RC2.csv`` (line: time, columns: base point, then the centre of each link) and
``kinematics/c/RC2.csv`` (0 or 1 per link: whether it touches). Units there are mN, µN·m and mm; signs and axes are ours
and WHISKiT's alike. Time is not written: lines follow the frames of the stimulus set. SeNSE-lab's programs end each
line with a comma; the thesis's programs write and expect none.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import CHANNELS, check_stimulus_set
from brainbench.core.errors import DataError, UsageError, check_name, choose_name
from brainbench.core.files import write_text
from brainbench.core.reading.tables import read_numbers
from brainbench.core.reading.texts import read_text
from brainbench.stimuli.whiskers.array import MountedWhisker, WhiskerArray, published_whisker
from brainbench.stimuli.whiskers.selection import ROWS

if TYPE_CHECKING:
    import xarray as xr

BENDS = 20
"""Links in WHISKiT's table of bends."""
DIALECTS = ("sense-lab", "thesis")

_MILLI = 1e3


def load_parameters(folder: str | os.PathLike[str], *, species: str = "whiskit") -> WhiskerArray:
    """Read the whiskers of a parameter folder; see the module for the files.

    Diameters, taper, density, stiffness, damping and friction follow the published rules that the mouse and
    rat arrays use. ``param_angles`` is not needed: the whole curvature is kept by any number of links.
    ``species`` is the name given to the array.
    """
    root = Path(folder)
    names = read_names(root / "param_name.csv")
    columns = {"side_row_col": 3, "s_a": 2, "bp_pos": 3, "bp_angles": 3}
    tables = [_table(root, f"param_{name}", len(names), count).tolist() for name, count in columns.items()]
    mounts = []
    for name, place, (length, curvature), (x, y, z), (theta, phi, zeta) in zip(names, *tables, strict=True):
        side, row, col = map(int, place)
        expected = f"{'R' if side == 1 else 'L'}{ROWS[row - 1] if 1 <= row <= len(ROWS) else '?'}{col}"
        if name != expected:
            raise DataError(
                f"{os.fspath(root)!r}: param_name says {name!r} where param_side_row_col says {expected!r}; the tables "
                "do not list the same whiskers in the same order."
            )
        mounts.append(
            MountedWhisker(
                name=name[1:],
                side="right" if side == 1 else "left",
                row=row - 1,
                col=col,
                position=(x * 1e-3, y * 1e-3, z * 1e-3),
                angles=(theta, phi, zeta),
                whisker=published_whisker(length, curvature, row - 1, col),
            )
        )
    return WhiskerArray(species, tuple(mounts), f"WHISKiT parameter folder {root.name}")


def load_bends(folder: str | os.PathLike[str]) -> NDArray[np.float64]:
    """Read ``param_angles``: the bend [whisker, link] (rad) of each link against the one before; errors as above."""
    return _table(Path(folder), "param_angles", len(read_names(Path(folder) / "param_name.csv")), None)


def bends(array: WhiskerArray, links: int = BENDS) -> NDArray[np.float64]:
    """Return the bends [whisker, link] (rad) that ``param_angles`` holds, from the exact parabola.

    WHISKiT's own table is computed from an approximate arc length and differs by up to 2 %.
    """
    found = np.zeros((len(array), links))
    for index, mount in enumerate(array):
        points = mount.whisker.centre_line(np.linspace(0.0, mount.whisker.arc_length, links + 1))
        directions = np.arctan2(*np.diff(points, axis=0).T[::-1])
        found[index, 1:] = np.diff(directions, prepend=0.0)[1:]
        # The table has no place for the direction of the first link: it is added to the bend of the second.
        found[index, 1] += directions[0]
    return found


def save_parameters(
    array: WhiskerArray, folder: str | os.PathLike[str], *, bends_table: ArrayLike | None = None
) -> Path:
    """Write an array as a parameter folder that WHISKiT reads; existing tables are replaced.

    Diameters and material have no place there and are not written. ``bends_table`` is [whisker, link] (rad), such as
    :func:`load_bends` read; :func:`bends` of the array when None.
    """
    table = bends(array) if bends_table is None else np.asarray(bends_table, dtype=float)
    if table.ndim != 2 or len(table) != len(array):
        raise UsageError(
            f"The bends of {len(array)} whiskers have shape [{len(array)}, links]; received {table.shape}."
        )
    root = Path(folder)
    rows: dict[str, list[Any]] = {
        "name": [[mount.full_name] for mount in array],
        "side_row_col": [[int(m.side == "right"), m.row + 1, m.col] for m in array],
        "s_a": [[m.whisker.arc_length * _MILLI, -m.whisker.curvature / _MILLI] for m in array],
        "bp_pos": [[value * _MILLI for value in m.position] for m in array],
        "bp_angles": [m.angles for m in array],
        "angles": table.tolist(),
    }
    for name, lines in rows.items():
        # Enough digits for any published table, and none that only changing the unit brought in.
        _write(root / f"param_{name}.csv", lines, digits=12)
    return root


def save_run(
    dataset: xr.Dataset,
    folder: str | os.PathLike[str],
    *,
    stimulus: str | None = None,
    shapes: Sequence[ArrayLike] | None = None,
    dialect: Literal["sense-lab", "thesis"] = "sense-lab",
) -> Path:
    """Write one stimulus of a stimulus set in WHISKiT's output layout; see the module for files, units and signs.

    Args:
        dataset: a stimulus set in world axes.
        folder: created when missing.
        stimulus: label of the stimulus; may be None when the set has one.
        shapes: joints and tip of each whisker [time, links + 1, 3] (m, world), in the order of the whiskers, as a
            backend records them; without them no ``kinematics`` are written.
        dialect: ``sense-lab`` ends lines with a comma, ``thesis`` does not.
    """
    check_stimulus_set(dataset)
    check_name("dialect", dialect, DIALECTS)
    labels = [str(label) for label in dataset["stimulus"].values]
    chosen = choose_name("stimulus", stimulus, labels)
    if not str(dataset.attrs.get("frame", "world")).startswith("world"):
        raise UsageError("WHISKiT's results are in world axes; read the stimulus set in world axes to write them.")
    one = dataset.isel(stimulus=labels.index(chosen))
    names = _run_names(one)
    end = ",\n" if dialect == "sense-lab" else "\n"
    root = Path(folder)
    _write(root / "whisker_ID.csv", [[name] for name in names], end)
    # N to mN, and N·m to mN·mm.
    wrench = one["wrench"].values.astype(float) * np.repeat([1e3, 1e6], 3)
    for index, channel in enumerate(CHANNELS):
        _write(root / "dynamics" / f"{channel}.csv", wrench[:, :, index].tolist(), end)
    if shapes is not None:
        _write_kinematics(one, root / "kinematics", names, shapes, end)
    return root


def _write_kinematics(one: xr.Dataset, root: Path, names: Sequence[str], shapes: Sequence[ArrayLike], end: str) -> None:
    times = one.sizes["time"]
    if len(shapes) != len(names):
        raise UsageError(f"{len(names)} whiskers need as many shapes; received {len(shapes)}.")
    arcs, touches = one["contact_arc"].values, one["contact"].values
    for index, (name, shape) in enumerate(zip(names, shapes, strict=True)):
        joints = np.asarray(shape, dtype=float)
        if joints.ndim != 3 or joints.shape[0] != times or joints.shape[1] < 2 or joints.shape[2] != 3:
            raise UsageError(f"The shape of {name} is [{times}, links + 1, 3]; received {joints.shape}.")
        links = joints.shape[1] - 1
        points = np.concatenate([joints[:, :1], (joints[:, :-1] + joints[:, 1:]) / 2], axis=1) * _MILLI
        for axis, letter in enumerate("xyz"):
            _write(root / letter / f"{name}.csv", points[:, :, axis].tolist(), end)
        flags = np.zeros((times, links), dtype=int)
        when = np.flatnonzero(touches[:, index] & np.isfinite(arcs[:, index]))
        # Links do not stretch, so their chords in any frame tell the arc length.
        length = np.linalg.norm(np.diff(joints[0], axis=0), axis=1).sum()
        link = np.clip((arcs[when, index] / length * links).astype(int), 0, links - 1)
        flags[when, link] = 1
        _write(root / "c" / f"{name}.csv", flags.tolist(), end)


def _run_names(one: xr.Dataset) -> list[str]:
    """Return the names with their side: ``RC2``."""
    if "side" not in one.coords:
        raise UsageError("The stimulus set does not say on which side its whiskers are; WHISKiT's names need it.")
    sides = [str(side)[0].upper() for side in one["side"].values]
    rows, cols = one["row"].values.astype(int), one["col"].values.astype(int)
    names = [f"{side}{ROWS[row]}{col}" for side, row, col in zip(sides, rows, cols, strict=True)]
    if len(set(names)) < len(names):
        raise UsageError("The stimulus set has several animals; a WHISKiT run has one: select its whiskers first.")
    return names


def _write(path: Path, lines: Iterable[Iterable[float | str]], end: str = "\n", *, digits: int = 7) -> None:
    cells = ((cell if isinstance(cell, str) else f"{cell:.{digits}g}" for cell in line) for line in lines)
    write_text(path, "".join(",".join(line) + end for line in cells))


def read_names(path: Path) -> list[str]:
    """Return the names in a file, one a line or with commas between them; a :class:`DataError` without any."""
    return read_text(path, "file of the whiskers' names").replace(",", " ").split()


def _table(root: Path, name: str, lines: int, columns: int | None) -> NDArray[np.float64]:
    path = root / f"{name}.csv"
    table = read_numbers(path)
    if len(table) != lines or (columns is not None and table.shape[1] != columns):
        raise DataError(
            f"{os.fspath(path)!r} has shape {list(table.shape)}; {lines} names need [{lines}, {columns or 'links'}]."
        )
    return table
