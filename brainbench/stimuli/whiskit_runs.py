"""Results of WHISKiT Physics read as a stimulus set; :func:`brainbench.stimuli.whiskit.save_run` writes them.

A run is a folder with ``whisker_ID.csv`` (names such as ``RC2``) and ``dynamics/Fx.csv`` … ``Mz.csv`` (line: time,
column: whisker; mN and µN·m, world axes, action of the whisker on its base). ``kinematics`` are optional; only the
contacts in ``kinematics/c`` are read. The simulator writes a line *before* it computes the frame: line 0 is memory that
nothing has written, and the other lines hold the last of the sub-steps, not a mean.
"""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS, GRID_SHAPE
from brainbench.core.errors import DataError, UsageError, check_name, listing, unknown_name
from brainbench.core.reading.ranges import check_number
from brainbench.core.reading.tables import read_numbers
from brainbench.stimuli.external import FRAME_STATUSES, assemble_stimulus_set
from brainbench.stimuli.scenes.frames import Frames
from brainbench.stimuli.whiskers.selection import ROWS
from brainbench.stimuli.whiskit import read_names

if TYPE_CHECKING:
    import xarray as xr

Cleaning = Literal["mark", "published"]
"""``mark``: values that cannot be trusted become missing (NaN) and their frames get a status. ``published``: what the
released ``process_raw_dataset.py --process_values`` does: of 1000 rows 1, 10, … 982 are kept; a missing value becomes
0; a value beyond 1000 becomes the last one that is not, or 0."""

LARGEST = 1000.0
"""Magnitude [mN, µN·m] beyond which no value is trusted."""
_NAMES = [f"{side}{row}{col}" for side in "RL" for row in ROWS for col in range(GRID_SHAPE[1])]
_SCALE = np.repeat([1e-3, 1e-6], 3)
_ROWS = {1000: Frames(first=0.0, interval=0.001, count=1000), 110: Frames(first=0.0, interval=1 / 110, count=110)}
"""Frames of a run by its number of rows, as the study ran them: one second at 1000 or 110 Hz."""
_KEPT = Frames(first=0.001, interval=0.009, count=110)
"""Frames that the published cleaning keeps of 1000."""


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
    found = {path.parent for name in ("whisker_ID.csv", "dynamics") for path in root.rglob(name)}
    return (root,) if root in found else tuple(sorted(found))


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
    kept = dynamics[1:983:9] if len(dynamics) == 1000 else dynamics
    kept = np.where(np.isnan(kept), 0.0, kept)
    good = np.abs(kept) <= LARGEST
    rows = np.arange(len(kept))[:, None, None]
    last = np.maximum.accumulate(np.where(good, rows, -1), axis=0)
    filled = np.take_along_axis(kept, np.maximum(last, 0), axis=0)
    return np.where(last < 0, 0.0, filled)


def read_runs(
    folders: Sequence[str | os.PathLike[str]], *, cleaning: Cleaning = "mark", rate: float | None = None
) -> xr.Dataset:
    """Read runs as one stimulus set in SI units, a stimulus per run.

    What cannot be trusted is marked and counted by :func:`~brainbench.stimuli.external.assemble_stimulus_set`; with
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
    kept = slice(1, 983, 9) if frames is _KEPT else slice(None)
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
        values * _SCALE,
        first.names,
        frames,
        [{"label": label} for label in labels],
        {name: where[:, kept] for name, where in faults.items()},
        frame_status=(row[:, kept, :, 0] * FRAME_STATUSES.index("unwritten")).astype(np.uint8),
        contact=np.stack(touching)[:, kept] if len(touching) == len(runs) else None,
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
