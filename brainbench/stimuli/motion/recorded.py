"""Recorded whisking: angular velocities of whisker bases, integrated as rotations and played on an array.

Files as WHISKiT Physics reads them: one line per whisker, comma separated, three numbers (ωx, ωy, ωz) per
sample, rad/s in the axes of the array (head), 1000 samples per second. Such a file carries no names; its
*layout* says which line is which whisker.

Whiskers are matched by side and name, never by line number. A whisker of the array that the file lacks moves
as the nearest whisker of its row: E0 of the mouse as E1 of a rat file. Lines without counterpart, such as B5,
are not used. The published sample (62 lines, 8 Hz, 45° peak to peak) is played as it is: some of its lines were
computed for another whisker than they stand for.

Letters: W whisker, n sample.
"""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError, check_name, listing
from brainbench.core.limits import Limit, Positive, limited
from brainbench.core.reading.ranges import check_numbers
from brainbench.core.reading.tables import read_numbers
from brainbench.core.rotations import TURN, Vector, base_rotation
from brainbench.stimuli.motion.trajectories import ROTATIONS, Rotations, follow_angles
from brainbench.stimuli.whiskers.array import MountedWhisker

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


@dataclass(frozen=True, eq=False)
@limited(of="{} of a trajectory")
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
        from brainbench.core.files import content_hash

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


@dataclass(frozen=True, eq=False)
@limited(of="{} of recorded whisking")
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
        from brainbench.core.files import to_plain

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
    names = _names(path, len(table), layout)
    return Trajectory(names, table.reshape(len(table), -1, 3), rate)


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
