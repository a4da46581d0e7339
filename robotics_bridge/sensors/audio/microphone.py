"""A listener: the sum of all sources of a suite at a point, each late by r / c and weaker by 1 / r^p."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import torch

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError, check_kind
from brainbench.core.limits import NotNegative, Positive, limited
from brainbench.core.reading.ranges import check_number
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.audio.sensors import AudioSensor
from robotics_bridge.sensors.kernels import sound as k
from robotics_bridge.sensors.suite import SensorSuite


@dataclass(frozen=True)
@limited
class Microphone:
    """A place of a listener, and the way sound takes to it."""

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In the frame of ``link``, or of the world [m]."""
    link: str | None = None
    """The link that carries it; None stands still in the world."""
    sources: tuple[str, ...] = ()
    """Names of the ContactAudio and ActuationAudio that are heard; empty hears all."""
    speed_of_sound: Positive = 343.0
    """c [m/s]."""
    power: NotNegative = 1.0
    """p: 1 is the sound pressure of a free field."""
    nearest: Positive = 0.01
    """Sources nearer than this are as loud as at this distance [m]."""
    reach: Positive = 3.0
    """Longest distance that is rendered with its full delay [m]; sets the memory."""

    def __post_init__(self) -> None:
        check_kind("sources", self.sources, (tuple, list), "the names of sensors, such as ('tip',)")

    def build(self, suite: SensorSuite) -> Listener:
        """Return the listener of a suite; call its ``update`` after the suite's."""
        return Listener(self, suite)


class Listener:
    """Renders what a microphone hears, block by block.

    An environment in which a source is not finite reads NaN until its reset; the others do not notice.

    Args:
        microphone: Where it is and which sources it hears; all of the suite if it names none.
        suite: Whose audio sensors are the sources; update it before each block.
    """

    def __init__(self, microphone: Microphone, suite: SensorSuite) -> None:
        self.microphone, self._suite = microphone, suite
        sources = [name for name, sensor in suite.sensors.items() if isinstance(sensor, AudioSensor)]
        names = microphone.sources or sources
        self._sources = {name: suite.runtime_of(name, AudioSensor, "source of sound") for name in names}
        lengths = {cast(AudioSensor, suite.sensors[name]).samples for name in names}
        if len(lengths) != 1:
            raise UsageError(
                "A microphone needs sources with one length of block; "
                + (f"these have {sorted(lengths)}." if lengths else "the suite has no source of sound.")
            )
        self.samples = lengths.pop()
        c, scene = suite.context, suite.scene
        self._link = -1 if microphone.link is None else scene.link_index(microphone.link)
        self._links = c.array([scene.link_index(suite.sensors[name].link) for name in self._sources], int)
        self._now, self._before = (c.zeros((suite.num_envs, len(self._sources))) for _ in range(2))
        self._out = c.zeros((self.samples, suite.num_envs))
        self.diverged = torch.zeros(suite.num_envs, dtype=torch.bool, device=warp().to_torch(self._out).device)
        """Mask [B] of environments in which a source was not finite since their reset; their blocks are NaN."""
        self._ring: Any = None
        self._slot = 0

    def update(self, state: HandState, dt: float) -> None:
        """Take the suite's latest block, of ``dt`` seconds."""
        check_number("dt (time of a block, s)", dt, above=0)
        c, m, envs = self._suite.context, self.microphone, self._suite.num_envs
        rate, age, block = self.samples / dt, c.age, (self.samples, envs)
        # The ring holds the longest delay, reach / c, a few samples for the interpolation, and the block being written.
        blocks = math.ceil((m.reach / m.speed_of_sound * rate + 3) / self.samples) + 1
        fresh = self._ring is None
        if fresh:
            self._ring = c.zeros((blocks * self.samples, envs, len(self._sources)))
        if self._ring.shape[0] != blocks * self.samples:
            raise UsageError(f"The time step of a microphone stays as it was; received another, {dt:g} s.")
        self.diverged &= warp().to_torch(age) > 0
        for index, (name, runtime) in enumerate(self._sources.items()):
            part = runtime.slices[name]
            # The ring takes silence in place of what is not finite, and later blocks hear it late.
            self.diverged |= ~warp().to_torch(runtime.io.truth)[:, :, part.span].sum(dim=2).isfinite().all(dim=0)
            c.launch(k.record_source, block, runtime.io.truth, part.start, part.count, self._slot, index, self._ring)
        # Lengths at the start and the end of the block: the kernel lets them change evenly in between.
        place, paths = warp().vec3f(*m.position), [self._now, self._before]
        # Before the first block, the way was that of its end.
        for _ in range(1 + fresh):
            c.launch(k.measure_paths, self._now.shape, state.pose, self._links, self._link, place, age, *paths)
        inputs = [self._ring, self._slot, self.samples, rate, m.speed_of_sound, m.nearest, m.power, age]
        c.launch(k.mix_sources, block, *inputs, *paths, self._out)
        warp().to_torch(self._out).masked_fill_(self.diverged, math.nan)
        self._slot = (self._slot + self.samples) % self._ring.shape[0]

    def read(self) -> torch.Tensor:
        """Return the latest block [B, K], a view."""
        return warp().to_torch(self._out).permute(1, 0)
