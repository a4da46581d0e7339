"""Stimulus sets on disk: HDF5 through h5netcdf, written atomically, read with their hash checked."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.contracts import CHANNELS, check_stimulus_set
from brainbench.core.errors import DataError
from brainbench.core.files import atomic_path, content_hash
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.version import __version__
from brainbench.stimuli.whiskers.selection import ROWS

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.stimuli.scenes.frames import Frames

_CELL = re.compile(rf"(?:.*:)?[LR]?([{ROWS}])(\d+)")


def new_stimulus_set(
    labels: Sequence[str],
    whiskers: Sequence[tuple[str, int, int, str]],
    frames: Frames,
    variables: Mapping[str, Any],
    attributes: Mapping[str, Any],
) -> xr.Dataset:
    """Return variables over named stimuli, frames and whiskers (name, row, col, side), not yet hashed or checked."""
    import xarray as xr

    names, rows, cols, sides = zip(*whiskers, strict=True)
    return xr.Dataset(
        dict(variables),
        coords={
            "stimulus": np.array(labels, dtype=object),
            "time": ("time", frames.times, {"units": "s"}),
            "whisker": np.array(names, dtype=object),
            "row": ("whisker", list(rows)),
            "col": ("whisker", list(cols)),
            "side": ("whisker", np.array(sides, dtype=object)),
            "channel": np.array(CHANNELS, dtype=object),
        },
        attrs={
            **attributes,
            # Nothing random is drawn, or what was drawn elsewhere is not known; the contract asks for the field.
            "seed": 0,
            "version": __version__,
            "frame": f"{frames.axes} axes; action of the whisker on its base, about the base point",
            "axes": frames.axes,
            "readout": frames.describe(),
        },
    )


def hash_stimulus_set(dataset: xr.Dataset) -> str:
    """Hash what a stimulus set says: labels, whiskers and cells, times, forces and the configuration behind them."""
    cells = [*zip(dataset["row"].values.tolist(), dataset["col"].values.tolist(), strict=True)]
    matches = [_CELL.fullmatch(str(name)) for name in dataset["whisker"].values]
    # Names that tell their own cells need no word of them, as in sets that were hashed when cells were not.
    places = [cell if of is None else (ROWS.index(of[1]), int(of[2])) for cell, of in zip(cells, matches, strict=True)]
    return content_hash(
        {
            **({} if places == cells else {"cells": cells}),
            "stimulus": [str(label) for label in dataset["stimulus"].values],
            "whisker": [str(name) for name in dataset["whisker"].values],
            **{key: dataset.attrs[key] for key in ("array", "scene", "fidelity", "seed", "backend")},
        },
        dataset["time"].values.astype("<f8"),
        dataset["wrench"].values.astype("<f4"),
    )


def write_stimulus_set(dataset: xr.Dataset, path: str | os.PathLike[str]) -> Path:
    """Write a stimulus set to an HDF5 file (netCDF4 layout), replacing an older one in one step."""
    with atomic_path(path) as temporary:
        check_stimulus_set(dataset).to_netcdf(temporary, engine="h5netcdf")
    return Path(path)


def read_stimulus_set(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a stimulus set into memory."""
    import xarray as xr

    name = os.fspath(path)
    with open_hdf5(path, "stimulus set"), xr.open_dataset(path, engine="h5netcdf") as stored:
        dataset = check_stimulus_set(stored.load())
    if hash_stimulus_set(dataset) != dataset.attrs["content_hash"]:
        raise DataError(
            f"The numbers in {name!r} do not match the content hash in the file: it was damaged or edited;"
            " simulate the stimuli again, or set content_hash and config_hash anew, both to"
            " brainbench.stimuli.stimulus_set.hash_stimulus_set."
        )
    return dataset
