"""Motion of placed bodies as seen from any frame. Metres."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.rotations import from_matrices

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from brainbench.stimuli.motion.trajectories import Path, Spin, Translation
    from brainbench.stimuli.objects.obstacle import RigidMotion


def euler_matrix(angles: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrix [3, 3] of ``angles`` [rad] about the fixed x, then y, then z axis."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def translating(motion: Translation, axes: NDArray[np.float64]) -> RigidMotion:
    """Return the translation in the frame ``axes`` [3, 3]."""

    def path(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return motion.displacement(times) @ axes, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    return path


def turning(motion: Spin | Path, axes: NDArray[np.float64], place: NDArray[np.float64]) -> RigidMotion:
    """Return the motion of a body whose origin is at ``place`` [3] (m) at t = 0, in the frame ``axes`` [3, 3]."""

    def path(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return place + motion.displacement(times) @ axes, from_matrices(axes.T @ motion.turn(times) @ axes)

    return path
