"""Hands of paper for the control loop, by clocks of their own."""

from __future__ import annotations

import numpy as np

from robotics_bridge.deploy.controller import Controller
from robotics_bridge.deploy.driver import Clock, HandReading, LinkCounters
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.policies.contract import PolicyContract, TrainedMap

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


def still_map(joints: tuple[str, ...]) -> TrainedMap:
    """Return a map under which actions of zero leave joints at zero."""
    return TrainedMap(joints, *((number,) * len(joints) for number in (0.0, 1.0, -1.0, 1.0)))


def make_contract(groups=("proprio",), rate=40.0) -> PolicyContract:
    actions = TrainedMap(("a", "c"), default=(0.1, 0.2), scale=(0.5, 0.5), low=(-1.0, 0.0), high=(1.0, 0.4))
    return PolicyContract(dict.fromkeys(groups, (1,)), rate, "paper", JOINTS, ("a", "c"), actions, {"b": 0.3})


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
