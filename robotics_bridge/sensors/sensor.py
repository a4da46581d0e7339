"""What every tactile sensor is: a frozen configuration, and the runtime that serves all sensors of one kind.

Letters: B environment, N probe, C channel; readings are stored planar [C, B, N].
"""

from __future__ import annotations

import abc
import math
from collections.abc import Hashable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.errors import UsageError
from robotics_bridge.sensors.kernels.readout import CLEAN, FUSED, STAGED, ProbeArrays, ReadoutArrays, append_history
from robotics_bridge.sensors.noise.model import BASE_KNOBS, PROBE_KNOBS, Noise, stream_seed
from robotics_bridge.sensors.noise.stages import DelayLine, NoisePart, NoiseStage
from robotics_bridge.sensors.probes.placement import Probes

if TYPE_CHECKING:
    from robotics_bridge.physics.scene import TouchScene
    from robotics_bridge.physics.state import HandState
    from robotics_bridge.sensors.queries.pairs import PairTable
    from robotics_bridge.sensors.queries.solids import Solids

Convention = Literal["physical", "thesis"]


@dataclass(frozen=True)
class QueryRequirements:
    """What a sensor needs built for it."""

    fields: frozenset[int] = frozenset()
    """Geometries whose signed distance it asks for (meshes among them get a sampled field)."""
    trees: frozenset[int] = frozenset()
    """Geometries whose triangles it asks for."""


@dataclass(frozen=True, kw_only=True)
class Sensor(abc.ABC):
    """Configuration of a sensor on one link."""

    link: str
    """The link that carries it."""
    noise: Noise = field(default_factory=Noise)
    """Imperfections of the measured reading."""
    history: int = 0
    """Last readings kept, at the rate of updates; 0 keeps none."""

    channels: ClassVar[int] = 0
    """Channels of a reading; 0 is a scalar per probe."""
    units: ClassVar[str] = ""
    knobs: ClassVar[frozenset[str]] = BASE_KNOBS
    """Noise knobs it has (thesis, table 4.2)."""

    def __post_init__(self) -> None:
        self.noise.check(self.knobs, type(self).__name__)
        if self.history < 0:
            raise UsageError(f"A history holds 0 or more readings; received {self.history}.")

    @abc.abstractmethod
    def layout(self) -> tuple[int, ...]:
        """Shape (N,) or (rows, columns) of the reading of one environment, without channels."""

    def group(self) -> Hashable:
        """Sensors of one class and equal group share one runtime and its kernels."""
        return ()

    def asks(self, scene: TouchScene) -> QueryRequirements:
        """Return what must be built for it."""
        del scene
        return QueryRequirements()

    @classmethod
    @abc.abstractmethod
    def build(cls, sensors: Mapping[str, Self], context: Context) -> Runtime:
        """Return the runtime that serves these sensors (by name) together."""


@dataclass(eq=False)
class Clock:
    """Counts updates and episodes on the device."""

    age: Any
    """Warp array [B] int32: updates since the environment's reset, 0 at the first."""
    episode: Any
    """Warp array [B] int32: resets so far."""
    env_offset: int = 0
    """Number, in the whole experiment, of environment 0."""


@dataclass(eq=False)
class Context:
    """What a suite lends to the runtimes of its sensors."""

    scene: TouchScene
    num_envs: int
    device: Any
    seed: int
    clock: Clock
    solids: Solids
    pairs: PairTable


@dataclass(frozen=True)
class ReadoutSlice:
    """Where the reading of one sensor lies in planar storage."""

    start: int
    layout: tuple[int, ...]
    scalar: bool
    """Whether a reading has no channel axis."""

    @property
    def count(self) -> int:
        """Number of probes."""
        return math.prod(self.layout)


class Runtime(abc.ABC):
    """Serves the sensors of one group. Updates launch kernels and do nothing else, so that they can be recorded."""

    places: Mapping[str, ReadoutSlice]
    recordable: bool = True
    """Whether its updates can become part of a CUDA graph."""

    @abc.abstractmethod
    def update(self, state: HandState, dt: float) -> None:
        """Read the state; ``dt`` seconds have passed since the last update."""

    @abc.abstractmethod
    def measured(self) -> Any:
        """Return the planar Warp array of measured readings."""

    @abc.abstractmethod
    def truth(self) -> Any:
        """Return the planar Warp array of readings without noise."""

    @property
    @abc.abstractmethod
    def state_bytes(self) -> int:
        """Lasting memory per environment [bytes], readings included, without history and delay."""

    @property
    def ring_bytes(self) -> int:
        """Memory per environment [bytes] of delays that the user asked for."""
        return 0

    @property
    def scratch_bytes(self) -> int:
        """Memory per environment [bytes] that every update writes anew."""
        return 0


class ReadoutRuntime(Runtime):
    """Readings of a group with their noise: fused into the sensor's kernel where that can be, in stages otherwise.

    Args:
        sensors: by name.
        channels: planes of the storage.
        context: of the suite.
        fusable: whether the sensor's kernel applies the noise itself when no crosstalk forbids it.
        active: which probes [N] are none of the fillers.
    """

    def __init__(
        self,
        sensors: Mapping[str, Sensor],
        channels: int,
        context: Context,
        *,
        fusable: bool = True,
        active: np.ndarray | None = None,
    ) -> None:
        wp, device = warp(), context.device
        self.context = context
        self.places = {}
        parts, start = [], 0
        for name, sensor in sensors.items():
            place = ReadoutSlice(start, sensor.layout(), sensor.channels == 0)
            mask = None if active is None else active[start : start + place.count]
            parts.append(NoisePart(name, sensor.noise, start, place.layout, mask))
            self.places[name] = place
            start += place.count
        self.count = start
        noises = [part.noise for part in parts]
        self.noisy = any(noise.active for noise in noises)
        staged = self.noisy and (not fusable or any(noise.crosstalks for noise in noises))
        self.mode = STAGED if staged else FUSED if self.noisy else CLEAN
        fused = self.mode == FUSED
        self.stores = (
            fused and any(noise.stores_hysteresis for noise in noises),
            fused and any(noise.stores_walk for noise in noises),
        )
        shape = (channels, context.num_envs, self.count)

        def planes(wanted: bool) -> Any:
            return wp.zeros(shape if wanted else (1, 1, 1), dtype=wp.float32, device=device)

        self._truth = planes(True)
        self._measured = planes(True) if self.noisy else self._truth
        self._stage = NoiseStage(parts, channels, context.num_envs, context) if staged else None
        late = any(noise.delays for noise in noises)
        self._delay = DelayLine(parts, channels, context.num_envs, context) if late else None
        io = ReadoutArrays()
        io.truth, io.measured = self._truth, self._measured
        io.hysteresis, io.walk = (planes(wanted) for wanted in self.stores)
        io.age, io.episode = context.clock.age, context.clock.episode
        io.env_offset = context.clock.env_offset
        self.io = io
        self._channels = channels
        from robotics_bridge.sensors.noise.kernels.noise import NoiseParams

        params = [part.noise.params(stream_seed(context.seed, part.name)) for part in parts]
        self.knobs = wp.array(params, dtype=NoiseParams, device=device)

    def measured(self) -> Any:
        """Return the planar Warp array of measured readings."""
        return self._delay.out if self._delay else self._measured

    def truth(self) -> Any:
        """Return the planar Warp array of readings without noise."""
        return self._truth

    def begin(self, state: HandState, dt: float) -> None:
        """Point the structure that kernels take at this update."""
        self.io.status, self.io.dt = state.status, dt

    def finish(self, dt: float) -> None:
        """Run what noise is left after the sensor's own kernel."""
        if self._stage:
            self._stage.launch(self._measured, self._measured, dt)
        if self._delay:
            self._delay.launch(self._measured, dt)

    @property
    def state_bytes(self) -> int:
        """Lasting memory per environment [bytes], readings included, without history and delay."""
        planes = 1 + int(self.noisy) + sum(self.stores)
        return 4 * self._channels * self.count * planes + (self._stage.state_bytes if self._stage else 0)

    @property
    def ring_bytes(self) -> int:
        """Memory per environment [bytes] of delays that the user asked for."""
        return self._delay.ring_bytes if self._delay else 0


@dataclass(frozen=True, kw_only=True)
class ProbeSensor(Sensor):
    """A sensor made of probes that look at geometries of other links."""

    probes: Probes
    """Where its probes sit, in the frame of the link."""
    track: tuple[str, ...] = ()
    """Links it looks at; empty means everything that may touch its link."""

    knobs: ClassVar[frozenset[str]] = PROBE_KNOBS

    def layout(self) -> tuple[int, ...]:
        """Shape (N,) or (rows, columns) of the reading of one environment, without channels."""
        return self.probes.shape

    def tracked(self, scene: TouchScene) -> tuple[int, ...]:
        """Return the numbers of the geometries it looks at."""
        scene.link_index(self.link)
        if not self.track:
            return scene.candidates(self.link)
        return tuple(sorted({g for link in self.track for g in scene.geometries_of(link)}))


@dataclass(frozen=True, kw_only=True)
class QuerySensor(ProbeSensor):
    """A probe sensor that asks for distances, by fields or by triangles."""

    query: Literal["sdf", "raycast"] = "sdf"
    """``sdf``: closed forms, and sampled fields for meshes. ``raycast``: the nearest triangle, for thin or exact
    meshes; primitives become triangles too."""
    pairs: Literal["contact", "all"] = "contact"
    """``contact``: geometries that the engine reports in contact with the link (published); ``all``: every tracked
    geometry within reach, for engines or links without collision."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, allowed in (("query", ("sdf", "raycast")), ("pairs", ("contact", "all"))):
            if getattr(self, name) not in allowed:
                raise UsageError(f"{name} is {' or '.join(map(repr, allowed))}; received {getattr(self, name)!r}.")

    def group(self) -> Hashable:
        """Sensors of one class and equal group share one runtime and its kernels."""
        return (self.query,)

    def asks(self, scene: TouchScene) -> QueryRequirements:
        """Return what must be built for it."""
        tracked = frozenset(self.tracked(scene))
        return QueryRequirements(fields=tracked) if self.query == "sdf" else QueryRequirements(trees=tracked)


class ProbeRuntime(ReadoutRuntime):
    """Probes of all sensors of a group, one after another, with their slots.

    Args:
        sensors: by name.
        channels: planes of the storage.
        context: of the suite.
        reach: how far beyond its radius a probe looks (m); None is unlimited, and geometries need not be in contact.
    """

    def __init__(
        self,
        sensors: Mapping[str, ProbeSensor],
        channels: int,
        context: Context,
        *,
        reach: float | None = 0.0,
        fusable: bool = True,
    ) -> None:
        active = np.concatenate([sensor.probes.active for sensor in sensors.values()])
        super().__init__(sensors, channels, context, fusable=fusable, active=active)
        wp, device = warp(), context.device
        numbers, probe, slots = [], [], []
        tracked: set[int] = set()
        for index, sensor in enumerate(sensors.values()):
            members = sensor.tracked(context.scene)
            tracked |= set(members)
            numbers.append(np.full(len(sensor.probes), index))
            probe.append(np.arange(len(sensor.probes)))
            slots.append(np.full(len(sensor.probes), self._slot(sensor, members, reach)))
        self.kinds = context.solids.kinds_of(sorted(tracked))
        values = [sensor.probes for sensor in sensors.values()]
        p = ProbeArrays()
        p.position = wp.array(
            np.concatenate([v.position for v in values]).astype(np.float32), dtype=wp.vec3f, device=device
        )
        p.normal = wp.array(
            np.concatenate([v.normal for v in values]).astype(np.float32), dtype=wp.vec3f, device=device
        )
        p.radius = wp.array(
            np.concatenate([v.radius for v in values]).astype(np.float32), dtype=wp.float32, device=device
        )
        for name, column in (("slot", slots), ("part", numbers), ("probe", probe)):
            setattr(p, name, wp.array(np.concatenate(column).astype(np.int32), dtype=wp.int32, device=device))
        self.probes = p

    def _slot(self, sensor: ProbeSensor, members: tuple[int, ...], reach: float | None) -> int:
        link = self.context.scene.link_index(sensor.link)
        contact = reach is not None and getattr(sensor, "pairs", "all") == "contact"
        center, span = enclosing_sphere(sensor.probes)
        far = 0.0 if reach is None or contact else span + reach
        return self.context.pairs.slot(link, members, contact=contact, center=center, reach=far)

    def launch(self, kernel: Any, *inputs: Any) -> None:
        """Run a kernel over all environments and probes."""
        warp().launch(kernel, dim=(self.context.num_envs, self.count), inputs=inputs, device=self.context.device)


_SHARED = 32
"""Probes that one thread of a processor takes in turn."""
_SHARED_CUDA = {CLEAN: (8, 3072), FUSED: (4, 6144), STAGED: (8, 3072)}
"""The same on a GPU by mode: at most, and probes of a multiprocessor for each of them (measured on an H200)."""


def probe_rows(places: Iterable[ReadoutSlice], context: Context, mode: int) -> np.ndarray:
    """Return rows (first, end, step, number of the sensor) [R, 4] of probes that one thread takes in turn.

    What all probes of an environment share is then read less often. On a GPU the rows of neighbouring threads are
    interleaved, so that these touch neighbouring memory.

    Args:
        places: of the sensors, in the order of their numbers.
        context: of the suite.
        mode: of the readout; noise leaves fewer registers to share.
    """
    places = list(places)
    cuda = bool(context.device.is_cuda)
    total = context.num_envs * sum(place.count for place in places)
    most = _SHARED
    if cuda:
        limit, fill = _SHARED_CUDA[mode]
        most = min(limit, max(1, total // (fill * context.device.sm_count)))
    rows = []
    for part, place in enumerate(places):
        end, threads = place.start + place.count, -(-place.count // most)
        if cuda:
            rows += [(place.start + k, end, threads, part) for k in range(threads)]
        else:
            rows += [(place.start + most * k, min(place.start + most * (k + 1), end), 1, part) for k in range(threads)]
    return np.array(rows, dtype=np.int32).reshape(-1, 4)


def enclosing_sphere(probes: Probes) -> tuple[np.ndarray, float]:
    """Return centre [3] and radius (m) of a sphere around the sensing spheres of active probes."""
    position, radius = probes.position[probes.active], probes.radius[probes.active]
    if not len(position):
        return np.zeros(3), 1e-6
    center = 0.5 * (position.min(axis=0) + position.max(axis=0))
    return center, float((np.linalg.norm(position - center, axis=1) + radius).max())


class History:
    """The last readings of one sensor, ready as one contiguous window."""

    def __init__(self, place: ReadoutSlice, channels: int, length: int, context: Context) -> None:
        wp = warp()
        self.place, self.length, self._context = place, length, context
        shape = (2 * length, channels, context.num_envs, place.count)
        self.ring: Any = wp.zeros(shape, dtype=wp.float32, device=context.device)

    @property
    def bytes(self) -> int:
        """Memory per environment [bytes]."""
        return self.ring.size * 4 // self._context.num_envs

    def launch(self, value: Any, counter: Any) -> None:
        """Append the reading of this update; ``counter`` [1] counts updates on the device."""
        dim = (self._context.num_envs, self.place.count)
        inputs = [value, self.place.start, counter, self._context.clock.age, self.ring]
        warp().launch(append_history, dim=dim, inputs=inputs, device=self._context.device)
