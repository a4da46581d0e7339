"""The loop on a hand keeps its rate, notices what is wrong and leaves the hand holding."""

from __future__ import annotations

import gc
import os
import re

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.deploy.controller import PRIORITY, Controller, realtime
from robotics_bridge.deploy.safety import SafetyLimits
from tests.factories.paper_hands import OwnClock, PaperHand, make_contract, make_limits, run_session

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
