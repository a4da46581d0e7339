import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.motion.hinge_angles import follow_angles, principal_angles
from brainbench.stimuli.motion.recorded import Trajectory


def _coning(times, rate=40.0, opening=0.7):
    """Rotation [n, 3, 3] that spins about an axis which itself turns, and its angular velocity [n, 3]."""
    about_z = Rotation.from_rotvec(np.outer(times * rate, [0, 0, 1]))
    about_x = Rotation.from_rotvec(np.outer(opening * np.sin(9 * times), [1, 0, 0]))
    velocity = np.array([0, 0, rate]) + about_z.apply(np.outer(9 * opening * np.cos(9 * times), [1, 0, 0]))
    return (about_z * about_x).as_matrix(), velocity


def _sampled(count, rate, motion=_coning):
    return Trajectory(("RC1",), motion(np.arange(count) / rate)[1][None], rate)


def _random_rotation(seed):
    return Rotation.random(rng=np.random.default_rng(seed))


def test_the_motion_is_smooth_between_the_samples():
    trajectory = _sampled(200, 1000.0)
    step = 2e-5
    times = np.arange(0, 0.1, step)
    angles = follow_angles(lambda t: trajectory.rotation("RC1", t), times, principal_angles(np.eye(3)), "RC1")
    accelerations = np.diff(angles, n=2, axis=0) / step**2
    # A velocity held from sample to sample would jump by 40 · 9 · 1 ms = .4 rad/s within one step, 2e4 rad/s².
    assert np.abs(np.diff(accelerations, axis=0)).max() < 0.02 * 2e4
    assert np.abs(accelerations).max() < 2e3


@given(st.integers(0, 10_000))
def test_hinge_angles_give_back_the_rotation(seed):
    rotation = _random_rotation(seed).as_matrix()
    np.testing.assert_allclose(base_rotation(principal_angles(rotation)), rotation, atol=1e-9)


@settings(max_examples=30)
@given(st.floats(-7, 7), st.floats(-1.4, 1.4), st.floats(-7, 7))
def test_followed_angles_start_in_the_turn_of_the_first_and_never_jump(theta, phi, zeta):
    first = np.array([theta, phi, zeta])

    def rotation(times):
        return base_rotation(first + np.outer(times, [30.0, 0.0, -25.0]))

    times = np.linspace(0, 1, 300)
    np.testing.assert_allclose(
        follow_angles(rotation, times, first, "C2"), first + np.outer(times, [30.0, 0.0, -25.0]), atol=1e-9
    )
    # Sparse and unordered times give the same angles.
    few = np.array([0.9, 0.1])
    np.testing.assert_allclose(
        follow_angles(rotation, few, first, "C2"), first + np.outer(few, [30.0, 0.0, -25.0]), atol=1e-9
    )


def test_a_whisker_that_turns_upright_is_refused_in_words():
    def rotation(times):
        return base_rotation(np.outer(times, [0.0, math.pi, 0.0]))

    with pytest.raises(UsageError, match=r"RC2 .* 0\.48.*gimbal lock"):
        follow_angles(rotation, np.linspace(0, 0.6, 7), (0.0, 0.0, 0.0), "RC2")
