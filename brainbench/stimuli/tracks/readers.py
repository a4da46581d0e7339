"""Read traced shapes of any tracker: the kind of table is seen from the file, or named.

Of Janelia's whisk (Clack et al. 2012, PLoS Comput. Biol. 8, e1002591) ``.whiskers`` files are read, binary
(``bwhiskbin1``) and text (``whisker1``), and the HDF5 files that WhiskiWrap makes of them (``summary`` with
``pixels_x`` and ``pixels_y``). Which trace of a frame is which whisker stands in the measurements, read as the CSV
table (columns ``fid``, ``wid``, ``label`` and perhaps ``follicle_x``, ``follicle_y``) that whisk's Python and MATLAB
interfaces export; binary ``.measurements`` files are not read.
"""

from __future__ import annotations

import math
import os
import pickletools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, brief, check_each, choose_name, listing
from brainbench.core.limits import Limit, Share, limited
from brainbench.core.reading.apart import read_apart
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.regular import MOST_TABLE, MOST_TEXT, check_file, readable
from brainbench.core.reading.tables import read_columns, read_rows, to_numbers
from brainbench.stimuli.tracks.contract import check_track, every_frame, new_shapes, real_numbers

Array = NDArray[np.float64]
Segments = dict[tuple[int, int], Array]  # points [k, 2] (pixels) of each trace by frame and number within the frame
Identities = tuple[dict[tuple[int, int], int], dict[tuple[int, int], Array]]  # label and follicle (pixels) of each
_HEADER = b"bwhiskbin1\0\0"
_MOST_POINTS = 100_000


@limited
class TrackOptions:
    """Scale, frame rate and identity of a track; a value that cannot be is a :class:`UsageError`."""

    metres_per_pixel: Annotated[float, Limit(least=1e-8, most=1e-2, unit="m")] | None = None
    """Length of a pixel (or of the unit of the file) in m."""
    frame_rate: Annotated[float, Limit(least=10, most=1e6, unit="frames per second")] | None = None
    """Frames per second of the video (Hz)."""
    track: str | None = None
    """Which whisker of the file: a label of whisk, a number of WhiskerMan (from 1), or an individual of DeepLabCut."""
    layout: Literal["auto", "deeplabcut", "points", "whisk", "whiskerman"] = "auto"
    """Kind of table: auto, deeplabcut, points, whisk or whiskerman."""
    zero_frame: int = 0
    """Frame at which time is 0: the start of the scene, or the release of a plucked whisker."""
    identities: str | None = None
    """Table of whisk's measurements (CSV) that says which trace is which whisker and where its follicle is."""
    parts: tuple[str, ...] = ()
    """Body parts of DeepLabCut from the base to the tip; in the order of the file when empty."""
    least_likelihood: Share = 0.6
    """Likelihood of DeepLabCut from which a point is used."""
    points: Annotated[int, Limit(least=2)] = 30
    """Most points of a frame that are kept of whisk's traces."""
    rows_down: bool = True
    """True for image coordinates, whose y runs down; it is turned, so that left stays left."""

    def __post_init__(self) -> None:
        for name, what in (
            ("metres_per_pixel", "the scale: metres per pixel (5e-5 for 50 µm)"),
            ("frame_rate", "the frames per second of the video"),
        ):
            if getattr(self, name) is None:
                raise UsageError(f"A track holds pixels and frame numbers; give {what} as {name}.")


def _need(wanted: tuple[str, ...], held: Iterable[str], path: str | os.PathLike[str], kind: str) -> None:
    names = list(held)
    if missing := [name for name in wanted if name not in names]:
        raise DataError(f"{brief(os.fspath(path))} is no {kind}: {missing[0]!r} is missing; it holds {listing(names)}.")


def _columns(path: str | os.PathLike[str], kind: str, wanted: tuple[str, ...]) -> dict[str, Array]:
    """Return the columns [n] of a table by name."""
    names, table = read_columns(path, kind, gaps=True)
    _need(wanted, names, path, kind)
    return dict(zip(names, table.T, strict=True))


def read_whisk(path: str | os.PathLike[str], options: TrackOptions) -> tuple[NDArray[np.int_], Array]:
    """Return frame numbers [n] and points [n, k, 2] (pixels) of one whisker."""
    name = brief(os.fspath(path))
    if Path(path).suffix in (".h5", ".hdf5"):
        segments, (labels, follicles) = _read_whiskiwrap(path)
    else:
        segments, labels, follicles = _read_segments(path), {}, {}
    if options.identities is not None:
        columns = _columns(options.identities, "table of whisk's measurements", ("fid", "wid", "label"))
        labels, follicles = _identities(columns, options.identities)
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


def _keys(columns: Mapping[str, Array], path: str | os.PathLike[str]) -> list[tuple[int, int]]:
    """Return frame and number of each trace."""
    return list(zip(*(frame_numbers(columns[name], path).tolist() for name in ("fid", "wid")), strict=True))


def _identities(columns: dict[str, Array], path: str | os.PathLike[str]) -> Identities:
    keys = _keys(columns, path)
    labels: dict[tuple[int, int], int] = {}
    if "label" in columns:
        labels = dict(zip(keys, frame_numbers(columns["label"], path).tolist(), strict=True))
    if not {"follicle_x", "follicle_y"} <= set(columns):
        return labels, {}
    places = np.stack([columns["follicle_x"], columns["follicle_y"]], axis=1)
    return labels, {key: place for key, place in zip(keys, places, strict=True) if np.isfinite(place).all()}


def _read_whiskiwrap(path: str | os.PathLike[str]) -> tuple[Segments, Identities]:
    with open_hdf5(path, "HDF5 file of WhiskiWrap") as file:
        parts = ("summary", "pixels_x", "pixels_y")
        _need(parts, file, path, "file of WhiskiWrap")
        arrays = {name: cast("Any", file[name])[()] for name in parts}
        summary = arrays["summary"]
        if {arrays[name].shape[:1] for name in arrays} != {summary.shape}:
            raise DataError(f"{brief(os.fspath(path))} needs one row of summary, pixels_x, pixels_y for each trace.")
        # Older files call frame, number and follicle otherwise.
        renamed = {"time": "fid", "id": "wid", "fol_x": "follicle_x", "fol_y": "follicle_y"}
        columns = {str(renamed.get(name, name)): real_numbers(summary[name]) for name in summary.dtype.names or ()}
        _need(("fid", "wid"), columns, path, "file of WhiskiWrap")
        pairs = zip(arrays["pixels_x"], arrays["pixels_y"], strict=True)
        points = [np.stack([real_numbers(x), real_numbers(y)], axis=1) for x, y in pairs]
    return dict(zip(_keys(columns, path), points, strict=True)), _identities(columns, path)


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


Columns = dict[tuple[str, str, str], Array]
"""[n] of each individual ("" without), body part and coordinate."""


# Points of DeepLabCut (Mathis et al. 2018, Nat. Neurosci. 21, 1281): the CSV and HDF5 tables of analysed videos. Three
# lines of names (scorer, bodyparts, coords; four with individuals) stand above x, y and likelihood of each body part.
# HDF5 tables of pandas keep their names as a pickle; it is taken apart word by word and never loaded.
def read_deeplabcut(path: str | os.PathLike[str], options: TrackOptions) -> tuple[NDArray[np.int_], Array]:
    """Return frame numbers [n] and points [n, k, 2 or 3] (pixels) of one whisker."""
    name = brief(os.fspath(path))
    frames, columns = _read_hdf5(path) if Path(path).suffix in (".h5", ".hdf5") else _read_csv(path)
    individuals = list(dict.fromkeys(individual for individual, _, _ in columns))
    wanted = choose_name(f"individual of {name}", options.track, individuals, how="as track")
    parts = list(dict.fromkeys(part for individual, part, _ in columns if individual == wanted))
    check_each(f"body part of {name}", options.parts, parts)
    points = []
    for part in options.parts or parts:
        axes = [axis for axis in ("x", "y", "z") if (wanted, part, axis) in columns]
        if axes[:2] != ["x", "y"]:
            raise DataError(f"The body part {part!r} of {name} has no columns x and y.")
        place = np.stack([columns[wanted, part, axis] for axis in axes], axis=-1)
        likelihood = columns.get((wanted, part, "likelihood"))
        if likelihood is not None:
            place = np.where((likelihood >= options.least_likelihood)[:, None], place, np.nan)
        points.append(place)
    return frames, np.stack(points, axis=1)


def _read_csv(path: str | os.PathLike[str]) -> tuple[NDArray[np.int_], Columns]:
    kind = "table of DeepLabCut"
    rows = read_rows(path, kind)
    heads = {row[0]: row[1:] for row in rows[:4] if row[0] in ("scorer", "individuals", "bodyparts", "coords")}
    if not {"bodyparts", "coords"} <= set(heads):
        raise DataError(f"{brief(os.fspath(path))} is no {kind}: its first lines are not scorer, bodyparts and coords.")
    if len({len(row) for row in heads.values()} | {len(rows[0]) - 1}) > 1:
        raise DataError(f"{brief(os.fspath(path))} is no {kind}: its lines of names differ in length.")
    body = rows[len(heads) :]
    if not body:
        raise DataError(f"{brief(os.fspath(path))} holds no frame.")
    table = to_numbers(body, path, kind, first=len(heads) + 1, columns=len(rows[0]), gaps=True)
    individuals = heads.get("individuals", [""] * len(heads["bodyparts"]))
    names = zip(individuals, heads["bodyparts"], heads["coords"], strict=True)
    return frame_numbers(table[:, 0], path), {key: table[:, 1 + index] for index, key in enumerate(names)}


def _read_hdf5(path: str | os.PathLike[str]) -> tuple[NDArray[np.int_], Columns]:
    with open_hdf5(path, "table of DeepLabCut") as file:
        groups = pandas_groups(file)
        if not groups:
            raise DataError(f"{brief(os.fspath(path))} is no table of DeepLabCut: it holds no pandas table.")
        group: Any = groups[0]
        if "table" in group:
            table = group["table"]
            rows = table[()]
            names = pickled_names(bytes(table.attrs["values_block_0_kind"]), brief(os.fspath(path)))
            index, values = real_numbers(rows["index"]), real_numbers(rows["values_block_0"])
        else:
            index, values = real_numbers(group["axis1"][()]), real_numbers(group["block0_values"][()])
            levels = int(group.attrs["block0_items_nlevels"])
            words = [
                [group[f"block0_items_level{level}"][code].decode() for code in group[f"block0_items_label{level}"][()]]
                for level in range(levels)
            ]
            names = list(zip(*words, strict=True))
    if len(names) != values.shape[1]:
        raise DataError(f"{brief(os.fspath(path))} has {len(names)} names of columns and {values.shape[1]} columns.")
    # The first level is the scorer; before the last two there may be individuals.
    keys = [(name[1] if len(name) == 4 else "", name[-2], name[-1]) for name in names]
    return frame_numbers(index, path), {key: values[:, column] for column, key in enumerate(keys)}


def pandas_groups(file: Any) -> list[Any]:
    """Return the groups of an HDF5 file that hold a table of pandas."""
    return [item for item in file.values() if hasattr(item, "keys") and ("table" in item or "block0_values" in item)]


def frame_numbers(values: Array, path: str | os.PathLike[str]) -> NDArray[np.int_]:
    """Return frame numbers [n] as integers; others are a :class:`DataError`."""
    if not (np.abs(values) < 2**53).all() or (values % 1).any():
        raise DataError(f"The numbers of frames or traces of {brief(os.fspath(path))} are not whole numbers.")
    return values.astype(int)


def pickled_names(data: bytes, name: str) -> list[tuple[str, ...]]:
    """Return the list of tuples of texts that a pickle spells out, without loading it."""
    rows: list[tuple[str, ...]] = []
    texts: list[str] = []
    memo: dict[int, str | None] = {}
    try:
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name in ("UNICODE", "BINUNICODE", "SHORT_BINUNICODE"):
                texts.append(argument)  # pyright: ignore[reportArgumentType] # checked above
            elif opcode.name in ("GET", "BINGET", "LONG_BINGET"):
                texts.append(memo[int(argument or 0)] or "")
            elif opcode.name in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
                # What is put away is the last text, or else a list or a tuple, which no name asks for again.
                memo[len(memo) if opcode.name == "MEMOIZE" else int(argument or 0)] = texts[-1] if texts else None
            elif opcode.name in ("TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"):
                rows.append(tuple(texts))
                texts = []
            elif opcode.name not in ("PROTO", "FRAME", "STOP", "MARK", "LIST", "EMPTY_LIST", "APPEND", "APPENDS"):
                raise DataError(f"The names of the columns of {name} are not plain texts ({opcode.name}).")
    except (ValueError, KeyError) as error:
        raise DataError(f"The names of the columns of {name} cannot be read ({error}).") from error
    if texts or not rows or not all(len(row) in (3, 4) and all(row) for row in rows):
        raise DataError(f"The columns of {name} are not named by scorer, body part and coordinate.")
    return rows


# Tracks of WhiskerMan (Petersen et al. 2020, PLoS Comput. Biol. 16, e1007402): .tr4, .tr4_2D and .mat. The struct array
# "whisker" holds, for each whisker, the control points of a Bézier curve in every frame, whether it was tracked, and
# its follicle (pixels). Read are MATLAB's formats up to 7, and 7.3, which is HDF5. As many points are taken of a curve
# as it has control points: more would repeat the same numbers.
_STRUCT_FIELDS = ("r3all", "tracked", "fp3_all")


def read_whiskerman(path: str | os.PathLike[str], options: TrackOptions) -> tuple[NDArray[np.int_], Array]:
    """Return frame numbers [n] and points [n, k, 2 or 3] (pixels) of one whisker."""
    name = brief(os.fspath(path))
    whiskers = _read_structs(path)
    if not whiskers:
        raise DataError(f"{name} holds no whisker.")
    numbers = [str(number) for number in range(1, len(whiskers) + 1)]
    wanted = choose_name(f"whisker of {name}", options.track, numbers, how="as track")
    fields = whiskers[int(wanted) - 1]
    control = real_numbers(fields["r3all"])
    if control.ndim != 3 or control.shape[1] != 3:
        raise DataError(f"'r3all' of {name} has the shape {control.shape}; [frame, 3, control point] is needed.")
    tracked = np.asarray(fields["tracked"], dtype=bool).ravel()
    if len(tracked) != len(control) or not tracked.any():
        raise DataError(f"{name} has no tracked frame of whisker {wanted}.")
    # Without a second view there is no third axis.
    axes = 3 if np.nan_to_num(control[tracked, 2]).any() else 2
    points = bezier(control, control.shape[2])[..., :axes]
    follicle = real_numbers(fields["fp3_all"]).reshape(len(control), -1)[:, :axes]
    far = np.linalg.norm(points[:, [0, -1]] - follicle[:, None], axis=-1)
    backward = far[:, 1] < far[:, 0]
    points[backward] = points[backward, ::-1]
    points[~tracked] = np.nan
    frames = np.flatnonzero(tracked)
    span = slice(frames[0], frames[-1] + 1)
    return np.arange(len(control))[span], points[span]


def bezier(control: Array, count: int) -> Array:
    """Return points [n, count, 3] evenly spaced in the parameter of Bézier curves of control points [n, 3, c]."""
    degree = control.shape[2] - 1
    t = np.linspace(0, 1, count)
    weights = np.stack([math.comb(degree, i) * t**i * (1 - t) ** (degree - i) for i in range(degree + 1)], axis=1)
    return np.einsum("nac,kc->nka", control, weights)


def _read_structs(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    file = check_file(path, "track of WhiskerMan", most=4 * MOST_TABLE)
    with file.open("rb") as stream:
        head = stream.read(520)
    if b"\x89HDF\r\n" in head:  # MATLAB 7.3
        return _structs_of_hdf5(path)
    arrays = read_apart(f"{__name__}:matlab_arrays", path, "track of WhiskerMan (MATLAB file)")
    return [{name: arrays[f"{name}{place}"] for name in _STRUCT_FIELDS} for place in range(len(arrays) // 3)]


def matlab_arrays(path: str) -> dict[str, Array]:
    """Return the numbers of WhiskerMan's structs in a MATLAB file up to version 7, by field and place.

    SciPy's compiled reader crashes on some damaged files: :func:`~brainbench.core.reading.apart.read_apart` calls this.
    """
    from scipy.io import loadmat

    data = loadmat(path, variable_names=["whisker"], struct_as_record=True, appendmat=False)
    if "whisker" not in data or data["whisker"].dtype.names is None:
        raise DataError(f"{brief(path)} is no track of WhiskerMan: the struct 'whisker' is missing.")
    _need(_STRUCT_FIELDS, data["whisker"].dtype.names, path, "track of WhiskerMan")
    structs = enumerate(data["whisker"].ravel())
    return {f"{name}{place}": real_numbers(one[name]) for place, one in structs for name in _STRUCT_FIELDS}


def _structs_of_hdf5(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    import h5py

    with open_hdf5(path, "track of WhiskerMan") as file:
        group = file.get("whisker")
        if not isinstance(group, h5py.Group):
            raise DataError(f"{brief(os.fspath(path))} is no track of WhiskerMan: the struct 'whisker' is missing.")
        _need(_STRUCT_FIELDS, group, path, "track of WhiskerMan")
        columns: dict[str, list[Any]] = {}
        for name in _STRUCT_FIELDS:
            dataset: Any = group[name]
            # A struct array of several elements stores references; MATLAB's axes stand in reverse order.
            cells: list[Any] = (
                [file[one] for one in dataset[()].ravel()] if dataset.dtype == h5py.ref_dtype else [dataset]
            )
            columns[name] = [np.asarray(cell[()]).T for cell in cells]
    counts = {len(cells) for cells in columns.values()}
    if len(counts) > 1:
        raise DataError(f"The fields of 'whisker' in {brief(os.fspath(path))} differ in length.")
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


_LAYOUTS = {".whiskers": "whisk", **dict.fromkeys((".tr4", ".tr4_2d", ".mat"), "whiskerman")}
"""Layout by the ending of the file."""
_SEVERAL = (".csv", ".h5", ".hdf5")  # endings of several layouts, and of wrenches


def read_shapes(path: str | os.PathLike[str], options: TrackOptions):  # noqa: ANN201 — xarray is imported late
    """Read the traced shapes of one whisker over time.

    Args:
        path: a track of DeepLabCut (``.csv``, ``.h5``), whisk (``.whiskers``, ``.hdf5`` of WhiskiWrap), WhiskerMan
            (``.tr4``, ``.mat``), or a table of points (``.csv`` with the columns frame, x, y, and perhaps z and
            whisker; points of a frame in order from the base).
        options: scale, frame rate, and which whisker.

    Returns:
        The data set of :mod:`brainbench.stimuli.tracks.contract`; its attributes ``faults`` say, a sentence
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
    suffix, name = Path(path).suffix.lower(), brief(os.fspath(path))
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
    columns = _columns(path, "table of points", ("frame", "x", "y"))
    if "whisker" in columns:
        present = [f"{one:g}" for one in np.unique(columns["whisker"])]
        wanted = choose_name(f"whisker of {brief(os.fspath(path))}", options.track, present, how="as track")
        columns = {name: values[columns["whisker"] == float(wanted)] for name, values in columns.items()}
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
