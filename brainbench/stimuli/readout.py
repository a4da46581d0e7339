"""Views of a stimulus set: the network's input grid, a tidy table, and other axes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import GRID_SHAPE, check_stimulus_set
from brainbench.core.errors import DataError, UsageError, check_name, listing
from brainbench.core.files import content_hash
from brainbench.stimuli.scenes.frames import Axes
from brainbench.stimuli.stimulus_set import hash_stimulus_set

if TYPE_CHECKING:
    import xarray as xr

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
