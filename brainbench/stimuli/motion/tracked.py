"""Whisking as a video shows it: tracked whiskers turn, and their bases move, as in the trial that was filmed.

A track (:mod:`brainbench.stimuli.tracks`) holds points of a whisker in every frame. The direction of its part next to
the base follows the follicle, also while the whisker bends. Its turn in the plane of the image is the change of
azimuth; of a track with three axes its rise is the change of elevation. Angles that a track does not tell are coupled
to azimuth as in :class:`.trajectories.Whisking`. A table of angles tells all three itself.

Only changes count: where the whisker points at ``rest`` it has the pose of its array. So a camera above the animal may
be turned in any way; a view from below mirrors the image. Displacements of bases need the direction of rostral in it.

Letters: W whisker, n sample, k traced point.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, brief, listing
from brainbench.core.limits import Limit, NotNegative, Positive, limited
from brainbench.core.reading.tables import read_columns
from brainbench.core.rotations import Angle
from brainbench.stimuli.motion.trajectories import ROTATIONS, Rotations
from brainbench.stimuli.tracks.readers import TrackOptions, read_shapes
from brainbench.stimuli.whiskers.array import ROWS, MountedWhisker

_LOG = logging.getLogger(__name__)
Array = NDArray[np.float64]
NEAR = 0.25  # share of the traced length, from the base, whose chord is the direction of the base
_ORDER = 4
_TAIL = 0.01  # time [s] for which the last pose is held beyond the end, for the last steps of a simulation
_AXES = ("theta", "phi", "zeta")


@dataclass(frozen=True)
@limited(of="{} of tracked whisking")
class PlayOptions:
    """How tracks become motion."""

    rest: Angle | None = None
    """Direction of a whisker at rest in the image, counter-clockwise from its x axis [rad]; the median of each track
    when None."""
    view: Literal["top", "bottom"] = "top"
    """Side from which the camera looks at the animal; from the bottom turns are mirrored."""
    rostral: Angle | None = None
    """Direction of rostral in the image, counter-clockwise from its x axis [rad]. With it bases move as they did;
    without it they stay where the array has them."""
    longest_gap: Annotated[float, Limit(least=0, unit="s")] = 0.02
    """Longest gap of a track that is filled, evenly from its last value before to the first behind it [s]."""
    lowpass: Annotated[float, Limit(above=0, unit="Hz")] | None = 50.0
    """Cut-off [Hz] of a fourth-order Butterworth filter that runs forwards and backwards over angles and displacements:
    the noise of a tracker is small in angle and large in acceleration, which a whisker feels. Mice and rats whisk below
    25 Hz. None for no filter."""


@dataclass(frozen=True, eq=False)
@limited(of="{} of tracked whisking")
class Tracked:
    """Whisking of one trial: each whisker turns, and its base moves, as it was tracked."""

    names: tuple[str, ...]
    """[W] side and name, such as ``RC2``."""
    turns: Array
    """[W, n, 3] changes of (θ, φ, ζ) against the rest pose [rad]; NaN throughout where an angle was not tracked."""
    rate: Positive
    """Samples per second [Hz]."""
    start: NotNegative = 0.0
    """Time of the first sample [s]; negative times of a track are left out."""
    shifts: Array | None = None
    """[W, n, 3] displacements of the bases [m, array frame]; None when they stay."""
    rotations: Rotations = field(default_factory=lambda: ROTATIONS["knutsen"])
    """Coupling of the angles that were not tracked to azimuth."""

    def __post_init__(self) -> None:
        shape = (len(self.names), np.shape(self.turns)[1] if np.ndim(self.turns) == 3 else 0, 3)
        if np.shape(self.turns) != shape or shape[1] < 2 or not all(self.names):
            raise DataError(
                f"Tracked whisking of {len(self.names)} whiskers needs turns [{len(self.names)}, n, 3] with at least "
                f"two samples; received an array of shape {np.shape(self.turns)}."
            )
        if self.shifts is not None and np.shape(self.shifts) != shape:
            raise DataError(f"Displacements have the shape of turns, {shape}; received {np.shape(self.shifts)}.")
        finite = np.isfinite(self.turns)
        if not finite[..., 0].all() or (finite.any(axis=1) != finite.all(axis=1)).any():
            raise DataError("Turns of tracked whisking have gaps; azimuth is known at every sample.")

    @property
    def end(self) -> float:
        """Time of the last sample [s]."""
        return self.start + (self.turns.shape[1] - 1) / self.rate

    @property
    def finest(self) -> float:
        """Shortest period of anything in the motion (s): two samples."""
        return 2 / self.rate

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicSpline

        values = np.nan_to_num(self.turns)
        both = values if self.shifts is None else np.concatenate([values, self.shifts], axis=2)
        return CubicSpline(self.start + np.arange(both.shape[1]) / self.rate, both, axis=1)

    def line(self, mount: MountedWhisker) -> int:
        """Return which of the tracked whiskers moves ``mount``: itself, else the nearest one of its side."""
        side = [name for name in self.names if name[0] == mount.full_name[0]]
        if not side:
            raise UsageError(
                f"No whisker of the {mount.side} side was tracked, which {mount.full_name} needs; tracked are "
                f"{listing(self.names)}."
            )
        # Rows first: whiskers of one row share the coupling of their angles.
        chosen = min(side, key=lambda name: (abs(ROWS.index(name[1]) - mount.row), abs(int(name[2:]) - mount.col)))
        if chosen != mount.full_name:
            _LOG.info("%s was not tracked and moves as %s", mount.full_name, chosen)
        return self.names.index(chosen)

    def angles(self, mount: MountedWhisker, times: Array) -> Array:
        """Return (θ, φ, ζ) [m, 3] (rad) of one whisker."""
        which, rates = self.line(mount), self.rotations.rates(mount)
        change = self._at(times)[which, :, :3]
        protraction = change[:, :1] * rates[0]
        tracked = np.isfinite(self.turns[which, 0])
        return np.array(mount.angles) + np.where(tracked, change, protraction * np.array(rates))

    def displacement(self, mount: MountedWhisker, times: Array) -> Array:
        """Return how far a base is from its place in the array [m, 3] (m)."""
        return np.zeros((len(times), 3)) if self.shifts is None else self._at(times)[self.line(mount), :, 3:]

    def _at(self, times: Array) -> Array:
        times = np.asarray(times, dtype=float)
        if times.size and (times.min() < self.start - 1e-9 or times.max() > self.end + _TAIL):
            wrong = times.min() if times.min() < self.start else times.max()
            raise UsageError(
                f"The track lasts from {self.start:g} to {self.end:g} s; the scene needs it at {wrong:g} s: read fewer "
                "frames, or say with zero_frame at which frame the scene begins."
            )
        return self._spline(np.clip(times, self.start, self.end))

    def config(self) -> dict[str, Any]:
        """Return plain values for hashing and display; the track counts by its hash."""
        from brainbench.core.files import content_hash, to_plain

        return {
            "kind": "track",
            "whiskers": list(self.names),
            "track": content_hash(self.turns, [] if self.shifts is None else self.shifts, self.rate, self.start),
            "rotations": to_plain(self.rotations),
        }


def load_tracks(
    path: str | os.PathLike[str],
    whiskers: Mapping[str, str],
    track: TrackOptions,
    options: PlayOptions | None = None,
    *,
    rotations: Rotations = ROTATIONS["knutsen"],
) -> Tracked:
    """Read the motion of whiskers from the track of one trial.

    Args:
        path: a file that :func:`brainbench.stimuli.tracks.readers.read_shapes` reads.
        whiskers: side and name (``RC2``) → which whisker of the file it is (a label, number or individual; empty where
            the file holds one).
        track: scale, frame rate and kind of the file.
        options: how it is played.
        rotations: coupling of angles that were not tracked.
    """
    if not whiskers:
        raise UsageError("Tracked whisking names its whiskers, each with the label that it has in the file.")
    options = options or PlayOptions()
    series: dict[str, tuple[Array, Array]] = {}
    for name, label in whiskers.items():
        shapes = read_shapes(path, replace(track, track=label or None))
        series[name] = shapes["time"].values, _motion_of(shapes["shape"].values, options)
    rate = float(track.frame_rate or 0.0)
    times, values = _common(path, series, rate)
    values = _smooth(_filled(path, times, values, options.longest_gap), rate, options.lowpass)
    turns, shifts = values[..., :3], values[..., 3:]
    return Tracked(
        tuple(whiskers), turns, rate, float(times[0]), None if np.isnan(shifts).all() else np.nan_to_num(shifts),
        rotations,
    )  # fmt: skip


def load_angles(
    path: str | os.PathLike[str], options: PlayOptions | None = None, *, rotations: Rotations = ROTATIONS["knutsen"]
) -> Tracked:
    """Read the motion of whiskers from a table of angles.

    Args:
        path: a CSV table with the column ``time_s``, evenly spaced, and for each whisker ``RC2.theta_deg``, and perhaps
            ``RC2.phi_deg`` and ``RC2.zeta_deg``: how far it has turned from its rest pose.
        options: how gaps are filled and noise is removed; its view does not matter.
        rotations: coupling of angles that are not in the table.
    """
    options = options or PlayOptions()
    columns, table = read_columns(path, "table of angles", gaps=True)
    given = {name: table[:, index] for index, name in enumerate(columns)}
    names = tuple(dict.fromkeys(name.split(".")[0] for name in columns if name.endswith(".theta_deg")))
    allowed = {"time_s", *(f"{name}.{axis}_deg" for name in names for axis in _AXES)}
    if "time_s" not in given or not names or set(given) - allowed:
        raise DataError(
            f"{brief(os.fspath(path))} is no table of angles: its columns are time_s and, for each whisker, "
            f"RC2.theta_deg and perhaps RC2.phi_deg and RC2.zeta_deg; it has {listing(columns)}."
        )
    times = given["time_s"]
    step = float(np.median(np.diff(times))) if len(times) > 1 else math.nan
    if not step > 0 or not np.allclose(np.diff(times), step, rtol=0.01):
        raise DataError(f"The times of {brief(os.fspath(path))} are evenly spaced seconds, at least two.")
    missing = np.full(len(times), np.nan)
    degrees = [[given.get(f"{name}.{axis}_deg", missing) for axis in _AXES] for name in names]
    turns = np.moveaxis(np.radians(degrees), 1, 2)[:, times >= 0]
    times = times[times >= 0]
    filled = _filled(path, times, turns, options.longest_gap)
    return Tracked(names, _smooth(filled, 1 / step, options.lowpass), 1 / step, float(times[0]), rotations=rotations)


def base_directions(points: Array) -> Array:
    """Return the chord [n, axis] of the part next to the base of traced points [n, k, axis]; NaN without a base."""
    directions = np.full((len(points), points.shape[2]), np.nan)
    for index, frame in enumerate(points):
        present = frame[np.isfinite(frame).all(axis=-1)]
        if len(present) >= 2 and np.isfinite(frame[0]).all():
            away = np.linalg.norm(present - present[0], axis=1)
            directions[index] = present[np.argmax(away >= max(NEAR * away.max(), 1e-12))] - present[0]
    return directions


def _motion_of(points: Array, options: PlayOptions) -> Array:
    """Return turns and displacements [n, 6] (rad, m) of traced points [n, k, 2 or 3] (m); NaN where unknown."""
    if points.shape[1] < 2:
        raise DataError("A track that is played holds at least two points of a whisker, its base and one next to it.")
    motion = np.full((len(points), 6), np.nan)
    # A view from below is that from above in a mirror; then x runs the other way, and so does the sense of turns.
    mirror = np.ones(points.shape[2])
    mirror[0] = 1.0 if options.view == "top" else -1.0
    directions = base_directions(points * mirror)
    seen = np.isfinite(directions).all(axis=1)
    if not seen.any():
        raise DataError("No frame of the track has the base of the whisker and a point next to it.")
    azimuth = np.unwrap(np.arctan2(directions[seen, 1], directions[seen, 0]))
    if options.rest is None:
        rest = float(np.median(azimuth))
    else:
        rest = options.rest if options.view == "top" else math.pi - options.rest
        azimuth = azimuth - 2 * math.pi * round((float(np.median(azimuth)) - rest) / (2 * math.pi))
    motion[seen, 0] = azimuth - rest
    if points.shape[2] == 3:
        rise = np.arcsin(directions[seen, 2] / np.linalg.norm(directions[seen], axis=1))
        motion[seen, 1] = rise - np.median(rise)
    if options.rostral is not None:
        rostral = options.rostral if options.view == "top" else math.pi - options.rostral
        angle = math.pi / 2 - rostral  # rostral is the y axis of the array
        base = points[:, 0] * mirror
        base = base - np.nanmedian(base, axis=0)
        motion[:, 3] = math.cos(angle) * base[:, 0] - math.sin(angle) * base[:, 1]
        motion[:, 4] = math.sin(angle) * base[:, 0] + math.cos(angle) * base[:, 1]
        motion[:, 5] = base[:, 2] if points.shape[2] == 3 else 0.0
    return motion


def _common(
    path: str | os.PathLike[str], series: Mapping[str, tuple[Array, Array]], rate: float
) -> tuple[Array, Array]:
    """Return times [n] (s), from 0 on, and values [W, n, 6] of the frames within the tracks of all whiskers."""
    spans = []
    for times, values in series.values():
        seen = times[np.isfinite(values[:, 0])]
        spans.append((max(float(seen[0]), 0.0), float(seen[-1])))
    first, last = max(low for low, _ in spans), min(high for _, high in spans)
    if last - first < 1 / rate:
        raise DataError(
            f"The tracks of {listing(series)} in {brief(os.fspath(path))} have no time from 0 on in common."
        )
    some = [
        (times[inside], values[inside])
        for times, values in series.values()
        for inside in [(times > first - 0.5 / rate) & (times < last + 0.5 / rate)]
    ]
    return some[0][0], np.stack([values for _, values in some])


def _filled(path: str | os.PathLike[str], times: Array, values: Array, longest: float) -> Array:
    """Return values [W, n, c] whose gaps are filled evenly; one that is longer than ``longest`` (s) is an error."""
    filled, frames = values.copy(), 0
    for which, column in np.ndindex(len(values), values.shape[2]):
        series = filled[which, :, column]
        lost = ~np.isfinite(series)
        if lost.all() or not lost.any():
            continue
        places = np.flatnonzero(~lost)
        steps = np.diff(times[places])
        worst = int(np.argmax(steps))
        gap = float(steps[worst] - np.diff(times).min())
        if gap > longest + 1e-9 or places[0] > 0 or places[-1] < len(times) - 1:
            raise DataError(
                f"{brief(os.fspath(path))} has a gap of {1e3 * gap:.3g} ms from {times[places[worst]]:.4g} s on; gaps "
                f"are filled up to {1e3 * longest:g} ms: track these frames again, or allow longer ones."
            )
        series[lost] = np.interp(times[lost], times[places], series[places])
        frames = max(frames, int(lost.sum()))
    if frames:
        _LOG.warning("%s: %d of %d samples were missing and are filled in", os.fspath(path), frames, len(times))
    return filled


def _smooth(values: Array, rate: float, lowpass: float | None) -> Array:
    from scipy.signal import butter, sosfiltfilt

    if lowpass is None:
        return values
    if lowpass >= rate / 2:
        raise UsageError(
            f"lowpass of tracked whisking (Hz) must be below half of the frame rate, {rate / 2:g} Hz; received "
            f"{lowpass:g}."
        )
    edge = min(values.shape[1] - 1, math.ceil(2 * rate / lowpass))
    return sosfiltfilt(butter(_ORDER, lowpass, fs=rate, output="sos"), values, axis=1, padlen=edge)
