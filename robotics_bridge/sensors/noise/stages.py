"""The noise of whole readings: a stage that measures, and a line that delays. Arrays are planar [C, B, N].

Sensors that fuse the noise into their own kernels need the delay alone. Letters: B environment, N probe, C channel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.errors import UsageError
from robotics_bridge.sensors.noise.model import Noise, stream_seed

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class NoisePart:
    """The probes of one sensor within a planar array [C, B, N]."""

    name: str
    """Name of the sensor, for its random numbers."""
    noise: Noise
    start: int
    """Its first probe on N."""
    layout: tuple[int, ...]
    """(n,) or (ny, nx)."""
    active: NDArray[np.bool_] | None = None
    """[n] False for fillers, which read 0; None if there are none."""

    @property
    def count(self) -> int:
        """Number of probes."""
        return math.prod(self.layout)


class _Parts:
    """What the stages share: per-part structures and per-probe indices on the device."""

    def __init__(self, parts: Sequence[NoisePart], channels: int, num_envs: int, context: Any) -> None:
        from brainbench.core.devices import warp
        from robotics_bridge.sensors.noise.kernels.noise import NoiseParams

        self.wp = wp = warp()
        self.noises = [part.noise for part in parts]
        self.channels, self.num_envs, self.clock, self.device = channels, num_envs, context.clock, context.device
        self.total = sum(part.count for part in parts)
        index, probe, active = (np.zeros(self.total, np.int32) for _ in range(3))
        for number, part in enumerate(parts):
            place = slice(part.start, part.start + part.count)
            index[place], probe[place] = number, np.arange(part.count)
            active[place] = 1 if part.active is None else part.active
        self.part, self.probe, self.active = (self.array(item) for item in (index, probe, active))
        structures = [part.noise.params(stream_seed(context.seed, part.name)) for part in parts]
        self.params = wp.array(structures, dtype=NoiseParams, device=self.device)

    def array(self, values: ArrayLike) -> Any:
        """Copy a NumPy array to the device."""
        return self.wp.array(np.ascontiguousarray(values), device=self.device)

    def zeros(self, wanted: bool, leading: tuple[int, ...] = ()) -> Any:
        """Return [..., C, B, N] zeros, or an empty array when they are not wanted."""
        shape = (*leading, self.channels, self.num_envs, self.total) if wanted else (0,) * (3 + len(leading))
        return self.wp.zeros(shape, dtype=self.wp.float32, device=self.device)

    def run(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any]) -> None:
        """Launch a kernel."""
        self.wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)


class NoiseStage:
    """The measured branch after the sensor's own kernel: crosstalk, then everything up to dead probes.

    For sensors that do not fuse the noise into their kernel. It needs no reset: what belongs to an environment
    whose ``clock.age`` is 0 counts as zero.
    """

    def __init__(
        self, parts: Sequence[NoisePart], channels: int, num_envs: int, context: Any, *, gained: bool = True
    ) -> None:
        """Prepare the stage.

        Args:
            parts: The sensors that share the arrays.
            channels: C.
            num_envs: B.
            context: Has ``clock`` (``age``, ``episode``, ``env_offset``), ``device`` and ``seed``.
            gained: The sensor applies the gain itself; otherwise it multiplies the signal here.

        Raises:
            UsageError: crosstalk is asked for on probes that form no grid.
        """
        self._parts = own = _Parts(parts, channels, num_envs, context)
        self._gained = gained
        self._hysteresis = own.zeros(any(noise.stores_hysteresis for noise in own.noises))
        self._walk = own.zeros(any(noise.stores_walk for noise in own.noises))
        self._mixes = any(noise.crosstalks for noise in own.noises)
        self._buffers = [own.zeros(self._mixes) for _ in range(2)]
        if self._mixes:
            self._crosstalk = self._prepare_crosstalk(parts)

    def _prepare_crosstalk(self, parts: Sequence[NoisePart]) -> tuple[Any, Any, Any]:
        own = self._parts
        half = 0
        for part in parts:
            if part.noise.crosstalks and len(part.layout) != 2:
                raise UsageError(
                    f"Sensor {part.name!r} has crosstalk but its {part.count} probes form no grid; "
                    "give it a layout (ny, nx) or set crosstalk to 0."
                )
            if part.noise.crosstalks:
                half = max(half, math.ceil(4 * part.noise.crosstalk_sigma))
        weights = np.zeros((len(parts), half + 1), np.float32)
        shape, strength = np.ones((len(parts), 2), np.int32), np.zeros(len(parts), np.float32)
        for row, part in enumerate(parts):
            if part.noise.crosstalks:
                weights[row] = gaussian_weights(part.noise.crosstalk_sigma, half)
                shape[row], strength[row] = part.layout, part.noise.crosstalk
        return own.array(shape), own.array(strength), own.array(weights)

    @property
    def state_bytes(self) -> int:
        """Memory per environment [bytes]."""
        arrays = (self._hysteresis, self._walk, *self._buffers)
        return sum(array.size for array in arrays) * 4 // max(self._parts.num_envs, 1)

    def launch(self, x: Any, out: Any, dt: float) -> None:
        """Measure the signal ``x`` [C, B, N] (after radius noise) into ``out``; ``dt`` is the time step [s]."""
        from robotics_bridge.sensors.noise.kernels.noise import crosstalk, measure

        own, clock = self._parts, self._parts.clock
        if own.total == 0 or own.num_envs == 0:
            return
        signal = x
        if self._mixes:
            for along, source, target in ((1, x, self._buffers[0]), (0, self._buffers[0], self._buffers[1])):
                shape, strength, weights = self._crosstalk
                inputs = [along, x, source, own.part, own.probe, shape, strength, weights, target]
                own.run(crosstalk, (own.channels, own.num_envs, own.total), inputs)
            signal = self._buffers[1]
        inputs = [own.params, own.part, own.probe, own.active, clock.age, clock.episode, int(clock.env_offset)]
        inputs += [int(self._gained), float(dt), signal, self._hysteresis, self._walk, out]
        own.run(measure, (own.num_envs, own.total), inputs)


class DelayLine:
    """Late readings: a ring of what was measured, read with a zero-order hold.

    A late reading carries the noise it was recorded with. Before the first reading after a reset has arrived,
    the first is read.

    Args:
        parts: Sensors within the planar array, one after another on N.
        channels: C.
        num_envs: B.
        context: Of the suite; lends clock, device and seed.
    """

    def __init__(self, parts: Sequence[NoisePart], channels: int, num_envs: int, context: Any) -> None:
        self._parts = own = _Parts(parts, channels, num_envs, context)
        self._delay = own.array(np.array([noise.read_delay for noise in own.noises], np.float32))
        self._jitter = own.array(np.array([noise.jitter for noise in own.noises], np.float32))
        self._longest = max((noise.read_delay + noise.jitter for noise in own.noises), default=0.0)
        self._ring: Any = None
        self.out = own.zeros(True)
        """[C, B, N] what is read."""

    @property
    def ring_bytes(self) -> int:
        """Memory per environment [bytes]; the ring exists from the first launch on."""
        ring = 0 if self._ring is None else self._ring.size
        return (ring + self.out.size) * 4 // max(self._parts.num_envs, 1)

    def launch(self, measured: Any, dt: float) -> None:
        """Record ``measured`` [C, B, N] of this update; ``dt`` is the time step [s].

        Raises:
            UsageError: the time step became so short that the ring does not reach back far enough.
        """
        from robotics_bridge.sensors.noise.kernels.noise import delay_line

        own, clock = self._parts, self._parts.clock
        if own.total == 0 or own.num_envs == 0:
            return
        slots = math.ceil(self._longest / dt - 1e-4) + 1
        if self._ring is None:
            self._ring = own.zeros(True, (slots,))
        if slots > self._ring.shape[0]:
            raise UsageError(
                f"A delay of {self._longest:g} s needs {slots} readings at a time step of {dt:g} s, but the first "
                f"update made room for {self._ring.shape[0]}; build the sensors anew for the shorter step."
            )
        inputs = [own.params, own.part, self._delay, self._jitter, clock.age, clock.episode, int(clock.env_offset)]
        own.run(delay_line, (own.num_envs, own.total), [*inputs, float(dt), measured, self._ring, self.out])


def gaussian_weights(sigma: float, half: int) -> NDArray[np.float64]:
    """Return the centre and one side of a normalised Gaussian [half + 1], cut at four standard deviations."""
    weights = np.exp(-0.5 * (np.arange(half + 1) / sigma) ** 2)
    weights[np.arange(half + 1) > 4 * sigma] = 0
    return weights / (weights[0] + 2 * weights[1:].sum())
