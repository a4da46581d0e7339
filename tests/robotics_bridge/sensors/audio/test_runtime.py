"""Sound of contacts and drives over blocks, environments and resets."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.audio.runtime import Microphone, joint_drive
from robotics_bridge.sensors.audio.sensors import ActuationAudio, ContactAudio, Modes
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.suite import SensorSuite
from tests.factories.touch_scenes import (
    DT,
    MODES,
    RATE,
    K,
    ball_state,
    box_scene,
    make_box,
    strike,
    suite_of,
    touch_box,
)


def test_what_is_held_at_a_reset_makes_no_sound_and_what_strikes_afterwards_does():
    suite, state = make_box()
    touch_box(state, 30.0)
    for _ in range(2):
        suite.reset()
        for _ in range(3):
            suite.update(state, DT)
            assert np.all(suite.read("sound").numpy() == 0)
    touch_box(state, 40.0)
    suite.update(state, DT)
    assert suite.read("sound").abs().max() > 0


def test_environments_ring_reset_and_break_alone_and_alike_in_any_batch():
    alone = strike(*make_box(), 3)
    suite, state = make_box(envs=3)
    suite.update(state, DT)
    touch_box(state, 10.0, envs=(0, 2))
    suite.update(state, DT)
    read = suite.read("sound").numpy()
    assert np.array_equal(read[0, 0], alone[:K])
    assert np.all(read[1] == 0)
    state.contact_count.fill_(0)
    suite.reset([0])
    state.pose_torch[1, 1, 0] = math.nan
    suite.update(state, DT)
    read = suite.read("sound").numpy()
    assert np.all(read[0] == 0)
    assert np.isnan(read[1]).all()
    assert np.array_equal(read[2, 0], alone[K : 2 * K])
    assert read.shape == (3, 1, K)


def test_drives_whine_at_their_speed_and_grow_louder_with_load():
    sensor = ActuationAudio(link="box", joints=2, samples=K, friction=0.0, pitch=80.0, hum=0.0)
    suite, state = SensorSuite(box_scene(), {"drives": sensor}, num_envs=1), HandState.empty(1, 3)
    effort, speed = joint_drive(suite, "drives")
    effort[0] = effort.new_tensor([1.0, 3.0])
    speed[0] = speed.new_tensor([10.0, -5.0])
    heard = []
    for _ in range(200):
        suite.update(state, DT)
        heard.append(suite.read("drives")[0].numpy().copy())
    sound = np.concatenate(heard, axis=1)
    frequency = np.fft.rfftfreq(sound.shape[1], 1 / RATE)
    spectrum = np.abs(np.fft.rfft(sound, axis=1)) / sound.shape[1] * 2
    loud = [1e-3 * 1 + 1e-3 * 10, 1e-3 * 3 + 1e-3 * 15]
    for joint, tone in enumerate((800.0, 400.0)):
        assert frequency[spectrum[joint].argmax()] == pytest.approx(tone, abs=1.5)
        assert spectrum[joint].max() == pytest.approx(loud[joint], rel=0.02)
    assert np.abs(np.diff(sound[0])).max() < 4 * loud[0]


def test_idle_drives_hum_and_moving_ones_rasp():
    sensor = ActuationAudio(link="box", joints=1, samples=K, hum=0.01, hum_frequency=120.0, friction=1e-2)
    suite, state = SensorSuite(box_scene(), {"drives": sensor}, num_envs=1), HandState.empty(1, 3)
    suite.update(state, DT)
    t = np.arange(1, K + 1) / RATE
    assert suite.read("drives")[0, 0].numpy() == pytest.approx(0.01 * np.sin(2 * np.pi * 120 * t), abs=1e-5)
    joint_drive(suite, "drives")[1].fill_(2.0)
    suite.update(state, DT)
    suite.update(state, DT)
    assert suite.read("drives")[0, 0].numpy().std() == pytest.approx(0.02, rel=0.3)
    with pytest.raises(UsageError, match="'drives'"):
        joint_drive(suite, "drive")


@pytest.mark.parametrize("samples", [160, 960, 3000])
def test_samples_of_a_block_of_any_length_have_noise_of_their_own(samples):
    noisy = Noise(white=1.0)
    sensor = ContactAudio(link="box", modes=MODES, samples=samples, noise=noisy)
    suite, state, heard = SensorSuite(box_scene(), {"sound": sensor}, num_envs=1), HandState.empty(1, 3), []
    for _ in range(3):
        suite.reset()
        suite.update(state, DT)
        heard.append(suite.read("sound")[0, 0].numpy().copy())
    assert len(np.unique(heard)) == pytest.approx(3 * samples, rel=0.01)


@pytest.mark.parametrize("distance", [0.343, 1.0, 2.5])
def test_a_microphone_hears_late_by_r_over_c_and_weaker_by_one_over_r(distance):
    suite, state = make_box()
    listener = Microphone(position=(distance, 0.0, 0.0)).build(suite)
    suite.update(state, DT)
    listener.update(state, DT)
    touch_box(state, 10.0)
    source, heard = [], []
    for _ in range(6):
        suite.update(state, DT)
        listener.update(state, DT)
        state.contact_count.fill_(0)
        source.append(suite.read("sound")[0, 0].numpy().copy())
        heard.append(listener.read()[0].numpy().copy())
    source, heard = np.concatenate(source), np.concatenate(heard)
    onset = np.flatnonzero(np.abs(heard) > 1e-6)[0] / RATE
    assert onset == pytest.approx(distance / 343, abs=1.5 / RATE)
    lag = distance / 343 * RATE
    late = np.interp(np.arange(len(source)) - lag, np.arange(-1, len(source)), [0.0, *source], left=0.0) / distance
    assert heard == pytest.approx(late, abs=1e-3 * np.abs(late).max())


def test_a_microphone_set_up_during_an_episode_is_no_louder_at_first():
    sensor = ActuationAudio(link="box", joints=1, samples=K, hum=1.0, hum_frequency=400.0)
    suite, state = SensorSuite(box_scene(), {"drives": sensor}, num_envs=1), HandState.empty(1, 3)
    pose = np.tile([1.0, 0, 0, 1, 0, 0, 0], (3, 1))
    pose[0, 0] = 0.0
    state.set_pose(pose)
    suite.update(state, DT)
    listener, peaks = Microphone().build(suite), []
    for _ in range(4):
        suite.update(state, DT)
        listener.update(state, DT)
        peaks.append(float(listener.read().abs().max()))
    assert peaks[0] < 1.1 * peaks[3]


def test_sources_add_up_and_the_power_of_distance_is_chosen():
    sensors = {name: ContactAudio(link=name, modes=MODES, samples=K) for name in ("box", "ball")}
    suite, state = SensorSuite(box_scene(), sensors, num_envs=1), HandState.empty(1, 3, 4)
    pose = np.zeros((3, 7))
    pose[:, 3] = 1
    pose[1, 0], pose[2, 0] = 1.0, -1.0
    state.set_pose(pose)
    both = Microphone(power=2.0).build(suite)
    one = Microphone(power=2.0, sources=("box",)).build(suite)
    for block in range(3):
        if block == 1:
            touch_box(state, 10.0)
        suite.update(state, DT)
        both.update(state, DT)
        one.update(state, DT)
    assert np.abs(one.read().numpy()).max() > 0
    assert both.read().numpy() == pytest.approx(2 * one.read().numpy(), rel=1e-5)
    with pytest.raises(UsageError, match="did you mean 'ball'"):
        Microphone(sources=("bal",)).build(suite)


def test_a_microphone_without_sources_and_wrong_settings_are_explained():
    with pytest.raises(UsageError, match="no source of sound"):
        Microphone().build(SensorSuite(box_scene(), {}, num_envs=1))
    with pytest.raises(UsageError, match=r"samples .*received 0"):
        ContactAudio(link="box", modes=MODES, samples=0)
    with pytest.raises(UsageError, match=r"threshold .*received -1"):
        ContactAudio(link="box", modes=MODES, threshold=-1.0)
    with pytest.raises(UsageError, match=r"joints .*at least 1"):
        ActuationAudio(link="box", joints=0)
    with pytest.raises(UsageError, match=r"speed_of_sound .*received 0"):
        Microphone(speed_of_sound=0.0)


@pytest.mark.parametrize("place", range(3))
@pytest.mark.parametrize("value", [np.nan, np.inf, True])
def test_a_microphone_stands_somewhere(place, value):
    position = [0.0, 0.0, 0.0]
    position[place] = value
    with pytest.raises(UsageError, match=rf"position .*received {value}"):
        Microphone(position=tuple(position))
    with pytest.raises(UsageError, match="position holds 3 numbers"):
        Microphone(position=(0.0, 1.0))  # type: ignore[arg-type]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_sound_that_is_not_finite_is_heard_as_nan_until_the_reset_and_not_as_silence(value):
    suite = SensorSuite(box_scene(), {"drive": ActuationAudio(link="box", joints=2, samples=K, hum=1.0)}, num_envs=2)
    state = HandState.empty(2, 3, 4)
    listener = Microphone(position=(1.0, 0.0, 0.0)).build(suite)
    torque, _speed = joint_drive(suite, "drive")

    def hear():
        suite.update(state, DT)
        listener.update(state, DT)
        return listener.read()

    assert hear().isfinite().all()
    torque[1, 0] = value
    for _ in range(3):
        heard = hear()
        assert heard[0].isfinite().all()
        assert heard[1].isnan().all()
    torque[:] = 0
    # What was lost is still under way to the listener.
    assert hear()[1].isnan().all()
    assert listener.diverged.tolist() == [False, True]
    suite.reset([1])
    hear()
    assert hear().abs().amax(dim=1).gt(0).all()
    assert not listener.diverged.any()


def test_a_state_that_diverged_is_heard_as_nan():
    suite, state = make_box(2)
    listener = Microphone(position=(1.0, 0.0, 0.0)).build(suite)
    state.pose_torch[1, 1, 0] = np.nan
    suite.update(state, DT)
    listener.update(state, DT)
    assert suite.diverged.tolist() == listener.diverged.tolist() == [False, True]
    assert listener.read().isnan().all(dim=1).tolist() == [False, True]


@pytest.mark.parametrize("dt", [0, -0.01, np.nan, np.inf])
def test_a_microphone_hears_blocks_of_some_length(dt) -> None:
    suite = suite_of({"a": ContactAudio(link="hand", modes=Modes((500.0,), (0.0,), (1.0,)))})
    suite.update(ball_state(0.014))
    with pytest.raises(UsageError, match="dt"):
        Microphone().build(suite).update(ball_state(0.014), dt)
    with pytest.raises(UsageError, match="sources"):
        Microphone(sources="a")
