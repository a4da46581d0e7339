"""The control loop and its safety, on a hand of paper and by a clock of its own."""

from __future__ import annotations

import gc
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.deploy.controller import Clock, Controller
from robotics_bridge.deploy.driver import HandReading, LinkCounters
from robotics_bridge.deploy.safety import SILENCE, ClockOffset, Command, SafeLink, SafetyLimits
from robotics_bridge.policies.contract import PolicyContract

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


def test_limits_are_of_the_joints_of_the_hand() -> None:
    one = SafetyLimits(np.array([-1.0]), np.array([1.0]), np.array([8.0]))
    clock = OwnClock()
    with pytest.raises(UsageError, match="limits of 1 joints; the hand has 3"):
        Controller(lambda obs, forget: np.zeros(2), PaperHand(clock), _contract(), one, clock=clock)


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


@pytest.mark.parametrize("place", ["read", "source", "policy", "record", "collection"])
@pytest.mark.parametrize("call", [1, 30], ids=["first", "later"])
def test_no_command_comes_from_an_old_report_wherever_time_is_lost(place: str, call: int) -> None:
    for stall, timeout in itertools.product(STALLS, TIMEOUTS):
        clock, calls = OwnClock(), Counter()

        def lose_time(where: str, stall=stall, clock=clock, calls=calls) -> None:
            calls[where] += 1
            # The first report is only waited for.
            if where == place and calls[where] == call + (where == "read"):
                clock.now += stall

        def collect(phase: str, info: dict, lose_time=lose_time) -> None:
            if phase == "stop":
                lose_time("collection")

        def policy(obs, forget, lose_time=lose_time):
            lose_time("policy")
            if place == "collection":
                gc.collect(0)
            return np.zeros(2, np.float32)

        def source(reading, lose_time=lose_time):
            lose_time("source")
            return np.zeros(1)

        hand = StallingHand(clock, lose_time)
        controller = Controller(
            policy, hand, _contract(("proprio", "goal")), _limits(timeout=timeout), sources={"goal": source},
            clock=clock, record=lambda *_, lose_time=lose_time: lose_time("record"),
        )  # fmt: skip
        gc.callbacks.append(collect)
        try:
            report, case = controller.run(2.0), (stall, timeout)
        finally:
            gc.callbacks.remove(collect)
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


class JitteringClock(OwnClock):
    """Time that passes between any two looks at it, sometimes much."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.chance = np.random.default_rng(seed)

    def __call__(self) -> float:
        self.now += float(self.chance.exponential(0.001)) + (self.chance.random() < 0.01) * self.chance.uniform(0, 20)
        return self.now


@pytest.mark.parametrize("start", range(0, 250, 50))
def test_no_command_comes_from_an_old_report_by_a_clock_that_jitters(start: int) -> None:
    ends = Counter()
    for seed in range(start, start + 50):
        clock = JitteringClock(seed)
        hand = PaperHand(clock)
        ages = []
        sent = hand.send

        def send(targets, sent=sent, hand=hand, clock=clock, ages=ages) -> None:
            ages.append(clock.now - hand.last.arrived)
            sent(targets)

        hand.send = send
        report = Controller(lambda obs, forget: np.zeros(2), hand, _contract(), _limits(), clock=clock).run(5.0)
        assert max(ages, default=0.0) <= 0.1, seed
        assert hand.stops == 1, seed
        ends[report.status] += 1
    assert ends["stopped"]


def _link(clock=None, **changes):
    clock = clock or OwnClock()
    hand = PaperHand(clock)
    link = SafeLink(hand, _limits(**changes), clock, 1 / 40)
    reading = link.read()
    assert link.fault(reading) is None
    return link, hand, reading, clock


@pytest.mark.parametrize(
    ("targets", "words"),
    [
        ([0.0, np.nan, 0.0], "no numbers"), ([0.0, np.inf, 0.0], "no numbers"), ([0.0, 1e38, 0.0], "beyond"),
        ([0.0, 0.0, -1.001], "beyond"), ([0.0, 0.3, 0.0], "joint 1 faster"),
    ],
)  # fmt: skip
def test_the_link_itself_refuses_what_is_unsafe(targets, words) -> None:
    link, hand, reading, _ = _link()
    assert words in link.send(Command(np.array(targets), reading, link.deadline(reading)))
    assert hand.sent == []


def test_a_command_holds_until_its_deadline_and_a_stop_is_final() -> None:
    link, hand, reading, clock = _link()
    command = Command(np.zeros(3), reading, link.deadline(reading))
    assert command.deadline == pytest.approx(clock.now + 0.1)
    clock.now = command.deadline
    assert link.send(command) is None
    clock.now += 1e-6
    assert "after the report" in link.send(command)
    assert "no numbers" not in link.send(Command(np.zeros(3), reading, np.nan))
    link.stop()
    assert link.send(Command(np.zeros(3), reading, clock.now + 1)) == "the hand was stopped"
    assert len(hand.sent) == 1


def test_the_link_stops_the_hand_while_the_loop_hangs() -> None:
    link, hand, reading, _ = _link(Clock())
    with link.watched():
        assert link.send(Command(np.zeros(3), reading, link.deadline(reading))) is None
        time.sleep(0.1)
        assert hand.stops == 0
        time.sleep(2 * SILENCE)
        assert hand.stops == 1
        reading = link.read()
        assert "no command came for" in link.fault(reading)
        assert "no command came for" in link.send(Command(np.zeros(3), reading, link.deadline(reading)))
    assert len(hand.sent) == 1


_SESSION = """
import json, sys, time
import numpy as np
sys.path.insert(0, {root!r})
from tests.robotics_bridge.deploy.test_safety import PaperHand, _contract, _limits
from robotics_bridge.deploy.controller import Clock, Controller

class Noting(PaperHand):
    ages = []

    def send(self, targets):
        self.ages.append(time.monotonic() - self.last.arrived)
        super().send(targets)

clock = Clock()
hand = Noting(clock)
controller = Controller(lambda obs, forget: np.zeros(2), hand, _contract(), _limits(rate_share=0.01), clock=clock)
print("running", flush=True)
report = controller.run(30.0)
print(json.dumps([max(hand.ages), report.status, report.reason, hand.stops]), flush=True)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_session_that_was_suspended_stops_when_it_goes_on() -> None:
    root = os.fspath(Path(__file__).parents[3])
    process = subprocess.Popen([sys.executable, "-c", _SESSION.format(root=root)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "running\n"
    time.sleep(0.5)
    for _ in range(20):
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.4)
        process.send_signal(signal.SIGCONT)
        time.sleep(0.05)
        if process.poll() is not None:
            break
    age, status, reason, stops = json.loads(process.communicate(timeout=60)[0])
    # Between the link's look at its clock and the hand's a signal may fall, of which nobody is told.
    assert age < 0.1 + 0.01, age
    assert status == "stopped", reason
    assert stops >= 1
