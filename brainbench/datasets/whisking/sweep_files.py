"""Sweep files of the published study: one ``.npz`` per sweep, as its ``process_raw_dataset.py`` writes them.

``data`` [110, 35, 6] in mN and mN·mm = µN·m, Fx … Mz, in world axes: the action of the whisker on its base, as ours.
The 35 cells are the flat 5 × 7 grid, of which 5, 6, 12, 13 and 34 have no whisker; without ``--process_values`` there
are the 30 whiskers alone. ``shape`` is "category/object", ``label`` the number of the class. Sweeps at 1000 Hz hold
``h``, ``d``, ``t`` as texts (mm, mm, degrees), those at 110 Hz ``h``, ``to``, ``t``, ``v``, ``s`` (mm, degrees,
degrees, mm/s, mm).
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.contracts import CHANNELS, GRID_SHAPE
from brainbench.core.errors import DataError
from brainbench.core.reading.archives import read_npz
from brainbench.core.reading.texts import check_values

if TYPE_CHECKING:
    from numpy.typing import NDArray

FRAMES = 110
EMPTY_CELLS = (5, 6, 12, 13, 34)
CELLS = np.setdiff1d(np.arange(GRID_SHAPE[0] * GRID_SHAPE[1]), EMPTY_CELLS)
"""[30] flat cell of each whisker: A0–A4, B0–B4, C0–C6, D0–D6, E0–E5."""
LARGEST = 1000.0
"""Magnitude [mN, µN·m] above which the published cleaning trusts no value."""
SCALE = np.repeat([1e-3, 1e-6], 3)
"""N and N·m per mN and µN·m, by channel."""
RATES: Mapping[int, tuple[str, ...]] = {1000: ("h", "d", "t"), 110: ("h", "to", "t", "v", "s")}
"""Fields with the conditions, by simulated rate [Hz]."""
FRAME_TIMES = {1000: (0.001, 0.009), 110: (0.0, 1 / 110)}
"""Time of the first frame and interval [s]: of 1000 rows 1, 10, … 982 are kept, of 110 all."""
CONDITIONS = ("speed", "height", "rotation", "distance", "size")
"""Conditions of a sweep, in m/s, m, rad, m and m; what a file does not say is that of table 3.1 of the thesis."""
FAULTS = {
    "repeated": "equal those of the frame before in a channel that moves, as the published cleaning fills gaps",
    "too large": "are beyond 1000 mN or µN·m",
    "missing": "are missing",
    "unwritten": "of row 0 at 110 Hz come from memory that nothing has written",
}
"""Known faults of values → what they are."""
DOUBTFUL = ("too large", "missing")
"""Faults of values that are not used."""


@dataclass(frozen=True, eq=False)
class SweepFile:
    """One sweep as its file holds it."""

    data: NDArray[np.float64]
    """[110, 30, 6] forces and moments of the 30 whiskers (mN, µN·m)."""
    label: int | None
    """Number of the class; None where the file has none, or "?"."""
    shape: str
    """"category/object"."""
    rate: int
    """Simulated frames per second, 1000 or 110."""
    conditions: tuple[float, ...]
    """Values of :data:`CONDITIONS`."""

    def wrench(self) -> NDArray[np.float32]:
        """Return the forces [110, 30, 6] in N and N·m; NaN where a value is missing or beyond :data:`LARGEST`."""
        trusted = np.abs(self.data) <= LARGEST
        return np.where(trusted, self.data * SCALE, math.nan).astype(np.float32)

    def faulty(self) -> dict[str, NDArray[np.bool_]]:
        """Return where [110, 30, 6] a value has each of :data:`FAULTS`."""
        before = np.pad(self.data, ((1, 0), (0, 0), (0, 0)))[:-1]
        repeated = (self.data == before) & (self.data != 0)
        # A whisker may rest on the object: an equal value is a filled gap where most frames differ.
        moving = 2 * repeated.sum(axis=0) < (self.data != 0).sum(axis=0)
        unwritten = np.zeros(self.data.shape, dtype=bool)
        unwritten[0] = (self.data[0] != 0) & (self.rate == 110)
        masks = (repeated & moving, np.abs(self.data) > LARGEST, np.isnan(self.data), unwritten)
        return dict(zip(FAULTS, masks, strict=True))


def read_sweep(path: str | os.PathLike[str]) -> SweepFile:
    """Read a sweep file; no pickle is loaded."""
    name, held = os.fspath(path), read_npz(path, "published sweep (.npz)")
    rate = next((rate for rate, needed in RATES.items() if {"data", "shape", *needed} <= held.keys()), None)
    if rate is None:
        raise DataError(
            f"{name!r} is no sweep of the published study: it holds {', '.join(held) or 'nothing'}; needed are data, "
            "shape, label and h, d, t (1000 Hz) or h, to, t, v, s (110 Hz)."
        )
    try:
        told = {key: float(str(held[key])) for key in RATES[rate]}
    except ValueError as error:
        raise DataError(f"{name!r} has a condition that is no number ({error}).") from error
    check_values(told, name)
    label = _label(str(held.get("label", "")))
    return SweepFile(_whiskers(held["data"], name), label, str(held["shape"]), rate, _conditions(told))


def _whiskers(data: NDArray[Any], name: str) -> NDArray[np.float64]:
    """Return the 30 whiskers of an array of 35 cells, or of the whiskers alone."""
    grid, alone = [FRAMES, GRID_SHAPE[0] * GRID_SHAPE[1], len(CHANNELS)], [FRAMES, len(CELLS), len(CHANNELS)]
    if data.dtype.kind not in "fiu" or [*data.shape] not in (grid, alone):
        raise DataError(
            f"'data' in {name!r} is {[*data.shape]} of {data.dtype}; a published sweep has numbers {grid} "
            f"(frame, cell, channel), or {alone} for the whiskers alone."
        )
    if [*data.shape] == grid:
        if np.any(data[:, EMPTY_CELLS]):
            raise DataError(f"'data' in {name!r} has forces in the cells {EMPTY_CELLS}, which have no whisker.")
        data = data[:, CELLS]
    return np.asarray(data, dtype=np.float64)


def _label(text: str) -> int | None:
    """Return a class number; None for anything that is not one."""
    try:
        number = float(text)
    except ValueError:
        return None
    return int(number) if 0 <= number < 2**31 and number.is_integer() else None


def _conditions(told: Mapping[str, float]) -> tuple[float, ...]:
    """Return :data:`CONDITIONS` of the fields of a file; rotation is the turn and its offset ``to`` together."""
    speed, distance, size = told.get("v", 30.0), told.get("d", 5.0), told.get("s", 40.0)
    rotation = math.radians(told["t"] + told.get("to", 0.0))
    return speed / 1e3, told["h"] / 1e3, rotation, distance / 1e3, size / 1e3
