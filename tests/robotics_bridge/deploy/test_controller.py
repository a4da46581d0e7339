"""The loop on a hand keeps its rate, notices what is wrong and leaves the hand holding."""

from __future__ import annotations

import gc
import os
import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from robotics_bridge import hands, tasks
from robotics_bridge.deploy.controller import (
    PRIORITY,
    Controller,
    DeployedPolicy,
    LatencyHistogram,
    PressureCalibration,
    RateMonitor,
    RealTouch,
    read_deployed,
    realtime,
)
from robotics_bridge.deploy.driver import Clock, Driver, HandReading, LinkCounters
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.evaluate import Policy
from robotics_bridge.policies.export import export_policy
from robotics_bridge.policies.training.distill import build_student, describe_run
from robotics_bridge.policies.training.distill_config import DistillConfig
from robotics_bridge.tasks.task import ObservationNoise
from tests.factories.paper_hands import OwnClock, PaperHand, make_contract, make_limits, run_session, still_map
from tests.factories.policies import contract_of

linux = pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="SCHED_FIFO is Linux's")


@linux
def test_a_thread_goes_ahead_and_comes_back_also_after_an_error() -> None:
    try:
        with realtime():
            assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_FIFO
            assert os.sched_getparam(0).sched_priority == PRIORITY
            assert not gc.isenabled()
            raise KeyError
    except KeyError:
        pass
    except UsageError as error:
        pytest.skip(str(error))
    assert os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK == os.SCHED_OTHER
    assert gc.isenabled()


@linux
def test_a_user_who_may_not_is_told_how_to_be_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with pytest.raises(UsageError, match=r"rtprio 20' in .*limits\.conf"), realtime():
        pass
    assert gc.isenabled()


def test_other_systems_are_told_that_they_have_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "SCHED_FIFO", raising=False)
    with pytest.raises(UsageError, match="Linux's"), realtime():
        pass


def test_a_quiet_session_runs_at_its_rate_and_ends_with_the_hand_holding() -> None:
    report, hand, controller = run_session()
    assert (report.status, report.reason) == ("finished", "")
    assert report.ticks == pytest.approx(80, abs=1)
    assert hand.stops == 1
    np.testing.assert_allclose(hand.sent[-1], [0.2, 0.3, 0.25], atol=1e-6)
    assert len(controller.latency) == report.ticks


def test_the_rate_is_that_of_control_and_not_of_waiting_for_the_first_report() -> None:
    clock = OwnClock()
    hand = PaperHand(clock)
    controller = Controller(lambda obs, forget: np.zeros(2), hand, make_contract(), make_limits(), clock=clock)
    read, begun = controller.link.read, clock()
    controller.link.read = lambda: read() if clock() - begun > 2 else None  # type: ignore[method-assign]
    report = controller.run(2.0)
    assert report.status == "finished"
    assert report.seconds == pytest.approx(4.0, abs=0.1)
    assert report.rate == pytest.approx(40, rel=0.02)


def test_targets_move_no_faster_than_allowed_where_ticks_are_made_up_for() -> None:
    clock, limits, sent = OwnClock(), make_limits(), []
    hand, calls = PaperHand(clock), iter(range(10_000))

    def stalls(obs, forget):
        number = next(calls)
        clock.now += 0.07 if number % 7 == 6 else 0.0
        return np.full(2, 50.0 if number % 14 < 7 else -50.0)

    controller = Controller(stalls, hand, make_contract(), limits, clock=clock)
    send = controller.link.send
    controller.link.send = lambda targets, *rest: (sent.append((clock(), targets)), send(targets, *rest))[1]
    assert controller.run(2.0).status == "finished"
    times, targets = (np.array(part) for part in zip(*sent, strict=True))
    assert np.diff(times).min() < 1e-4  # ticks at once
    allowed = limits.speed * np.diff(times)[:, None]
    assert (np.abs(np.diff(targets, axis=0)) <= allowed + 1e-9).all()
    assert (np.abs(np.diff(targets, axis=0)) > 0.9 * allowed).any()


def test_observations_are_those_of_the_tasks() -> None:
    seen = []

    def policy(obs, forget):
        seen.append((obs["proprio"].copy(), forget))
        return np.array([0.4, -0.2], np.float32)

    def spoil(number, fields):
        return {**fields, "velocity": np.array([1.0, 2.0, 3.0])}

    run_session(spoil, policy=policy, seconds=0.1)
    first, second = seen[0], seen[1]
    np.testing.assert_allclose(first[0], [0, 0, 0, 0.2, 0.4, 0.6, 0, 0], atol=1e-6)
    np.testing.assert_allclose(second[0][-2:], [0.4, -0.2], atol=1e-6)
    assert [forget for _, forget in seen[:3]] == [True, False, False]


def _from(number, **changes):
    return lambda n, fields: {**fields, **{k: v for k, v in changes.items()}} if n > number else fields


NAN = np.array([0.0, np.nan, 0.0])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_from(20, position=NAN), "no numbers"),
        (_from(20, velocity=NAN), "no numbers"),
        (_from(20, pressure=np.full((2, 3), np.inf)), "no numbers"),
        (_from(20, time=float("nan")), "no numbers"),
        (_from(20, position=np.array([0.0, 1000.0, 0.0])), "joint 1 is reported at 1e"),
        (_from(20, velocity=np.array([0.0, 0.0, -17.0])), "joint 2 is reported to move at -17 rad/s"),
        (_from(20, pressure=np.full((2, 3), 40.0)), "a finger tip is pressed with 69.3"),
        (lambda n, fields: None if n > 20 else fields, "ms old \\(allowed 100 ms\\)"),
        (lambda n, fields: {**fields, "time": 50.5} if n > 20 else fields, "ms old"),
        (lambda n, fields: {**fields, "time": fields["time"] - 0.2} if n > 20 else fields, "the newest report is 2"),
    ],
)
def test_bad_data_stops_the_hand_before_it_is_acted_upon(spoil, message) -> None:
    report, hand, _ = run_session(spoil)
    assert report.status == "stopped"
    assert re.search(message, report.reason), report.reason
    assert hand.stops == 1
    assert len(hand.sent) == report.ticks < 30
    assert all(np.isfinite(sent).all() for sent in hand.sent)


def test_short_gaps_and_repeats_are_survived() -> None:
    # Two of three reports are lost: the newest is at most 50 ms old.
    report, _, _ = run_session(lambda n, fields: fields if n % 3 == 0 else None)
    assert report.status == "finished"
    assert report.ticks > 70


def test_a_silent_hand_is_not_waited_for_for_ever() -> None:
    report, hand, _ = run_session(lambda n, fields: None)
    assert report.reason == "the hand said nothing for 3 s"
    assert (report.ticks, hand.sent, hand.stops) == (0, [], 1)


def test_a_policy_that_gives_no_numbers_or_fails_leaves_the_hand_holding() -> None:
    calls = iter([np.zeros(2), np.zeros(2), np.array([np.nan, 0.0])])
    report, hand, _ = run_session(policy=lambda obs, forget: next(calls))
    assert "policy gave values that are no numbers" in report.reason
    assert len(hand.sent) == 2
    clock = OwnClock()
    hand = PaperHand(clock)

    def broken(obs, forget):
        raise RuntimeError("boom")

    controller = Controller(broken, hand, make_contract(), make_limits(), clock=clock)
    with pytest.raises(RuntimeError, match="boom"):
        controller.run(1.0)
    assert hand.stops == 1


def test_a_command_that_comes_too_late_to_be_sent_is_no_limited_tick() -> None:
    clock, calls = OwnClock(), iter(range(100))

    def policy(obs, forget):
        clock.now += 0.2 if next(calls) == 2 else 0.0
        return np.array([9.0, 9.0])

    report = Controller(policy, PaperHand(clock), make_contract(), make_limits(), clock=clock).run(1.0)
    assert "after the report" in report.reason
    assert report.limited == report.ticks == 2


def test_slow_control_is_noticed() -> None:
    clock = OwnClock()

    def slow(obs, forget):
        clock.now += 0.05
        return np.zeros(2)

    report, _, _ = run_session(policy=slow, clock=clock, seconds=5)
    assert "control runs at 20.0 Hz instead of 40" in report.reason
    assert report.overruns > 15


def test_what_does_not_fit_is_refused_before_anything_moves() -> None:
    with pytest.raises(UsageError, match="group 'command'"):
        run_session(groups=("proprio", "command"))
    with pytest.raises(UsageError, match=r"'timeout' .* -1"):
        make_limits(timeout=-1)
    hand = hands.load("xhand1")
    limits = SafetyLimits.of_hand(hand, hand.joints)
    assert limits.speed.max() == pytest.approx(14.38)
    with pytest.raises(UsageError, match=r"'xhand1' .*'knee'"):
        SafetyLimits.of_hand(hand, ("knee",))
    report, _, _ = run_session(groups=("proprio", "command"), sources={"command": lambda r: np.array([np.nan])})
    assert report.reason == "the observation 'command' holds values that are no numbers"


def test_histogram_and_rate() -> None:
    histogram = LatencyHistogram()
    for value in np.linspace(0.001, 0.1, 1000):
        histogram.append(float(value))
    assert sum(int(line.split()[3]) for line in histogram.text().splitlines()) == 1000
    assert histogram.summary()["p50"] == pytest.approx(50.5, rel=1e-3)
    assert histogram.summary()["max"] == pytest.approx(100.0)
    assert histogram.text().count("\n") == 20  # two decades
    monitor = RateMonitor(40, 1.0)
    rates = [monitor.tick(0.05 * step) for step in range(60)]
    assert rates[5] == 40  # too early to tell
    assert rates[-1] == pytest.approx(20)


def test_a_source_that_the_policy_does_not_read_is_refused() -> None:
    with pytest.raises(UsageError, match=r"'comand'.*did you mean 'command'"):
        run_session(groups=("proprio", "command"), sources={"comand": None, "command": lambda reading: np.zeros(1)})


def _deployed(group: str, size: int = 1, **deployment: Any) -> DeployedPolicy:
    contract = contract_of()
    contract["inputs"][1] = [group, [size]]
    contract["deployment"] |= {"hand": "xhand1", **deployment}
    return DeployedPolicy(Path("policy.onnx"), PolicyContract.of(contract, "policy.onnx.json"))


@pytest.mark.parametrize("group", ["goal", "priv_obj_state", "priv_proprio", "aux_goal_dist", "aux_obj_size"])
def test_no_constant_stands_for_what_only_the_simulation_knows(group: str) -> None:
    with pytest.raises(UsageError, match=f"'{group}', which only the simulation knows"):
        _deployed(group).require({group, "tactile"})


def test_a_command_that_the_contract_states_needs_no_word_of_the_user() -> None:
    assert "command" not in _deployed("command", command=[1.0]).require({"tactile"})
    with pytest.raises(UsageError, match=r"command \(\[4\], what the hand is told"):
        _deployed("command", 4).require({"tactile"})


@pytest.mark.parametrize("stated", [{"task": "screwdriver"}, {"task": "mine", "starts": "grasps"}])
def test_actions_that_are_counted_from_a_grasp_reach_no_hand(stated: dict[str, str]) -> None:
    """A target was off by up to .17 rad within half a second, and the session had finished."""
    with pytest.raises(UsageError, match=f"{stated['task']}.*counted from each"):
        _deployed("command", command=[1.0], **stated).require({"tactile"})
    assert "tactile" in _deployed("command", command=[1.0], task="in_palm_rotate").require({"tactile"})


def test_touch_of_a_policy_without_touch_reaches_nothing_and_is_refused() -> None:
    deployed, hand = _deployed("command", command=[0.5]), SimpleNamespace(joints=(), fingers=())
    inputs = {name: shape for name, shape in deployed.contract.inputs.items() if name != "tactile"}
    deployed = replace(deployed, contract=replace(deployed.contract, inputs=inputs, links=()))
    for options in ({"fallback": lambda reading: None}, {"calibration": PressureCalibration()}):
        with pytest.raises(UsageError, match="reads no touch"):
            deployed.controller(cast("Driver", hand), **options)
    with pytest.raises(UsageError, match="fallback, not among sources"):
        deployed.controller(cast("Driver", hand), sources={"tactile": lambda reading: None})


class _OwnClock(Clock):
    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


class _TaskHand:
    """A hand that is the task itself: each command is held against what evaluation does in the same state."""

    def __init__(self, env: Any, policy: Policy, clock: Clock) -> None:
        self.env, self.policy, self.clock, self.counters = env, policy, clock, LinkCounters()
        self.joints, self.fingers = env.joint_names, tuple(env.hand.fingers)
        self.number = 0
        self.pairs: list[tuple[np.ndarray, np.ndarray]] = []
        self.largest = 0.0

    def read(self) -> HandReading:
        self.number += 1
        columns, state = self.env.state.actuators, self.env.simulation
        position, velocity = state.qpos[0, columns.qpos_columns], state.qvel[0, columns.qvel_columns]
        pressure = np.zeros((len(self.fingers), 3))
        now = self.clock()
        return HandReading(self.number, now, now, position.double().numpy(), velocity.double().numpy(), pressure)

    def send(self, targets: np.ndarray) -> None:
        self.env.step(self.policy(self.env.observations))
        self.largest = max(self.largest, float(self.env.state.episode.action.abs().max()))
        self.pairs.append((np.array(targets), self.env.state.actuators.target[0].numpy().copy()))

    def stop(self) -> None: ...

    def close(self) -> None: ...


def test_a_deployed_policy_sees_and_does_what_evaluation_does(tmp_path: Path) -> None:
    task = replace(tasks.load("in_palm_rotate"), noise=ObservationNoise(position=0.0, velocity=0.0))
    env = tasks.make(task, num_envs=1, threads=1, seed=2)
    config = DistillConfig(task="in_palm_rotate", observe="none", embedder="lstm", hidden=(16,), num_envs=1)
    with torch.random.fork_rng():
        torch.manual_seed(3)
        student = build_student(config, env.observation_shapes, ["proprio", "command"], env.num_actions).eval()
        # Actions beyond the limit: deployed, they must be bounded and remembered as in the task.
        student.mlp[-1].weight.data *= 200.0  # type: ignore[index]
    described = describe_run(config, student, env)
    found = export_policy(student, tmp_path / "policy", deployment=described["deployment"])
    clock = _OwnClock()
    hand = _TaskHand(env, Policy(student), clock)
    limits = {"margin": 1.0, "pressure": 1000.0}
    controller = read_deployed(found.path).controller(hand, limits=limits, clock=clock)
    report = controller.run(0.5)
    assert (report.status, report.ticks) == ("finished", 20)
    sent, wanted = (np.array(part) for part in zip(*hand.pairs, strict=True))
    assert np.ptp(wanted, axis=0).max() > 0.1
    assert hand.largest == pytest.approx(task.action_limit)
    np.testing.assert_allclose(sent, wanted, atol=2e-4)


JOINTS = ("a", "b", "c")


def _touching(observe: str, shape: tuple[int, ...]) -> PolicyContract:
    body = hands.load("xhand1")
    links = (body.palm, body.fingers["index"][-1], body.fingers["thumb"][-1])
    still = still_map(JOINTS)
    return PolicyContract({"tactile": shape}, 40.0, "xhand1", JOINTS, JOINTS, still, {}, links, observe)


def test_real_values_fill_all_slots_and_simulated_ones_the_rest() -> None:
    pressure = np.array([[0.0, 0.0, 0.03], [0.02, 0.0, 0.1]])
    reading = HandReading(0, 0.0, 0.0, np.zeros(3), np.zeros(3), pressure)
    fallback = lambda r: np.full((5, 3, 1), 7.0)  # noqa: E731
    touch = RealTouch(_touching("agg_bool", (5, 3, 1)), ("thumb", "index"), fallback=fallback)
    assert touch(reading)[:, :, 0].tolist() == [[7.0, 1.0, 0.0]] * 5  # 4.31: |f| > 0.05
    force = RealTouch(_touching("agg_force", (5, 3, 3)), ("thumb", "index"))
    assert force(reading)[2].tolist() == [[0, 0, 0], [-20.0, 0.0, 100.0], [0.0, 0.0, 30.0]]
    calibration = PressureCalibration(per_finger={"index": 500.0})
    again = calibration.pressure(("thumb", "index"), calibration.force(("thumb", "index"), pressure))
    np.testing.assert_allclose(again, pressure)
    simulated = RealTouch(_touching("force", (5, 9, 3)), (), fallback=lambda r: np.ones((5, 9, 3)))
    assert simulated(reading).all()
    with pytest.raises(UsageError, match=r"'force', .*'agg_force'"):
        RealTouch(_touching("force", (5, 9, 3)), ())


@pytest.mark.parametrize("observe", ["agg_force", "agg_bool"])
def test_a_calibration_of_a_finger_that_the_hand_lacks_is_refused(observe) -> None:
    calibration = PressureCalibration(per_finger={"indx": 5.0})
    with pytest.raises(UsageError, match="'indx'; did you mean 'index'"):
        RealTouch(_touching(observe, (5, 3, 3)), ("thumb", "index"), calibration=calibration)
