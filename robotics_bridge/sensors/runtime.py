"""Runtimes: the arrays and launches that serve all sensors of one kind. Letters: B environment, N probe, C channel.

Readings are stored planar [C, B, N]. :class:`Runtime` keeps readings and noise, :class:`ProbeRuntime` adds
probes that meet geometries.
"""

from __future__ import annotations

import abc
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from brainbench.core.devices import warp
from robotics_bridge.physics.scene import TouchScene
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.context import LaunchContext, ReadoutSlice
from robotics_bridge.sensors.kernels.readout import CLEAN, FUSED, STAGED, ProbeArrays, append_history
from robotics_bridge.sensors.noise.stages import ReadingNoise
from robotics_bridge.sensors.probes.placement import enclosing_sphere
from robotics_bridge.sensors.queries.pairs import PairTable
from robotics_bridge.sensors.queries.solids import Solids
from robotics_bridge.sensors.sensor import ProbeSensor, Sensor

wp = warp()


@dataclass(eq=False)
class SuiteContext(LaunchContext):
    """Parts of a suite that the runtimes of its sensors share."""

    scene: TouchScene
    solids: Solids
    sensors: Sequence[Sensor]
    """Of the whole suite."""
    pairs: PairTable = field(init=False)


class Runtime(abc.ABC):
    """Serves the sensors of one group; noise is fused into the sensor's kernel where that can be, in stages otherwise.

    Updates launch kernels and do nothing else, so that they can be recorded.

    Args:
        channels: planes of the storage.
        fusable: whether the sensor's kernel applies the noise itself when no crosstalk forbids it.
        active: which probes [N] are none of the fillers.
    """

    recordable: bool = True
    """True if its updates can become part of a CUDA graph."""

    def __init__(
        self,
        sensors: Mapping[str, Sensor],
        channels: int,
        context: SuiteContext,
        *,
        fusable: bool = True,
        active: np.ndarray | None = None,
    ) -> None:
        self.context = context
        self.slices: dict[str, ReadoutSlice] = {}
        """Place of the reading of each sensor, by name."""
        self.lasting: list[Any] = []
        """Further Warp arrays of environments that later updates read; the runtime of a class enters its own."""
        self.count = 0
        """Probes N of all sensors."""
        for name, sensor in sensors.items():
            count = int(np.prod(sensor.layout()))
            mask = None if active is None else active[self.count : self.count + count]
            self.slices[name] = ReadoutSlice(
                name, sensor.noise, self.count, sensor.layout(), sensor.channels == 0, mask
            )
            self.count += count
        self._noise = noise = ReadingNoise(list(self.slices.values()), channels, context, fusable=fusable)
        self.io = noise.io
        """Warp structure of the readings: ``truth`` and ``measured``, planar."""
        self.io.status = context.pairs.status
        self.mode, self.stores, self.make_room = noise.mode, noise.stores, noise.make_room

    def update(self, state: HandState, dt: float) -> None:
        """Read the state; ``dt`` seconds have passed since the last update."""
        self.io.dt = dt
        self.run_kernels(state, dt)
        self._noise.launch(dt)

    def seed(self) -> None:
        """Draw from the context's present seed from now on."""
        self._noise.seed()

    def memory(self) -> list[Any]:
        """Return the Warp arrays of environments that later updates depend on."""
        return [array for array in (*self._noise.memory, *self.lasting, *self._noise.rings) if array.size]

    @property
    def readable(self) -> list[Any]:
        """Warp arrays [C, B, N] that can be read, which a reset clears."""
        return self._noise.readable

    @abc.abstractmethod
    def run_kernels(self, state: HandState, dt: float) -> None:
        """Run the sensor's own kernels; ``io`` knows of this update."""

    def measured(self) -> Any:
        """Return the planar Warp array of measured readings."""
        return self._noise.read()


class ProbeRuntime(Runtime):
    """Probes of all sensors of a group, one after another, with their slots.

    A probe looks ``reach`` beyond its radius (m); None is unlimited, and geometries need not be in contact. ``others``:
    what it looks at may be of kinds without a distance.
    """

    def __init__(
        self,
        sensors: Mapping[str, ProbeSensor],
        channels: int,
        context: SuiteContext,
        *,
        reach: float | None = 0.0,
        others: bool = False,
    ) -> None:
        active = np.concatenate([sensor.probes.active for sensor in sensors.values()])
        super().__init__(sensors, channels, context, active=active)
        tracked = {name: sensor.tracked(context.scene) for name, sensor in sensors.items()}
        members = sorted({g for members in tracked.values() for g in members})
        self.kinds = context.solids.kinds_of(members, others=others)
        """Kinds of the geometries that they may meet."""
        self.slots: list[int] = []
        """Slot of each sensor in the pair table."""
        for name, sensor in sensors.items():
            link, (center, span) = context.scene.link_index(sensor.link), enclosing_sphere(sensor.probes)
            contact = reach is not None and sensor.contact_only
            far = 0.0 if reach is None or contact else span + reach
            slot = context.pairs.slot(link, tracked[name], contact=contact, center=center, reach=far)
            self.slots.append(slot)
        p = ProbeArrays()
        for name, dtype in (("position", wp.vec3f), ("normal", wp.vec3f), ("radius", float)):
            columns = [getattr(sensor.probes, name) for sensor in sensors.values()]
            setattr(p, name, context.array(np.concatenate(columns), dtype))
        packed = [np.column_stack([s.probes.position, s.probes.radius]) for s in sensors.values()]
        p.packed = context.array(np.concatenate(packed), wp.vec4f)
        counts = [part.count for part in self.slices.values()]
        p.slot = context.array(np.repeat(self.slots, counts), int)
        self.probes = p

    def launch(self, kernel: Any, *inputs: Any) -> None:
        """Run a kernel over all environments and probes."""
        self.context.launch(kernel, (self.context.num_envs, self.count), *inputs)


_SHARED = 32  # probes that one thread of a processor takes in turn
_SHARED_CUDA = {CLEAN: (8, 6144), FUSED: (1, 6144), STAGED: (8, 3072)}
"""The same on a GPU by mode: at most, and probes of a multiprocessor for each of them (measured on an H100)."""


def probe_rows(slices: Iterable[ReadoutSlice], context: LaunchContext, mode: int) -> np.ndarray:
    """Return rows (first, end, step, number of the sensor) [R, 4] of probes that one thread takes in turn.

    What all probes of an environment share is then read less often. On a GPU the rows of neighbouring threads are
    interleaved, so that these touch neighbouring memory; noise in the same kernel (``mode``) leaves no registers to
    share.
    """
    slices = list(slices)
    cuda = bool(context.device.is_cuda)
    total = context.num_envs * sum(part.count for part in slices)
    most = _SHARED
    if cuda:
        limit, fill = _SHARED_CUDA[mode]
        # Enough threads must be left to fill the GPU; only beyond that do probes share one.
        most = min(limit, max(1, total // (fill * context.device.sm_count)))
    rows = []
    for number, part in enumerate(slices):
        end, threads = part.start + part.count, -(-part.count // most)
        if cuda:
            rows += [(part.start + k, end, threads, number) for k in range(threads)]
        else:
            starts = range(part.start, end, most)
            rows += [(start, min(start + most, end), 1, number) for start in starts]
    return np.array(rows, dtype=np.int32).reshape(-1, 4)


class History:
    """The last readings of one sensor, ready as one contiguous window."""

    def __init__(self, part: ReadoutSlice, channels: int, length: int, context: LaunchContext) -> None:
        self.part, self.length, self._context = part, length, context
        self.ring: Any = context.zeros((2 * length, channels, context.num_envs, part.count))
        """Warp array [2 T, C, B, N]: every reading is written twice."""

    def launch(self, value: Any, counter: Any) -> None:
        """Append the reading of this update; ``counter`` [1] counts updates on the device."""
        c = self._context
        dim = (c.num_envs, self.part.count)
        c.launch(append_history, dim, value, self.part.start, counter, self.ring)
