"""Recorded whisking: velocities of whisker bases played on an array, and whisking as a video shows it.

Angular velocities are integrated as rotations.

Files as WHISKiT Physics reads them: one line per whisker, comma separated, three numbers (ωx, ωy, ωz) per
sample, rad/s in the axes of the array (head), 1000 samples per second. Such a file carries no names; its
*layout* says which line is which whisker.

Whiskers are matched by side and name, never by line number. A whisker of the array that the file lacks moves
as the nearest whisker of its row: E0 of the mouse as E1 of a rat file. Lines without counterpart, such as B5,
are not used. The published sample (62 lines, 8 Hz, 45° peak to peak) is played as it is: some of its lines were
computed for another whisker than they stand for.

Tracked whiskers turn, and their bases move, as in the trial that was filmed. A track (:mod:`brainbench.stimuli.tracks`)
holds points of a whisker in every frame. The direction of its part next to the base follows the follicle, also while
the whisker bends. Its turn in the plane of the image is the change of azimuth; of a track with three axes its rise is
the change of elevation. Angles that a track does not tell are coupled to azimuth as in :class:`.trajectories.Whisking`.
A table of angles tells all three itself.

Only changes count: where the whisker points at ``rest`` it has the pose of its array. So a camera above the animal may
be turned in any way; a view from below mirrors the image. Displacements of bases need the direction of rostral in it.

Letters: W whisker, n sample, k traced point.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import field, replace
from functools import cached_property
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, brief, check_name, check_numbers, listing
from brainbench.core.files import content_hash, to_plain
from brainbench.core.limits import Limit, NotNegative, Positive, limited
from brainbench.core.reading.tables import read_columns, read_numbers
from brainbench.core.rotations import TURN, Angle, Vector, base_rotation
from brainbench.stimuli.motion.trajectories import ROTATIONS, Rotations, follow_angles, low_pass
from brainbench.stimuli.tracks.readers import TrackOptions, read_shapes
from brainbench.stimuli.whiskers.array import ROWS, MountedWhisker

_LOG = logging.getLogger(__name__)

_TAIL = 0.01  # time [s] for which the last velocity is held beyond the end, for the last steps of a simulation
# Gauss-Legendre nodes of the fourth-order Magnus integrator (Blanes, Casas, Oteo & Ros 2009, Phys. Rep. 470).
_NODES = (0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6)


def _layout(**columns: range) -> tuple[str, ...]:
    names = [f"{row}{col}" for row, cols in columns.items() for col in cols]
    return tuple(side + name for side in "RL" for name in names)


LAYOUTS = {
    "whiskit-62": _layout(A=range(5), B=range(6), C=range(7), D=range(7), E=range(1, 7)),
    "rat-60": _layout(A=range(5), B=range(5), C=range(7), D=range(7), E=range(1, 7)),
    "mouse-60": _layout(A=range(5), B=range(5), C=range(7), D=range(7), E=range(6)),
}
"""Order of the lines, right side then left: ``whiskit-62`` is the older array of 31 whiskers a side (with
B5) of the published sample; the average arrays have 30, the mouse E0–E5 and the rat E1–E6."""


@limited(of="{} of a trajectory", eq=False)
class Trajectory:
    """Angular velocities of whisker bases, evenly sampled from t = 0."""

    names: tuple[str, ...]
    """[W] side and name, such as ``RC2``."""
    velocity: NDArray[np.float64]
    """[W, n, 3] angular velocity in the axes of the array [rad/s]; sample k is the velocity at t = k/rate."""
    rate: Positive = 1000.0
    """Samples per second [Hz]."""

    def __post_init__(self) -> None:
        velocity = np.array(self.velocity, dtype=float)
        if velocity.shape[::2] != (len(self.names), 3) or velocity.ndim != 3 or velocity.shape[1] < 2:
            raise DataError(
                f"A trajectory of {len(self.names)} whiskers needs velocities [{len(self.names)}, n, 3] with at least "
                f"two samples; received an array of shape {velocity.shape}."
            )
        if not np.isfinite(velocity).all():
            raise DataError("A trajectory has velocities that are not finite numbers.")
        if len(set(self.names)) < len(self.names):
            raise DataError("A trajectory names a whisker twice.")
        velocity.setflags(write=False)
        object.__setattr__(self, "velocity", velocity)

    @property
    def duration(self) -> float:
        """Time from the first sample to the end of the last [s]."""
        return self.velocity.shape[1] / self.rate

    @cached_property
    def content_hash(self) -> str:
        """Hash of names, velocities and rate."""
        return content_hash(list(self.names), self.velocity, self.rate)

    def rotation(self, name: str, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far the base of ``name`` has turned since t = 0: rotation matrices [m, 3, 3].

        The velocity between samples is a cubic spline, and Q′ = [ω]Q is integrated by the exponential map with the
        fourth-order Magnus expansion, one step per sample: Q is a rotation to rounding, however long the recording.
        """
        from scipy.spatial.transform import Rotation

        check_name("whisker of the trajectory", name, self.names)
        times = np.asarray(times, dtype=float)
        if times.size and (times.min() < 0 or times.max() > self.duration + _TAIL):
            raise UsageError(
                f"The recorded trajectory lasts {self.duration:g} s; the scene needs it at "
                f"{times.max() if times.min() >= 0 else times.min():g} s: read fewer frames or play a longer recording."
            )
        which = self.names.index(name)
        begin = np.clip(np.floor(times * self.rate), 0, self.velocity.shape[1] - 1)
        before = Rotation.from_quat(self._knots[begin.astype(int), which])
        start = begin / self.rate
        # Angular velocities are in the axes of the array, so later turns multiply from the left.
        return (Rotation.from_rotvec(self._turn(start, times - start, which)) * before).as_matrix()

    @cached_property
    def _splines(self) -> tuple[Any, ...]:
        from scipy.interpolate import CubicSpline

        samples = np.arange(self.velocity.shape[1]) / self.rate
        return tuple(CubicSpline(samples, velocity) for velocity in self.velocity)

    @cached_property
    def _knots(self) -> NDArray[np.float64]:
        """[n, W, 4] rotation up to each sample (scipy's x, y, z, w)."""
        from scipy.spatial.transform import Rotation

        steps = self.velocity.shape[1] - 1
        begin, step = np.arange(steps) / self.rate, np.full(steps, 1 / self.rate)
        turns = np.stack([self._turn(begin, step, which) for which in range(len(self.names))], axis=1)
        # Rotations do not commute: samples are multiplied in order, those of all whiskers at once.
        current = Rotation.identity(len(self.names))
        knots = np.empty((steps + 1, len(self.names), 4))
        knots[0] = current.as_quat()
        for k in range(steps):
            current = Rotation.from_rotvec(turns[k]) * current
            knots[k + 1] = current.as_quat()
        return knots

    def _turn(self, start: NDArray[np.float64], step: NDArray[np.float64], which: int) -> NDArray[np.float64]:
        """Return rotation vectors [m, 3] from ``start`` [m] over ``step`` [m] (s): h (ω₁ + ω₂)/2 − √3/12 h² ω₁ × ω₂."""
        end = (self.velocity.shape[1] - 1) / self.rate
        # Behind the last sample its velocity is held; a cubic would run away.
        first, second = (self._splines[which](np.minimum(start + node * step, end)) for node in _NODES)
        h = step[:, None]
        return h / 2 * (first + second) - math.sqrt(3) / 12 * h**2 * np.cross(first, second)


@limited(of="{} of recorded whisking", eq=False)
class Recorded:
    """Whisking as recorded: each whisker turns from its starting orientation as its line of the file says."""

    trajectory: Trajectory
    start: Annotated[float, Limit(least=-math.pi / 2, most=math.pi / 2, unit="rad")] = 0.0
    """Azimuth in front of rest from which play starts [rad], with elevation and torsion coupled by ``rotations``;
    negative behind rest. Unused for whiskers in ``initial``."""
    rotations: Rotations = field(default_factory=lambda: ROTATIONS["knutsen"])
    initial: Mapping[str, Vector] = field(default_factory=dict)
    """Starting angles (θ, φ, ζ) [rad] by side and name (``RC2``), as :func:`load_initial_angles` reads them."""

    def __post_init__(self) -> None:
        for name, angles in self.initial.items():
            check_numbers(f"starting angles of {name} (rad)", angles, 3, least=-TURN, most=TURN)

    @property
    def finest(self) -> float:
        """Shortest period of anything in the motion (s): two samples."""
        return 2 / self.trajectory.rate

    def line(self, mount: MountedWhisker) -> str:
        """Return the name of the line that moves ``mount`` (see the module); none is a :class:`UsageError`."""
        name = mount.full_name
        if name in self.trajectory.names:
            return name
        row = [other for other in self.trajectory.names if other[:2] == name[:2]]
        if not row:
            raise UsageError(
                f"The recorded trajectory has no whisker of row {name[1]} on the {mount.side} side, which {name} needs;"
                f" it has {listing(self.trajectory.names)}."
            )
        chosen = min(row, key=lambda line: abs(int(line[2:]) - mount.col))
        _LOG.info("the recording lacks %s, which moves as %s", name, chosen)
        return chosen

    def angles(self, mount: MountedWhisker, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return continuous (θ, φ, ζ) [n, 3] (rad) of one whisker."""
        first = np.array(mount.angles) + self.start * np.array(self.rotations.rates(mount))
        first = np.array(self.initial.get(mount.full_name, first), dtype=float)
        # Recorded turns are in the axes of the array: they act from the left on the starting frame.
        base, line = base_rotation(first), self.line(mount)
        return follow_angles(lambda t: self.trajectory.rotation(line, t) @ base, times, first, mount.full_name)

    def config(self) -> dict[str, Any]:
        """Return plain values for hashing and display; the recording counts by its hash."""
        return {
            "kind": "recorded",
            "trajectory": self.trajectory.content_hash,
            "duration": self.trajectory.duration,
            "start": self.start,
            "rotations": to_plain(self.rotations),
            "initial": to_plain(self.initial),
        }


def load_trajectory(path: str | os.PathLike[str], *, layout: str | None = None, rate: float = 1000.0) -> Trajectory:
    """Read a trajectory file.

    Args:
        path: comma-separated angular velocities, one line per whisker.
        layout: one of :data:`LAYOUTS`; None takes ``whiskit-62`` for 62 lines.
        rate: samples per second [Hz].
    """
    table = read_numbers(path)
    if table.shape[1] % 3:
        raise DataError(
            f"{os.fspath(path)!r} has {table.shape[1]} numbers per line; velocities come in threes (ωx, ωy, ωz)."
        )
    return Trajectory(_names(path, len(table), layout), table.reshape(len(table), -1, 3), rate)


def load_initial_angles(path: str | os.PathLike[str], *, layout: str | None = None) -> dict[str, Vector]:
    """Read starting angles (θ, φ, ζ) [rad] by whisker (``RC2``), as in WHISKiT's ``whisking_init_angle.csv``.

    Errors are those of :func:`load_trajectory`.
    """
    table = read_numbers(path)
    if table.shape[1] != 3:
        raise DataError(
            f"{os.fspath(path)!r} has {table.shape[1]} numbers per line; starting angles are three (θ, φ, ζ)."
        )
    if not np.isfinite(table).all():
        raise DataError(f"{os.fspath(path)!r} has starting angles that are not finite numbers.")
    names = _names(path, len(table), layout)
    return {name: (float(a), float(b), float(c)) for name, (a, b, c) in zip(names, table, strict=True)}


def _names(path: str | os.PathLike[str], lines: int, layout: str | None) -> tuple[str, ...]:
    fitting = [name for name, names in LAYOUTS.items() if len(names) == lines]
    if layout is None:
        if len(fitting) != 1:
            layouts = ", ".join(f"{name} ({len(names)})" for name, names in LAYOUTS.items())
            raise UsageError(
                f"{os.fspath(path)!r} has {lines} lines, which does not tell whose whiskers they are; "
                f"say it with layout=… (lines): {layouts}."
            )
        return LAYOUTS[fitting[0]]
    check_name("layout of whisker lines", layout, LAYOUTS)
    if layout not in fitting:
        raise DataError(f"{os.fspath(path)!r} has {lines} lines; the layout {layout!r} has {len(LAYOUTS[layout])}.")
    return LAYOUTS[layout]


Array = NDArray[np.float64]
NEAR = 0.25  # share of the traced length, from the base, whose chord is the direction of the base
_AXES = ("theta", "phi", "zeta")


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


@limited(of="{} of tracked whisking", eq=False)
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
    # The mean: rounded to 10 µs, most steps of 300 Hz are 3.33 ms, which is 10 ms too early after 10 s.
    step = float(times[-1] - times[0]) / max(len(times) - 1, 1)
    if not step > 0 or not np.allclose(times, times[0] + step * np.arange(len(times)), rtol=0, atol=0.01 * step):
        raise DataError(f"The times of {brief(os.fspath(path))} are evenly spaced seconds, at least two.")
    missing = np.full(len(times), np.nan)
    degrees = [[given.get(f"{name}.{axis}_deg", missing) for axis in _AXES] for name in names]
    turns = np.moveaxis(np.radians(degrees), 1, 2)[:, times >= 0]
    times = times[times >= 0]
    if not len(times):
        raise DataError(f"{brief(os.fspath(path))} has no time from 0 on, where a scene begins; shift its times.")
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
    frames = np.arange(round((last - first) * rate) + 1)
    common = np.full((len(series), len(frames), 6), np.nan)
    for row, (times, values) in zip(common, series.values(), strict=True):
        # A table may leave out the rows of frames in which it holds nothing; they are gaps.
        places = np.round((times - first) * rate).astype(int)
        inside = (places >= 0) & (places < len(frames))
        row[places[inside]] = values[inside]
    return first + frames / rate, common


def _filled(path: str | os.PathLike[str], times: Array, values: Array, longest: float) -> Array:
    """Return values [W, n, c] whose gaps are filled evenly; one that is longer than ``longest`` (s) is an error.

    Angles (rad) that begin anew after a whole turn are counted through, and begin within half a turn of rest.
    """
    filled, frames = values.copy(), 0
    for which, column in np.ndindex(len(values), values.shape[2]):
        series = filled[which, :, column]
        lost = ~np.isfinite(series)
        places = np.flatnonzero(~lost)
        if not len(places):
            continue
        series[places] = np.unwrap(series[places])
        series -= 2 * math.pi * np.round(series[places[0]] / (2 * math.pi))
        if not lost.any():
            continue
        if places[0] > 0 or places[-1] < len(times) - 1:
            raise DataError(
                f"{brief(os.fspath(path))} lacks a whisker at its {'beginning' if places[0] else 'end'}: cut it to"
                f" {times[places[0]]:.4g} to {times[places[-1]]:.4g} s, in which all whiskers were seen."
            )
        steps = np.diff(times[places])
        worst = int(np.argmax(steps))
        gap = float(steps[worst] - np.diff(times).min())
        if gap > longest + 1e-9:
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
    if lowpass is None:
        return values
    if lowpass >= rate / 2:
        raise UsageError(
            f"lowpass of tracked whisking (Hz) must be below half of the frame rate, {rate / 2:g} Hz; received "
            f"{lowpass:g}."
        )
    return low_pass(values.swapaxes(0, 1), rate, lowpass).swapaxes(0, 1)
