"""A listener: the sum of all sources of a suite at a point, each late by r / c and weaker by 1 / r^p."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError, unknown_name
from robotics_bridge.sensors.audio.runtime import ContactAudioRuntime, DriveAudioRuntime

if TYPE_CHECKING:
    import torch

    from robotics_bridge.physics.state import HandState
    from robotics_bridge.sensors.suite import SensorSuite


@dataclass(frozen=True)
class Microphone:
    """Where the listener is and how sound reaches it.

    Raises:
        UsageError: a number lies outside its range.
    """

    position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """In the frame of ``link``, or of the world [m]."""
    link: str | None = None
    """The link that carries it; None stands still in the world."""
    sources: tuple[str, ...] = ()
    """Names of the ContactAudio and ActuationAudio that are heard; empty hears all."""
    speed_of_sound: float = 343.0
    """c [m/s]."""
    power: float = 1.0
    """p: 1 is the sound pressure of a free field."""
    nearest: float = 0.01
    """Sources nearer than this are as loud as at this distance [m]."""
    reach: float = 3.0
    """Longest distance that is rendered with its full delay [m]; sets the memory."""

    def __post_init__(self) -> None:
        for name in ("speed_of_sound", "nearest", "reach"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0):
                raise UsageError(f"{name} must be positive; received {getattr(self, name)!r}.")
        if not (math.isfinite(self.power) and self.power >= 0):
            raise UsageError(f"power must be zero or positive; received {self.power!r}.")

    def build(self, suite: SensorSuite) -> Listener:
        """Return the listener of a suite; call its ``update`` after the suite's."""
        return Listener(self, suite)


class Listener:
    """Renders what a microphone hears, block by block.

    Args:
        microphone: Where it is and which sources it hears; all of the suite if it names none.
        suite: Whose audio sensors are the sources; update it before each block.

    Raises:
        UsageError: a source is unknown, none exists, or their blocks differ in length.
    """

    def __init__(self, microphone: Microphone, suite: SensorSuite) -> None:
        self.microphone, self._suite = microphone, suite
        found: dict[str, ContactAudioRuntime | DriveAudioRuntime] = {
            name: runtime
            for runtime in suite.runtimes
            if isinstance(runtime, (ContactAudioRuntime, DriveAudioRuntime))
            for name in runtime.places
        }
        for name in microphone.sources:
            if name not in found:
                raise unknown_name("source of sound", name, found)
        self._sources = {name: found[name] for name in microphone.sources or found}
        lengths = {runtime.samples for runtime in self._sources.values()}
        if len(lengths) != 1:
            raise UsageError(
                "A microphone needs sources with one length of block; "
                + (f"these have {sorted(lengths)}." if lengths else "the suite has no source of sound.")
            )
        self.samples = lengths.pop()
        wp, scene = warp(), suite.scene
        self._link = -1 if microphone.link is None else scene.link_index(microphone.link)
        links = [scene.link_index(suite.sensors[name].link) for name in self._sources]
        self._links = wp.array(np.array(links, np.int32), dtype=wp.int32, device=suite.device)
        shape = (suite.num_envs, len(links))
        self._now, self._before = (wp.zeros(shape, dtype=wp.float32, device=suite.device) for _ in range(2))
        self._out = wp.zeros((self.samples, suite.num_envs), dtype=wp.float32, device=suite.device)
        self._ring: Any = None
        self._slot = 0

    def update(self, state: HandState, dt: float) -> None:
        """Take the suite's latest block, of ``dt`` seconds.

        Raises:
            UsageError: the time step changed.
        """
        from robotics_bridge.sensors.audio.kernels import sound as k

        wp, suite, m = warp(), self._suite, self.microphone
        rate, envs = self.samples / dt, suite.num_envs
        blocks = math.ceil((m.reach / m.speed_of_sound * rate + 3) / self.samples) + 1
        if self._ring is None:
            shape = (blocks * self.samples, envs, len(self._sources))
            self._ring = wp.zeros(shape, dtype=wp.float32, device=suite.device)
        if self._ring.shape[0] != blocks * self.samples:
            raise UsageError(f"The time step of a microphone stays as it was; received another, {dt:g} s.")

        def run(kernel: Any, dim: Any, *inputs: Any) -> None:
            wp.launch(kernel, dim=dim, inputs=inputs, device=suite.device)

        for index, (name, runtime) in enumerate(self._sources.items()):
            place = runtime.places[name]
            sound = runtime.truth()
            run(k.record_source, (self.samples, envs), sound, place.start, place.count, self._slot, index, self._ring)
        age, place = suite.clock.age, wp.vec3f(*m.position)
        run(k.measure_paths, self._now.shape, state.pose, self._links, self._link, place, age, self._now, self._before)
        run(
            k.mix_sources, (self.samples, envs), self._ring, self._slot, self.samples, rate, m.speed_of_sound, m.nearest,
            m.power, age, self._now, self._before, self._out,
        )  # fmt: skip
        self._slot = (self._slot + self.samples) % self._ring.shape[0]

    def read(self) -> torch.Tensor:
        """Return the latest block [B, K], a view."""
        return warp().to_torch(self._out).permute(1, 0)
