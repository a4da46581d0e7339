"""Read traced shapes of any tracker: the kind of table is seen from the file, or named."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, choose_name, listing, shown
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import check_file
from brainbench.core.reading.tables import read_columns, read_rows
from brainbench.stimuli.fitting.tracks.contract import new_shapes
from brainbench.stimuli.fitting.tracks.deeplabcut import frame_numbers, pandas_groups, read_deeplabcut
from brainbench.stimuli.fitting.tracks.options import TrackOptions
from brainbench.stimuli.fitting.tracks.quality import check_track, every_frame
from brainbench.stimuli.fitting.tracks.whisk import read_whisk
from brainbench.stimuli.fitting.tracks.whiskerman import read_whiskerman

Array = NDArray[np.float64]
_LAYOUTS = {".whiskers": "whisk", **dict.fromkeys((".tr4", ".tr4_2d", ".mat"), "whiskerman")}
"""Layout by the ending of the file."""
_SEVERAL = (".csv", ".h5", ".hdf5")
"""Endings of several layouts, and of wrenches."""


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
    return _look(path)[0] is not None if suffix in _SEVERAL else suffix not in (".nwb", ".nc")


def detect_layout(path: str | os.PathLike[str]) -> str:
    """Return the kind of table that a file holds; a file that is none is a :class:`DataError`."""
    suffix, name = Path(path).suffix.lower(), shown(os.fspath(path))
    check_file(path, "track")
    if suffix in _LAYOUTS:
        return _LAYOUTS[suffix]
    if suffix in _SEVERAL:
        layout, held = _look(path)
        if layout is None:
            raise DataError(
                f"{name} is no track: a table of DeepLabCut begins with scorer, one of points with frame, x and y, and "
                f"HDF5 files are of DeepLabCut or WhiskiWrap; this one holds {listing(held)}."
            )
        return layout
    if suffix == ".measurements":
        raise UsageError(
            f"{name} holds no shapes; give the file of traces (.whiskers), and the measurements, exported as CSV, as "
            "identities."
        )
    raise UsageError(f"{name} is no track; tracks end in .csv, .h5, .hdf5, .mat, .tr4 or .whiskers.")


def _look(path: str | os.PathLike[str]) -> tuple[str | None, list[str]]:
    """Return the layout of a table or an HDF5 file, None for no track, and the first names in it."""
    if Path(path).suffix.lower() == ".csv":
        names = (read_rows(path, "track or table of wrenches") or [[""]])[0]
        return "deeplabcut" if names[0] == "scorer" else "points" if {"x", "y"} <= set(names) else None, names
    with open_hdf5(path, "track or file of wrenches") as file:
        return "whisk" if "pixels_x" in file else "deeplabcut" if pandas_groups(file) else None, list(file)


def _read_points(path: str | os.PathLike[str], options: TrackOptions) -> tuple[NDArray[np.int_], Array]:
    """Return frames [n] and points [n, k, 2 or 3] of a table of points."""
    names, table = read_columns(path, "table of points", gaps=True)
    columns = {name: table[:, index] for index, name in enumerate(names)}
    if missing := [name for name in ("frame", "x", "y") if name not in columns]:
        raise DataError(f"{shown(os.fspath(path))} has no column {missing[0]!r}.")
    if "whisker" in columns:
        present = [f"{one:g}" for one in np.unique(columns["whisker"])]
        wanted = choose_name(f"whisker of {shown(os.fspath(path))}", options.track, present, how="as track")
        chosen = columns["whisker"] == float(wanted)
        columns = {name: values[chosen] for name, values in columns.items()}
    frames = frame_numbers(columns["frame"], path)
    axes = [axis for axis in ("x", "y", "z") if axis in columns]
    every, order = every_frame(frames, path), np.argsort(frames, kind="stable")
    ordered = frames[order]
    # Which of its frame each point is: they stand in order from the base.
    place = np.arange(len(order)) - np.searchsorted(ordered, ordered)
    points = np.full((len(every), place.max() + 1, len(axes)), np.nan)
    points[ordered - every[0], place] = np.stack([columns[axis][order] for axis in axes], axis=1)
    return every, points


_READERS: dict[str, Callable[[str | os.PathLike[str], TrackOptions], tuple[NDArray[np.int_], Array]]] = {
    "deeplabcut": read_deeplabcut,
    "points": _read_points,
    "whisk": read_whisk,
    "whiskerman": read_whiskerman,
}
