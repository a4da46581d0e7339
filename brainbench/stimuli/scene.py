"""Scenes: a whisker array, how it moves, what stands in its way and when forces are read.

World frame: where head and objects are placed [m]. Array frame: the frame of the morphology (origin at
the mean base point, x right, y rostral, z dorsal), placed in the world by :class:`Head`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.errors import UsageError
from brainbench.files import to_plain
from brainbench.stimuli.backends.protocol import Job
from brainbench.stimuli.motion import ArrayFollicle, Still, Translation, Whisking
from brainbench.stimuli.objects import PlacedObject, euler_matrix

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.stimuli.morphology import WhiskerArray

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Head:
    """Where the array stands in the world and how it travels."""

    position: Vector = (0.0, 0.0, 0.0)
    """World position of the array's origin at t = 0 [m]."""
    rotation: Vector = (0.0, 0.0, 0.0)
    """Angles [rad] about the world's x, then y, then z axis that turn the array frame."""
    motion: Still | Translation = field(default_factory=Still)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """Rotation matrix [3, 3] from the array frame to the world."""
        return euler_matrix(self.rotation)

    def config(self) -> dict[str, Any]:
        """Plain values that determine the physics."""
        return {
            "position": list(self.position),
            "rotation": list(self.rotation),
            "motion": self.motion.config(),
        }


@dataclass(frozen=True)
class Frames:
    """When forces are read.

    The default reads 110 instantaneous frames, 9 ms apart, the first at 1 ms, as the published pipeline
    does (every ninth sample of a 1 kHz simulation). Whatever vibrates above 1/(2·interval) = 56 Hz then
    aliases, and a sliding tip does: the RDM of the six Rodgers stimuli at the presets ``balanced`` and
    ``accurate`` correlates by .90. With ``average`` = 18, each frame the mean of 18 readings, by .995.
    """

    first: float = 0.001
    """Time of the first frame [s]; the whiskers start at rest at t = 0."""
    interval: float = 0.009
    """Time between frames [s]."""
    count: int = 110
    average: int = 1
    """Readings, evenly spread over the interval that begins at the frame's time, whose mean a frame is."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.first) and self.first >= 0 and math.isfinite(self.interval) and self.interval > 0):
            raise UsageError(
                "The first frame lies at 0 s or later and the interval is positive;"
                f" received {self.first!r} s and {self.interval!r} s."
            )
        for name in ("count", "average"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise UsageError(f"{name} of the frames must be a whole number of at least 1; received {value!r}.")

    @property
    def times(self) -> NDArray[np.float64]:
        """Frame times [count] (s)."""
        return np.asarray(self.first + self.interval * np.arange(self.count), dtype=np.float64)

    @property
    def readings(self) -> NDArray[np.float64]:
        """Times [count · average] (s) at which the simulation is read."""
        within = self.interval / self.average * np.arange(self.average)
        return (self.times[:, None] + within).reshape(-1)


@dataclass(frozen=True, eq=False)
class Scene:
    """One stimulus to simulate."""

    label: str
    array: WhiskerArray
    objects: tuple[PlacedObject, ...] = ()
    whisking: Still | Whisking = field(default_factory=Whisking)
    head: Head = field(default_factory=Head)
    frames: Frames = field(default_factory=Frames)

    def __post_init__(self) -> None:
        object.__setattr__(self, "objects", tuple(self.objects))
        if not self.label:
            raise UsageError("A scene needs a label: it names the stimulus in every table.")

    def select(self, whiskers: str) -> Scene:
        """Return the scene with only the named whiskers; see :meth:`WhiskerArray.select`."""
        return replace(self, array=self.array.select(whiskers))

    def jobs(self) -> list[Job]:
        """Return one physics job per whisker, expressed in the array frame as it stood at t = 0.

        There the follicles have the published angles, far from the poles of the Euler angles; the
        head does not rotate, so only the wrench must be turned to the world (:attr:`Head.matrix`).
        """
        axes = self.head.matrix
        obstacles = tuple(item.obstacle((axes, self.head.position)) for item in self.objects)
        motion = self.head.motion
        travel = None if isinstance(motion, Still) else lambda times: motion.displacement(times) @ axes
        return [
            Job(mount.whisker, ArrayFollicle(mount, self.whisking, travel), obstacles, self.frames.readings)
            for mount in self.array
        ]

    def config(self) -> dict[str, Any]:
        """Plain values that determine the result, for hashing and for the data set's attributes."""
        return {
            "label": self.label,
            "objects": [item.config() for item in self.objects],
            "whisking": self.whisking.config(),
            "head": self.head.config(),
            "frames": to_plain(self.frames),
        }
