"""Extremes of the bridge to robots: each ends in a status or one sentence, and none passes silently."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import hands, tasks
from robotics_bridge.deploy.controller import Controller, PressureCalibration, constant
from robotics_bridge.deploy.driver import Clock, HandReading, LinkCounters
from robotics_bridge.deploy.links.udp import UdpDriver, new_key
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.envs import ActionMap
from robotics_bridge.hands.scenes import holding
from robotics_bridge.physics import Geometry, HandState, MujocoEngine
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.sensors import ContactDepthProbe, KinematicTaxel, Probes, SensorSuite
from tests.factories.touch_scenes import pad_scene, poses_at, state_of

NOT_FINITE = (np.nan, np.inf, -np.inf)
NO_NUMBERS = (*NOT_FINITE, 1e30, -1e30)


def _one_sentence(error: pytest.ExceptionInfo[BaseException]) -> bool:
    return "\n" not in str(error.value) and len(str(error.value)) < 400


class _Hand:
    joints, fingers = ("a", "b"), ("thumb",)

    def __init__(self) -> None:
        self.counters, self.sent, self.stops = LinkCounters(), [], 0
        self.number = 0

    def read(self) -> HandReading:
        self.number += 1
        return HandReading(self.number, self.number / 40, self.number / 40, np.zeros(2), np.zeros(2), np.zeros((1, 3)))

    def send(self, targets) -> None:
        self.sent.append(targets)

    def stop(self) -> None:
        self.stops += 1

    def close(self) -> None: ...


class _Ticks(Clock):
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += max(seconds, 1e-6)


def _controller(hand, policy, *, rate=40.0, **mapping):
    parts = {"default": (0.0, 0.0), "scale": (1.0, 1.0), "low": (-1.0, -1.0), "high": (1.0, 1.0), **mapping}
    limits = SafetyLimits(-np.ones(2), np.ones(2), np.full(2, 8.0), timeout=2.0)
    actions: Any = ActionMap(hand.joints, **parts)
    contract = PolicyContract({"proprio": (6,)}, rate, "paper", hand.joints, hand.joints, actions, {})
    return Controller(policy, hand, contract, limits, clock=_Ticks())


@pytest.mark.parametrize("name", ["default", "scale", "low", "high"])
@pytest.mark.parametrize("value", NOT_FINITE)
def test_no_command_leaves_the_loop_that_is_not_finite_or_within_the_limits(name, value) -> None:
    hand = _Hand()
    report = _controller(hand, lambda obs, forget: np.full(2, 0.1), **{name: np.full(2, value)}).run(0.5)
    assert all((np.abs(targets) <= 1).all() for targets in hand.sent)
    assert hand.stops == 1
    if np.isnan(value):
        assert (report.status, hand.sent) == ("stopped", [])


@pytest.mark.parametrize("action", [np.zeros(0), np.zeros(3), np.zeros((2, 2)), np.float64(0.0), np.zeros(100_000)])
def test_actions_of_another_shape_stop_the_hand(action) -> None:
    hand = _Hand()
    report = _controller(hand, lambda obs, forget: action).run(0.5)
    assert report.status == "stopped"
    assert str(action.shape) in report.reason
    assert hand.sent == []


@pytest.mark.parametrize("value", [1e30, -1e30, 3e38])
def test_huge_actions_are_limited_in_speed_and_position(value) -> None:
    hand = _Hand()
    report = _controller(hand, lambda obs, forget: np.full(2, value)).run(0.5)
    assert report.status == "finished"
    assert report.limited > 0
    assert np.abs(hand.sent[-1]).max() == 1.0
    assert np.abs(np.diff(hand.sent, axis=0)).max() <= 8.0 / 40 + 1e-9


@pytest.mark.parametrize("rate", [*NOT_FINITE, 0.0, -40.0, 1e-3, 1e9])
def test_rates_and_durations_out_of_range_are_refused(rate) -> None:
    with pytest.raises(UsageError, match="control steps per second") as error:
        _controller(_Hand(), lambda obs, forget: np.zeros(2), rate=rate)
    assert _one_sentence(error)
    controller = _controller(_Hand(), lambda obs, forget: np.zeros(2))
    if not 0 < rate < 86400:
        with pytest.raises(UsageError, match="session"):
            controller.run(rate)


def test_names_of_safety_limits_are_known() -> None:
    with pytest.raises(UsageError, match="did you mean 'timeout'"):
        SafetyLimits.of_hand(hands.load("xhand1"), (), timeouts=1.0)


@pytest.mark.parametrize("place", [0, 1, 2])
@pytest.mark.parametrize("value", NOT_FINITE)
def test_limits_of_joints_are_finite(place, value) -> None:
    parts = [-np.ones(2), np.ones(2), np.ones(2)]
    parts[place][1] = value
    with pytest.raises(UsageError, match="finite"):
        SafetyLimits(*parts)


@pytest.mark.parametrize("values", [[np.nan], [np.inf], [1e7], [], [1.0, 2.0], [0.0] * 100_000])
def test_constants_have_a_size_and_a_range(values) -> None:
    with pytest.raises(UsageError, match="'goal'") as error:
        constant("goal", values, (3,))
    assert _one_sentence(error)


@pytest.mark.parametrize("value", [*NOT_FINITE, 0, 1e9, "1000", None])
def test_a_calibration_of_a_finger_has_a_range(value) -> None:
    with pytest.raises(UsageError, match=f"thumb.*{value}"):
        PressureCalibration(per_finger={"thumb": value})
    with pytest.raises(UsageError, match="'axes' of a pressure calibration must not be 0"):
        PressureCalibration(axes=(1.0, 0.0, 1.0))


@pytest.mark.parametrize(("joints", "fingers"), [(0, 0), (256, 0), (1, 256), (100_000, 1)])
def test_hands_of_no_or_too_many_joints_are_refused(joints, fingers) -> None:
    with pytest.raises(UsageError, match=rf"(joints|fingers) of a hand .*received ({joints}|{fingers})\."):
        UdpDriver(("", 9), tuple(map(str, range(joints))), tuple(map(str, range(fingers))), new_key())


def _pad():
    scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(0.01,)))
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.002)
    sensors = {"d": ContactDepthProbe(link="hand", probes=probe), "k": KinematicTaxel(link="hand", probes=probe)}
    return scene, sensors


@pytest.mark.parametrize("value", NOT_FINITE)
@pytest.mark.parametrize("what", ["pose", "velocity"])
def test_poses_and_velocities_that_are_not_finite_are_a_status_and_stay_in_their_environment(what, value) -> None:
    scene, sensors = _pad()
    suite = SensorSuite(scene, sensors, num_envs=2)
    poses = np.repeat(poses_at(3, {2: (0, 0, 0.014)}), 2, axis=0)
    state = state_of(scene, poses)
    (state.pose_torch if what == "pose" else state.velocity_torch)[1, 2, 0] = value
    suite.update(state)
    assert suite.diverged.tolist() == [False, True]
    for name in sensors:
        reading = suite.read(name)
        assert torch.isfinite(reading[0]).all()
        assert reading[1].isnan().all()


@pytest.mark.parametrize(("length", "wrong"), [(1.0, False), (1 + 1e-6, False), (1.01, True), (0.9, True), (0.0, True)])
@pytest.mark.parametrize("pairs", ["contact", "all"])
def test_quaternions_that_are_not_of_unit_length_are_a_status(length, wrong, pairs) -> None:
    scene, sensors = _pad()
    suite = SensorSuite(scene, {name: replace(sensor, pairs=pairs) for name, sensor in sensors.items()}, num_envs=2)
    state = state_of(scene, np.repeat(poses_at(3, {2: (0, 0, 0.014)}), 2, axis=0))
    state.set_contacts([0, 1], [(1, 2)] * 2)
    turn = state.pose_torch[1, 2, 3:]
    turn *= length
    suite.update(state)
    assert suite.diverged.tolist() == [False, wrong]
    for name in sensors:
        assert suite.read(name).flatten(1).isnan().any(dim=1).tolist() == [False, wrong]


@pytest.mark.parametrize("count", [0, -1, 10**9, 10**15])
def test_no_environment_and_too_many_are_refused_before_memory_is_taken(count) -> None:
    scene, sensors = _pad()
    model = holding(hands.load("xhand1"))
    makers = (
        lambda: SensorSuite(scene, sensors, num_envs=count),
        lambda: MujocoEngine(model, count),
        lambda: HandState.empty(count, 3, 10, "cpu"),
        lambda: tasks.make("in_palm_rotate", num_envs=count),
    )
    for make in makers:
        with pytest.raises(UsageError, match="1,000,000") as error:
            make()
        assert _one_sentence(error)


@pytest.mark.parametrize("timestep", [*NOT_FINITE, 0.0, -0.002, 10.0])
def test_engines_have_a_sensible_time_step(timestep) -> None:
    with pytest.raises(UsageError, match="step"):
        MujocoEngine(holding(hands.load("xhand1"), timestep=timestep), 1, threads=1)


@pytest.mark.parametrize("value", NO_NUMBERS)
def test_an_action_of_no_numbers_ends_its_environment_and_no_other(value) -> None:
    env = tasks.make("in_palm_rotate", num_envs=2)
    env.reset()
    actions = torch.zeros(2, env.num_actions)
    actions[0] = value
    observations, reward, terminated, _, info = env.step(actions)
    assert torch.isfinite(reward).all()
    assert all(torch.isfinite(group).all() for group in observations.values())
    # Infinite and huge actions are cut to the range of actions; no number has no such place.
    assert info["diverged"].tolist() == terminated.tolist() == [bool(np.isnan(value)), False]
