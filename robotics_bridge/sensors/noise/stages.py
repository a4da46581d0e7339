"""The noise of whole readings: crosstalk, all that follows it, and the delay. Arrays are planar [C, B, N].

Sensors that fuse the noise into their own kernels need the delay alone. Letters: B environment, N probe, C channel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import pick_device
from brainbench.core.errors import UsageError, check_number
from robotics_bridge.sensors.context import LaunchContext, ReadoutSlice, fill
from robotics_bridge.sensors.kernels.noise import NoiseParams, ReadoutArrays, crosstalk, delay_line, measure
from robotics_bridge.sensors.kernels.readout import CLEAN, FUSED, STAGED
from robotics_bridge.sensors.noise.model import Noise, stream_key


class ReadingNoise:
    """Readings of the sensors that share planar arrays, and their noise: what a sensor's kernel leaves, and the delay.

    It needs no reset: what belongs to an environment whose ``age`` is 0 counts as zero. A late reading (held until the
    next) carries the noise it was recorded with; before the first one after a reset has arrived, the first is read.

    Args:
        slices: The sensors, one after another on N.
        channels: C.
        context: Device, clock and seed.
        fusable: The sensors' kernel applies the noise itself where no crosstalk forbids it; otherwise it is applied
            here, up to dead probes.
        gained: The sensors apply the gain themselves; otherwise it multiplies the signal here.
    """

    def __init__(
        self,
        slices: Sequence[ReadoutSlice],
        channels: int,
        context: LaunchContext,
        *,
        fusable: bool = True,
        gained: bool = True,
    ) -> None:
        self._slices, self._context, self._gained = slices, context, gained
        total, noises = sum(part.count for part in slices), [part.noise for part in slices]
        self._shape = (channels, context.num_envs, total)
        noisy = any(noise.active for noise in noises)
        # Crosstalk needs the values of neighbours, which threads of one kernel cannot have; all other noise is fused.
        self._mixes = any(noise.crosstalk for noise in noises)
        self.mode = CLEAN if not noisy else FUSED if fusable and not self._mixes else STAGED
        lasting = noisy and any(noise.hysteresis for noise in noises), noisy and any(noise.walk for noise in noises)
        self.stores = (self.mode == FUSED and lasting[0], self.mode == FUSED and lasting[1])
        """True for hysteresis, and for drift, that the sensor's kernel keeps."""
        index, probe, active = (np.zeros(total, np.int32) for _ in range(3))
        for number, part in enumerate(slices):
            index[part.span], probe[part.span] = number, np.arange(part.count)
            active[part.span] = 1 if part.active is None else part.active
        io = ReadoutArrays()
        io.truth = self._zeros(True)
        io.measured = self._zeros(True) if noisy else io.truth
        io.hysteresis, io.walk = map(self._zeros, lasting)
        io.part, io.probe, self._active = (context.array(numbers, int) for numbers in (index, probe, active))
        io.age, io.episode, io.env_offset = context.age, context.episode, context.env_offset
        io.knobs = self._draw_keys()
        self.io = io
        """Warp structure of readings, knobs and clock."""
        self._buffers = [self._zeros(self._mixes) for _ in range(2)]
        if self._mixes:
            self._crosstalk = self._prepare_crosstalk()
        self._longest = max(noise.read_delay + noise.jitter for noise in noises)
        self._late, self._ring = self._zeros(self._longest > 0), None
        self.rings = [self._late]
        """Warp arrays of the delay; its ring exists from the first launch on."""
        self.memory = [*self.readable[:-1], io.hysteresis, io.walk, *self._buffers]
        """Warp arrays that later updates depend on, without the delay."""

    @property
    def readable(self) -> list[Any]:
        """Warp arrays that can be read."""
        return [self.io.truth, *([self.io.measured] if self.io.measured is not self.io.truth else []), self._late]

    def _draw_keys(self) -> Any:
        structures = [noise_params(part.noise, self._context.seed, part.name) for part in self._slices]
        return self._context.array(structures, NoiseParams)

    def seed(self) -> None:
        """Draw from the context's present seed from now on."""
        # Into the same memory, which recorded launches keep the address of.
        self.io.knobs.assign(self._draw_keys())

    def _zeros(self, wanted: bool, leading: tuple[int, ...] = ()) -> Any:
        """Return [..., C, B, N] zeros, or an empty array when they are not wanted."""
        return self._context.zeros((*leading, *self._shape) if wanted else (0, 0, 0))

    def _prepare_crosstalk(self) -> tuple[Any, Any]:
        mixed = {number: part for number, part in enumerate(self._slices) if part.noise.crosstalk}
        for part in mixed.values():
            if len(part.layout) != 2:
                raise UsageError(
                    f"Sensor {part.name!r} has crosstalk but its {part.count} probes form no grid; "
                    "give it a layout (ny, nx) or set crosstalk to 0."
                )
        # One array for all sensors: shorter kernels are padded with zeros.
        half = max(math.ceil(4 * part.noise.crosstalk_sigma) for part in mixed.values())
        weights = np.zeros((len(self._slices), half + 1), np.float32)
        shape = np.ones((len(self._slices), 2), np.int32)
        for row, part in mixed.items():
            weights[row], shape[row] = gaussian_weights(part.noise.crosstalk_sigma, half), part.layout
        return self._context.array(shape, int), self._context.array(weights, float)

    def launch(self, dt: float) -> None:
        """Apply to ``io.measured`` what is left of the noise, ``dt`` seconds after the last time, and record it."""
        context, io = self._context, self.io
        io.dt, signal = dt, io.measured
        if self._mixes:
            # Rows into one buffer, columns into the other: threads read neighbours, so no pass writes what it reads.
            for along, buffer in zip((1, 0), self._buffers, strict=True):
                context.launch(crosstalk, self._shape, along, io, signal, *self._crosstalk, buffer)
                signal = buffer
        if self.mode == STAGED:
            context.launch(measure, self._shape[1:], io, self._active, int(self._gained), signal)
        if self._longest > 0:
            context.launch(delay_line, self._shape[1:], io, self.make_room(dt), self._late)

    def make_room(self, dt: float) -> Any:
        """Return the ring of readings that are late, made for steps of ``dt`` (s) the first time; None without any."""
        # The small amount less than a slot keeps a delay of exactly n steps at n despite rounding of the quotient.
        slots = math.ceil(self._longest / dt - 1e-4) + 1
        if self._ring is None and self._longest > 0:
            self._ring = self._zeros(True, (slots,))
            self.rings.append(self._ring)
        if self._ring is not None and slots > self._ring.shape[0]:
            raise UsageError(
                f"A delay of {self._longest:g} s needs {slots} readings at a time step of {dt:g} s, but the first "
                f"update made room for {self._ring.shape[0]}; build the sensors anew for the shorter step."
            )
        return self._ring

    def read(self) -> Any:
        """Return the planar array [C, B, N] that is read: an earlier reading than the newest if there is a delay."""
        return self._late if self._longest > 0 else self.io.measured


def noise_params(noise: Noise, seed: int, name: str) -> Any:
    """Return the Warp structure ``NoiseParams`` of the sensor ``name`` in an experiment."""
    return fill(NoiseParams, noise, levels=1.0 / noise.quantum if noise.quantum else 0.0, **stream_key(seed, name))


def gaussian_weights(sigma: float, half: int) -> NDArray[np.float64]:
    """Return the centre and one side of a normalised Gaussian [half + 1], cut at four standard deviations."""
    # Sums to one over both sides, so that crosstalk moves a signal without making it stronger (4.28).
    weights = np.exp(-0.5 * (np.arange(half + 1) / sigma) ** 2)
    weights[np.arange(half + 1) > 4 * sigma] = 0
    return weights / (weights[0] + 2 * weights[1:].sum())


def simulate(
    noise: Noise,
    clean: ArrayLike,
    *,
    dt: float,
    seed: int = 0,
    layout: tuple[int, ...] | None = None,
    name: str = "sensor",
    device: str = "cpu",
    env_offset: int = 0,
) -> NDArray[np.float32]:
    """Return what a sensor with this noise measures of a recorded clean signal.

    The error of the sensing radius needs the geometry and is left out.

    Args:
        clean: [T, B, N, C] signal [unit of the sensor].
        dt: Time step [s].
        seed: Seed of the experiment; its numbers also depend on the ``name`` of the sensor.
        layout: (ny, nx) where crosstalk is wanted.
        env_offset: Number of the first environment in the whole experiment.
    """
    frames = np.asarray(clean, dtype=np.float32)
    if frames.ndim != 4:
        raise UsageError(f"A recorded signal has axes [time, environment, probe, channel]; received {frames.shape}.")
    check_number("dt (s)", dt, above=0)
    _steps, envs, probes, channels = frames.shape
    layout = layout or (probes,)
    if any(not isinstance(side, int) or side < 1 for side in layout) or math.prod(layout) != probes:
        raise UsageError(f"The layout of {probes} probes is (ny, nx) with ny nx = {probes}; received {layout}.")
    where = pick_device(device)
    slices = [ReadoutSlice(name, replace(noise, radius=0.0), 0, layout)]
    context = LaunchContext(envs, where, seed, env_offset)
    stages, out = ReadingNoise(slices, channels, context, fusable=False, gained=False), np.empty_like(frames)
    for step, frame in enumerate(frames):
        context.age.fill_(step)
        stages.io.measured.assign(np.ascontiguousarray(frame.transpose(2, 0, 1)))
        stages.launch(dt)
        out[step] = stages.read().numpy().transpose(1, 2, 0)
    return out
