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

from brainbench.core.devices import pick_device, warp
from brainbench.core.errors import UsageError, check_number
from robotics_bridge.sensors.context import LaunchContext, ReadoutSlice, fill
from robotics_bridge.sensors.kernels.noise import NoiseParams, crosstalk, delay_line, measure
from robotics_bridge.sensors.noise.model import Noise, stream_key

wp = warp()


class ReadingNoise:
    """Noise of the sensors that share planar arrays: what their own kernel leaves to stages, and the delay.

    It needs no reset: what belongs to an environment whose ``age`` is 0 counts as zero. A late reading (held until the
    next) carries the noise it was recorded with; before the first one after a reset has arrived, the first is read.

    Args:
        slices: The sensors, one after another on N.
        channels: C.
        context: Device, clock and seed.
        staged: Crosstalk and everything up to dead probes are applied here; otherwise the sensors' kernel does it.
        gained: The sensors apply the gain themselves; otherwise it multiplies the signal here.
    """

    def __init__(
        self,
        slices: Sequence[ReadoutSlice],
        channels: int,
        context: LaunchContext,
        *,
        staged: bool,
        gained: bool = True,
    ) -> None:
        self._slices, self._context, self._staged, self._gained = slices, context, staged, gained
        total, noises = sum(part.count for part in slices), [part.noise for part in slices]
        self._shape = (channels, context.num_envs, total)
        index, probe, active = (np.zeros(total, np.int32) for _ in range(3))
        for number, part in enumerate(slices):
            index[part.span], probe[part.span] = number, np.arange(part.count)
            active[part.span] = 1 if part.active is None else part.active
        self.part, self.probe, self._active = (context.array(item, int) for item in (index, probe, active))
        """Warp arrays [N]: number of the sensor, number of the probe within it, 0 for fillers."""
        self.params = self._draw_keys()
        """Warp array [S] of the knobs."""
        self._hysteresis = self._zeros(staged and any(noise.hysteresis for noise in noises))
        self._walk = self._zeros(staged and any(noise.walk for noise in noises))
        self._mixes = staged and any(noise.crosstalk for noise in noises)
        self._buffers = [self._zeros(self._mixes) for _ in range(2)]
        self.lasting = [self._hysteresis, self._walk, *self._buffers]
        """Warp arrays of the memory, without the delay."""
        if self._mixes:
            self._crosstalk = self._prepare_crosstalk()
        self._delay = context.array([noise.read_delay for noise in noises], float)
        self._jitter = context.array([noise.jitter for noise in noises], float)
        self._longest = max(noise.read_delay + noise.jitter for noise in noises)
        self.late, self._ring = self._zeros(self._longest > 0), None
        """Warp array of late readings; empty without a delay."""
        self.rings = [self.late]
        """Warp arrays of the delay; its ring exists from the first launch on."""

    def _draw_keys(self) -> Any:
        structures = [noise_params(part.noise, self._context.seed, part.name) for part in self._slices]
        return self._context.array(structures, NoiseParams)

    def seed(self) -> None:
        """Draw from the context's present seed from now on."""
        # Into the same memory, which recorded launches keep the address of.
        self.params.assign(self._draw_keys())

    def _zeros(self, wanted: bool, leading: tuple[int, ...] = ()) -> Any:
        """Return [..., C, B, N] zeros, or an empty array when they are not wanted."""
        return self._context.zeros((*leading, *self._shape) if wanted else (0, 0, 0))

    def _prepare_crosstalk(self) -> tuple[Any, Any, Any]:
        slices, context = self._slices, self._context
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

    def launch(self, x: Any, out: Any, dt: float) -> None:
        """Measure the signal ``x`` [C, B, N] (after radius noise) into ``out`` if that is staged; record ``out``."""
        context = self._context
        knobs, now = [self.params, self.part], [context.age, context.episode, context.env_offset, float(dt)]
        if self._mixes:
            first, second = self._buffers
            # Rows into one buffer, columns into the other: threads read neighbours, so no pass writes what it reads.
            for along, source, target in ((1, x, first), (0, first, second)):
                context.launch(
                    crosstalk, self._shape, along, x, source, self.part, self.probe, *self._crosstalk, target
                )
            x = second
        if self._staged:
            inputs = [*knobs, self.probe, self._active, *now, int(self._gained), x, self._hysteresis, self._walk, out]
            context.launch(measure, self._shape[1:], *inputs)
        if self._longest > 0:
            inputs = [*knobs, self._delay, self._jitter, *now, out, self.make_room(dt), self.late]
            context.launch(delay_line, self._shape[1:], *inputs)

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

    def read(self, measured: Any) -> Any:
        """Return what is read where ``measured`` [C, B, N] is newest: an earlier reading if there is a delay."""
        return self.late if self._longest > 0 else measured


def noise_params(noise: Noise, seed: int, name: str) -> Any:
    """Return the Warp structure ``NoiseParams`` of the sensor ``name`` in an experiment."""
    ranges = dict(zip(("gain_low", "gain_high", "dead_low", "dead_high"), noise.gain + noise.dead_range, strict=True))
    levels = 1.0 / noise.quantum if noise.quantum else 0.0
    return fill(NoiseParams, noise, tau=noise.hysteresis_tau, levels=levels, **stream_key(seed, name), **ranges)


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
    stages = ReadingNoise(slices, channels, context, staged=True, gained=False)
    measured, out = context.zeros((channels, envs, probes)), np.empty_like(frames)
    for step, frame in enumerate(frames):
        context.age.fill_(step)
        stages.launch(wp.array(np.ascontiguousarray(frame.transpose(2, 0, 1)), device=where), measured, dt)
        out[step] = stages.read(measured).numpy().transpose(1, 2, 0)
    return out
