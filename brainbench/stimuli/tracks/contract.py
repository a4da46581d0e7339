"""Data sets of measurements: traced shapes and base wrenches over time, in SI units; what is missing is NaN.

``shape`` [time, point, axis] (m): points from the base to the tip, axes x, y and perhaps z. ``wrench`` [time, channel]
(N, N·m): action of the whisker on its base about the base point, some of the channels Fx … Mz. ``time`` [s] increases.
A variable ``noise`` may hold the standard deviation of one reading, one number for shapes or [channel] for wrenches,
from repeats.

Faults of shapes are gaps, whiskers that change places, wrong units, shapes longer than the whisker. What can be used
stays and is counted; what cannot be true is refused in one sentence. Letters: n frame, k point.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, brief, check_each, check_number, check_once

if TYPE_CHECKING:
    import xarray as xr

AXES = ("x", "y", "z")
FARTHEST = 1e3  # magnitude [m] beyond which no point of a whisker is, also where millimetres are taken for metres
LARGEST_FORCE = 1e3  # magnitude [N, N·m] that no base of a whisker feels
_NOISE = "noise of a measurement (standard deviation, SI units)"


def real_numbers(values: ArrayLike) -> NDArray[np.float64]:
    """Return numbers in double precision; complex ones, of which a part would be lost, are a :class:`DataError`."""
    array = np.asarray(values)
    if array.dtype.kind == "c":
        raise DataError("Measurements are real numbers; received complex ones.")
    return array.astype(float)


def new_shapes(times: ArrayLike, points: ArrayLike, *, noise: float | None = None, **attributes: Any) -> xr.Dataset:
    """Return traced shapes as a data set.

    Args:
        times: [n] (s), increasing.
        points: [n, k, 2 or 3] (m), from the base to the tip; NaN where missing.
        noise: standard deviation of a coordinate (m), when repeats tell it.
        attributes: where they come from.
    """
    import xarray as xr

    values = real_numbers(points)
    if values.ndim != 3 or values.shape[2] not in (2, 3) or not values.shape[1]:
        raise DataError(
            f"Traced shapes are points [time, point, 2 or 3], at least one point a frame; received {values.shape}."
        )
    _check_largest("points of a track (m)", values, FARTHEST, "the scale (metres per pixel) or the file is wrong")
    # A point with one missing coordinate is missing.
    values = np.where(np.isfinite(values).all(axis=-1, keepdims=True), values, np.nan)
    if not np.isfinite(values).any():
        raise DataError("No frame of the track has a single traced point.")
    times = check_times(times, len(values))
    dataset = xr.Dataset(
        {"shape": (("time", "point", "axis"), values, {"units": "m"})},
        coords={"time": ("time", times, {"units": "s"}), "axis": np.array(AXES[: values.shape[2]], dtype=object)},
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
    array = real_numbers(values)
    if array.ndim != 2 or array.shape[1] != len(channels):
        raise DataError(f"Wrenches are numbers [time, {len(channels)}]; received an array of shape {array.shape}.")
    if not np.isfinite(array).any():
        raise DataError("The wrenches hold no number.")
    _check_largest("wrenches (N, N·m)", array, LARGEST_FORCE, "the unit or the file is wrong")
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


def _check_largest(what: str, values: NDArray[np.float64], most: float, hint: str) -> None:
    """Refuse measurements beyond what can be; NaN is missing."""
    largest = float(np.nanmax(np.abs(values), initial=0.0))
    if largest > most:
        raise DataError(f"The {what} reach {largest:.3g}; at most {most:g} can be: {hint}.")


def check_times(times: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return times [n] (s) that increase and are as many as there are rows; others are a :class:`DataError`."""
    values = real_numbers(times)
    if values.shape != (count,):
        raise DataError(f"{count} rows of measurements need {count} times; received an array of shape {values.shape}.")
    good = np.isfinite(values) & (np.diff(values, prepend=-np.inf) > 0)
    if not good.all():
        wrong = int(np.argmin(good))
        raise DataError(f"The times of a measurement increase, in seconds; row {wrong + 1} has {values[wrong]:g}.")
    return values


MOST_GAPS = 0.5  # share of the frames without a shape up to which a track is used
LONGER = 1.1
"""Traced length over arc length from which a shape cannot be that whisker: noise lengthens a polyline a little."""
UNITS = 5.0
"""The same ratio, or its inverse, from which the unit is wrong and not the whisker."""
JUMP = 8.0
"""Step of the base over the usual step from which it is a jump; a jump must also be a share :data:`FAR` of the
length."""
FAR = 0.1


@dataclass(frozen=True, eq=False)
class TrackQuality:
    """What is wrong with a track, in numbers."""

    frames: int
    missing_frames: int
    """Frames without a shape."""
    longest_gap: int
    """Frames of the longest gap."""
    missing_points: float
    """Share of the points that are missing in the frames that have a shape."""
    jumps: NDArray[np.int_]
    """Frames at which the base jumps or the shape turns into its mirror image, as when two whiskers change places."""
    length: float
    """Median length of the traced shapes [m]."""

    @property
    def words(self) -> tuple[str, ...]:
        """One sentence for each fault."""
        sentences = []
        if self.missing_frames:
            sentences.append(
                f"{self.missing_frames} of {self.frames} frames have no shape, the longest gap is {self.longest_gap} "
                "frames; they are left out."
            )
        if self.missing_points > 0:
            sentences.append(f"{100 * self.missing_points:.2g} % of the points in the other frames are missing.")
        if len(self.jumps):
            sentences.append(_swap_words(self.jumps))
        return tuple(sentences)


def every_frame(frames: NDArray[np.int_], path: str | os.PathLike[str]) -> NDArray[np.int_]:
    """Return all frame numbers [n] from the first to the last of some, before room is made for their shapes."""
    first, last, seen = int(frames.min()), int(frames.max()), len(np.unique(frames))
    if (count := last - first + 1) - seen > MOST_GAPS * count:
        raise DataError(
            f"{brief(os.fspath(path))} has shapes in {seen:,} of the {count:,} frames from {first} to {last}; a track "
            f"is used from {100 * (1 - MOST_GAPS):g} % on: give numbers of frames, not times, or cut it to frames in "
            "which it was seen."
        )
    return np.arange(first, last + 1)


def inspect_track(shapes: xr.Dataset) -> TrackQuality:
    """Return what is wrong with traced shapes."""
    points = shapes["shape"].values
    present: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=-1))
    seen = present.sum(axis=1) >= min(2, points.shape[1])
    edges = np.flatnonzero(np.diff(np.concatenate([[0], ~seen, [0]]).astype(int)))
    gaps = np.diff(edges.reshape(-1, 2), axis=1)
    lengths = traced_lengths(points)
    length = float(np.nanmedian(lengths)) if np.isfinite(lengths).any() else math.nan
    return TrackQuality(
        frames=len(points),
        missing_frames=int((~seen).sum()),
        longest_gap=int(gaps.max()) if len(gaps) else 0,
        missing_points=float(1 - present[seen].mean()) if seen.any() else 1.0,
        jumps=_jumps(points, seen, length) if math.isfinite(length) else np.zeros(0, dtype=int),
        length=length,
    )


def check_track(shapes: xr.Dataset) -> TrackQuality:
    """Return what is wrong with traced shapes that can be used."""
    quality = inspect_track(shapes)
    if quality.missing_frames > MOST_GAPS * quality.frames:
        raise DataError(
            f"{quality.missing_frames} of {quality.frames} frames have no shape (the longest gap is "
            f"{quality.longest_gap}); a track is used up to {100 * MOST_GAPS:g} %: trace "
            "it again, or cut it to frames in which it was seen."
        )
    if len(quality.jumps):
        raise DataError(f"{_swap_words(quality.jumps)} Correct the identities, or cut the track there.")
    return quality


def check_length(shapes: xr.Dataset, arc_length: float) -> None:
    """Refuse traced shapes that are no shapes of a whisker of this arc length [m]."""
    lengths = traced_lengths(shapes["shape"].values)
    if not np.isfinite(lengths).any():  # single points, as of a tip, have no length
        return
    if not (length := float(np.nanmedian(lengths))):
        raise DataError("The points of most traced shapes lie at one place; trace them along the whisker.")
    ratio = length / arc_length
    if not 1 / UNITS**2 < ratio < UNITS:
        near = 10.0 ** round(math.log10(ratio))
        unit = {1e3: " (millimetres taken for metres)", 1e-3: " (metres taken for millimetres)"}.get(near, "")
        raise DataError(
            f"The traced shapes are {length:.3g} m long, {ratio:.3g} times the whisker's {arc_length:.3g} m{unit}: the "
            "scale (metres per pixel or per unit of the file) is wrong."
        )
    if ratio > LONGER:
        raise DataError(
            f"The traced shapes are {1e3 * length:.3g} mm long and the whisker {1e3 * arc_length:.3g} mm; correct the "
            "scale or the whisker's arc_length, or fit another whisker."
        )


def traced_lengths(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the length [n] (m) of the polyline through the known points of each frame; NaN below two."""
    lengths = np.full(len(points), np.nan)
    for index, frame in enumerate(points):
        present = frame[np.isfinite(frame).all(axis=-1)]
        if len(present) >= 2:
            # At most a dozen chords: noise lengthens a polyline of many points.
            some = present[np.unique(np.linspace(0, len(present) - 1, min(len(present), 12)).round().astype(int))]
            lengths[index] = np.linalg.norm(np.diff(some, axis=0), axis=1).sum()
    return lengths


def _jumps(points: NDArray[np.float64], seen: NDArray[np.bool_], length: float) -> NDArray[np.int_]:
    """Return the frames at which the base jumps far, or the shape is suddenly the mirror image of the one before."""
    frames = np.flatnonzero(seen)
    if len(frames) < 3:
        return np.zeros(0, dtype=int)
    shapes = [points[index][np.isfinite(points[index]).all(axis=-1)] for index in frames]
    base, chord = np.array([one[0] for one in shapes]), np.array([one[-1] - one[0] for one in shapes])
    steps = np.linalg.norm(np.diff(base, axis=0), axis=1)
    typical = max(float(np.median(steps)), 1e-12)
    jumped = (steps > JUMP * typical) & (steps > FAR * length)
    # Signed height of the middle above the chord in the x-y plane, over the length: its sign is the side it curves to.
    middle = np.array([one[len(one) // 2] - one[0] for one in shapes])
    height = (chord[:, 0] * middle[:, 1] - chord[:, 1] * middle[:, 0]) / np.maximum(
        np.linalg.norm(chord, axis=1) * length, 1e-300
    )
    change = np.abs(np.diff(height))
    mirrored = (
        (height[1:] * height[:-1] < 0)
        & (np.minimum(np.abs(height[1:]), np.abs(height[:-1])) > 0.02)
        & (change > JUMP * max(float(np.median(change)), 1e-12))
    )
    # A whisker turned end for end, or one of the other side, also points the other way.
    turned = np.sum(chord[1:] * chord[:-1], axis=1) < 0
    return frames[1:][jumped | mirrored | turned]


def _swap_words(jumps: NDArray[np.int_]) -> str:
    frames = ", ".join(map(str, jumps[:5].tolist())) + (" …" if len(jumps) > 5 else "")
    return (
        f"The base jumps or the shape turns into its mirror image at {len(jumps)} frames ({frames}), as when the "
        "whisker changes places with its neighbour or with that of the other side."
    )
