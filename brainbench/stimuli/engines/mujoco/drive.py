"""Bodies that follow a prescribed trajectory exactly in MuJoCo's discrete integrator.

A MuJoCo mocap body teleports and has no velocity. Instead every moving coordinate is a joint of huge armature B, pushed
by B times the second difference of its trajectory: the integrator then reproduces the trajectory, with
the right velocity, to rounding. Units here are MuJoCo's (mm, ms). Letters: n time step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

ARMATURE = 1e9
"""Inertia of a prescribed coordinate. Larger would cost the solver digits, smaller would let the whisker's
reaction (µN·m) deflect the follicle."""


@dataclass(frozen=True, eq=False)
class PrescribedMotion:
    """Prescribed positions and velocities of some joints and the accelerations that produce them."""

    position: NDArray[np.float64]
    """[n, coordinates] as MuJoCo's qpos, before step n."""
    velocity: NDArray[np.float64]
    """[n, degrees of freedom] as MuJoCo's qvel, before step n."""
    acceleration: NDArray[np.float64]
    """[n, degrees of freedom] over step n."""


def drive_scalars(path: NDArray[np.float64], step: float) -> PrescribedMotion:
    """Drive hinges or slides along ``path`` [n + 1, joints] sampled at every step (ms)."""
    return _drive(path[:-1], np.diff(path, axis=0) / step, step)


def drive_free(position: NDArray[np.float64], quaternion: NDArray[np.float64], step: float) -> PrescribedMotion:
    """Drive a free joint along positions [n + 1, 3] and unit quaternions [n + 1, 4].

    MuJoCo integrates a quaternion by the constant body-frame rotation of each step, so the rotation
    vector from sample to sample is the velocity that reproduces them.
    """
    from scipy.spatial.transform import Rotation

    # A semi-implicit step moves by the velocity after it: the forward difference is that velocity exactly.
    linear = np.diff(position, axis=0) / step
    turns = Rotation.from_quat(np.roll(quaternion, -1, axis=-1))
    angular = (turns[:-1].inv() * turns[1:]).as_rotvec() / step
    return _drive(np.concatenate([position, quaternion], axis=1)[:-1], np.concatenate([linear, angular], axis=1), step)


def _drive(position: NDArray, after: NDArray, step: float) -> PrescribedMotion:
    """Build a drive from positions before and velocities after each step."""
    acceleration = np.empty_like(after)
    # Second difference of the path. Force B a on the armature B makes the integrator's own velocities those of the
    # path.
    acceleration[1:] = np.diff(after, axis=0) / step
    # The acceleration at the start is unknown before the first sample: continue the next one.
    acceleration[0] = acceleration[1] if len(after) > 1 else 0.0
    return PrescribedMotion(position, after - step * acceleration, acceleration)
