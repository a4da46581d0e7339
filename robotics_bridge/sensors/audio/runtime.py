"""The runtimes of sound sources, and a listener: their sum at a point, each late by r / c and weaker by 1 / r^p."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError, check_number
from brainbench.core.limits import NotNegative, Positive, limited
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.audio.sensors import ActuationAudio, AudioSensor, ContactAudio
from robotics_bridge.sensors.context import fill
from robotics_bridge.sensors.kernels import sound as k
from robotics_bridge.sensors.kernels.sound import (
    ContactSoundArrays,
    DriveSoundArrays,
    DriveSoundParams,
    SourceParams,
    excite_modes,
    gather_contacts,
    ring_modes,
    sound_drives,
)
from robotics_bridge.sensors.noise.model import stream_key
from robotics_bridge.sensors.runtime import Runtime, SuiteContext
from robotics_bridge.sensors.suite import SensorSuite

wp = warp()


class ContactAudioRuntime(Runtime):
    """Serves contact sounds of one block length."""

    def __init__(self, sensors: Mapping[str, ContactAudio], context: SuiteContext) -> None:
        self._sensors = dict(sensors)
        first = next(iter(sensors.values()))
        self.samples, self._quads = first.samples, first.quads
        super().__init__(sensors, self.samples, context, fusable=False)
        count, envs = len(sensors), context.num_envs
        self._dt = math.nan
        self._turns: NDArray[np.float64] | None = None
        arrays, quads = ContactSoundArrays(), self._quads
        arrays.sources, arrays.link_of = context.zeros(count, SourceParams), context.solids.struct.link
        arrays.force, arrays.before, arrays.rubbing = (context.zeros((envs, count)) for _ in range(3))
        arrays.drive = context.zeros((self.samples, envs, count))
        arrays.first, arrays.second, arrays.gain = (context.zeros((quads, count), wp.vec4) for _ in range(3))
        arrays.y1, arrays.y2 = (context.zeros((quads, envs, count), wp.vec4) for _ in range(2))
        self._own = arrays
        self.lasting = [arrays.force, arrays.before, arrays.rubbing, arrays.drive, arrays.y1, arrays.y2]

    def seed(self) -> None:
        """Draw from the context's present seed from now on."""
        super().seed()
        self._dt = math.nan

    def _set_step(self, dt: float) -> None:
        """Compute the poles for a sample rate of K / dt; modes beyond its half stay silent."""
        if dt == self._dt:
            return
        for name, sensor in self._sensors.items():
            check_number(
                f"contact_time (s) of {name!r}, which ends within the time step,", sensor.contact_time, most=dt
            )
            if all(value >= self.samples / dt / 2 for value in sensor.modes.frequency):
                warnings.warn(
                    f"Impacts of {name!r} are silent: all its modes lie above {self.samples / dt / 2:g} Hz, half the "
                    "sample rate. Take more samples.", RuntimeWarning, stacklevel=5,
                )  # fmt: skip
        self._dt = dt
        step = dt / self.samples
        poles = np.zeros((3, self._quads * 4, len(self._sensors)))
        turns = np.zeros((2, self._quads * 4, len(self._sensors)))
        sources = []
        for column, (name, sensor) in enumerate(self._sensors.items()):
            frequency, decay, gain = (np.array(values) for values in zip(*sensor.modes.rows(), strict=True))
            theta, radius = 2 * np.pi * frequency * step, np.exp(-decay * step)
            heard = theta < np.pi
            rows = slice(0, len(frequency))
            # Coefficients of 4.32 for this sample rate: pole radius e^(−d Δt) and angle 2π f Δt, computed in double
            # precision.
            poles[0, rows, column] = 2 * radius * np.cos(theta)
            poles[1, rows, column] = radius**2
            # The resonator answers an impulse with sin(kθ) / sin θ; this factor makes it the velocity per impulse.
            poles[2, rows, column] = np.where(heard, gain * np.sin(theta), 0.0)
            poles[:2, rows, column] *= heard
            turns[:, rows, column] = theta * heard, radius
            pulse = int(np.clip(round(sensor.contact_time / step), 1, self.samples))
            link, key = self.context.scene.link_index(sensor.link), stream_key(self.context.seed, f"{name}/sound")
            sources.append(fill(SourceParams, sensor, link=link, pulse=pulse, **key))
        # Four modes side by side in one vector: a thread loads them at once.
        poles, turns = (
            np.moveaxis(each.reshape(-1, self._quads, 4, len(self._sensors)), 2, 3) for each in (poles, turns)
        )
        for array, values in zip((self._own.first, self._own.second, self._own.gain), poles, strict=True):
            array.assign(np.ascontiguousarray(values, dtype=np.float32))
        if self._turns is not None:
            self._resample(self._turns, turns)
        self._turns = turns
        self._own.sources.assign(self.context.array(sources, SourceParams))

    def _resample(self, before: NDArray[np.float64], now: NDArray[np.float64]) -> None:
        """Let modes ring on at another sample rate: angle and radius [2, Q, S, 4] of the poles before and now.

        The last two values are Im Z and Im Z e^(−iθ) / r of a phasor Z, whose size goes with 1 / sin θ; what is silent
        at one of the rates stops.
        """
        (old, decay), (new, radius) = before[:, :, None], now[:, :, None]
        y1, y2 = (array.numpy().astype(float) for array in (self._own.y1, self._own.y2))
        rings = (old > 0) & (new > 0)
        sines = np.where(rings, np.sin(old), 1.0), np.where(rings, np.sin(new), 1.0)
        real = (y1 * np.cos(old) - decay * y2) / sines[0]
        scale = np.where(rings, sines[0] / sines[1], 0.0)
        last = scale * (y1 * np.cos(new) - real * np.sin(new)) / np.where(rings, radius, 1.0)
        self._own.y1.assign((scale * y1).astype(np.float32))
        self._own.y2.assign(last.astype(np.float32))

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Make the next block from the contacts."""
        self._set_step(dt)
        c, arrays, many = self.context, self._own, (self.context.num_envs, len(self._sensors))
        c.launch(gather_contacts, state.contact_env.shape[0], state.arrays, arrays)
        c.launch(excite_modes, (self.samples, *many), arrays, self.io, self.samples)
        c.launch(ring_modes, many, arrays, self.io, self.samples)


class DriveAudioRuntime(Runtime):
    """Serves actuation sounds of one block length."""

    def __init__(self, sensors: Mapping[str, ActuationAudio], context: SuiteContext) -> None:
        self.samples = next(iter(sensors.values())).samples
        super().__init__(sensors, self.samples, context, fusable=False)
        self._drives = dict(sensors)
        arrays, shape = DriveSoundArrays(), (context.num_envs, self.count)
        arrays.settings = self._settings()
        for name in ("effort", "speed", "last_loud", "last_speed", "phase", "hum_phase"):
            setattr(arrays, name, context.zeros(shape))
            self.lasting.append(getattr(arrays, name))
        self._own, self.effort, self.speed = arrays, arrays.effort, arrays.speed

    def _settings(self) -> Any:
        keys = [stream_key(self.context.seed, f"{name}/sound") for name in self._drives]
        settings = [fill(DriveSoundParams, each, **key) for each, key in zip(self._drives.values(), keys, strict=True)]
        return self.context.array(settings, DriveSoundParams)

    def seed(self) -> None:
        """Draw from the context's present seed from now on."""
        super().seed()
        self._own.settings.assign(self._settings())

    def run_kernels(self, state: HandState, dt: float) -> None:
        """Make the next block from the torques and speeds that were written."""
        c = self.context
        c.launch(sound_drives, (c.num_envs, self.count), self._own, self.io, self.samples)


def joint_drive(suite: SensorSuite, name: str) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the views [B, J] for torque (N·m) and speed (rad/s) of the joints of an ActuationAudio."""
    runtime = cast(DriveAudioRuntime, suite.runtime_of(name, ActuationAudio, "actuation sound"))
    window = runtime.slices[name].span
    return wp.to_torch(runtime.effort)[:, window], wp.to_torch(runtime.speed)[:, window]


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
        self._slot, self._dt = 0, math.nan

    def update(self, state: HandState, dt: float) -> None:
        """Take the suite's latest block, of ``dt`` seconds."""
        check_number("dt (time of a block, s)", dt, above=0)
        c, m, envs = self._suite.context, self.microphone, self._suite.num_envs
        rate, age, block = self.samples / dt, c.age, (self.samples, envs)
        fresh = self._ring is None
        if fresh:
            # The longest delay, reach / c, a few samples for the interpolation, and the block being written.
            blocks = math.ceil((m.reach / m.speed_of_sound * rate + 3) / self.samples) + 1
            self._ring, self._dt = c.zeros((blocks * self.samples, envs, len(self._sources))), dt
        if dt != self._dt:
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
