"""Read traced shapes of any tracker: the kind of table is seen from the file, or named."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, listing, shown
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import check_file
from brainbench.core.reading.tables import read_columns, read_rows
from brainbench.stimuli.fitting.tracks.contract import new_shapes
from brainbench.stimuli.fitting.tracks.deeplabcut import read_deeplabcut
from brainbench.stimuli.fitting.tracks.options import TrackOptions
from brainbench.stimuli.fitting.tracks.quality import check_track
from brainbench.stimuli.fitting.tracks.whisk import read_whisk
from brainbench.stimuli.fitting.tracks.whiskerman import read_whiskerman

Array = NDArray[np.float64]


def read_shapes(path: str | os.PathLike[str], options: TrackOptions):  # noqa: ANN201 — xarray is imported late
    """Read the traced shapes of one whisker over time.

    Args:
        path: a track of DeepLabCut (``.csv``, ``.h5``), whisk (``.whiskers``, ``.hdf5`` of WhiskiWrap), WhiskerMan
            (``.tr4``, ``.mat``), or a table of points (``.csv`` with the columns frame, x, y, and perhaps z and
            whisker; points of a frame in order from the base).
        options: scale, frame rate, and which whisker.

    Returns:
        The data set of :mod:`brainbench.stimuli.fitting.tracks.contract`; its attributes ``faults`` say, a sentence
        each, what is missing.

    Raises:
        UsageError: the whisker, or an option, is unknown.
        DataError: the file is no such track, has too few shapes, or whiskers change places in it.
    """
    layout = options.layout if options.layout != "auto" else detect_layout(path)
    frames, points = _READERS[layout](path, options)
    scale = np.full(points.shape[-1], float(options.metres_per_pixel or 1.0))
    if options.rows_down:
        scale[1] = -scale[1]
    times = (frames - options.zero_frame) / float(options.frame_rate or 1.0)
    shapes = new_shapes(
        times,
        points * scale,
        source=os.fspath(path),
        layout=layout,
        metres_per_pixel=options.metres_per_pixel,
        frame_rate=options.frame_rate,
        track="" if options.track is None else options.track,
    )
    shapes.attrs["faults"] = list(check_track(shapes).words)
    return shapes


def holds_shapes(path: str | os.PathLike[str]) -> bool:
    """Return True for a file of traced shapes, False for one of wrenches, as far as its ending and first names tell."""
    suffix = Path(path).suffix.lower()
    if suffix == ".csv":
        first = read_rows(path, "track or table of wrenches")[:1]
        return bool(first) and (first[0][0] == "scorer" or {"x", "y"} <= set(first[0]))
    if suffix in (".h5", ".hdf5"):
        with open_hdf5(path, "track or file of wrenches") as file:
            groups = [item for item in file.values() if hasattr(item, "keys")]
            return "pixels_x" in file or any("table" in item or "block0_values" in item for item in groups)
    return suffix not in (".nwb", ".nc")


def detect_layout(path: str | os.PathLike[str]) -> str:
    """Return the kind of table that a file holds; a file that is none is a :class:`DataError`."""
    suffix, name = Path(path).suffix.lower(), shown(os.fspath(path))
    check_file(path, "track")
    if suffix == ".whiskers":
        return "whisk"
    if suffix in (".tr4", ".tr4_2d", ".mat"):
        return "whiskerman"
    if suffix in (".h5", ".hdf5"):
        with open_hdf5(path, "track") as file:
            if "pixels_x" in file:
                return "whisk"
            if any("table" in item or "block0_values" in item for item in file.values() if hasattr(item, "keys")):
                return "deeplabcut"
            held = listing(file)
        raise DataError(f"{name} is no track: an HDF5 file of DeepLabCut or WhiskiWrap is read; this one holds {held}.")
    if suffix == ".csv":
        first = read_rows(path, "track")[:1]
        if first and first[0][0] == "scorer":
            return "deeplabcut"
        if first and {"frame", "x", "y"} <= set(first[0]):
            return "points"
        raise DataError(
            f"{name} is no track: a table of DeepLabCut begins with scorer, one of points with frame, x and y; this "
            f"one begins with {listing(first[0] if first else [])}."
        )
    if suffix == ".measurements":
        raise UsageError(
            f"{name} holds no shapes; give the file of traces (.whiskers), and the measurements, exported as CSV, as "
            "identities."
        )
    raise UsageError(f"{name} is no track; tracks end in .csv, .h5, .hdf5, .mat, .tr4 or .whiskers.")


def _read_points(path: str | os.PathLike[str], options: TrackOptions) -> tuple[NDArray[np.int_], Array]:
    """Return frames [n] and points [n, k, 2 or 3] of a table of points."""
    names, table = read_columns(path, "table of points", gaps=True)
    columns = {name: table[:, index] for index, name in enumerate(names)}
    if missing := [name for name in ("frame", "x", "y") if name not in columns]:
        raise DataError(f"{shown(os.fspath(path))} has no column {missing[0]!r}.")
    if "whisker" in columns:
        present = np.unique(columns["whisker"])
        wanted = options.track or (f"{present[0]:g}" if len(present) == 1 else None)
        if wanted is None or wanted not in [f"{one:g}" for one in present]:
            raise UsageError(
                f"Name one whisker of {shown(os.fspath(path))} as track; it holds "
                f"{listing(f'{one:g}' for one in present)}."
            )
        chosen = columns["whisker"] == float(wanted)
        columns = {name: values[chosen] for name, values in columns.items()}
    frames = columns["frame"]
    if not np.isfinite(frames).all() or (frames % 1).any():
        raise DataError(f"The frame numbers of {shown(os.fspath(path))} are not whole numbers.")
    axes = [axis for axis in ("x", "y", "z") if axis in columns]
    every = np.arange(int(frames.min()), int(frames.max()) + 1)
    counts = np.array([np.sum(frames == frame) for frame in every])
    points = np.full((len(every), counts.max(), len(axes)), np.nan)
    for index, frame in enumerate(every):
        rows = np.flatnonzero(frames == frame)
        points[index, : len(rows)] = np.stack([columns[axis][rows] for axis in axes], axis=1)
    return every, points


_READERS: dict[str, Callable[[str | os.PathLike[str], TrackOptions], tuple[NDArray[np.int_], Array]]] = {
    "deeplabcut": read_deeplabcut,
    "points": _read_points,
    "whisk": read_whisk,
    "whiskerman": read_whiskerman,
}
