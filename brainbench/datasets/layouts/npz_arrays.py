"""Arrays of the published ``.npz`` recordings, checked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, listing
from brainbench.core.reading.archives import read_npz

STRAY = "allow_pickle"
"""Entry without meaning: numpy before 2.2 stored this keyword of ``savez`` as an array."""
SLOTS = tuple(f"slot-{number}" for number in range(1, 7))
"""Places along axis 1, in the order of the file."""
MOST_RATE = 1e6
"""Spikes per second beyond those of any neuron, even in the shortest window."""
RATES = f"rates [trials, {len(SLOTS)}, units]"


def read_arrays(path: Path) -> tuple[dict[str, NDArray[np.float64]], bool]:
    """Return rates [trials, 6, units] by animal, as the file holds them, and whether :data:`STRAY` is there.

    Raises:
        DataError: the file is no ``.npz`` of plain arrays, holds something else, or rates that cannot be.
    """
    arrays = read_npz(path, "file of published recordings (.npz)")
    if {"data", "label"} <= arrays.keys():
        raise DataError(
            f"{path} is a whisker sweep (arrays {listing(sorted(arrays))}), not recordings of neurons; a "
            "folder of sweeps is what `brainbench train MODEL --data FOLDER` takes."
        )
    if {"r_xy", "r_yy"} <= arrays.keys():
        raise DataError(
            f"{path} holds split halves of a score, not recordings; try `brainbench score {path} --explain-estimator`."
        )
    stray = STRAY in arrays and not arrays[STRAY].ndim
    animals = {name: array for name, array in arrays.items() if not (stray and name == STRAY)}
    if not animals:
        raise DataError(f"{path} holds no animal: expected one array of {RATES} for each.")
    for name, array in animals.items():
        if fault := _fault(array):
            raise DataError(f"The array {name!r} of {path} {fault}.")
    return {name: array.astype(np.float64) for name, array in animals.items()}, stray


def _fault(array: NDArray[Any]) -> str:
    """Return why an array holds no rates; empty where it does."""
    if array.dtype.kind not in "fiu":
        return f"holds {array.dtype}, not numbers; expected {RATES}"
    if array.ndim != 3 or array.shape[1] != len(SLOTS) or not array.size:
        return f"has shape {list(array.shape)}; expected {RATES} with {len(SLOTS)} stimuli on axis 1"
    missing = np.isnan(array)
    gone: NDArray[np.bool_] = np.asarray(missing.all(axis=1))
    if missing.all():
        return "holds no rate: every value is NaN; leave this animal out"
    if (array > MOST_RATE).any() or (array < 0).any():
        return f"holds infinite, negative or impossible rates; rates are 0 to {MOST_RATE:,.0f} spikes/s"
    if np.any(gone[:-1] & ~gone[1:]) or np.any(gone[0]):
        return "has trials of NaN inside a session; they may only pad a unit's trials at the end"
    if len(several := np.argwhere((array > 0).sum(axis=1) > 1)):
        trial, unit = several[0]
        return f"has rates in several slots of one trial (trial {trial}, unit {unit}); the other slots hold zeros"
    return ""
