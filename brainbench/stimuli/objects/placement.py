"""Parts, turned, moved and scaled, and how placed bodies move as seen from any frame. Metres."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from brainbench.stimuli.objects.obstacle import Box, ConvexPart, Part, Sphere, rotation_matrix

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


def move_part(part: Part, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Part:
    """Return ``part`` rotated by a matrix [3, 3] about the origin, then translated by [3] (m)."""

    def place(point: ArrayLike) -> Any:
        return tuple(map(float, rotation @ np.asarray(point) + translation))

    if isinstance(part, ConvexPart):
        return ConvexPart(part.vertices @ rotation.T + translation)
    if isinstance(part, Sphere):
        return replace(part, centre=place(part.centre))
    if isinstance(part, Box):
        from scipy.spatial.transform import Rotation

        turned = np.roll(Rotation.from_matrix(rotation @ rotation_matrix(part.quaternion)).as_quat(), 1)
        return replace(part, centre=place(part.centre), quaternion=tuple(map(float, turned)))
    return replace(part, start=place(part.start), end=place(part.end))


def scale_part(part: Part, factor: float) -> Part:
    """Return ``part`` scaled about the origin."""

    def times(vector: ArrayLike) -> Any:
        return tuple(float(value) * factor for value in np.asarray(vector))

    if isinstance(part, ConvexPart):
        return ConvexPart(part.vertices * factor)
    if isinstance(part, Sphere):
        return Sphere(times(part.centre), part.radius * factor)
    if isinstance(part, Box):
        return replace(part, centre=times(part.centre), half_sizes=times(part.half_sizes))
    return replace(part, start=times(part.start), end=times(part.end), radius=part.radius * factor)


def translating(motion: Translation, axes: NDArray[np.float64]) -> RigidMotion:
    """Return the translation in the frame ``axes`` [3, 3]."""

    def path(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return motion.displacement(times) @ axes, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    return path


def turning(motion: Spin | Path, axes: NDArray[np.float64], place: NDArray[np.float64]) -> RigidMotion:
    """Return the motion of a body whose origin is at ``place`` [3] (m) at t = 0, in the frame ``axes`` [3, 3]."""

    def path(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        from scipy.spatial.transform import Rotation

        turned = Rotation.from_matrix(axes.T @ motion.turn(times) @ axes)
        return place + motion.displacement(times) @ axes, np.roll(turned.as_quat(), 1, axis=-1)

    return path
