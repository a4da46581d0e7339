"""The runtimes of sound sources."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.core.devices import warp
from robotics_bridge.sensors.noise.model import stream_seed
from robotics_bridge.sensors.sensor import ReadoutRuntime

if TYPE_CHECKING:
    from robotics_bridge.physics.state import HandState
    from robotics_bridge.sensors.audio.sensors import ActuationAudio, ContactAudio
    from robotics_bridge.sensors.sensor import Context


def _keyed(item: Any, seed: int, name: str) -> Any:
    wp, key = warp(), stream_seed(seed, f"{name}/sound")
    item.key_low, item.key_high = wp.uint32(key & 0xFFFFFFFF), wp.uint32(key >> 32)
    return item


class ContactAudioRuntime(ReadoutRuntime):
    """Serves contact sounds of one block length."""

    def __init__(self, sensors: Mapping[str, ContactAudio], context: Context) -> None:
        from robotics_bridge.sensors.audio.kernels.sound import SourceParams

        self._sensors = dict(sensors)
        first = next(iter(sensors.values()))
        self.samples, self._quads = first.samples, (len(first.modes.frequency) + 3) // 4
        super().__init__(sensors, self.samples, context, fusable=False)
        wp, device, count, envs = warp(), context.device, len(sensors), context.num_envs
        self._dt = math.nan
        link_of = context.scene.link_of.astype(np.int32)
        self._link_of = wp.array(link_of if len(link_of) else np.zeros(1, np.int32), dtype=wp.int32, device=device)
        blank = np.zeros((self._quads, count, 4), np.float32)
        self._coefficients = [wp.array(blank, dtype=wp.vec4, device=device) for _ in range(3)]
        self._structures = wp.zeros(count, dtype=SourceParams, device=device)
        self._drive = wp.zeros((self.samples, envs, count), dtype=wp.float32, device=device)
        self._y1, self._y2 = (wp.zeros((self._quads, envs, count), dtype=wp.vec4, device=device) for _ in range(2))
        sums = [wp.zeros((envs, count), dtype=wp.float32, device=device) for _ in range(3)]
        self._force, self._before, self._rubbing = sums

    def _set_step(self, dt: float) -> None:
        """Compute the poles for a sample rate of K / dt; modes beyond its half stay silent."""
        from robotics_bridge.sensors.audio.kernels.sound import SourceParams

        if dt == self._dt:
            return
        self._dt = dt
        step = dt / self.samples
        poles = np.zeros((3, self._quads * 4, len(self._sensors)))
        sources = []
        for column, (name, sensor) in enumerate(self._sensors.items()):
            frequency, decay, gain = (np.array(values) for values in zip(*sensor.modes.rows(), strict=True))
            theta, radius = 2 * np.pi * frequency * step, np.exp(-decay * step)
            heard = theta < np.pi
            rows = slice(0, len(frequency))
            poles[0, rows, column] = 2 * radius * np.cos(theta)
            poles[1, rows, column] = radius**2
            # The resonator answers an impulse with sin(kθ) / sin θ; this factor makes it the velocity per impulse.
            poles[2, rows, column] = np.where(heard, gain * np.sin(theta), 0.0)
            poles[:2, rows, column] *= heard
            item = _keyed(SourceParams(), self.context.seed, name)
            item.link = self.context.scene.link_index(sensor.link)
            item.threshold, item.impact, item.scrape = sensor.threshold, sensor.impact, sensor.scrape
            item.pulse = int(np.clip(round(sensor.contact_time / step), 1, self.samples))
            sources.append(item)
        for array, values in zip(self._coefficients, poles, strict=True):
            quads = values.reshape(self._quads, 4, -1).transpose(0, 2, 1)
            array.assign(np.ascontiguousarray(quads, dtype=np.float32))
        wp = warp()
        self._structures.assign(wp.array(sources, dtype=SourceParams, device=self.context.device))

    def update(self, state: HandState, dt: float) -> None:
        """Read the contacts and make the next block."""
        from robotics_bridge.sensors.audio.kernels import sound as k

        self._set_step(dt)
        wp, c = warp(), self.context
        many = (c.num_envs, len(self._sensors))

        def run(kernel: Any, dim: Any, *inputs: Any) -> None:
            wp.launch(kernel, dim=dim, inputs=inputs, device=c.device)

        run(
            k.gather_contacts, state.contact_env.shape[0], state.contact_count, state.contact_env, state.contact_geom,
            state.contact_position, state.contact_normal, state.contact_force, self._link_of, self._structures,
            state.pose, state.velocity, self._force, self._rubbing,
        )  # fmt: skip
        run(
            k.excite_modes, (self.samples, *many), self._structures, c.clock.age, c.clock.episode, c.clock.env_offset, dt,
            self.samples, self._force, self._before, self._rubbing, self._drive,
        )  # fmt: skip
        run(
            k.ring_modes, many, c.clock.age, state.status, self.samples, self._quads, *self._coefficients, self._drive,
            self._y1, self._y2, self._force, self._before, self._rubbing, self._truth, self._measured,
        )  # fmt: skip
        self.finish(dt)

    @property
    def state_bytes(self) -> int:
        """Lasting memory per environment [bytes]."""
        return super().state_bytes + 4 * len(self._sensors) * (8 * self._quads + self.samples + 3)


class DriveAudioRuntime(ReadoutRuntime):
    """Serves actuation sounds of one block length."""

    def __init__(self, sensors: Mapping[str, ActuationAudio], context: Context) -> None:
        from robotics_bridge.sensors.audio.kernels.sound import DriveSoundParams

        first = next(iter(sensors.values()))
        self.samples = first.samples
        super().__init__(sensors, self.samples, context, fusable=False)
        wp, device = warp(), context.device
        settings, part, number = [], [], []
        for index, (name, sensor) in enumerate(sensors.items()):
            item = _keyed(DriveSoundParams(), context.seed, name)
            for knob in ("load", "power", "pitch", "partials", "rolloff", "friction", "hum", "hum_frequency"):
                setattr(item, knob, getattr(sensor, knob))
            settings.append(item)
            part += [index] * sensor.joints
            number += range(sensor.joints)
        self._settings = wp.array(settings, dtype=DriveSoundParams, device=device)
        self._part = wp.array(np.array(part, np.int32), dtype=wp.int32, device=device)
        self._number = wp.array(np.array(number, np.int32), dtype=wp.int32, device=device)
        shape = (context.num_envs, self.count)
        fields = [wp.zeros(shape, dtype=wp.float32, device=device) for _ in range(6)]
        self.effort, self.speed, *self._memory = fields

    def update(self, state: HandState, dt: float) -> None:
        """Make the next block from the torques and speeds that were written."""
        from robotics_bridge.sensors.audio.kernels.sound import sound_drives

        del state
        c = self.context
        inputs = [self._settings, self._part, self._number, c.clock.age, c.clock.episode, c.clock.env_offset, dt]
        inputs += [self.samples, self.effort, self.speed, *self._memory, self._truth, self._measured]
        warp().launch(sound_drives, dim=(c.num_envs, self.count), inputs=inputs, device=c.device)
        self.finish(dt)

    @property
    def state_bytes(self) -> int:
        """Lasting memory per environment [bytes]."""
        return super().state_bytes + 4 * 6 * self.count
