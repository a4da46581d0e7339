"""Hands of paper for the control loop, by clocks of their own, and sessions in which time is lost.

Time is lost in the policy, in a source of observations, in reading, in the recorder and in garbage collection, at the
first command and at a later one, by clocks that jitter, and by SIGSTOP.
"""

from __future__ import annotations

import gc
import itertools
import json
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robotics_bridge.deploy.controller import Controller, Report
from robotics_bridge.deploy.driver import Clock, HandReading, LinkCounters
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.policies.contract import PolicyContract

JOINTS = ("a", "b", "c")


class OwnClock(Clock):
    """Time that only waiting and stalls move."""

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


def make_contract(groups=("proprio",), rate=40.0) -> PolicyContract:
    return PolicyContract(dict.fromkeys(groups, (1,)), rate, "paper", JOINTS, ("a", "c"), ACTIONS, {"b": 0.3})


def make_limits(**changes) -> SafetyLimits:
    return SafetyLimits(np.full(3, -1.0), np.full(3, 1.0), np.full(3, 8.0), **changes)


def run_session(spoil=None, *, policy=None, seconds=2.0, clock=None, **changes):
    """Let a policy control a paper hand; return the report, the hand and the controller."""
    clock = clock or OwnClock()
    hand = PaperHand(clock, spoil)
    controller = Controller(
        policy or (lambda obs, forget: np.array([0.2, 0.1], np.float32)), hand,
        make_contract(changes.pop("groups", ("proprio",))), make_limits(), clock=clock, **changes,
    )  # fmt: skip
    return controller.run(seconds), hand, controller


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
from tests.factories.paper_hands import Clock, Controller, NotingHand, make_contract, make_limits

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
        [sys.executable, "-c", _SESSION], stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2]
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(0.5)
    process.send_signal(signal.SIGSTOP)
    time.sleep(length)
    process.send_signal(signal.SIGCONT)
    ages, *rest = json.loads(process.communicate(timeout=60)[0])
    return Stall(length, 0.1 + SIGNAL_DELAY, tuple(ages), *rest)
