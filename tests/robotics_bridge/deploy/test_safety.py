"""No command comes from an old report, and none is beyond the limits, wherever time is lost.

Time is lost in the policy, in a source of observations, in reading, in the recorder and in garbage collection, at the
first command and at a later one, by clocks that jitter, and by SIGSTOP.
"""

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
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.deploy.controller import Controller, Report
from robotics_bridge.deploy.driver import Clock, HandReading
from robotics_bridge.deploy.safety import SILENCE, ClockOffset, SafeLink, SafetyLimits
from tests.factories.paper_hands import OwnClock, PaperHand, make_contract, make_limits, run_session


class NotingHand(PaperHand):
    """Notes how old the newest report is at each command; may lose time after it took a report."""

    def __init__(self, clock: Clock, lose_time: Callable[[str], None] = lambda _: None) -> None:
        super().__init__(clock)
        self.lose_time, self.ages = lose_time, []

    def read(self) -> HandReading | None:
        reading = super().read()
        self.lose_time("read")
        return reading

    def send(self, targets) -> None:
        self.ages.append(self.clock() - self.last.arrived)
        super().send(targets)


class JitteringClock(OwnClock):
    """Time that passes between any two looks at it, sometimes much."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self.chance = np.random.default_rng(seed)

    def __call__(self) -> float:
        self.now += float(self.chance.exponential(0.001)) + (self.chance.random() < 0.01) * self.chance.uniform(0, 20)
        return self.now


PLACES = ("policy", "source", "read", "record", "collection")
STALLS = (0.05, 0.09, 0.2, 0.5, 1.0, 2.0, 5.0, 20.0)  # s
TIMEOUTS = (0.06, 0.1, 0.3, 1.0, 2.0)  # s, oldest report to act upon


@dataclass(frozen=True)
class Stall:
    """A session in which time was lost."""

    length: float
    """Time lost at once [s]; 0 where a clock jitters."""
    timeout: float
    """Oldest report to act upon [s]."""
    ages: tuple[float, ...]
    """Age of the newest report at each command [s]."""
    status: str
    reason: str
    stops: int
    """Times that the hand was stopped."""

    @property
    def stale(self) -> int:
        """Number of commands from a report that was too old."""
        return sum(age > self.timeout for age in self.ages)


def stalls(place: str, call: int) -> Iterator[Stall]:
    """Lose time at a place once, at a call of it, by each of the stalls with each of the timeouts."""
    for length, timeout in itertools.product(STALLS, TIMEOUTS):
        clock, calls = OwnClock(), Counter()

        def lose_time(where: str, length=length, clock=clock, calls=calls) -> None:
            calls[where] += 1
            # The first report is only waited for.
            if where == place and calls[where] == call + (where == "read"):
                clock.now += length

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

        hand = NotingHand(clock, lose_time)
        controller = Controller(
            policy, hand, make_contract(("proprio", "goal")), make_limits(timeout=timeout), sources={"goal": source},
            clock=clock, record=lambda *_, lose_time=lose_time: lose_time("record"),
        )  # fmt: skip
        gc.callbacks.append(collect)
        try:
            report = controller.run(2.0)
        finally:
            gc.callbacks.remove(collect)
        yield _stall(length, timeout, hand, report)


def jitter(seeds: range) -> Iterator[Stall]:
    """Run a session by a clock that jitters, for each seed."""
    for seed in seeds:
        clock = JitteringClock(seed)
        hand = NotingHand(clock)
        hand.clock = lambda clock=clock: clock.now  # the hand's own look takes no time
        report = Controller(lambda obs, forget: np.zeros(2), hand, make_contract(), make_limits(), clock=clock).run(5.0)
        yield _stall(0.0, 0.1, hand, report)


def _stall(length: float, timeout: float, hand: NotingHand, report: Report) -> Stall:
    return Stall(length, timeout, tuple(hand.ages), report.status, report.reason, hand.stops)


SIGNAL_DELAY = 0.01
"""Between the link's look at its clock and the hand's a signal may fall, of which nobody is told [s]."""
_SESSION = """
import json
import numpy as np
from robotics_bridge.deploy.controller import Clock, Controller
from tests.factories.paper_hands import make_contract, make_limits
from tests.robotics_bridge.deploy.test_safety import NotingHand

hand = NotingHand(Clock())
limits = make_limits(rate_share=0.01)
controller = Controller(lambda obs, forget: np.zeros(2), hand, make_contract(), limits, clock=hand.clock)
print("running", flush=True)
report = controller.run(2.0)
print(json.dumps([hand.ages, report.status, report.reason, hand.stops]))
"""


def suspended(length: float) -> Stall:
    """Suspend the process of a session by SIGSTOP for a time [s]."""
    process = subprocess.Popen(
        [sys.executable, "-c", _SESSION], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[3]
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(0.5)
    process.send_signal(signal.SIGSTOP)
    time.sleep(length)
    process.send_signal(signal.SIGCONT)
    ages, *rest = json.loads(process.communicate(timeout=60)[0])
    return Stall(length, 0.1 + SIGNAL_DELAY, tuple(ages), *rest)


def test_targets_keep_to_limits_of_joint_and_speed() -> None:
    report, hand, _ = run_session(policy=lambda obs, forget: np.array([9.0, 9.0]))
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
        Controller(lambda obs, forget: np.zeros(2), PaperHand(clock), make_contract(), one, clock=clock)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("call", [1, 30], ids=["first", "later"])
def test_no_command_comes_from_an_old_report_wherever_time_is_lost(place: str, call: int) -> None:
    for case in stalls(place, call):
        assert (case.stale, case.stops) == (0, 1), case
        if place != "record" and case.length > case.timeout:
            # The place alone says in which words: a report that is old when it is read, or a command.
            assert case.status == "stopped", case
            words = rf"{1e3 * case.length:.0f} ms .*allowed {1e3 * case.timeout:.0f} ms"
            assert re.search(words, case.reason), case
            assert len(case.ages) == call - 1, case
        elif case.length <= 0.1:
            assert case.status == "finished", case


def test_a_stall_before_every_command_sends_none() -> None:
    clock = OwnClock()
    hand = PaperHand(clock)

    def slow(obs, forget):
        clock.now += 0.101
        return np.zeros(2)

    report = Controller(slow, hand, make_contract(), make_limits(), clock=clock).run(5.0)
    assert (report.status, hand.sent, hand.stops) == ("stopped", [], 1)
    assert report.reason == "a command came 101 ms after the report it was decided from (allowed 100 ms)"


@pytest.mark.parametrize("start", range(0, 250, 50))
def test_no_command_comes_from_an_old_report_by_a_clock_that_jitters(start: int) -> None:
    cases = list(jitter(range(start, start + 50)))
    assert {(case.stale, case.stops) for case in cases} == {(0, 1)}
    assert "stopped" in {case.status for case in cases}


def _link(clock=None, **changes):
    clock = clock or OwnClock()
    hand = PaperHand(clock)
    link = SafeLink(hand, make_limits(**changes), clock, 1 / 40)
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
    assert words in link.send(np.array(targets), reading, link.deadline(reading))
    assert hand.sent == []


def test_a_command_holds_until_its_deadline_and_a_stop_is_final() -> None:
    link, hand, reading, clock = _link()
    deadline = link.deadline(reading)
    assert deadline == pytest.approx(clock.now + 0.1)
    clock.now = deadline
    assert link.send(np.zeros(3), reading, deadline) is None
    clock.now += 1e-6
    assert "after the report" in link.send(np.zeros(3), reading, deadline)
    assert "no numbers" not in link.send(np.zeros(3), reading, np.nan)
    link.stop()
    assert link.send(np.zeros(3), reading, clock.now + 1) == "the hand was stopped"
    assert len(hand.sent) == 1


def test_the_link_stops_the_hand_while_the_loop_hangs() -> None:
    link, hand, reading, _ = _link(Clock())
    with link.watched():
        assert link.send(np.zeros(3), reading, link.deadline(reading)) is None
        time.sleep(0.1)
        assert hand.stops == 0
        time.sleep(2 * SILENCE)
        assert hand.stops == 1
        reading = link.read()
        assert "no command came for" in link.fault(reading)
        assert "no command came for" in link.send(np.zeros(3), reading, link.deadline(reading))
    assert len(hand.sent) == 1


def test_a_loop_that_goes_on_before_its_watch_sends_nothing_from_a_fresh_report_either() -> None:
    link, hand, reading, clock = _link()
    assert link.send(np.zeros(3), reading, link.deadline(reading)) is None
    clock.now += SILENCE + 0.03
    reading = link.read()
    assert link.fault(reading) is None
    assert "no command came for" in link.send(np.zeros(3), reading, link.deadline(reading))
    assert "no command came for" in link.fault(reading)
    assert len(hand.sent) == 1


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_a_session_that_was_suspended_stops_when_it_goes_on() -> None:
    case = suspended(0.4)
    assert (case.stale, case.status) == (0, "stopped"), case
    assert case.stops >= 1
