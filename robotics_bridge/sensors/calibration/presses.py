"""Presses of a ball on a device, and what its taxels should read, with derivatives.

The law is that of :class:`~robotics_bridge.sensors.taxels.sensors.KinematicTaxel` with friction, of taxels that a ball
touches; a test compares both. What follows (gain, crosstalk, delay, hysteresis) is linear and that of
:mod:`robotics_bridge.sensors.noise`; then each taxel reads along axes of its own. Letters: T reading, N taxel,
C axis (1: along the inward normal, or 3), G shared number, Q touch of one taxel, L reading of a touch, V variant.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from brainbench.core.errors import DataError
from robotics_bridge.sensors.calibration.calibrate import Log
from robotics_bridge.sensors.noise.stages import gaussian_weights
from robotics_bridge.sensors.probes.placement import Probes

_MARGIN = 4e-3
"""Distance (m) beyond its radius at which a taxel may still be touched, since it may lie elsewhere."""
_STEPS = np.repeat([1e-8, 1e-6], [3, 2])
"""Changes of place (m), friction and grip by which derivatives are taken."""
MOST_TAXELS, MOST_NUMBERS = 144, 5_000_000
"""Most taxels, and numbers of a log, that are fitted at once."""
SHARED = (
    "stiffness", "exponent", "damping", "friction", "grip", "crosstalk", "hysteresis", "hysteresis_tau", "read_delay",
)  # fmt: skip
"""Numbers G that all taxels share: stiffness and hysteresis_tau as logarithms, damping as a part of stiffness (s/m)."""


@dataclass(frozen=True, eq=False)
class Presses:
    """A log of a ball's presses on the taxels of one link."""

    log: Log
    probes: Probes
    """Where the taxels should be [N]."""
    radius: float
    """Of the ball (m)."""
    ball: NDArray[np.float64] = field(init=False)
    """[T, 3] its centre (m)."""
    near: NDArray[np.bool_] = field(init=False)
    """[N, T] where a taxel may be touched."""
    pressed: NDArray[np.bool_] = field(init=False)
    """[T] where one should be."""

    def __post_init__(self) -> None:
        count, probes, ball = self.log.readings.shape[1], self.probes, self.log.ball
        if ball is None:
            raise DataError("A log of presses has the columns 'x', 'y' and 'z', the centre of the ball (m).")
        if count not in (len(probes), 3 * len(probes)):
            raise DataError(
                f"The log has {count} columns of readings and the device {len(probes)} taxels, which give one or three "
                "each: a log of another device?"
            )
        if len(probes) > MOST_TAXELS or self.log.readings.size > MOST_NUMBERS:
            raise DataError(
                f"{len(probes)} taxels with {self.log.readings.size:,} numbers are more than are fitted at once "
                f"({MOST_TAXELS} and {MOST_NUMBERS:,}); calibrate a part of the device, or thin the log."
            )
        gap = np.stack([np.linalg.norm(ball - place, axis=1) for place in probes.position]) - self.radius
        if gap.min() > probes.radius.max():
            raise DataError(
                f"No press touches a taxel: the ball comes no nearer than {gap.min():.3g} m, and taxels sense to "
                f"{probes.radius.max():.3g} m. Its centre is in metres in the frame of the link; check --ball."
            )
        if gap.min() < -0.5 * self.radius:
            raise DataError(
                f"A taxel lies {-gap.min():.3g} m inside the ball, more than half its radius of {self.radius:g} m: "
                "check its radius (--ball) and the frame of its centre."
            )
        object.__setattr__(self, "ball", ball)
        object.__setattr__(self, "pressed", (gap < probes.radius[:, None]).any(axis=0))
        object.__setattr__(self, "near", gap < (probes.radius + _MARGIN)[:, None])

    @property
    def readings(self) -> NDArray[np.float64]:
        """[T, N, C]."""
        return self.log.readings.reshape(len(self.log.time), len(self.probes), -1)

    @property
    def axes(self) -> NDArray[np.float64]:
        """[N, C, 3] along which the taxels should read."""
        count = len(self.probes)
        return np.tile(np.eye(3), (count, 1, 1)) if self.readings.shape[2] == 3 else -self.probes.normal[:, None]

    @cached_property
    def speed(self) -> NDArray[np.float64]:
        """[T, 3] of the ball (m/s)."""
        return np.concatenate([np.gradient(self.ball[span], self.log.step, axis=0) for span in self.log.spans])

    def stretches(self, near: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
        """Return the rows of each stretch of ``near`` [T], which ends with an episode."""
        blocks: list[NDArray[np.int64]] = []
        for span in self.log.spans:
            rows = np.arange(span.start, span.stop)[near[span]]
            blocks += [block for block in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(block)]
        return blocks

    @cached_property
    def runs(self) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
        """Rows [L, Q] of the touches of each taxel, the taxels [Q], and what of the rows is no padding [L, Q]."""
        runs = [(n, rows) for n, near in enumerate(self.near) for rows in self.stretches(near)]
        longest = max(len(rows) for _, rows in runs)
        padded = np.stack([np.pad(rows, (0, longest - len(rows)), mode="edge") for _, rows in runs], axis=1)
        inside = np.arange(longest)[:, None] < [len(rows) for _, rows in runs]
        return padded, np.array([n for n, _ in runs]), inside


@dataclass(frozen=True, eq=False)
class Device:
    """Numbers of a device, as they are fitted."""

    shared: dict[str, float]
    place: NDArray[np.float64]
    """[N, 3] (m)."""
    axes: NDArray[np.float64]
    """[N, C, 3] along which taxels read that are not turned."""
    turn: Rotation
    """[N] of each taxel and its axes from where they should be."""
    gain: NDArray[np.float64]
    """[N] logarithm of its force over that of the mean taxel."""
    bias: NDArray[np.float64]
    """[N, C]."""


def crosstalk_of(probes: Probes) -> NDArray[np.float64] | None:
    """Return the share [N, N] of each taxel's signal in each other's (4.28), or None for taxels that form no grid."""
    if len(probes.shape) != 2 or len(probes) == 1 or not probes.active.all():
        return None
    half = max(probes.shape)
    weight = np.pad(gaussian_weights(1.0, max(half, 4)), (0, half))
    rows, columns = (np.abs(np.subtract.outer(np.arange(side), np.arange(side))) for side in probes.shape)
    return np.asarray(np.kron(weight[rows], weight[columns]), np.float64)


def forces(presses: Presses, device: Device, *, slopes: bool = True) -> NDArray[np.float64]:
    """Return forces [1 or 8, T, N, 3] of taxels of stiffness 1, and with ``slopes`` their derivatives.

    By place (3), exponent, damping, friction and grip.
    """
    rows, taxel, inside = presses.runs
    law, centre = device.shared, presses.ball[rows]
    move = np.diff(centre, axis=0, prepend=centre[:1])
    changes = np.vstack([np.zeros(5), np.diag(_STEPS)])[: 6 if slopes else 1]
    geometry = np.array([0, 1, 2, 3, 0, 0])[: len(changes)]
    place = device.place[taxel] + changes[:4, None, :3]
    away = place[:, None] - centre
    gap = np.linalg.norm(away, axis=-1)
    normal = away / gap[..., None]
    depth = (presses.probes.radius[taxel] + presses.radius) - gap
    # A derivative keeps the readings that find a taxel deep, at which the law has an edge.
    touched = np.broadcast_to((depth[0] > 0) & inside, depth.shape)
    depth = np.where(touched, np.maximum(depth, 1e-12), 1.0)
    most, ratio = (law[name] + changes[:, index, None, None]
                   for index, name in ((3, "friction"), (4, "grip")))  # fmt: skip
    # How far the ball went since each taxel took hold of it, in the limits of friction (kernels.kinematic.hold).
    sigma = np.zeros((len(changes), *centre.shape))
    way, held = np.zeros_like(sigma[:, 0]), np.zeros((len(changes), len(taxel), 1), bool)
    for index in range(len(rows)):
        across, deep = normal[geometry, index], depth[geometry, index, :, None]
        way = (way + move[index]) * held
        drag = (way - np.einsum("vqi,vqi->vq", way, across)[..., None] * across) * (ratio / deep)
        size = np.sqrt(np.einsum("vqi,vqi->vq", drag, drag))[..., None]
        # A derivative keeps the readings at which a taxel slips: there the way loses its part along the normal.
        slips = np.broadcast_to((size > most)[:1], size.shape)
        drag = np.where(slips, drag * (most / np.where(slips, size, 1.0)), drag)
        way = np.where(slips, drag * (deep / ratio), way)
        sigma[:, index] = drag
        held = touched[geometry, index, :, None]
    approach = np.einsum("lqi,vlqi->vlq", presses.speed[rows], normal)
    pull = 1 + law["damping"] * approach
    power = touched * depth ** law["exponent"] * (pull > 0)
    push = power * pull
    force = push[geometry, ..., None] * (normal[geometry] + sigma)
    values = force
    if slopes:
        slope = np.moveaxis((force[1:] - force[0]).T / _STEPS, -1, 0).swapaxes(1, 3)
        more = [np.log(depth[0])[..., None] * force[0], (power * approach)[0, ..., None] * (normal[0] + sigma[0])]
        values = np.stack([force[0], *slope[:3], *more, *slope[3:]])
    out = np.zeros((len(values), len(presses.ball), len(presses.probes), 3))
    out[:, rows[inside], np.broadcast_to(taxel, rows.shape)[inside]] = values[:, inside]
    return out


@dataclass(frozen=True, eq=False)
class Answer:
    """What a device should read, and how that changes with its numbers."""

    readings: NDArray[np.float64]
    """[T, N, C]."""
    shared: NDArray[np.float64]
    """[G, T, N, C] derivatives."""
    felt: NDArray[np.float64]
    """[4, T, N, 3] derivatives of each taxel's signal (N) by its place and gain, before crosstalk."""
    turned: NDArray[np.float64]
    """[3, T, N, C] derivatives of a taxel's reading by its turn."""
    along: NDArray[np.float64]
    """[N, C, 3] along which taxels read."""


def answer(presses: Presses, device: Device, mixing: NDArray[np.float64] | None) -> Answer:
    """Return the readings that a device should give, with derivatives."""
    base, *slope = forces(presses, device)
    scale = np.exp(device.shared["stiffness"] + device.gain)[:, None]
    matrix = mixed_by(device, mixing)
    late = Lag(presses, device.shared)
    clean, slope = base * scale, np.array(slope) * scale
    pure = matrix @ clean
    signal, law = late(pure), late(matrix @ slope[3:], axis=1)
    spread = np.zeros_like(signal) if mixing is None else late(mixing @ clean - clean)
    delayed, ahead = late.delayed(pure), late.delayed(pure, 1)
    creep, past = late.creep(delayed), late.creep(ahead)
    slower = device.shared["hysteresis"] * (late.creep(delayed, factor=1 + 1e-4) - creep) / 1e-4
    rate = (ahead - delayed + device.shared["hysteresis"] * (past - creep)) / presses.log.step
    shared = np.stack([signal, *law, spread, creep, slower, rate])
    along = turned_axes(device)
    turned = np.moveaxis(np.cross(along, signal[:, :, None]), -1, 0)

    def _read(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.einsum("nci,...tni->...tnc", along, values)

    felt = late(np.concatenate([slope[:3], clean[None]]), axis=1)
    return Answer(_read(signal) + device.bias, _read(shared), felt, turned, along)


def readings_of(presses: Presses, device: Device, mixing: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the readings [T, N, C] alone that a device should give."""
    felt = forces(presses, device, slopes=False)[0] * np.exp(device.shared["stiffness"] + device.gain)[:, None]
    signal = Lag(presses, device.shared)(mixed_by(device, mixing) @ felt)
    return np.einsum("nci,tni->tnc", turned_axes(device), signal) + device.bias


def turned_axes(device: Device) -> NDArray[np.float64]:
    """Return the axes [N, C, 3] along which the taxels of a device read."""
    return np.einsum("nij,ncj->nci", device.turn.as_matrix(), device.axes)


def mixed_by(device: Device, mixing: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return how much [N, N] of each taxel's signal the taxels of a device read."""
    share = 0.0 if mixing is None else device.shared["crosstalk"]
    return (1 - share) * np.eye(len(device.place)) + (0.0 if mixing is None else share * mixing)


class Lag:
    """Delay and hysteresis of a device, applied to signals along an axis T, episode by episode."""

    def __init__(self, presses: Presses, shared: dict[str, float]) -> None:
        self._spans, self._step = presses.log.spans, presses.log.step
        self._delay, self._share = shared["read_delay"] / self._step, shared["hysteresis"]
        self._tau = np.exp(shared["hysteresis_tau"])

    def __call__(self, values: NDArray[np.float64], axis: int = 0) -> NDArray[np.float64]:
        """Return signals as late as the device is, with its hysteresis."""
        values = self.delayed(values, axis=axis)
        return values + self._share * self.creep(values, axis=axis)

    def delayed(self, values: NDArray[np.float64], more: int = 0, axis: int = 0) -> NDArray[np.float64]:
        """Return signals [T, …] as late as the device, and ``more`` readings; before, they had their first value."""
        whole = int(np.floor(self._delay))
        part = self._delay - whole
        near, far = (
            np.concatenate([np.maximum(np.arange(span.start, span.stop) - whole - more - extra, span.start)
                            for span in self._spans])
            for extra in (0, 1)
        )  # fmt: skip
        late = np.take(values, near, axis)
        return (1 - part) * late + part * np.take(values, far, axis) if part else late

    def creep(self, values: NDArray[np.float64], axis: int = 0, factor: float = 1.0) -> NDArray[np.float64]:
        """Return ξ [T, …] of 4.26, with its time constant times a factor."""
        keep, values = np.exp(-self._step / (factor * self._tau)), np.moveaxis(values, axis, 0)
        parts = [lfilter([1.0, -1.0], [1.0, -keep], values[span] - values[span][:1], axis=0) for span in self._spans]
        return np.moveaxis(np.concatenate(parts), 0, axis)
