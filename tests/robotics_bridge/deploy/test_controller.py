"""The control loop and its safety, on a hand of paper and by a clock of its own."""

from __future__ import annotations

import gc
import itertools
import os
import re
from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.deploy.controller import PRIORITY, Clock, Controller, LatencyHistogram, RateMonitor, realtime
from robotics_bridge.deploy.driver import HandReading, LinkCounters
from robotics_bridge.deploy.safety import ClockOffset, SafetyLimits
from robotics_bridge.deploy.session import PressureCalibration, RealTouch
from robotics_bridge.policies.contract import PolicyContract

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


JOINTS = ("a", "b", "c")


class OwnClock(Clock):
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += max(seconds, 1e-6)


class PaperHand:
    """Follows its targets at once; ``spoil(reading number, fields)`` may change what it reports."""

    def __init__(self, clock: OwnClock, spoil=None) -> None:
        self.joints, self.fingers = JOINTS, ("thumb", "index")
        self.counters = LinkCounters()
        self.clock, self.spoil = clock, spoil
        self.position = np.zeros(3)
        self.sent: list[np.ndarray] = []
        self.number, self.stops = 0, 0
        self.last: HandReading | None = None

    def read(self) -> HandReading | None:
        self.number += 1
        fields = {
            "sequence": self.number, "time": self.clock() - 50.0, "arrived": self.clock(),
            "position": self.position.copy(), "velocity": np.zeros(3), "pressure": np.zeros((2, 3)),
        }  # fmt: skip
        if self.spoil is not None:
            fields = self.spoil(self.number, fields)
        if fields is not None:
            self.last = HandReading(**fields)
        return self.last

    def send(self, targets) -> None:
        self.sent.append(np.array(targets))
        self.position = np.array(targets)

    def stop(self) -> None:
        self.stops += 1

    def close(self) -> None:
        pass


ACTIONS = {"default": (0.1, 0.2), "scale": (0.5, 0.5), "low": (-1.0, 0.0), "high": (1.0, 0.4)}


def _contract(groups=("proprio",), rate=40.0) -> PolicyContract:
    return PolicyContract(dict.fromkeys(groups, (1,)), rate, "paper", JOINTS, ("a", "c"), ACTIONS, {"b": 0.3})


def _limits(**changes) -> SafetyLimits:
    return SafetyLimits(np.full(3, -1.0), np.full(3, 1.0), np.full(3, 8.0), **changes)


def _control(spoil=None, *, policy=None, seconds=2.0, clock=None, **changes):
    clock = clock or OwnClock()
    hand = PaperHand(clock, spoil)
    controller = Controller(
        policy or (lambda obs, forget: np.array([0.2, 0.1], np.float32)), hand,
        _contract(changes.pop("groups", ("proprio",))), _limits(), clock=clock, **changes,
    )  # fmt: skip
    return controller.run(seconds), hand, controller


def test_a_quiet_session_runs_at_its_rate_and_ends_with_the_hand_holding() -> None:
    report, hand, controller = _control()
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

    _control(spoil, policy=policy, seconds=0.1)
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
    report, hand, _ = _control(spoil)
    assert report.status == "stopped"
    assert re.search(message, report.reason), report.reason
    assert hand.stops == 1
    assert len(hand.sent) == report.ticks < 30
    assert all(np.isfinite(sent).all() for sent in hand.sent)


def test_short_gaps_and_repeats_are_survived() -> None:
    # Two of three reports are lost: the newest is at most 50 ms old.
    report, _, _ = _control(lambda n, fields: fields if n % 3 == 0 else None)
    assert report.status == "finished"
    assert report.ticks > 70


def test_a_silent_hand_is_not_waited_for_for_ever() -> None:
    report, hand, _ = _control(lambda n, fields: None)
    assert report.reason == "the hand said nothing for 3 s"
    assert (report.ticks, hand.sent, hand.stops) == (0, [], 1)


def test_a_policy_that_gives_no_numbers_or_fails_leaves_the_hand_holding() -> None:
    calls = iter([np.zeros(2), np.zeros(2), np.array([np.nan, 0.0])])
    report, hand, _ = _control(policy=lambda obs, forget: next(calls))
    assert "policy gave values that are no numbers" in report.reason
    assert len(hand.sent) == 2
    clock = OwnClock()
    hand = PaperHand(clock)

    def broken(obs, forget):
        raise RuntimeError("boom")

    controller = Controller(broken, hand, _contract(), _limits(), clock=clock)
    with pytest.raises(RuntimeError, match="boom"):
        controller.run(1.0)
    assert hand.stops == 1


def test_slow_control_is_noticed() -> None:
    clock = OwnClock()

    def slow(obs, forget):
        clock.now += 0.05
        return np.zeros(2)

    report, _, _ = _control(policy=slow, clock=clock, seconds=5)
    assert "control runs at 20.0 Hz instead of 40" in report.reason
    assert report.overruns > 15


def test_targets_keep_to_limits_of_joint_and_speed() -> None:
    report, hand, _ = _control(policy=lambda obs, forget: np.array([9.0, 9.0]))
    sent = np.array(hand.sent)
    assert np.abs(np.diff(sent, axis=0, prepend=np.zeros((1, 3)))).max() <= 8.0 / 40 + 1e-9
    np.testing.assert_allclose(sent[-1], [1.0, 0.3, 0.4])
    assert report.limited == 4  # until the slowest joint has come the 1 rad, 0.2 rad a tick


def test_ages_are_told_without_a_common_clock() -> None:
    offset = ClockOffset()
    assert offset.age(5.0, 105.02, 105.02) == pytest.approx(0.0)
    assert offset.age(5.1, 105.11, 105.11) == pytest.approx(0.0)  # came faster: the new zero
    assert offset.age(5.2, 105.31, 105.35) == pytest.approx(0.14, abs=1e-3)


def test_a_clock_that_runs_slow_makes_no_report_old() -> None:
    offset = ClockOffset()
    ages = [offset.age(0.9999 * t, t, t) for t in np.arange(0.0, 7200.0, 0.1)]  # 100 ppm
    assert max(ages) < 1e-4
    assert offset.age(0.9999 * 7200, 7200.15, 7200.15) == pytest.approx(0.15, abs=1e-3)


def _touching(observe: str, shape: tuple[int, ...]) -> PolicyContract:
    body = hands.load("xhand1")
    links = (body.palm, body.fingers["index"][-1], body.fingers["thumb"][-1])
    return PolicyContract({"tactile": shape}, 40.0, "xhand1", JOINTS, JOINTS, {}, {}, links, observe)


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


def test_what_does_not_fit_is_refused_before_anything_moves() -> None:
    with pytest.raises(UsageError, match="group 'command'"):
        _control(groups=("proprio", "command"))
    with pytest.raises(UsageError, match=r"'timeout' .* -1"):
        _limits(timeout=-1)
    hand = hands.load("xhand1")
    limits = SafetyLimits.of_hand(hand, hand.joints)
    assert limits.speed.max() == pytest.approx(14.38)
    with pytest.raises(UsageError, match=r"'xhand1' .*'knee'"):
        SafetyLimits.of_hand(hand, ("knee",))
    report, _, _ = _control(groups=("proprio", "command"), sources={"command": lambda r: np.array([np.nan])})
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


def test_limits_are_of_the_joints_of_the_hand() -> None:
    one = SafetyLimits(np.array([-1.0]), np.array([1.0]), np.array([8.0]))
    clock = OwnClock()
    with pytest.raises(UsageError, match="limits of 1 joints; the hand has 3"):
        Controller(lambda obs, forget: np.zeros(2), PaperHand(clock), _contract(), one, clock=clock)


def test_a_source_that_the_policy_does_not_read_is_refused() -> None:
    with pytest.raises(UsageError, match=r"'comand'.*did you mean 'command'"):
        _control(groups=("proprio", "command"), sources={"comand": None, "command": lambda reading: np.zeros(1)})


class StallingHand(PaperHand):
    """Stalls once after it took a report; notes how old the newest report is at each command."""

    def __init__(self, clock: OwnClock, stall: Callable[[str], None]) -> None:
        super().__init__(clock)
        self.stall, self.ages = stall, []

    def read(self) -> HandReading | None:
        reading = super().read()
        self.stall("read")
        return reading

    def send(self, targets) -> None:
        super().send(targets)
        self.ages.append(self.clock() - self.last.arrived)


STALLS = (0.05, 0.09, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0)
TIMEOUTS = (0.06, 0.1, 0.3, 1.0, 2.0)


@pytest.mark.parametrize("place", ["read", "source", "policy", "record"])
@pytest.mark.parametrize("call", [1, 30], ids=["first", "later"])
def test_no_command_comes_from_an_old_report_wherever_time_is_lost(place: str, call: int) -> None:
    for stall, timeout in itertools.product(STALLS, TIMEOUTS):
        clock, calls = OwnClock(), Counter()

        def lose_time(where: str, stall=stall, clock=clock, calls=calls) -> None:
            calls[where] += 1
            # The first report is only waited for.
            if where == place and calls[where] == call + (where == "read"):
                clock.now += stall

        def policy(obs, forget, lose_time=lose_time):
            lose_time("policy")
            return np.zeros(2, np.float32)

        def source(reading, lose_time=lose_time):
            lose_time("source")
            return np.zeros(1)

        hand = StallingHand(clock, lose_time)
        controller = Controller(
            policy, hand, _contract(("proprio", "goal")), _limits(timeout=timeout), sources={"goal": source},
            clock=clock, record=lambda *_, lose_time=lose_time: lose_time("record"),
        )  # fmt: skip
        report, case = controller.run(2.0), (stall, timeout)
        assert max(hand.ages, default=0.0) <= timeout, case
        assert hand.stops == 1, case
        if place != "record" and stall > timeout:
            # The place alone says in which words: a report that is old when it is read, or a command.
            assert report.status == "stopped", case
            assert re.search(rf"{1e3 * stall:.0f} ms .*allowed {1e3 * timeout:.0f} ms", report.reason), case
            assert len(hand.sent) == report.ticks == call - 1, case
        elif stall <= 0.1:
            assert report.status == "finished", case


def test_a_stall_before_every_command_sends_none() -> None:
    clock = OwnClock()
    hand = PaperHand(clock)

    def slow(obs, forget):
        clock.now += 0.101
        return np.zeros(2)

    report = Controller(slow, hand, _contract(), _limits(), clock=clock).run(5.0)
    assert (report.status, hand.sent, hand.stops) == ("stopped", [], 1)
    assert report.reason == "a command came 101 ms after the report it was decided from (allowed 100 ms)"
