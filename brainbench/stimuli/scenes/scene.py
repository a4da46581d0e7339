"""Scenes: a whisker array, how it moves, what stands in its way, and when and how forces are read.

Readings become frames by averaging or an anti-alias filter, in chosen axes, clipped if so wanted.

World frame: where head and objects are placed [m]. Array frame: the frame of the morphology (origin at
the mean base point, x right, y rostral, z dorsal), placed in the world by :class:`Head`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError
from brainbench.core.limits import Count, Limit, limited
from brainbench.core.rotations import Angles, Point, base_rotation, euler_matrix
from brainbench.stimuli.motion.jobs import Acceleration, Job, Velocity
from brainbench.stimuli.motion.recorded import Recorded, Tracked
from brainbench.stimuli.motion.trajectories import (
    FILTER_EDGE,
    FILTER_ORDER,
    ArrayFollicle,
    Path,
    Phase,
    Still,
    Translation,
    Whisking,
    low_pass,
)
from brainbench.stimuli.objects.solid import PlacedObject
from brainbench.stimuli.whiskers.array import MountedWhisker, WhiskerArray, match_whiskers

Axes = Literal["world", "follicle"]
"""``world``: axes of the world. ``follicle``: the whisker's base frame, which turns with it: x along the whisker
at its base, x-y the plane of its curvature."""
READINGS_PER_CUTOFF = 4  # readings per period of the cut-off that a filter needs at least


@limited(of="{} of the frames")
class Frames:
    """Times at which forces are read, and the rule that makes a frame of readings.

    The default reads 110 instantaneous frames, 9 ms apart, the first at 1 ms, as the published pipeline does. Whatever
    vibrates above 1/(2·interval) = 56 Hz then aliases, and a sliding tip does: the RDM of the six Rodgers stimuli at
    the presets ``balanced`` and ``accurate`` correlates by .90, with ``average`` = 18 by .995. A mean still lets some
    aliases through; ``lowpass`` stops them with a Butterworth filter.
    """

    first: Annotated[float, Limit(least=0, unit="s")] = 0.001
    """Time of the first frame [s]; the whiskers start at rest at t = 0."""
    interval: Annotated[float, Limit(above=0, unit="s")] = 0.009
    """Time between frames [s]."""
    count: Count = 110
    average: Count = 1
    """Readings, evenly spread over the interval that begins at the frame's time, whose mean a frame is; the
    readings per frame that a filter works on, when ``lowpass`` is given."""
    lowpass: Annotated[float, Limit(above=0, unit="Hz")] | None = None
    """Cut-off [Hz] of a fourth-order Butterworth filter on the readings (−3 dB; −6 dB with phase ``zero``, which
    applies it twice); a frame is then the filtered force at its time. None for no filter."""
    phase: Phase = "zero"
    """Direction of the filter."""
    axes: Axes = "world"
    """Axes of force and moment, turned by the follicle's pose at the time of each frame."""
    clip: Annotated[float, Limit(above=0, unit="N")] | None = None
    """Largest force component [N] that a frame reports; moments are clipped at ``clip`` × 1 mm, which is the same
    number in the published units mN and mN·mm (there 1000: ``clip`` = 1). None for no clipping."""

    def __post_init__(self) -> None:
        if self.lowpass is not None:
            self._check_filter(self.lowpass)

    @property
    def times(self) -> NDArray[np.float64]:
        """Frame times [count] (s)."""
        return np.asarray(self.first + self.interval * np.arange(self.count), dtype=np.float64)

    @property
    def readings(self) -> NDArray[np.float64]:
        """Times [n] (s) at which the simulation is read; for a filter also before and after the frames."""
        if self.lowpass is None:
            return (self.times[:, None] + self.interval / self.average * np.arange(self.average)).reshape(-1)
        steps = np.arange(-self._lead, (self.count - 1) * self.average + self._tail + 1)
        return np.maximum(self.first + self.interval / self.average * steps, 0.0)

    def reduce(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Make frames [count, …] of readings [n, …]: their means, or the filtered values at the frame times."""
        if self.lowpass is None:
            return self.split(values).mean(axis=1)
        rate = self.average / self.interval
        return low_pass(values, rate, self.lowpass, phase=self.phase)[self._lead :: self.average][: self.count]

    def split(self, values: NDArray[Any]) -> NDArray[Any]:
        """Cut readings [n, …] into those of each frame's interval [count, average, …]."""
        within = values[self._lead : self._lead + self.count * self.average]
        return within.reshape(self.count, self.average, *values.shape[1:])

    def config(self) -> dict[str, Any]:
        """Return plain values for hashing and display; what was added later appears only where it is used."""
        config = {"first": self.first, "interval": self.interval, "count": self.count, "average": self.average}
        if self.lowpass is not None:
            config |= {"lowpass": self.lowpass, "phase": self.phase}
        if self.axes != "world":
            config["axes"] = self.axes
        return config if self.clip is None else config | {"clip": self.clip}

    def describe(self) -> str:
        """Say in words what a frame is."""
        readings = f"{self.average} readings, {self.interval / self.average * 1e3:g} ms apart"
        if self.lowpass is not None:
            kind = "run forwards and backwards" if self.phase == "zero" else "causal"
            return f"Butterworth low-pass of order {FILTER_ORDER} at {self.lowpass:g} Hz, {kind}, on {readings}"
        return "instantaneous" if self.average == 1 else f"mean of {readings}"

    @property
    def _lead(self) -> int:
        """Readings before the first frame: the filter starts when the whisker does."""
        return 0 if self.lowpass is None else math.floor(self.first / self.interval * self.average + 1e-6)

    @property
    def _tail(self) -> int:
        """Readings after the last frame: its own interval, and what the filter needs to run backwards."""
        if self.lowpass is None or self.phase == "causal":
            return self.average - 1
        return max(self.average - 1, math.ceil(FILTER_EDGE / self.lowpass / self.interval * self.average))

    def _check_filter(self, cutoff: float) -> None:
        if cutoff * self.interval >= 0.5:
            raise UsageError(
                f"A low-pass at {cutoff:g} Hz lets aliases through: frames {self.interval * 1e3:g} ms apart show "
                f"nothing above {0.5 / self.interval:.4g} Hz; choose a lower cut-off or more frames."
            )
        needed = math.ceil(READINGS_PER_CUTOFF * cutoff * self.interval - 1e-9)
        if self.average < max(needed, 2):
            raise UsageError(
                f"A low-pass at {cutoff:g} Hz needs at least {max(needed, 2)} readings per frame; average is "
                f"{self.average}: the readings themselves must not alias."
            )


def clip_wrenches(wrench: NDArray[np.floating], limit: float) -> tuple[NDArray[np.floating], NDArray[np.bool_]]:
    """Clip wrenches [..., 6] to ±``limit`` (N) and ±``limit`` × 1 mm (N·m); also say what was clipped [..., 6].

    What is not finite stays so and does not count.
    """
    most = np.repeat([limit, limit * 1e-3], 3).astype(wrench.dtype)
    return np.clip(wrench, -most, most), np.abs(wrench) > most


WhiskerMotion = Still | Whisking | Recorded | Tracked  # motion of whiskers relative to the head


@limited(of="{} of a head")
class Head:
    """Pose of an array in the world, and its motion; one that is not finite is a :class:`UsageError`."""

    position: Point = (0.0, 0.0, 0.0)
    """World position of the array's origin at t = 0 [m]."""
    rotation: Angles = (0.0, 0.0, 0.0)
    """Angles [rad] about the world's x, then y, then z axis that turn the array frame."""
    motion: Still | Translation | Path = field(default_factory=Still)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Rotation matrix [3, 3] from the array frame at t = 0 to the world."""
        return euler_matrix(self.rotation)

    def config(self) -> dict[str, Any]:
        """Return plain values that determine the physics."""
        return {"position": list(self.position), "rotation": list(self.rotation), "motion": self.motion.config()}


@dataclass(frozen=True, eq=False)
class Animal:
    """One more array in a scene, with a pose and a motion of its own."""

    name: str
    """Prefix of its whiskers' names: ``b:C2``."""
    array: WhiskerArray
    whisking: WhiskerMotion = field(default_factory=Whisking)
    head: Head = field(default_factory=Head)


@limited(of="{} of a scene", eq=False)
class Scene:
    """One stimulus to simulate."""

    label: str
    array: WhiskerArray
    objects: tuple[PlacedObject, ...] = ()
    whisking: WhiskerMotion = field(default_factory=Whisking)
    head: Head = field(default_factory=Head)
    frames: Frames = field(default_factory=Frames)
    others: tuple[Animal, ...] = ()
    """More animals among the same objects. Whiskers touch objects only, neither one another nor a face."""
    animal: str = "a"
    """Name of the first animal, whose array, whisking and head stand above; used when there are others."""
    twist: bool = True
    """Twist of whiskers when :attr:`Fidelity.twist` leaves it open. False in recipes with shipped recordings or
    networks, which were made before whiskers could twist."""
    gravity: Acceleration = (0.0, 0.0, 0.0)
    """Gravitational acceleration [m/s², world axes]; none by default, since a whisker weighs micrograms."""
    air_flow: Velocity | None = None
    """Velocity of uniform air [m/s, world axes]; no air by default."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "objects", tuple(self.objects))
        object.__setattr__(self, "others", tuple(self.others))
        if not self.label:
            raise UsageError("A scene needs a label: it names the stimulus in every table.")
        names = [self.animal, *(other.name for other in self.others)]
        if len(set(names)) < len(names) or not all(names) or any(":" in name for name in names):
            raise UsageError(f"The animals of a scene need different names without a colon; received {names}.")

    @property
    def names(self) -> tuple[str, ...]:
        """Whisker names of all animals: those of the array, or ``a:C2``, ``b:C2`` when there are several animals."""
        if not self.others:
            return self.array.names
        return tuple(f"{part.animal}:{name}" for part in self.split() for name in part.array.names)

    @property
    def mounts(self) -> tuple[MountedWhisker, ...]:
        """Mounted whiskers of all animals, in the order of :attr:`names`."""
        return tuple(mount for part in self.split() for mount in part.array)

    @property
    def axes(self) -> NDArray[np.float64]:
        """Rotations [whisker, 3, 3] from the frame in which each whisker's job stands to the world."""
        return np.concatenate([np.tile(part.head.matrix, (len(part.array), 1, 1)) for part in self.split()])

    @property
    def origins(self) -> NDArray[np.float64]:
        """Origins [whisker, 3] (m, world) of these frames."""
        return np.array([part.head.position for part in self.split() for _ in part.array], dtype=float)

    def split(self) -> tuple[Scene, ...]:
        """Return one scene per animal; together they are this one, because whiskers touch objects only."""
        rest = (
            replace(self, array=animal.array, whisking=animal.whisking, head=animal.head, animal=animal.name, others=())
            for animal in self.others
        )
        return replace(self, others=()), *rest

    def select(self, whiskers: str) -> Scene:
        """Return the scene with only the named whiskers; see :meth:`WhiskerArray.select`.

        With several animals ``C2`` names one whisker of each, ``b:C2`` one of them and ``b:*`` an animal.
        Animals without any whisker left are dropped.
        """
        if not self.others:
            return replace(self, array=self.array.select(whiskers))
        mounts = self.mounts
        chosen = match_whiskers(whiskers, self.names, [mount.row for mount in mounts], [mount.col for mount in mounts])
        animals, begin = [], 0
        for part in self.split():
            stay = [index - begin for index in chosen if begin <= index < begin + len(part.array)]
            begin += len(part.array)
            if stay:
                array = replace(part.array, mounts=tuple(part.array.mounts[index] for index in stay))
                animals.append(Animal(part.animal, array, part.whisking, part.head))
        first, *rest = animals
        return replace(
            self, array=first.array, whisking=first.whisking, head=first.head, animal=first.name, others=tuple(rest)
        )

    def jobs(self) -> list[Job]:
        """Return one physics job per whisker, expressed in its array's frame as it stood at t = 0.

        There the follicles have the published angles, far from the poles of the Euler angles. That frame
        stands still even when the head moves, so one rotation turns the wrenches to the world (:attr:`axes`).
        """
        if self.others:
            return [job for part in self.split() for job in part.jobs()]
        axes = self.head.matrix
        obstacles = tuple(item.obstacle((axes, self.head.position)) for item in self.objects)
        motion = self.head.motion
        # Row vectors times the matrix are world vectors in the axes of the array; rotations become Rᵀ T R.
        travel = None if isinstance(motion, Still) else lambda times: motion.displacement(times) @ axes
        turn = (lambda times: axes.T @ motion.turn(times) @ axes) if isinstance(motion, Path) else None
        finest = min(self.whisking.finest, motion.finest)
        x, y, z = (np.asarray(self.gravity) @ axes).tolist() if any(self.gravity) else (0.0, 0.0, 0.0)
        flow: Any = None if self.air_flow is None else tuple((np.asarray(self.air_flow) @ axes).tolist())
        return [
            Job(
                mount.whisker,
                ArrayFollicle(mount, self.whisking, travel, turn, finest, self._shift(mount)),
                obstacles,
                self.frames.readings,
                gravity=(x, y, z),
                air_flow=flow,
            )
            for mount in self.array
        ]

    def _shift(self, mount: MountedWhisker) -> Callable[[NDArray[np.float64]], NDArray[np.float64]] | None:
        """Return how a base moves in its array; None where it stays."""
        whisking = self.whisking
        if not isinstance(whisking, Tracked) or whisking.shifts is None:
            return None
        return partial(whisking.displacement, mount)

    def orientations(self) -> NDArray[np.float64]:
        """Return rotations [time, whisker, 3, 3] from each whisker's base frame to the world at the frame times."""
        bases = [job.follicle.pose(self.frames.times)[1] for job in self.jobs()]
        return self.axes @ base_rotation(np.stack(bases, axis=1))

    def config(self) -> dict[str, Any]:
        """Return plain values that determine the result, for hashing and for the data set's attributes."""
        config: dict[str, Any] = {
            "label": self.label,
            "objects": [item.config() for item in self.objects],
            "whisking": self.whisking.config(),
            "head": self.head.config(),
            "frames": self.frames.config(),
        }
        # What was added later appears only where it is used, so that older hashes hold.
        if any(self.gravity):
            config["gravity"] = list(self.gravity)
        if self.air_flow is not None:
            config["air_flow"] = list(self.air_flow)
        if self.others:
            config["animal"] = self.animal
            config["others"] = [
                {"animal": animal.name, "whisking": animal.whisking.config(), "head": animal.head.config()}
                for animal in self.others
            ]
        return config
