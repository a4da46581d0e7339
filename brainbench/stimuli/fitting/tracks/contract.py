"""Data sets of measurements: traced shapes and base wrenches over time, in SI units; what is missing is NaN.

``shape`` [time, point, axis] (m): points from the base to the tip, axes x, y and perhaps z. ``wrench`` [time, channel]
(N, N·m): action of the whisker on its base about the base point, some of the channels Fx … Mz. ``time`` [s] increases.
A variable ``noise`` may hold the standard deviation of one reading, one number for shapes or [channel] for wrenches,
from repeats.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, check_each, check_once
from brainbench.core.reading.ranges import check_number

if TYPE_CHECKING:
    import xarray as xr

AXES = ("x", "y", "z")
_NOISE = "noise of a measurement (standard deviation, SI units)"


def new_shapes(times: ArrayLike, points: ArrayLike, *, noise: float | None = None, **attributes: Any) -> xr.Dataset:
    """Return traced shapes as a data set.

    Args:
        times: [n] (s), increasing.
        points: [n, k, 2 or 3] (m), from the base to the tip; NaN where missing.
        noise: standard deviation of a coordinate (m), when repeats tell it.
        attributes: where they come from.
    """
    import xarray as xr

    values = np.asarray(points, dtype=float)
    if values.ndim != 3 or values.shape[2] not in (2, 3) or not values.shape[1]:
        raise DataError(
            f"Traced shapes are points [time, point, 2 or 3], at least one point a frame; received {values.shape}."
        )
    # A point with one missing coordinate is missing.
    values = np.where(np.isfinite(values).all(axis=-1, keepdims=True), values, np.nan)
    if not np.isfinite(values).any():
        raise DataError("No frame of the track has a single traced point.")
    times = check_times(times, len(values))
    dataset = xr.Dataset(
        {"shape": (("time", "point", "axis"), values, {"units": "m"})},
        coords={
            "time": ("time", times, {"units": "s"}),
            "axis": np.array(AXES[: values.shape[2]], dtype=object),
        },
        attrs=attributes,
    )
    if noise is not None:
        check_number(_NOISE, noise, above=0)
        dataset["noise"] = float(noise)
    return dataset


def new_wrenches(
    times: ArrayLike,
    values: ArrayLike,
    channels: Sequence[str] = CHANNELS,
    *,
    noise: ArrayLike | None = None,
    **attributes: Any,
) -> xr.Dataset:
    """Return base wrenches as a data set.

    Args:
        times: [n] (s), increasing.
        values: [n, channel] (N, N·m); NaN where missing.
        channels: names of the columns, of Fx, Fy, Fz, Mx, My, Mz.
        noise: standard deviation of a reading, one for each channel, when repeats tell it.
        attributes: where they come from.
    """
    import xarray as xr

    check_each("channel of a wrench", channels, CHANNELS)
    check_once("A wrench", channels)
    array = np.asarray(values, dtype=float)
    if array.ndim != 2 or array.shape[1] != len(channels):
        raise DataError(f"Wrenches are numbers [time, {len(channels)}]; received an array of shape {array.shape}.")
    if not np.isfinite(array).any():
        raise DataError("The wrenches hold no number.")
    dataset = xr.Dataset(
        {"wrench": (("time", "channel"), array, {"units": "N (F), N m (M)"})},
        coords={
            "time": ("time", check_times(times, len(array)), {"units": "s"}),
            "channel": np.array(channels, dtype=object),
        },
        attrs=attributes,
    )
    if noise is not None:
        levels = np.broadcast_to(np.asarray(noise, dtype=float), len(channels))
        for level in levels:
            check_number(_NOISE, level, above=0)
        dataset["noise"] = ("channel", levels.copy())
    return dataset


def check_times(times: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return times [n] (s) that increase and are as many as there are rows; others are a :class:`DataError`."""
    values = np.asarray(times, dtype=float)
    if values.shape != (count,):
        raise DataError(f"{count} rows of measurements need {count} times; received an array of shape {values.shape}.")
    good = np.isfinite(values) & (np.diff(values, prepend=-np.inf) > 0)
    if not good.all():
        wrong = int(np.argmin(good))
        raise DataError(f"The times of a measurement increase, in seconds; row {wrong + 1} has {values[wrong]:g}.")
    return values
