"""Whiskers that posts press where it is hard to tell how: from opposite sides, and while they slide along."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from brainbench.stimuli import WhiskerArray
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.motion.trajectories import smooth_step
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle, Part

STRAIGHT = replace(WhiskerArray.of("rat")["C2"].whisker, curvature=0.0, friction=0.0)


def held_job(
    *,
    radius: float = 1e-4,
    apart: float = 2e-3,
    turn: float = 0.3,
    shape: Part | None = None,
    about_x: float = 0.0,
    friction: float = 0.0,
    frames: int = 100,
) -> Job:
    """Return the job of a whisker between two posts on opposite sides of its middle, which turn together in 40 ms."""
    middle = STRAIGHT.arc_length / 2
    away = float(STRAIGHT.radius(middle)) + 5e-5 + radius

    def post(side: int) -> Obstacle:
        def motion(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            angle = turn * smooth_step(times, 0.04)
            x, y = side * apart / 2, -side * away
            place = np.stack([middle + np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y])
            tilt = Rotation.from_rotvec([about_x, 0, 0])
            turned = (tilt * Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))).as_quat()
            return tilt.apply(np.pad(place.T, ((0, 0), (0, 1)))), np.roll(turned, 1, axis=-1)

        motion.finest = 0.04  # type: ignore[attr-defined]
        return Obstacle((shape or Capsule((0, 0, -4e-3), (0, 0, 4e-3), radius),), motion, friction)

    return Job(STRAIGHT, StillFollicle(), (post(-1), post(1)), np.linspace(1e-3, frames * 1e-3, frames))


def sliding_job(*, friction: float = 0.0, frames: int = 460) -> Job:
    """Return the job of a whisker along which a post slides at constant depth, from 60 ms to 460 ms."""
    length, radius = STRAIGHT.arc_length, 3e-4

    def motion(times: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        times = np.asarray(times, float)
        risen = smooth_step(times, 0.06)
        x = (0.45 + 0.3 * np.clip((times - 0.06) / 0.4, 0, 1)) * length
        low = -(radius + STRAIGHT.base_radius + 1e-4)
        return np.stack([x, low * (1 - risen) + 0.1 * length * risen, 0 * x], -1), np.tile([1.0, 0, 0, 0], (len(x), 1))

    motion.finest = 0.06  # type: ignore[attr-defined]
    post = Obstacle((Capsule((0, 0, -4e-3), (0, 0, 4e-3), radius),), motion, friction)
    return Job(STRAIGHT, StillFollicle(), (post,), np.linspace(1e-3, frames * 1e-3, frames))
