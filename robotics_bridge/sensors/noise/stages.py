"""The noise of whole readings: a stage that measures, and a line that delays. Arrays are planar [C, B, N].

Sensors that fuse the noise into their own kernels need the delay alone. Letters: B environment, N probe, C channel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.devices import pick_device, warp
from brainbench.core.errors import UsageError
from brainbench.core.reading.ranges import check_number
from robotics_bridge.sensors.context import LaunchContext, ReadoutSlice, UpdateClock
from robotics_bridge.sensors.noise.kernels.noise import NoiseParams, crosstalk, delay_line, measure
from robotics_bridge.sensors.noise.model import Noise, stream_seed

wp = warp()


class NoiseArrays:
    """Noise and probe indices of the sensors that share planar arrays, on the device.

    Args:
        slices: the sensors, one after another on N.
        channels: C.
        context: device, clock and seed.
    """

    def __init__(self, slices: Sequence[ReadoutSlice], channels: int, context: LaunchContext) -> None:
        self.slices, self.channels, self.context = slices, channels, context
        self.total = sum(part.count for part in slices)
        """N."""
        index, probe, active = (np.zeros(self.total, np.int32) for _ in range(3))
        for number, part in enumerate(slices):
            index[part.span], probe[part.span] = number, np.arange(part.count)
            active[part.span] = 1 if part.active is None else part.active
        self.part, self.probe, self.active = (context.array(item, int) for item in (index, probe, active))
        """Warp arrays [N]: number of the sensor, number of the probe within it, 0 for fillers."""
        structures = [part.noise.params(stream_seed(context.seed, part.name)) for part in slices]
        self.params = context.array(structures, NoiseParams)

    def zeros(self, wanted: bool, leading: tuple[int, ...] = ()) -> Any:
        """Return [..., C, B, N] zeros, or an empty array when they are not wanted."""
        shape = (*leading, self.channels, self.context.num_envs, self.total)
        return self.context.zeros(shape if wanted else (0,) * len(shape))

    def clock_inputs(self, dt: float) -> list[Any]:
        """Return age, episode, first environment and time step (s) as kernels take them."""
        clock = self.context.clock
        return [clock.age, clock.episode, int(clock.env_offset), float(dt)]


class NoiseStage:
    """The measured branch after the sensor's own kernel: crosstalk, then everything up to dead probes.

    For sensors that do not fuse the noise into their kernel. It needs no reset: what belongs to an environment
    whose ``clock.age`` is 0 counts as zero.

    Args:
        arrays: The sensors that share the arrays.
        gained: The sensor applies the gain itself; otherwise it multiplies the signal here.

    Raises:
        UsageError: crosstalk is asked for on probes that form no grid.
    """

    def __init__(self, arrays: NoiseArrays, *, gained: bool = True) -> None:
        self._arrays, self._gained = arrays, gained
        noises = [part.noise for part in arrays.slices]
        self._hysteresis = arrays.zeros(any(noise.hysteresis for noise in noises))
        self._walk = arrays.zeros(any(noise.walk for noise in noises))
        self._mixes = any(noise.crosstalk for noise in noises)
        self._buffers = [arrays.zeros(self._mixes) for _ in range(2)]
        if self._mixes:
            self._crosstalk = self._prepare_crosstalk()

    def _prepare_crosstalk(self) -> tuple[Any, Any, Any]:
        slices, context = self._arrays.slices, self._arrays.context
        mixed = {number: part for number, part in enumerate(slices) if part.noise.crosstalk}
        for part in mixed.values():
            if len(part.layout) != 2:
                raise UsageError(
                    f"Sensor {part.name!r} has crosstalk but its {part.count} probes form no grid; "
                    "give it a layout (ny, nx) or set crosstalk to 0."
                )
        # One array for all sensors: shorter kernels are padded with zeros.
        half = max(math.ceil(4 * part.noise.crosstalk_sigma) for part in mixed.values())
        weights = np.zeros((len(slices), half + 1), np.float32)
        shape, strength = np.ones((len(slices), 2), np.int32), np.zeros(len(slices), np.float32)
        for row, part in mixed.items():
            weights[row] = gaussian_weights(part.noise.crosstalk_sigma, half)
            shape[row], strength[row] = part.layout, part.noise.crosstalk
        return context.array(shape, int), context.array(strength, float), context.array(weights, float)

    @property
    def state_bytes(self) -> int:
        """Memory per environment [bytes]."""
        arrays = (self._hysteresis, self._walk, *self._buffers)
        return sum(array.size for array in arrays) * 4 // max(self._arrays.context.num_envs, 1)

    def launch(self, x: Any, out: Any, dt: float) -> None:
        """Measure the signal ``x`` [C, B, N] (after radius noise) into ``out``; ``dt`` is the time step [s]."""
        own, context = self._arrays, self._arrays.context
        signal = x
        if self._mixes:
            first, second = self._buffers
            # Rows into one buffer, columns into the other: threads read neighbours, so no pass writes what it reads.
            for along, source, target in ((1, x, first), (0, first, second)):
                context.launch(crosstalk, target.shape, along, x, source, own.part, own.probe, *self._crosstalk, target)
            signal = second
        inputs = [own.params, own.part, own.probe, own.active, *own.clock_inputs(dt), int(self._gained)]
        dim = (context.num_envs, own.total)
        context.launch(measure, dim, *inputs, signal, self._hysteresis, self._walk, out)


class DelayLine:
    """Late readings: a ring of what was measured, read with a zero-order hold.

    A late reading carries the noise it was recorded with. Before the first reading after a reset has arrived,
    the first is read.

    Args:
        arrays: The sensors that share the arrays.
    """

    def __init__(self, arrays: NoiseArrays) -> None:
        self._arrays, noises = arrays, [part.noise for part in arrays.slices]
        self._delay = arrays.context.array([noise.read_delay for noise in noises], float)
        self._jitter = arrays.context.array([noise.jitter for noise in noises], float)
        self._longest = max((noise.read_delay + noise.jitter for noise in noises), default=0.0)
        self._ring: Any = None
        self.out = arrays.zeros(True)
        """[C, B, N] what is read."""

    @property
    def ring_bytes(self) -> int:
        """Memory per environment [bytes]; the ring exists from the first launch on."""
        ring = 0 if self._ring is None else self._ring.size
        return (ring + self.out.size) * 4 // max(self._arrays.context.num_envs, 1)

    def launch(self, measured: Any, dt: float) -> None:
        """Record ``measured`` [C, B, N] of this update; ``dt`` is the time step [s].

        Raises:
            UsageError: the time step became so short that the ring does not reach back far enough.
        """
        own, context = self._arrays, self._arrays.context
        # The small amount less than a slot keeps a delay of exactly n steps at n despite rounding of the quotient.
        slots = math.ceil(self._longest / dt - 1e-4) + 1
        if self._ring is None:
            self._ring = own.zeros(True, (slots,))
        if slots > self._ring.shape[0]:
            raise UsageError(
                f"A delay of {self._longest:g} s needs {slots} readings at a time step of {dt:g} s, but the first "
                f"update made room for {self._ring.shape[0]}; build the sensors anew for the shorter step."
            )
        inputs = [own.params, own.part, self._delay, self._jitter, *own.clock_inputs(dt)]
        context.launch(delay_line, (context.num_envs, own.total), *inputs, measured, self._ring, self.out)


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
        noise: Knobs.
        clean: [T, B, N, C] signal [unit of the sensor].
        dt: Time step [s].
        seed: Seed of the experiment.
        layout: (ny, nx) where crosstalk is wanted.
        name: Name of the sensor.
        device: ``cpu`` or ``cuda``.
        env_offset: Number of the first environment in the whole experiment.

    Raises:
        UsageError: the signal has not four axes, or the layout is none of its probes.
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
    clock = UpdateClock(*(wp.zeros(envs, dtype=int, device=where) for _ in range(2)), env_offset=env_offset)
    slices = [ReadoutSlice(name, replace(noise, radius=0.0), 0, layout)]
    arrays = NoiseArrays(slices, channels, LaunchContext(envs, where, seed, clock))
    stage, line = NoiseStage(arrays, gained=False), DelayLine(arrays) if noise.read_delay else None
    measured, out = arrays.zeros(True), np.empty_like(frames)
    for step, frame in enumerate(frames):
        clock.age.fill_(step)
        stage.launch(wp.array(np.ascontiguousarray(frame.transpose(2, 0, 1)), device=where), measured, dt)
        if line:
            line.launch(measured, dt)
        out[step] = (line.out if line else measured).numpy().transpose(1, 2, 0)
    return out
