"""Traces of Janelia's whisk (Clack et al. 2012, PLoS Comput. Biol. 8, e1002591).

Read are ``.whiskers`` files, binary (``bwhiskbin1``) and text (``whisker1``), and the HDF5 files that WhiskiWrap makes
of them (``summary`` with ``pixels_x`` and ``pixels_y``). Which trace of a frame is which whisker stands in the
measurements, read as the CSV table (columns ``fid``, ``wid``, ``label`` and perhaps ``follicle_x``, ``follicle_y``)
that whisk's Python and MATLAB interfaces export; binary ``.measurements`` files are not read.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, brief, choose_name, listing
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import MOST_TEXT, check_file, readable
from brainbench.core.reading.tables import read_columns, read_rows
from brainbench.stimuli.fitting.options import TrackOptions
from brainbench.stimuli.fitting.tracks.contract import every_frame

Array = NDArray[np.float64]
Segments = dict[tuple[int, int], Array]
"""Points [k, 2] (pixels) of each trace by frame and number within the frame."""
_HEADER = b"bwhiskbin1\0\0"
_MOST_POINTS = 100_000


def read_whisk(path: str | os.PathLike[str], options: TrackOptions) -> tuple[NDArray[np.int_], Array]:
    """Return frame numbers [n] and points [n, k, 2] (pixels) of one whisker."""
    name = brief(os.fspath(path))
    if Path(path).suffix in (".h5", ".hdf5"):
        segments, labels, follicles = _read_whiskiwrap(path)
    else:
        segments, labels, follicles = _read_segments(path), {}, {}
    if options.identities is not None:
        labels, follicles = _read_identities(options.identities)
    wanted = options.track
    if labels:
        present = sorted({label for key, label in labels.items() if key in segments and label >= 0})
        wanted = choose_name(f"whisker (label) of {name}", wanted, map(str, present), how="as track")
        chosen = {key: label for key, label in labels.items() if str(label) == wanted and key in segments}
    else:
        chosen = {key: 0 for key in segments if wanted is None or str(key[1]) == wanted}
    frames = [frame for frame, _ in chosen]
    if len(set(frames)) < len(frames):
        of = f" of the label {wanted}" if labels else ""
        raise UsageError(
            f"Frames of {name} hold several traces{of}; give the table of whisk's measurements (CSV), in which each "
            "trace of a frame has a label of its own, as identities, and the whisker's label as track."
        )
    traces = {key[0]: segments[key] for key in chosen}
    if not traces:
        raise DataError(f"{name} holds no trace of the whisker {brief(wanted)}.")
    frames = every_frame(np.array(sorted(traces)), path)
    return frames, _stack(
        traces, frames, {key[0]: follicles[key] for key in chosen if key in follicles}, options.points
    )


def _read_segments(path: str | os.PathLike[str]) -> Segments:
    file = check_file(path, "file of whisk's traces", most=16 * MOST_TEXT)
    with file.open("rb") as stream:
        head = stream.read(len(_HEADER))
    if head == _HEADER:
        with readable(path, "binary file of whisk's traces"):
            return _parse_binary(file.read_bytes(), brief(os.fspath(path)))
    if head.startswith(b"whisker1"):
        return _parse_text(read_rows(path, "text file of whisk's traces"), brief(os.fspath(path)))
    raise DataError(
        f"{brief(os.fspath(path))} is no file of whisk's traces: it begins neither with bwhiskbin1 nor with whisker1."
    )


def _parse_binary(data: bytes, name: str) -> Segments:
    """Return the traces of records of three int32 (number, frame, length) and four float32 lists: x, y, width,
    score."""
    segments: Segments = {}
    place, end = len(_HEADER), len(data) - 4
    while place < end:
        number, frame, count = (int(one) for one in np.frombuffer(data, "<i4", 3, place))
        place += 12
        if not 0 < count <= _MOST_POINTS or frame < 0 or place + 16 * count > end:
            raise DataError(f"{name} is cut off or damaged at byte {place}: a trace of {count} points does not fit.")
        segments[frame, number] = np.frombuffer(data, "<f4", 2 * count, place).reshape(2, count).T.astype(float)
        place += 16 * count
    return segments


def _parse_text(rows: list[list[str]], name: str) -> Segments:
    """Return the traces of lines ``frame, id, time, n, x1, y1, width1, score1, …``."""
    segments: Segments = {}
    for index, row in enumerate(rows[1:], 2):
        try:
            frame, number, _, count = (int(cell) for cell in row[:4])
            values = np.array([float(cell) for cell in row[4 : 4 + 4 * count]]).reshape(count, 4)
        except ValueError as error:
            raise DataError(f"{name} is damaged: line {index} is no trace ({brief(','.join(row))}).") from error
        segments[frame, number] = values[:, :2]
    return segments


def _read_identities(path: str) -> tuple[dict[tuple[int, int], int], dict[tuple[int, int], Array]]:
    """Return the label and the follicle (pixels) of each trace, by frame and number."""
    names, table = read_columns(path, "table of whisk's measurements", gaps=True)
    if missing := [name for name in ("fid", "wid", "label") if name not in names]:
        raise DataError(
            f"{brief(path)} is no table of whisk's measurements: the column {missing[0]!r} is missing; it has "
            f"{listing(names)}."
        )
    columns = {name: table[:, names.index(name)] for name in names}
    return _identities(columns)


def _identities(
    columns: dict[str, Array],
) -> tuple[dict[tuple[int, int], int], dict[tuple[int, int], Array]]:
    keys = [(int(frame), int(number)) for frame, number in zip(columns["fid"], columns["wid"], strict=True)]
    labels = {key: int(label) for key, label in zip(keys, columns["label"], strict=True)} if "label" in columns else {}
    if not {"follicle_x", "follicle_y"} <= set(columns):
        return labels, {}
    places = np.stack([columns["follicle_x"], columns["follicle_y"]], axis=1)
    return labels, {key: place for key, place in zip(keys, places, strict=True) if np.isfinite(place).all()}


def _read_whiskiwrap(
    path: str | os.PathLike[str],
) -> tuple[Segments, dict[tuple[int, int], int], dict[tuple[int, int], Array]]:
    with open_hdf5(path, "HDF5 file of WhiskiWrap") as file:
        if missing := [name for name in ("summary", "pixels_x", "pixels_y") if name not in file]:
            raise DataError(f"{brief(os.fspath(path))} is no file of WhiskiWrap: {missing[0]!r} is missing.")
        arrays = {name: cast("Any", file[name])[()] for name in ("summary", "pixels_x", "pixels_y")}
        summary = arrays["summary"]
        # Older files call frame, number and follicle otherwise.
        renamed = {"time": "fid", "id": "wid", "fol_x": "follicle_x", "fol_y": "follicle_y"}
        columns = {str(renamed.get(name, name)): summary[name].astype(float) for name in summary.dtype.names or ()}
        if not {"fid", "wid"} <= set(columns):
            raise DataError(f"The summary of {brief(os.fspath(path))} has no frame and no number of each trace.")
        pairs = zip(arrays["pixels_x"], arrays["pixels_y"], strict=True)
        points = [np.stack([np.asarray(x, dtype=float), np.asarray(y, dtype=float)], axis=1) for x, y in pairs]
    keys = [(int(frame), int(number)) for frame, number in zip(columns["fid"], columns["wid"], strict=True)]
    return dict(zip(keys, points, strict=True)), *_identities(columns)


def _stack(traces: Mapping[int, Array], frames: NDArray[np.int_], follicles: Mapping[int, Array], most: int) -> Array:
    """Return points [n, k, 2] of traces in frames [n], base first, NaN behind the last.

    Frames that have no trace are NaN. Traces with more than ``most`` points lose some of
    them evenly: neighbours of a trace share the noise of their pixels, and more points would tell no more.
    """
    oriented = _orient({frame: traces[frame] for frame in sorted(traces)}, follicles)
    points = np.full((len(frames), min(most, max(len(one) for one in traces.values())), 2), np.nan)
    for frame, trace in oriented.items():
        picked = np.unique(np.linspace(0, len(trace) - 1, min(len(trace), most)).round().astype(int))
        points[frame - frames[0], : len(picked)] = trace[picked]
    return points


def _orient(traces: Mapping[int, Array], follicles: Mapping[int, Array]) -> dict[int, Array]:
    """Return the traces with their base first: the end nearer to the follicle where that is known.

    Else ends are followed from frame to frame, and the base is the one that moves less.
    """
    oriented: dict[int, Array] = {}
    unknown: list[int] = []
    before: Array | None = None
    for frame, trace in traces.items():
        if frame in follicles:
            near = np.linalg.norm(trace[[0, -1]] - follicles[frame], axis=1)
            trace = trace if near[0] <= near[1] else trace[::-1]
        else:
            unknown.append(frame)
            if before is not None:
                same = np.linalg.norm(trace[0] - before[0]) + np.linalg.norm(trace[-1] - before[-1])
                swapped = np.linalg.norm(trace[-1] - before[0]) + np.linalg.norm(trace[0] - before[-1])
                trace = trace if same <= swapped else trace[::-1]
        oriented[frame] = before = trace
    if len(unknown) == len(oriented):
        ends = np.array([[trace[0], trace[-1]] for trace in oriented.values()])
        moved = ends.std(axis=0).sum(axis=1)
        if moved[0] > moved[1]:
            oriented = {frame: trace[::-1] for frame, trace in oriented.items()}
    return oriented
