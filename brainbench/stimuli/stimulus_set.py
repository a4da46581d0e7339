"""Stimulus sets: files (HDF5, written atomically, read with their hash checked), the network's grid, other axes.

The package has sets of some recipes as its own engine gave them, found without building their scenes, so that a first
score neither compiles nor simulates (``python -m tests.stimuli.test_stimulus_set`` writes them). The errors of their
whiskers stand beside them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS, GRID_SHAPE, check_stimulus_set
from brainbench.core.errors import DataError, UsageError, check_name, listing
from brainbench.core.files import content_hash, create_hdf5, file_hash, read_json, to_json
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.version import __version__
from brainbench.stimuli.engines import PHYSICS_VERSION
from brainbench.stimuli.engines.error_estimates import remark_on
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE, Fidelity
from brainbench.stimuli.scenes.recipes import describe_recipe, recipe_file
from brainbench.stimuli.scenes.scene import Axes
from brainbench.stimuli.whiskers.array import ROWS

if TYPE_CHECKING:
    import h5py
    import xarray as xr
    from xarray.backends import H5NetCDFStore

    from brainbench.stimuli.scenes.scene import Frames

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
    coordinates = {
        "stimulus": ("stimulus", np.array(labels, dtype=object)),
        "time": ("time", frames.times, {"units": "s"}),
        "whisker": ("whisker", np.array(names, dtype=object)),
        "row": ("whisker", np.array(rows)),
        "col": ("whisker", np.array(cols)),
        "side": ("whisker", np.array(sides, dtype=object)),
        "channel": ("channel", np.array(CHANNELS, dtype=object)),
    }
    # Arrays they are already: to see whether they are dask's xarray would import it, for a tenth of a short command.
    arrays = {name: xr.Variable(*parts, fastpath=True) for name, parts in {**variables, **coordinates}.items()}
    return xr.Dataset(
        arrays,
        attrs={
            **attributes,
            # Nothing random is drawn, or what was drawn elsewhere is not known; the contract asks for the field.
            "seed": 0,
            "version": __version__,
            "frame": f"{frames.axes} axes; action of the whisker on its base, about the base point",
            "axes": frames.axes,
            "readout": frames.describe(),
        },
    ).set_coords([*coordinates])


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
    with create_hdf5(path) as file, _netcdf(file, "a") as store:
        check_stimulus_set(dataset).dump_to_store(store)
    return Path(path)


def read_stimulus_set(path: str | os.PathLike[str]) -> xr.Dataset:
    """Read a stimulus set into memory."""
    import xarray as xr

    name = os.fspath(path)
    with open_hdf5(path, "stimulus set") as file, xr.open_dataset(_netcdf(file, "r")) as stored:
        dataset = check_stimulus_set(stored.load())
        to_json(dataset.attrs).encode()  # bytes that are no text would end whatever shows them
        same = hash_stimulus_set(dataset) == dataset.attrs["content_hash"]
    dataset.encoding["source"] = name
    if not same:
        raise DataError(
            f"The numbers in {name!r} do not match the content hash in the file: it was damaged or edited;"
            " simulate the stimuli again, or set content_hash and config_hash anew, both to"
            " brainbench.stimuli.stimulus_set.hash_stimulus_set."
        )
    return dataset


def _netcdf(file: h5py.File, mode: str) -> H5NetCDFStore:
    """Return an open file as xarray reads and writes it."""
    import h5netcdf
    from xarray.backends import H5NetCDFStore

    return H5NetCDFStore(h5netcdf.File(file, mode, decode_vlen_strings=True))


ORIENTATION = "orientation"
"""Variable [stimulus, time, whisker, 3, 3] with the rotations from the follicle's axes to the world."""


def to_grid(
    dataset: xr.Dataset, *, substeps: int = 5, unstable: Literal["error", "zero"] = "error"
) -> NDArray[np.float32]:
    """Return the network's input [K, T, S·C, H, W] in SI units (N, N·m).

    Frame t·S + s, channel c of the whisker at (row, col) goes to [k, t, s·6 + c, row, col] (sub-step
    major). Cells without a whisker and whiskers that were not simulated are zero. 110 frames in
    sub-steps of 5 give [K, 22, 30, 5, 7].

    Args:
        dataset: stimulus set with whiskers of one side of one animal.
        substeps: frames S that make one time step.
        unstable: what to do with whiskers whose simulation became unstable (their numbers are NaN):
            refuse, or read them as zero.
    """
    check_stimulus_set(dataset)
    stimuli, frames, whiskers, channels = dataset["wrench"].shape
    if substeps < 1 or frames % substeps:
        raise UsageError(f"{frames} frames do not divide into time steps of {substeps} sub-steps.")
    rows, cols = dataset["row"].values.astype(int), dataset["col"].values.astype(int)
    cells = rows * GRID_SHAPE[1] + cols
    animals = dict.fromkeys(name.partition(":")[0] for name in map(str, dataset["whisker"].values) if ":" in name)
    if len(animals) > 1:
        raise UsageError(
            f"The stimulus set has {len(animals)} animals and a grid holds one; select its whiskers first: "
            f"{' or '.join(repr(f'{animal}:*') for animal in animals)}."
        )
    if len(set(cells)) < whiskers:
        raise UsageError("The stimulus set has two whiskers in one cell (both sides); select one side first.")
    wrench = dataset["wrench"].values
    if not np.isfinite(wrench).all():
        if unstable != "zero":
            raise DataError(_describe_gaps(dataset))
        wrench = np.nan_to_num(wrench, nan=0.0, posinf=0.0, neginf=0.0)
    grid = np.zeros((stimuli, frames, channels, GRID_SHAPE[0] * GRID_SHAPE[1]), dtype=np.float32)
    # Frames before channels: cutting the frame axis by S then gives channels in the order s·6 + c.
    grid[..., cells] = np.swapaxes(wrench, 2, 3)
    return grid.reshape(stimuli, frames // substeps, substeps * channels, *GRID_SHAPE)


def to_axes(dataset: xr.Dataset, axes: Axes) -> xr.Dataset:
    """Return the stimulus set in ``world`` or in ``follicle`` axes; the same set when it has them already.

    The follicle's pose at each frame must be in the set: it is when the scenes were read with
    ``Frames(axes="follicle")``. Moments stay about the base point. Clipped numbers are turned as they are.
    """
    check_name("axes", axes, get_args(Axes))
    if axes == dataset.attrs.get("axes", "world"):
        return dataset
    if ORIENTATION not in dataset:
        raise UsageError(
            "This stimulus set holds no follicle poses, so its axes cannot be changed; simulate it with "
            "Frames(axes='follicle'), which keeps them."
        )
    rotation = dataset[ORIENTATION].values
    turned = dataset.copy()
    turned["wrench"] = dataset["wrench"].copy(
        data=turn(dataset["wrench"].values, rotation if axes == "world" else np.swapaxes(rotation, -1, -2))
    )
    turned.attrs["axes"] = axes
    turned.attrs["frame"] = f"{axes} axes; action of the whisker on its base, about the base point"
    turned.attrs["config_hash"] = content_hash(dataset.attrs.get("config_hash", ""), axes)
    turned.attrs["content_hash"] = hash_stimulus_set(turned)
    return turned


def turn(wrench: NDArray[np.floating], rotation: NDArray[np.float64]) -> NDArray[np.floating]:
    """Turn forces and moments [..., 6] by the matrices ``rotation`` [..., 3, 3]; keeps the number type."""
    vectors = wrench.reshape(*wrench.shape[:-1], 2, 3)
    return np.einsum("...ij,...kj->...ki", rotation, vectors).reshape(wrench.shape).astype(wrench.dtype)


def _describe_gaps(dataset: xr.Dataset) -> str:
    bad = ~np.isfinite(dataset["wrench"].values).all(axis=(1, 3))
    names = [f"{dataset['whisker'].values[j]} in {dataset['stimulus'].values[i]}" for i, j in np.argwhere(bad)]
    reasons = dataset["reason"].values[bad].tolist() if "reason" in dataset else []
    why = f", the first because {reasons[0]}" if reasons else ": convert runs of WHISKiT with --cleaning published"
    return (
        f"The simulation of {len(names)} whiskers became unstable ({listing(names, limit=4)}){why}, or leave whiskers "
        "out (--whiskers), or read them as zero with to_grid(…, unstable='zero')."
    )


SHIPPED = Path(__file__).with_name("data") / "sets"
"""Folder of the package's own sets. A set has the name that its entry in the cache would have."""
SHIPPED_INDEX = SHIPPED / "index.json"
"""Recipe → name of its set, with the version of the physics and the hash of the scene file that it was made from."""


def shipped_facts(recipe: str) -> dict[str, object]:
    """Return what the package's set of a recipe depends on, as its index states it."""
    return {"physics": PHYSICS_VERSION, "scenes": file_hash(Path(str(recipe_file(recipe))))}


def find_kept(recipe: str, whiskers: str, fidelity: Fidelity, backend: str) -> tuple[Path, str] | None:
    """Return the package's set of a recipe with these options, and its description; None where it holds none."""
    held = read_json(SHIPPED_INDEX).get(recipe, {})
    entry = held.pop("entry", "")
    if (whiskers, fidelity, backend) != ("all", Fidelity.of(None), DEFAULT_ENGINE) or held != shipped_facts(recipe):
        return None
    return SHIPPED / entry, describe_recipe(recipe).strip()


def find_entry(path: Path) -> Path | None:
    """Return the file of an entry of the cache: the package's own, which is equal on every machine, goes first."""
    return next((file for file in (SHIPPED / path.name, path) if file.is_file()), None)


def error_file(path: Path) -> Path:
    """Return the file beside a set with the ``error`` and ``damping`` [stimulus, whisker] of its whiskers."""
    return path.with_suffix(".errors.json")


def with_kept_errors(dataset: xr.Dataset, path: Path) -> xr.Dataset:
    """Return a set with the errors that stand beside its file; as it is without any."""
    if not error_file(path).is_file():
        return dataset
    held = {name: np.array(values, dtype=np.float32) for name, values in read_json(error_file(path)).items()}
    remarks = np.vectorize(remark_on, otypes=[object])(held["error"])
    return dataset.assign(
        {name: (("stimulus", "whisker"), values) for name, values in {**held, "remark": remarks}.items()}
    )
