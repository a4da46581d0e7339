"""Bases and obstacles displaced against where a job has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core import rotations
from brainbench.stimuli.motion.jobs import Follicle
from brainbench.stimuli.objects.obstacle import Obstacle


@dataclass(frozen=True, eq=False)
class MovedFollicle:
    """A follicle with shifts of its pose: constant ones, or a cubic spline through knots."""

    follicle: Follicle
    offsets: NDArray[np.float64]
    """[6] or [knot, 6] of x, y, z (m), θ, φ, ζ (rad)."""
    knots: NDArray[np.float64] | None = None
    """[knot] times (s); before the first and after the last their values hold."""

    @property
    def finest(self) -> float | None:
        """Shortest period (s) of the motion, as the follicle's own says; None when it says nothing."""
        own = getattr(self.follicle, "finest", None)
        if self.knots is None or own is None:
            return own
        return min(own, 2 * float(np.diff(self.knots).min()))

    def pose(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions [n, 3] (m) and angles [n, 3] (rad)."""
        position, euler = self.follicle.pose(times)
        shift = self.offsets
        if self.knots is not None:
            from scipy.interpolate import CubicSpline

            spline = CubicSpline(self.knots, self.offsets, bc_type="clamped")
            shift = spline(np.clip(times, self.knots[0], self.knots[-1]))
        return np.asarray(position) + shift[..., :3], np.asarray(euler) + shift[..., 3:]


def move_obstacle(
    obstacle: Obstacle, shift: Sequence[float], turn: Sequence[float] = (0.0, 0.0, 0.0), *, start: float = 0.0
) -> Obstacle:
    """Return an obstacle turned about its middle at ``start`` (s) and shifted, in world axes.

    Args:
        shift: displacement [3] (m).
        turn: rotation vector [3] (rad).
    """
    from scipy.spatial.transform import Rotation

    rotation, way = Rotation.from_rotvec(turn).as_matrix(), np.asarray(shift, dtype=float)
    middle = obstacle.bounds.mean(axis=0)
    if obstacle.motion is not None:
        return replace(obstacle, motion=_MovedMotion(obstacle.motion, rotation, way, middle, start))
    return obstacle.moved(rotation, middle - rotation @ middle + way)


class _MovedMotion:
    """A motion of an object, turned about where its middle is at the start and shifted."""

    def __init__(self, motion: Any, turn: NDArray, shift: NDArray, middle: NDArray, start: float) -> None:
        self.motion, self.turn, self.shift = motion, turn, shift
        place, quaternion = motion(np.array([start]))
        self.middle = np.asarray(place)[0] + rotations.to_matrices(np.asarray(quaternion, dtype=float))[0] @ middle
        if hasattr(motion, "finest"):
            self.finest = motion.finest

    def __call__(self, times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        place, quaternion = self.motion(times)
        if np.array_equal(self.turn, np.eye(3)):
            return np.asarray(place) + self.shift, quaternion
        turns = self.turn @ rotations.to_matrices(np.asarray(quaternion, dtype=float))
        moved = (np.asarray(place) - self.middle) @ self.turn.T + self.middle + self.shift
        return moved, rotations.from_matrices(turns)
