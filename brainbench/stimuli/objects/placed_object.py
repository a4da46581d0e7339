"""A solid in a scene: where it stands and how it moves. Metres, world frame."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.stimuli.motion.trajectories import Path, Spin, Still, Translation
from brainbench.stimuli.objects.obstacle import Obstacle, Vector
from brainbench.stimuli.objects.placement import euler_matrix, translating, turning
from brainbench.stimuli.objects.solid import Solid

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


@dataclass(frozen=True, eq=False)
class PlacedObject:
    """A solid in a scene (world frame)."""

    solid: Solid
    position: Vector = (0.0, 0.0, 0.0)
    """Where the solid's origin lies [m]."""
    rotation: Vector = (0.0, 0.0, 0.0)
    """Angles [rad] about the world's x, then y, then z axis."""
    motion: Still | Translation | Spin | Path = field(default_factory=Still)
    """How it moves from there; it turns about its solid's origin."""
    friction: float | None = None
    """Coulomb coefficient of its contacts; None takes each whisker's own."""

    def obstacle(self, frame: tuple[ArrayLike, ArrayLike] | None = None) -> Obstacle:
        """Return what the physics sees.

        Args:
            frame: rotation [3, 3] and origin [3] (m) of the frame, in the world, in which the
                obstacle and its motion are expressed; the world itself when None.
        """
        axes, origin = (np.eye(3), np.zeros(3)) if frame is None else (np.asarray(frame[0]), np.asarray(frame[1]))
        rotation = axes.T @ euler_matrix(self.rotation)
        place = axes.T @ (np.asarray(self.position) - origin)
        motion = self.motion
        path = None
        if isinstance(motion, (Spin, Path)):
            path = turning(motion, axes, place)
        elif isinstance(motion, Translation):
            path = translating(motion, axes)
        # What turns is expressed about its own origin, which stays near it.
        shift = np.zeros(3) if isinstance(motion, (Spin, Path)) else place
        parts = tuple(part.moved(rotation, shift) for part in self.solid.parts)
        surface = self.solid.surface and self.solid.surface.moved(rotation, shift)
        return Obstacle(parts=parts, motion=path, friction=self.friction, surface=surface)

    def config(self) -> dict[str, Any]:
        """Plain values that determine the physics."""
        return {
            "solid": self.solid.config(),
            "position": list(self.position),
            "rotation": list(self.rotation),
            "motion": self.motion.config(),
            "friction": self.friction,
        }
