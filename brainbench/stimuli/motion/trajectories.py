"""Motions of whiskers, heads and objects, the hinge angles that they give a follicle, and a filter. In rad, m and s.

Letters: n time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError
from brainbench.core.limits import Limit, limited
from brainbench.core.rotations import Vector, base_rotation
from brainbench.stimuli.whiskers.array import MountedWhisker

STEEPEST = math.radians(87)  # elevation up to which a follicle is driven by its Euler angles
_RATE = 1000.0
"""Instants per second at which angles are followed from the start; between two of them nothing turns by 180°."""


def principal_angles(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (θ, φ, ζ) [..., 3] (rad) of base frames [..., 3, 3], the inverse of ``base_rotation``.

    φ lies within ±90°, θ − 90° and ζ + 90° within ±180°.
    """
    # Rz(θ − 90°) Ry(−φ) Rx(ζ + 90°) has the first column (cos φ cos θ′, cos φ sin θ′, sin φ) and the last row (sin φ,
    # cos φ sin ζ′, cos φ cos ζ′), with θ′ = θ − 90° and ζ′ = ζ + 90°.
    theta = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]) + np.pi / 2
    phi = np.arcsin(np.clip(rotation[..., 2, 0], -1.0, 1.0))
    zeta = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2]) - np.pi / 2
    return np.stack([theta, phi, zeta], axis=-1)


def follow_angles(
    rotation: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    times: NDArray[np.float64],
    first: ArrayLike,
    name: str,
) -> NDArray[np.float64]:
    """Return the angles (θ, φ, ζ) [n, 3] (rad) of a moving base frame at ``times`` [n] (s), without jumps by turns.

    ``rotation`` gives base frames [m, 3, 3] at times [m]; ``first`` are the angles at t = 0, which tell the turn to
    start in. Times may have any order: the angles do not depend on which others are asked for.
    """
    times = np.asarray(times, dtype=float)
    grid = np.arange(math.floor(max(times.max(initial=0.0), 0.0) * _RATE) + 2) / _RATE
    # The last instant may lie beyond what is known of the motion.
    grid = np.minimum(grid, max(times.max(initial=0.0), 0.0))
    coarse, fine = principal_angles(rotation(grid)), principal_angles(rotation(times))
    for angles, when in ((coarse, grid), (fine, times)):
        steep = np.abs(angles[:, 1]) > STEEPEST
        if steep.any():
            raise UsageError(
                f"The whisker {name} points along the vertical axis of its array (elevation "
                f"{math.degrees(angles[steep][0, 1]):.0f}°) at {when[steep][0]:.4g} s; the follicle is driven by "
                f"azimuth, elevation and torsion, which lose their meaning beyond "
                f"{math.degrees(STEEPEST):.0f}° (gimbal lock). Leave this whisker out, or let it move less."
            )
    # The number of whole turns follows from the way since t = 0; the even grid makes it independent of ``times``.
    track = np.unwrap(coarse, axis=0)
    track += 2 * np.pi * np.round((np.asarray(first, dtype=float) - track[0]) / (2 * np.pi))
    # Exact principal angles, each with the whole turns that bring it nearest to the followed ones.
    expected = np.stack([np.interp(times, grid, track[:, axis]) for axis in range(3)], axis=1)
    return fine + 2 * np.pi * np.round((expected - fine) / (2 * np.pi))


_Onset = Annotated[float, Limit(least=0, unit="s")]
_Excursion = Annotated[float, Limit(least=-math.pi / 2, most=math.pi / 2, unit="rad")]


@dataclass(frozen=True)
class Rotations:
    """Coupling of elevation φ and torsion ζ to azimuth θ in each row: dφ/dθ and dζ/dθ for rows A to E."""

    name: str
    elevation: tuple[float, float, float, float, float]
    torsion: tuple[float, float, float, float, float]

    def rates(self, mount: MountedWhisker) -> Vector:
        """Return the change of (θ, φ, ζ) per radian of protraction; the left side mirrors the right."""
        # In a mirrored frame azimuth and torsion change sign, elevation does not (``MountedWhisker.mirrored``).
        mirror = 1.0 if mount.side == "right" else -1.0
        return mirror, self.elevation[mount.row], mirror * self.torsion[mount.row]


ROTATIONS = {
    "knutsen": Rotations("knutsen", (0.398, 0.591, 0.578, 0.393, 0.217), (-0.900, -0.284, 0.243, 0.449, 0.744)),
    "knutsen-b": Rotations("knutsen-b", (0.12, 0.30, 0.30, 0.14, 0.02), (-0.76, -0.25, 0.22, 0.43, 0.73)),
}
"""Published coefficients for the couplings that Knutsen, Biess & Ahissar (2008, Neuron 59, 35–42)
measured in rats: ``knutsen`` as WHISKiT uses them (Zweifel et al. 2021), ``knutsen-b`` a second
published fit."""


class HingeMotion(Protocol):
    """Motion of whiskers relative to the head, such as :class:`Still`, :class:`Whisking` or recorded whisking."""

    def angles(self, mount: MountedWhisker, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (θ, φ, ζ) [n, 3] (rad) of one whisker."""
        ...


class _Motion:
    """Base of all motions that their fields determine."""

    def config(self) -> dict[str, Any]:
        """Return plain values for hashing and display."""
        from brainbench.core.files import to_plain

        return {"kind": type(self).__name__.lower(), **to_plain(self)}


@dataclass(frozen=True)
class Still(_Motion):
    """Nothing moves."""

    finest: ClassVar[float] = math.inf
    """Shortest period of anything in the motion (s), as engines ask for it: nothing ever changes."""

    def angles(self, mount: MountedWhisker, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the rest angles (θ, φ, ζ) [n, 3] of one whisker."""
        return np.tile(np.array(mount.angles), (len(times), 1))

    def displacement(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return zeros [n, 3]."""
        return np.zeros((len(times), 3))


@limited(of="{} of whisking")
class Whisking(_Motion):
    """Sinusoidal whisking of the whole array about its rest pose.

    With the azimuth a(t) = (protraction + retraction)/2 · cos(2πft + π) + (protraction − retraction)/2
    each whisker has θ = θ₀ + a, φ = φ₀ + a·dφ, ζ = ζ₀ + a·dζ with its row's coefficients (the form of
    Knutsen et al. 2008); the left side mirrors the right. The sinusoid starts retracted, at a = −retraction.
    During ``onset`` the part that leaves this pose grows from nothing as 6u⁵ − 15u⁴ + 10u³, so position,
    velocity and acceleration start without a jump.
    """

    frequency: Annotated[float, Limit(above=0, unit="Hz")] = 20.0
    """Whisks per second [Hz]."""
    protraction: _Excursion = math.pi / 6
    """Largest azimuth forward of rest [rad]."""
    retraction: _Excursion = math.pi / 18
    """Largest azimuth backward of rest [rad]."""
    onset: _Onset = 0.05
    """Duration of the smooth start [s]."""
    rotations: Rotations = field(default_factory=lambda: ROTATIONS["knutsen"])

    def __post_init__(self) -> None:
        if self.protraction + self.retraction <= 0:
            raise UsageError(
                "Whisking needs a protraction in front of its retraction (their sum is the peak-to-peak amplitude); "
                f"received {self.protraction!r} and {self.retraction!r} rad."
            )

    @property
    def finest(self) -> float:
        """Shortest period of anything in the motion (s)."""
        return min(1 / self.frequency, 2 * self.onset or math.inf)

    def azimuth(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return a(t) [n] (rad), the azimuth relative to rest, positive forward on both sides."""
        times = np.asarray(times, dtype=float)
        # The published form with cos(x + π) = −cos x, written as the way from the retracted pose, which alone is
        # smoothed.
        stroke = (self.protraction + self.retraction) / 2 * (1 - np.cos(2 * np.pi * self.frequency * times))
        return smooth_step(times, self.onset) * stroke - self.retraction

    def angles(self, mount: MountedWhisker, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return (θ, φ, ζ) [n, 3] (rad) of one whisker."""
        azimuth = self.azimuth(times)[:, None]
        return np.array(mount.angles) + azimuth * np.array(self.rotations.rates(mount))


@dataclass(frozen=True)
class _SteadyMotion(_Motion):
    """Motion that reaches its velocity smoothly: the speed grows as 6u⁵ − 15u⁴ + 10u³ during ``onset``, then stays."""

    velocity: Vector
    """Final velocity in the world: [m/s] of a translation; [rad/s] of a spin, along the axis by the right-hand rule."""
    onset: _Onset = 0.01  # duration of the smooth start [s]; 0 moves at full speed from the first instant

    @property
    def finest(self) -> float:
        """Shortest period of anything in the motion (s); without an onset there is none, and 1 s tells it from rest."""
        return 2 * self.onset or 1.0

    def _moved(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the integral [n, 3] of the velocity since t = 0."""
        times = np.asarray(times, dtype=float)
        way = np.maximum(times - self.onset, 0.0)
        if self.onset > 0:
            u = np.clip(times / self.onset, 0.0, 1.0)
            # Integral of the quintic; it is ½ at u = 1, so half of the onset is lost against full speed.
            way = self.onset * (u**6 - 3 * u**5 + 2.5 * u**4) + way
        return way[:, None] * np.array(self.velocity)


@limited(of="{} of a translation (SI units)")
class Translation(_SteadyMotion):
    """Straight motion that reaches its velocity smoothly."""

    def displacement(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far it has moved since t = 0, [n, 3] (m, world)."""
        return self._moved(times)


@limited(of="{} of a spin (SI units)")
class Spin(_SteadyMotion):
    """Turning about an axis through the body's origin that reaches its speed smoothly, as :class:`Translation` does."""

    def displacement(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return zeros [n, 3]: the origin stays."""
        return np.zeros((len(times), 3))

    def turn(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far the body has turned since t = 0, rotation matrices [n, 3, 3] in world axes."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_rotvec(self._moved(times)).as_matrix()


@dataclass(frozen=True)
class Path(_Motion):
    """Motion of a body through keyframes: translation and rotation, such as those of a tracked head.

    Positions follow a natural cubic spline and orientations a rotation spline, so velocity and acceleration are
    continuous, angular ones too. The body moves off with the velocity of the first stretch; repeat the first
    keyframe to start from rest. Between keyframes it turns the shorter way.
    """

    times: tuple[float, ...]
    """Times of the keyframes [s], ascending from 0, at least two."""
    displacements: tuple[Vector, ...]
    """Displacements of the body's origin since t = 0 [m, world]."""
    rotations: tuple[Vector, ...]
    """Rotations of the body about its origin since t = 0: angles [rad] about the world's x, then y, then z."""

    def __post_init__(self) -> None:
        for name in ("displacements", "rotations"):
            rows = tuple(tuple(map(float, row)) for row in getattr(self, name))
            if len(rows) != len(self.times) or any(len(row) != 3 or not all(map(math.isfinite, row)) for row in rows):
                raise UsageError(
                    f"A path needs three finite numbers of {name} for each of its {len(self.times)} times."
                )
            if any(rows[0]):
                raise UsageError(f"A path starts without {name}: they count from t = 0; received {rows[0]}.")
            object.__setattr__(self, name, rows)
        times = np.array(self.times, dtype=float)
        if len(times) < 2 or times[0] != 0 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
            raise UsageError(f"The times of a path ascend from 0 and are at least two; received {self.times!r}.")
        object.__setattr__(self, "times", tuple(times.tolist()))
        self._check_turns()

    def _check_turns(self) -> None:
        from scipy.spatial.transform import Rotation

        angles = np.array(self.rotations)
        begin = Rotation.from_euler("xyz", angles[:-1])
        way = begin.inv() * Rotation.from_euler("xyz", angles[1:])
        # Angles of a tracked head that pass from 180° to -180° also differ much, but it turns little.
        wrapped = (way.magnitude() > 1e-6) & (way.magnitude() < math.pi / 6)
        longer = np.zeros(len(angles) - 1, dtype=bool)
        for share in (1 / 3, 1 / 2):  # several whole turns agree at one of them
            between = Rotation.from_euler("xyz", angles[:-1] + share * np.diff(angles, axis=0))
            shorter = begin * Rotation.from_rotvec(share * way.as_rotvec())
            longer |= ((shorter.inv() * between).magnitude() > math.pi / 2) & ~wrapped
        if longer.any():
            first = int(np.argmax(longer))
            degrees = [[round(math.degrees(angle), 3) for angle in row] for row in self.rotations[first : first + 2]]
            raise UsageError(
                f"Between keyframes a path turns the shorter way; from {degrees[0]} to {degrees[1]}° that is not the "
                "way of the angles: add keyframes less than half a turn apart."
            )

    @property
    def finest(self) -> float:
        """Shortest period of anything in the motion (s): two keyframes are half of one."""
        return 2 * float(np.diff(self.times).min())

    def displacement(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far the origin has moved, [n, 3] (m, world); no time may lie beyond the last keyframe."""
        from scipy.interpolate import CubicSpline

        return CubicSpline(self.times, self.displacements, bc_type="natural")(self._within(times))

    def turn(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return how far the body has turned, rotation matrices [n, 3, 3] in world axes; times as above."""
        from scipy.spatial.transform import Rotation, RotationSpline

        return RotationSpline(self.times, Rotation.from_euler("xyz", self.rotations))(self._within(times)).as_matrix()

    def _within(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        times = np.asarray(times, dtype=float)
        # A simulation ends a step or two behind its last reading.
        if times.size and times.max() > self.times[-1] + 0.01:
            raise UsageError(
                f"The path ends at {self.times[-1]:g} s; the scene needs it at {times.max():g} s: add keyframes or "
                "read fewer frames."
            )
        return times


@dataclass(frozen=True, eq=False)
class ArrayFollicle:
    """Trajectory of one whisker base in the frame in which its array stood at t = 0."""

    mount: MountedWhisker
    whisking: HingeMotion = field(default_factory=Still)
    travel: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Displacement of the head [n, 3] (m) at times [n]; None when it stands still."""
    turn: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Rotation of the head [n, 3, 3] about the origin of the array at times [n]; None when it does not turn."""
    finest: float | None = None
    """Shortest period of anything in all of these (s); None when unknown."""
    shift: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    """Displacement of the base in the array [n, 3] (m) at times [n]; None when it stays."""

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [n, 3] (m) and Euler angles (θ, φ, ζ) [n, 3] (rad).

        A head that turns a whisker upright, where these angles lose their meaning, is a :class:`UsageError`.
        """
        times = np.asarray(times, dtype=float)
        place = np.array(self.mount.position) + (0.0 if self.shift is None else self.shift(times))
        position = np.broadcast_to(place, (len(times), 3))
        angles = self.whisking.angles(self.mount, times)
        if self.turn is not None:
            turn, whisking = self.turn, self.whisking
            # The head carries the base point and the frame in which the whisker whisks; only hinge angles drive a
            # follicle, so the product of both rotations is taken apart again.
            position = turn(times) @ place if self.shift is None else np.einsum("nij,nj->ni", turn(times), place)
            first = whisking.angles(self.mount, np.zeros(1))[0]
            angles = follow_angles(
                lambda t: turn(t) @ base_rotation(whisking.angles(self.mount, t)), times, first, self.mount.name
            )
        if self.travel is not None:
            position = position + self.travel(times)
        return position, angles


def smooth_step(times: NDArray[np.float64], duration: float) -> NDArray[np.float64]:
    """Return 6u⁵ − 15u⁴ + 10u³ at times [n] (s), u = t/duration within 0 … 1; ones when ``duration`` is 0."""
    if duration == 0:
        return np.ones_like(np.asarray(times, dtype=float))
    u = np.clip(np.asarray(times, dtype=float) / duration, 0.0, 1.0)
    # Quintic: velocity and acceleration are 0 at both ends, so no step of the acceleration makes whiskers ring.
    return u**3 * (u * (6 * u - 15) + 10)


Phase = Literal["zero", "causal"]
"""``zero``: the filter runs forwards and backwards, so that nothing is delayed and frames know a little of the
future. ``causal``: it runs forwards, as a sensor would, and delays."""
# Periods of the cut-off that are looked at beyond the ends for the backward pass; order of the filter.
FILTER_EDGE = 2.0
FILTER_ORDER = 4


def low_pass(values: NDArray[np.float64], rate: float, cutoff: float, *, phase: Phase = "zero") -> NDArray[np.float64]:
    """Filter signals [n, …] sampled at ``rate`` (Hz) by a fourth-order Butterworth low-pass at ``cutoff`` (Hz).

    From the first value of a signal that is not finite on, it is NaN; before, it is filtered as if it ended there.
    """
    from scipy.signal import butter, sosfilt, sosfiltfilt

    # Second-order sections: the coefficients of one polynomial lose digits at low cut-offs.
    sections = butter(FILTER_ORDER, cutoff, fs=rate, output="sos")
    flat = np.asarray(values, dtype=float).reshape(len(values), -1)
    # Readings before the first one that is not finite; signals with as many are filtered together.
    lengths = np.where(np.isfinite(flat).all(axis=0), len(flat), np.argmin(np.isfinite(flat), axis=0))
    result = np.full_like(flat, np.nan)
    for end in np.unique(lengths[lengths > 0]).tolist():
        columns = lengths == end
        signal = flat[:end, columns]
        if phase == "causal":
            result[:end, columns] = sosfilt(sections, signal, axis=0)
        else:
            edge = min(end - 1, math.ceil(FILTER_EDGE * rate / cutoff))
            result[:end, columns] = sosfiltfilt(sections, signal, axis=0, padlen=edge)
    return result.reshape(np.shape(values))
