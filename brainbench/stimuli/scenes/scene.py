"""Scenes: a whisker array, how it moves, what stands in its way and when forces are read.

World frame: where head and objects are placed [m]. Array frame: the frame of the morphology (origin at
the mean base point, x right, y rostral, z dorsal), placed in the world by :class:`Head`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError
from brainbench.core.limits import limited
from brainbench.core.rotations import Angles, Point, base_rotation, euler_matrix
from brainbench.stimuli.motion.jobs import Acceleration, Job
from brainbench.stimuli.motion.recorded import Recorded, Tracked
from brainbench.stimuli.motion.trajectories import ArrayFollicle, Path, Still, Translation, Whisking
from brainbench.stimuli.objects.solid import PlacedObject
from brainbench.stimuli.scenes.frames import Frames
from brainbench.stimuli.whiskers.array import MountedWhisker, WhiskerArray, match_whiskers

WhiskerMotion = Still | Whisking | Recorded | Tracked  # motion of whiskers relative to the head


@dataclass(frozen=True)
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


@dataclass(frozen=True, eq=False)
@limited(of="{} of a scene")
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
        return [
            Job(
                mount.whisker,
                ArrayFollicle(mount, self.whisking, travel, turn, finest, self._shift(mount)),
                obstacles,
                self.frames.readings,
                gravity=(x, y, z),
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
        times = self.frames.times
        bases = [job.follicle.pose(times)[1] for job in self.jobs()]
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
        if self.others:
            config["animal"] = self.animal
            config["others"] = [
                {"animal": animal.name, "whisking": animal.whisking.config(), "head": animal.head.config()}
                for animal in self.others
            ]
        return config
