"""Arrays of the published ``.npz`` recordings: read without pickle, and checked."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, listing

STRAY = "allow_pickle"
"""Entry without meaning: numpy before 2.2 stored this keyword of ``savez`` as an array."""
SLOTS = tuple(f"slot-{number}" for number in range(1, 7))
"""Places along axis 1, in the order of the file."""


def read_arrays(path: Path) -> dict[str, NDArray[np.float64]]:
    """Return rates [trials, 6, units] by animal, as the file holds them: zeros kept, padded with NaN.

    Raises:
        DataError: the file is no ``.npz`` of plain arrays, holds something else, or rates that cannot be.
    """
    arrays = _plain_arrays(path)
    if {"data", "label"} <= arrays.keys():
        raise DataError(
            f"{path} is a whisker sweep (arrays {listing(sorted(arrays))}), not recordings of neurons; a "
            "folder of sweeps is what `brainbench train MODEL --data FOLDER` takes."
        )
    if {"r_xy", "r_yy"} <= arrays.keys():
        raise DataError(
            f"{path} holds split halves of a score, not recordings; try `brainbench score {path} --explain-estimator`."
        )
    animals = {name: array for name, array in arrays.items() if not _is_stray(name, array)}
    if not animals:
        raise DataError(f"{path} holds no animal: expected one array [trials, {len(SLOTS)}, units] for each.")
    for name, array in animals.items():
        _check_rates(f"The array {name!r} of {path}", array)
    return {name: array.astype(np.float64) for name, array in animals.items()}


def has_stray_entry(path: Path) -> bool:
    """Return whether a file holds the entry :data:`STRAY`."""
    return any(_is_stray(name, array) for name, array in _plain_arrays(path).items())


def _is_stray(name: str, array: NDArray[np.generic]) -> bool:
    return name == STRAY and array.ndim == 0


def _plain_arrays(path: Path) -> dict[str, NDArray[np.generic]]:
    if not zipfile.is_zipfile(path):
        with path.open("rb") as stream:
            head = stream.read(2)
        why = (
            "it is empty" if not head else "it is truncated; copy it again" if head == b"PK" else "it is no zip archive"
        )
        raise DataError(f"{path} is not an .npz file: {why}.")
    name = "?"
    found: dict[str, NDArray[np.generic]] = {}
    try:
        # Without pickle: a file from elsewhere must not run code.
        with np.load(path, allow_pickle=False) as stored:
            for name in stored.files:
                found[name] = np.asarray(stored[name])
    except (OSError, ValueError, EOFError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        objects = "Python objects, which are never loaded (they could run code)"
        why = objects if "allow_pickle" in str(error) else f"damaged ({error})"
        raise DataError(f"The entry {name!r} of {path} is {why}; expected rates [trials, 6, units].") from error
    return found


def _check_rates(what: str, array: NDArray[Any]) -> None:
    if array.dtype.kind not in "fiu":
        raise DataError(f"{what} holds {array.dtype}, not numbers; expected rates [trials, {len(SLOTS)}, units].")
    if array.ndim != 3 or array.shape[1] != len(SLOTS) or not array.size:
        raise DataError(
            f"{what} has shape {list(array.shape)}; expected rates [trials, {len(SLOTS)}, units] with "
            f"{len(SLOTS)} stimuli on axis 1."
        )
    missing = np.isnan(array)
    if missing.all():
        raise DataError(f"{what} holds no rate: every value is NaN; leave this animal out.")
    infinite = bool(np.isinf(array).any())
    if infinite or bool(np.any(array[~missing] < 0)):
        bad = "infinite" if infinite else "negative"
        raise DataError(f"{what} holds {bad} rates; rates are finite and at least 0 spikes/s.")
    gone: NDArray[np.bool_] = np.asarray(missing.all(axis=1))
    if np.any(gone[:-1] & ~gone[1:]) or np.any(gone[0]):
        raise DataError(f"{what} has trials of NaN inside a session; they may only pad a unit's trials at the end.")
    several = np.argwhere((array > 0).sum(axis=1) > 1)
    if len(several):
        trial, unit = several[0]
        raise DataError(
            f"{what} has rates in several slots of one trial (trial {trial}, unit {unit}); a trial has one stimulus "
            "and zeros in the other slots."
        )
