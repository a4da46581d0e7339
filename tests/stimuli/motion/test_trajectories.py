from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.motion.recorded import Trajectory
from brainbench.stimuli.motion.trajectories import (
    ROTATIONS,
    ArrayFollicle,
    Path,
    Spin,
    Still,
    Translation,
    Whisking,
    follow_angles,
    principal_angles,
    smooth_step,
)
from brainbench.stimuli.whiskers.array import WhiskerArray


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


ARRAY = WhiskerArray.mouse(side="both")
TIMES = np.linspace(0, 1, 20001)


def test_after_the_onset_whisking_is_the_published_sinusoid():
    whisking = Whisking(frequency=8.0, protraction=0.6, retraction=0.2, onset=0.05)
    times = TIMES[TIMES >= 0.05]
    published = np.cos(2 * np.pi * 8 * times + np.pi) * (0.6 + 0.2) / 2 + (0.6 - 0.2) / 2
    np.testing.assert_allclose(whisking.azimuth(times), published, atol=1e-14)


@given(st.floats(1, 25), st.floats(0, 1), st.floats(-0.3, 0.8), st.floats(0.005, 0.2))
def test_azimuth_stays_between_retraction_and_protraction(frequency, protraction, retraction, onset):
    if protraction + retraction <= 1e-6:
        return
    azimuth = Whisking(frequency, protraction, retraction, onset).azimuth(TIMES)
    assert azimuth.min() >= -retraction - 1e-12
    assert azimuth.max() <= protraction + 1e-12


def test_whisking_starts_retracted_without_a_jump_of_position_velocity_or_acceleration():
    whisking = Whisking()
    times = np.arange(5) * 1e-5
    azimuth = whisking.azimuth(times)
    assert azimuth[0] == -whisking.retraction
    top = 2 * np.pi * whisking.frequency * (whisking.protraction + whisking.retraction) / 2
    assert abs(np.diff(azimuth)[0] / 1e-5) < 1e-6 * top
    assert abs(np.diff(azimuth, n=2)[0] / 1e-10) < 1e-4 * top * 2 * np.pi * whisking.frequency


def test_without_onset_whisking_is_the_plain_sinusoid_from_the_first_instant():
    np.testing.assert_allclose(Whisking(onset=0.0).azimuth(np.array([0.025])), [math.radians(30)])


def test_each_row_couples_elevation_and_torsion_with_its_published_coefficients():
    whisking = Whisking()
    peak = np.array([0.025 + 0.05])
    tables = {"elevation": [0.398, 0.591, 0.578, 0.393, 0.217], "torsion": [-0.900, -0.284, 0.243, 0.449, 0.744]}
    for row, name in enumerate(["A1", "B1", "C1", "D1", "E1"]):
        mount = WhiskerArray.mouse()[name]
        theta, phi, zeta = (whisking.angles(mount, peak)[0] - mount.angles) / math.radians(30)
        assert theta == pytest.approx(1)
        assert phi == pytest.approx(tables["elevation"][row])
        assert zeta == pytest.approx(tables["torsion"][row])


def test_the_second_published_set_is_available_by_name():
    assert ROTATIONS["knutsen-b"].elevation == (0.12, 0.30, 0.30, 0.14, 0.02)
    assert ROTATIONS["knutsen-b"].torsion == (-0.76, -0.25, 0.22, 0.43, 0.73)


def test_protraction_carries_the_tips_of_both_sides_forward():
    whisking = Whisking()
    for name in ("RC1", "LC1"):
        angles = whisking.angles(ARRAY[name], np.array([0.05, 0.075]))
        # azimuth of the base axis against rostral: cos(θ − π/2 − π/2) grows as the whisker protracts
        forward = np.sin(angles[:, 0] - np.pi / 2) * np.cos(angles[:, 1])
        assert forward[1] > forward[0]


def test_the_left_side_whisks_as_the_mirror_image():
    right = Whisking().angles(ARRAY["RB2"], TIMES[::500])
    left = Whisking().angles(ARRAY["LB2"], TIMES[::500])
    np.testing.assert_allclose(left, right * [-1, 1, -1], atol=1e-15)


def test_whisking_backwards_is_refused():
    with pytest.raises(UsageError, match=r"received -0\.2 and 0\.1 rad"):
        Whisking(protraction=-0.2, retraction=0.1)


def test_translation_reaches_its_velocity_smoothly_and_then_keeps_it():
    motion = Translation((0.0, -0.03, 0.0), onset=0.02)
    path = motion.displacement(TIMES)
    speed = np.gradient(path[:, 1], TIMES)
    assert path[0, 1] == 0
    assert speed[TIMES > 0.021] == pytest.approx(-0.03)
    # The area under the smooth start is half of what full speed would have covered.
    assert path[-1, 1] == pytest.approx(-0.03 * (1 - 0.01))
    assert abs(speed[0]) < 1e-6


def test_translation_integrates_the_smooth_step():
    motion = Translation((1.0, 0.0, 0.0), onset=0.3)
    numerical = np.concatenate([[0], np.cumsum(np.diff(TIMES) * smooth_step((TIMES[1:] + TIMES[:-1]) / 2, 0.3))])
    np.testing.assert_allclose(motion.displacement(TIMES)[:, 0], numerical, atol=1e-8)


def test_a_spin_turns_about_its_axis_by_the_integral_of_its_speed():
    rate, axis = 4.0, np.array([1.0, 2.0, -2.0]) / 3
    motion = Spin(tuple(rate * axis), onset=0.2)
    turned = motion.turn(TIMES)
    np.testing.assert_allclose(turned @ axis, np.tile(axis, (len(TIMES), 1)), atol=1e-12)
    angle = np.arccos((np.trace(turned, axis1=1, axis2=2) - 1) / 2)
    travelled = Translation((rate, 0.0, 0.0), onset=0.2).displacement(TIMES)[:, 0]
    folded = np.abs((travelled + np.pi) % (2 * np.pi) - np.pi)
    np.testing.assert_allclose(angle, folded, atol=1e-7)
    # A quarter turn about z takes x to y, not to −y.
    quarter = Spin((0.0, 0.0, np.pi / 2), onset=0.0).turn(np.array([1.0]))[0]
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    assert (motion.displacement(TIMES) == 0).all()


def test_a_travelling_head_carries_its_follicles():
    mount = ARRAY["RC2"]
    motion = Translation((0.01, 0.0, 0.0), onset=0.0)
    position, euler = ArrayFollicle(mount, Still(), motion.displacement).pose(np.array([0.0, 0.1]))
    np.testing.assert_allclose(position - mount.position, [[0, 0, 0], [1e-3, 0, 0]], atol=1e-15)
    np.testing.assert_allclose(euler, [mount.angles] * 2)


def _turned(*degrees):
    rows = tuple((0.0, 0.0, math.radians(angle)) for angle in degrees)
    return Path(tuple(0.1 * place for place in range(len(rows))), ((0.0, 0.0, 0.0),) * len(rows), rows)


@pytest.mark.parametrize("degrees", [(0, 270), (0, 360), (0, 720), (0, 1080), (0, -90, -270), (0, 90, 300)])
def test_keyframes_that_go_the_longer_way_round_are_refused(degrees):
    with pytest.raises(UsageError, match="shorter way"):
        _turned(*degrees)


@pytest.mark.parametrize("degrees", [(0, 180), (0, -180), (0, 120, 240), (0, -120, -240), (0, 90, 175, -175)])
def test_keyframes_less_than_half_a_turn_apart_turn_as_their_angles_say(degrees):
    times = np.linspace(0, 0.1 * (len(degrees) - 1), 41)
    turns = Rotation.from_matrix(_turned(*degrees).turn(times))
    whole = math.degrees((turns[1:] * turns[:-1].inv()).as_rotvec()[:, 2].sum())
    assert whole == pytest.approx(185 if degrees[-1] == -175 else degrees[-1])
