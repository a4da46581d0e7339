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

import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import CHANNELS, GRID_SHAPE, check_stimulus_set
from brainbench.core.errors import DataError, UsageError, check_name, check_number, choose_name, listing, unknown_name
from brainbench.core.files import write_text
from brainbench.core.reading.tables import read_numbers
from brainbench.core.reading.texts import read_text
from brainbench.published.conversion import FRAME_STATUSES, LARGEST, SCALE, assemble_stimulus_set
from brainbench.stimuli.scenes.scene import Frames
from brainbench.stimuli.whiskers.array import ROWS, MountedWhisker, WhiskerArray, published_whisker

if TYPE_CHECKING:
    import xarray as xr

BENDS = 20  # links in WHISKiT's table of bends
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
    table = np.zeros((len(array), links))
    for index, mount in enumerate(array):
        points = mount.whisker.centre_line(np.linspace(0.0, mount.whisker.arc_length, links + 1))
        directions = np.arctan2(*np.diff(points, axis=0).T[::-1])
        table[index, 1:] = np.diff(directions, prepend=0.0)[1:]
        # The table has no place for the direction of the first link: it is added to the bend of the second.
        table[index, 1] += directions[0]
    return table


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
    run = dataset.isel(stimulus=labels.index(chosen))
    names = _run_names(run)
    end = ",\n" if dialect == "sense-lab" else "\n"
    root = Path(folder)
    _write(root / "whisker_ID.csv", [[name] for name in names], end)
    # N to mN, and N·m to mN·mm = µN·m.
    wrench = run["wrench"].values.astype(float) * np.repeat([1e3, 1e6], 3)
    for index, channel in enumerate(CHANNELS):
        _write(root / "dynamics" / f"{channel}.csv", wrench[:, :, index].tolist(), end)
    if shapes is not None:
        _write_kinematics(run, root / "kinematics", names, shapes, end)
    return root


def _write_kinematics(run: xr.Dataset, root: Path, names: Sequence[str], shapes: Sequence[ArrayLike], end: str) -> None:
    times = run.sizes["time"]
    if len(shapes) != len(names):
        raise UsageError(f"{len(names)} whiskers need as many shapes; received {len(shapes)}.")
    arcs, touches = run["contact_arc"].values, run["contact"].values
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


def _run_names(run: xr.Dataset) -> list[str]:
    """Return the names with their side: ``RC2``."""
    if "side" not in run.coords:
        raise UsageError("The stimulus set does not say on which side its whiskers are; WHISKiT's names need it.")
    sides = [str(side)[0].upper() for side in run["side"].values]
    rows, cols = run["row"].values.astype(int), run["col"].values.astype(int)
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


Cleaning = Literal["mark", "published"]
"""``mark``: values that cannot be trusted become missing (NaN) and their frames get a status. ``published``: what the
released ``process_raw_dataset.py --process_values`` does: of 1000 rows 1, 10, … 982 are kept; a missing value becomes
0; a value beyond 1000 becomes the last one that is not, or 0."""

_NAMES = [f"{side}{row}{col}" for side in "RL" for row in ROWS for col in range(GRID_SHAPE[1])]
_ROWS = {1000: Frames(first=0.0, interval=0.001, count=1000), 110: Frames(first=0.0, interval=1 / 110, count=110)}
"""Frames of a run by its number of rows, as the study ran them: one second at 1000 or 110 Hz."""
_KEPT = Frames(first=0.001, interval=0.009, count=110)  # frames that the published cleaning keeps of 1000


@dataclass(frozen=True, eq=False)
class WhiskitRun:
    """One run as its files hold it."""

    names: tuple[str, ...]
    """Whiskers with their side: ``RC2``."""
    dynamics: NDArray[np.float64]
    """[row, whisker, channel] as written (mN, µN·m), with its missing and impossible values."""
    contact: NDArray[np.bool_] | None
    """[row, whisker] whether any link touches; None without kinematics."""


def find_runs(folder: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Return the folder itself if it is a run, or else all runs below it, by path."""
    root = Path(folder)
    folders = {path.parent for name in ("whisker_ID.csv", "dynamics") for path in root.rglob(name)}
    return (root,) if root in folders else tuple(sorted(folders))


def read_run(folder: str | os.PathLike[str]) -> WhiskitRun:
    """Read one run without changing a value."""
    root = Path(folder)
    names = _names(root / "whisker_ID.csv")
    tables = {name: read_numbers(root / "dynamics" / f"{name}.csv") for name in CHANNELS}
    rows = Counter(map(len, tables.values())).most_common(1)[0][0]
    for name, table in tables.items():
        for size, needed, what in zip(table.shape, (rows, len(names)), ("rows", "columns"), strict=True):
            if size != needed:
                raise DataError(
                    f"'dynamics/{name}.csv' of the run {str(root)!r} has {size} {what}; it needs {needed}, as most "
                    "components have rows and whisker_ID.csv has names."
                )
    return WhiskitRun(names, np.stack(list(tables.values()), axis=-1), _contacts(root, names, rows))


def published_cleaning(dynamics: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the 110 rows [110, whisker, channel] of a run (mN, µN·m) that the released cleaning makes of it."""
    if len(dynamics) not in _ROWS:
        raise UsageError(f"The published cleaning takes runs of 1000 or 110 rows; received {len(dynamics)}.")
    values = dynamics[1:983:9] if len(dynamics) == 1000 else dynamics
    values = np.where(np.isnan(values), 0.0, values)
    good = np.abs(values) <= LARGEST
    rows = np.arange(len(values))[:, None, None]
    last = np.maximum.accumulate(np.where(good, rows, -1), axis=0)
    filled = np.take_along_axis(values, np.maximum(last, 0), axis=0)
    return np.where(last < 0, 0.0, filled)


def read_runs(
    folders: Sequence[str | os.PathLike[str]], *, cleaning: Cleaning = "mark", rate: float | None = None
) -> xr.Dataset:
    """Read runs as one stimulus set in SI units, a stimulus per run.

    What cannot be trusted is marked and counted by :func:`~brainbench.published.conversion.assemble_stimulus_set`; with
    ``cleaning="published"`` that tells what was replaced.

    Args:
        folders: one or more runs with the same whiskers and as many rows.
        cleaning: one of :data:`Cleaning`.
        rate: rows per second [Hz]; by the number of rows when None: 1000 and 110 rows are one second.
    """
    check_name("cleaning", cleaning, get_args(Cleaning))
    paths = [Path(folder).absolute() for folder in folders]
    if not paths:
        raise DataError("There is no run of WHISKiT (whisker_ID.csv and dynamics/) to be read.")
    # Runs of several objects have the same names; their paths differ.
    common = os.path.commonpath(paths) if len(paths) > 1 else paths[0].parent
    labels = [path.relative_to(common).as_posix() for path in paths]
    runs = [read_run(path) for path in paths]
    first = runs[0]
    for label, run in zip(labels, runs, strict=True):
        if (run.names, len(run.dynamics)) != (first.names, len(first.dynamics)):
            raise DataError(
                f"The runs {labels[0]!r} and {label!r} differ in whiskers or rows ({len(first.names)} and "
                f"{len(run.names)} whiskers, {len(first.dynamics)} and {len(run.dynamics)} rows); convert them apart."
            )
    raw = np.stack([run.dynamics for run in runs])
    frames = _frames(raw.shape[1], cleaning, rate)
    chosen = slice(1, 983, 9) if frames is _KEPT else slice(None)
    faults = {"missing": np.isnan(raw), "too large": np.abs(raw) > LARGEST}
    bad = faults["missing"] | faults["too large"]
    values = np.where(bad, math.nan, raw)
    if cleaning == "published":
        values = np.stack([published_cleaning(run.dynamics) for run in runs])
    row = np.zeros(raw.shape, dtype=bool)
    row[:, 0] = True
    faults = {"unwritten": row & (raw != 0) & ~bad, **faults}
    touching = [run.contact for run in runs if run.contact is not None]
    return assemble_stimulus_set(
        values * SCALE,
        first.names,
        frames,
        [{"label": label} for label in labels],
        {name: where[:, chosen] for name, where in faults.items()},
        frame_status=(row[:, chosen, :, 0] * FRAME_STATUSES.index("unwritten")).astype(np.uint8),
        contact=np.stack(touching)[:, chosen] if len(touching) == len(runs) else None,
        cleaning=cleaning,
    )


def _frames(rows: int, cleaning: Cleaning, rate: float | None) -> Frames:
    if cleaning == "published" and rows == 1000:
        return _KEPT
    if rate is None and rows not in _ROWS:
        raise UsageError(
            f"A run of {rows} rows does not tell its times; say how many rows make a second, as --rate does (1000 and "
            "110 rows are taken as one second)."
        )
    if rate is not None:
        check_number("rate (rows per second, Hz)", rate, above=0)
    return _ROWS[rows] if rate is None else Frames(first=0.0, interval=1 / rate, count=rows)


def _names(path: Path) -> tuple[str, ...]:
    names = read_names(path)
    for name in names:
        if name not in _NAMES:
            raise DataError(str(unknown_name(f"whisker in {str(path)!r}:", name, _NAMES)))
    if not names or len(set(names)) < len(names):
        raise DataError(f"{str(path)!r} must name each whisker once; it has {listing(names)}.")
    return tuple(names)


def _contacts(root: Path, names: Sequence[str], rows: int) -> NDArray[np.bool_] | None:
    """Return whether any link of a whisker touches [row, whisker]; None where nobody wrote it."""
    paths = [root / "kinematics" / "c" / f"{name}.csv" for name in names]
    if not all(path.is_file() for path in paths):
        return None
    flags = [(read_numbers(path) != 0).any(axis=1) for path in paths]
    if odd := [path for path, flag in zip(paths, flags, strict=True) if len(flag) != rows]:
        raise DataError(f"{str(odd[0])!r} has another number of rows than the {rows} of dynamics.")
    return np.stack(flags, axis=1)
