"""Scenes: a whisker array, how it moves, what stands in its way and when forces are read.

World frame: where head and objects are placed [m]. Array frame: the frame of the morphology (origin at
the mean base point, x right, y rostral, z dorsal), placed in the world by :class:`Head`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.errors import UsageError
from brainbench.stimuli.backends.protocol import Job, base_rotation
from brainbench.stimuli.frames import Frames
from brainbench.stimuli.motion import ArrayFollicle, Still, Translation, Whisking
from brainbench.stimuli.objects import PlacedObject, euler_matrix

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.stimuli.morphology import WhiskerArray
    from brainbench.stimuli.trajectory import Recorded

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


@dataclass(frozen=True, eq=False)
class Scene:
    """One stimulus to simulate."""

    label: str
    array: WhiskerArray
    objects: tuple[PlacedObject, ...] = ()
    whisking: Still | Whisking | Recorded = field(default_factory=Whisking)
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

    def orientations(self) -> NDArray[np.float64]:
        """Rotations [time, whisker, 3, 3] from each whisker's base frame to the world at the frame times."""
        times = self.frames.times
        bases = [ArrayFollicle(mount, self.whisking).pose(times)[1] for mount in self.array]
        return self.head.matrix @ base_rotation(np.stack(bases, axis=1))

    def config(self) -> dict[str, Any]:
        """Plain values that determine the result, for hashing and for the data set's attributes."""
        return {
            "label": self.label,
            "objects": [item.config() for item in self.objects],
            "whisking": self.whisking.config(),
            "head": self.head.config(),
            "frames": self.frames.config(),
        }
