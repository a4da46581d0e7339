"""Points of DeepLabCut (Mathis et al. 2018, Nat. Neurosci. 21, 1281): the CSV and HDF5 tables of analysed videos.

Three lines of names (scorer, bodyparts, coords; four with individuals) stand above x, y and likelihood of each body
part. Points below the least likelihood are missing. HDF5 tables of pandas keep their names as a pickle; it is taken
apart word by word and never loaded.
"""

from __future__ import annotations

import os
import pickletools
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, check_each, choose_name, shown
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.tables import read_rows, to_numbers
from brainbench.stimuli.fitting.tracks.options import TrackOptions

Array = NDArray[np.float64]
Columns = dict[tuple[str, str, str], Array]
"""[n] of each individual ("" without), body part and coordinate."""


def read_deeplabcut(path: str | os.PathLike[str], options: TrackOptions) -> tuple[NDArray[np.int_], Array]:
    """Return frame numbers [n] and points [n, k, 2 or 3] (pixels) of one whisker."""
    name = shown(os.fspath(path))
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
        raise DataError(f"{shown(os.fspath(path))} is no {kind}: its first lines are not scorer, bodyparts and coords.")
    if len({len(row) for row in heads.values()} | {len(rows[0]) - 1}) > 1:
        raise DataError(f"{shown(os.fspath(path))} is no {kind}: its lines of names differ in length.")
    body = rows[len(heads) :]
    if not body:
        raise DataError(f"{shown(os.fspath(path))} holds no frame.")
    table = to_numbers(body, path, kind, first=len(heads) + 1, columns=len(rows[0]), gaps=True)
    individuals = heads.get("individuals", [""] * len(heads["bodyparts"]))
    names = zip(individuals, heads["bodyparts"], heads["coords"], strict=True)
    return frame_numbers(table[:, 0], path), {key: table[:, 1 + index] for index, key in enumerate(names)}


def _read_hdf5(path: str | os.PathLike[str]) -> tuple[NDArray[np.int_], Columns]:
    with open_hdf5(path, "table of DeepLabCut") as file:
        groups = pandas_groups(file)
        if not groups:
            raise DataError(f"{shown(os.fspath(path))} is no table of DeepLabCut: it holds no pandas table.")
        group: Any = groups[0]
        if "table" in group:
            table = group["table"]
            rows = table[()]
            names = pickled_names(bytes(table.attrs["values_block_0_kind"]), shown(os.fspath(path)))
            index, values = rows["index"].astype(float), rows["values_block_0"].astype(float)
        else:
            index, values = group["axis1"][()].astype(float), group["block0_values"][()].astype(float)
            levels = int(group.attrs["block0_items_nlevels"])
            words = [
                [group[f"block0_items_level{level}"][code].decode() for code in group[f"block0_items_label{level}"][()]]
                for level in range(levels)
            ]
            names = list(zip(*words, strict=True))
    if len(names) != values.shape[1]:
        raise DataError(f"{shown(os.fspath(path))} has {len(names)} names of columns and {values.shape[1]} columns.")
    # The first level is the scorer; before the last two there may be individuals.
    keys = [(name[1] if len(name) == 4 else "", name[-2], name[-1]) for name in names]
    return frame_numbers(index, path), {key: values[:, column] for column, key in enumerate(keys)}


def pandas_groups(file: Any) -> list[Any]:
    """Return the groups of an HDF5 file that hold a table of pandas."""
    return [item for item in file.values() if hasattr(item, "keys") and ("table" in item or "block0_values" in item)]


def frame_numbers(values: Array, path: str | os.PathLike[str]) -> NDArray[np.int_]:
    """Return frame numbers [n] as integers; others are a :class:`DataError`."""
    if not np.isfinite(values).all() or (values % 1).any():
        raise DataError(f"The frame numbers of {shown(os.fspath(path))} are not whole numbers.")
    return values.astype(int)


def pickled_names(data: bytes, name: str) -> list[tuple[str, ...]]:  # noqa: PLR0912 — a branch for each word
    """Return the list of tuples of texts that a pickle spells out, without loading it."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    mark = object()

    def above_mark() -> list[Any]:
        place = len(stack) - 1 - stack[::-1].index(mark)
        taken = stack[place + 1 :]
        del stack[place:]
        return taken

    try:
        for code, argument, _ in pickletools.genops(data):
            match code.name:
                case "PROTO" | "FRAME" | "STOP":
                    pass
                case "UNICODE" | "BINUNICODE" | "SHORT_BINUNICODE":
                    stack.append(argument)
                case "MARK":
                    stack.append(mark)
                case "LIST":
                    stack.append(above_mark())
                case "TUPLE":
                    stack.append(tuple(above_mark()))
                case "EMPTY_LIST":
                    stack.append([])
                case "TUPLE1" | "TUPLE2" | "TUPLE3":
                    count = int(code.name[-1])
                    stack[-count:] = [tuple(stack[-count:])]
                case "APPEND":
                    item = stack.pop()
                    stack[-1].append(item)
                case "APPENDS":
                    items = above_mark()
                    stack[-1].extend(items)
                case "PUT" | "BINPUT" | "LONG_BINPUT":
                    memo[int(argument or 0)] = stack[-1]
                case "MEMOIZE":
                    memo[len(memo)] = stack[-1]
                case "GET" | "BINGET" | "LONG_BINGET":
                    stack.append(memo[int(argument or 0)])
                case other:
                    raise DataError(f"The names of the columns of {name} are not plain texts ({other}).")
    except (ValueError, IndexError, KeyError, AttributeError) as error:
        raise DataError(f"The names of the columns of {name} cannot be read ({error}).") from error
    if len(stack) != 1 or not all(
        isinstance(row, tuple) and len(row) in (3, 4) and all(isinstance(word, str) for word in row) for row in stack[0]
    ):
        raise DataError(f"The columns of {name} are not named by scorer, body part and coordinate.")
    return stack[0]
