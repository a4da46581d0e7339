"""A solid in a scene: where it stands and how it moves. Metres, world frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.limits import NotNegative, limited
from brainbench.core.rotations import Angles, Point, euler_matrix, from_matrices
from brainbench.stimuli.motion.trajectories import Path, Spin, Still, Translation
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.objects.solid import Solid


@dataclass(frozen=True, eq=False)
class _PlacedMotion:
    """Motion of a placed body in the frame ``axes`` [3, 3], where its origin is at ``place`` [3] (m) at t = 0."""

    motion: Translation | Spin | Path
    axes: NDArray[np.float64]
    place: NDArray[np.float64]

    @property
    def finest(self) -> float:
        """Shortest period of anything in the motion (s)."""
        return self.motion.finest

    def __call__(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [n, 3] (m) and quaternions [n, 4] at times [n] (s)."""
        # World displacements and rotations T seen from the frame: Rᵀ x (for rows, x R) and Rᵀ T R.
        moved = self.motion.displacement(times) @ self.axes
        if isinstance(self.motion, Translation):
            return moved, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))
        return self.place + moved, from_matrices(self.axes.T @ self.motion.turn(times) @ self.axes)


@dataclass(frozen=True, eq=False)
@limited(of="{} of an object")
class PlacedObject:
    """A solid in a scene (world frame); a friction below 0 or a pose that is not finite is a :class:`UsageError`."""

    solid: Solid
    position: Point = (0.0, 0.0, 0.0)
    """Position of the solid's origin [m]."""
    rotation: Angles = (0.0, 0.0, 0.0)
    """Angles [rad] about the world's x, then y, then z axis."""
    motion: Still | Translation | Spin | Path = field(default_factory=Still)
    """Motion from there; the object turns about its solid's origin."""
    friction: NotNegative | None = None
    """Coulomb coefficient of its contacts; None takes each whisker's own."""

    def obstacle(self, frame: tuple[ArrayLike, ArrayLike] | None = None) -> Obstacle:
        """Return what the physics sees in a frame, given by its rotation [3, 3] and origin [3] (m), or in the world."""
        axes, origin = (np.eye(3), np.zeros(3)) if frame is None else (np.asarray(frame[0]), np.asarray(frame[1]))
        rotation = axes.T @ euler_matrix(self.rotation)
        place = axes.T @ (np.asarray(self.position) - origin)
        # What turns is expressed about its own origin, which stays near it.
        shift = np.zeros(3) if isinstance(self.motion, (Spin, Path)) else place
        motion = None if isinstance(self.motion, Still) else _PlacedMotion(self.motion, axes, place)
        return Obstacle(self.solid.parts, motion, self.friction, self.solid.surface).moved(rotation, shift)

    def config(self) -> dict[str, Any]:
        """Return plain values that determine the physics."""
        place = {"position": list(self.position), "rotation": list(self.rotation)}
        return {"solid": self.solid.config(), **place, "motion": self.motion.config(), "friction": self.friction}
