"""The driver and the simulated hand, over a real local socket."""

from __future__ import annotations

import contextlib
import socket
import threading
import time

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.deploy.controller import Controller
from robotics_bridge.deploy.frames import new_key
from robotics_bridge.deploy.hand_link import HandLink
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.deploy.simulated_hand import Faults, SimulatedHand, serve, simulated_hand
from robotics_bridge.deploy.udp import UdpDriver
from robotics_bridge.policies.contract import PolicyContract

JOINTS, FINGERS, KEY = ("a", "b"), ("thumb",), new_key()


class QuickHand:
    """Stands for the physics: joints come half way to their target in every report."""

    joints, fingers, rate = JOINTS, FINGERS, 200.0

    def __init__(self) -> None:
        self.position, self.target = np.zeros(2), np.zeros(2)
        self.held = 0

    def hold(self) -> None:
        self.held += 1
        self.target = self.position.copy()

    def drive(self, targets) -> None:
        self.target = np.array(targets)

    def step(self) -> None:
        self.position = (self.position + self.target) / 2

    def report(self):
        return np.concatenate([self.position, np.zeros(2), np.zeros(3)])


@contextlib.contextmanager
def _hand(faults: Faults | None = None, seconds: float = 3.0):
    hand = QuickHand()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        thread = threading.Thread(target=serve, args=(hand, HandLink(link, KEY, 2, 1), faults or Faults(), seconds))
        thread.start()
        try:
            with UdpDriver(link.getsockname(), JOINTS, FINGERS, KEY) as driver:
                yield hand, driver
        finally:
            thread.join()


def _until(condition, seconds: float = 1.2) -> None:
    """Wait for what a busy machine may take its time for."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "did not happen in time"
        time.sleep(0.01)


def _contract(joints, default, low) -> PolicyContract:
    values = {"default": default, "scale": 1.0, "low": low, "high": 1.0}
    actions = {name: (value,) * len(joints) for name, value in values.items()}
    return PolicyContract({"proprio": (3 * len(joints),)}, 40.0, "hand", joints, joints, actions, {})


def _control(driver, seconds=0.6, **limits):
    safe = SafetyLimits(-np.ones(2), np.ones(2), np.full(2, 8.0), rate_share=0.2, **limits)
    policy = lambda obs, forget: np.full(2, 0.4)  # noqa: E731
    return Controller(policy, driver, _contract(JOINTS, 0.0, -1.0), safe).run(seconds)


@pytest.mark.parametrize(
    "faults",
    [
        Faults(),
        Faults(drop=0.4),
        Faults(jitter=0.03),
        Faults(damage=0.3),
        Faults(delay=0.03),
        Faults(drop=0.2, jitter=0.02, damage=0.1, seed=3),
    ],
)
def test_losses_delays_and_overtaking_are_survived(faults) -> None:
    with _hand(faults, 1.2) as (hand, driver):
        # A busy machine may lose time; what is tested is that no fault is believed.
        report = _control(driver, timeout=0.5)
        assert report.status == "finished", report.reason
        np.testing.assert_allclose(hand.position, 0.4, atol=1e-3)
        counters = driver.counters
        assert counters.received > 20
        if faults.drop or faults.damage:
            assert counters.lost > 5
        elif not faults.jitter:  # with it, some are still under way
            assert counters.lost == 0
        assert (counters.damaged > 2) is (faults.damage > 0)
        if faults.jitter:
            assert counters.late > 3
    assert hand.held >= 2  # at the start and at the stop


@pytest.mark.parametrize(
    ("faults", "message"),
    [
        (Faults(absurd=0.5), "beyond its limits"),
        (Faults(nan=0.5), "no numbers"),
        (Faults(silent_after=0.3), "ms old"),
        (Faults(frozen_after=0.3), "ms old"),
        (Faults(delay=0.4, delay_after=0.3), "ms old"),
    ],
)
def test_what_cannot_be_trusted_stops_the_hand_where_it_is(faults, message) -> None:
    with _hand(faults, 1.5) as (hand, driver):
        report = _control(driver, seconds=1.2, timeout=0.2)
        assert report.status == "stopped"
        assert message in report.reason
        time.sleep(0.05)
        place = hand.position.copy()
        driver.send(np.full(2, -1.0))  # refused after a stop
        time.sleep(0.1)
        np.testing.assert_allclose(hand.position, place, atol=1e-3)


def test_the_hand_holds_by_itself_when_the_controller_dies() -> None:
    with _hand(seconds=1.5) as (hand, driver):
        while driver.read() is None:
            time.sleep(0.005)
        before = hand.held
        driver.send(np.full(2, 0.9))
        _until(lambda: hand.held > before)
        assert hand.held == before + 1


def test_a_new_session_moves_a_hand_that_was_stopped() -> None:
    with _hand(seconds=2.0) as (hand, driver):
        driver.stop()
        time.sleep(0.05)
        with UdpDriver(driver.address, JOINTS, FINGERS, KEY) as second:
            while second.read() is None:
                time.sleep(0.005)
            second.send(np.full(2, 0.5))
            _until(lambda: bool(np.abs(hand.position - 0.5).max() < 1e-2))


def test_faults_are_read_from_words() -> None:
    assert Faults.parse(["drop=0.2", "silent-after=1"]) == Faults(drop=0.2, silent_after=1.0)
    with pytest.raises(UsageError, match="did you mean 'drop'"):
        Faults.parse(["drp=0.2"])
    with pytest.raises(UsageError, match="'silent_after' more than once"):
        Faults.parse(["silent-after=1", "silent_after=2"])
    with pytest.raises(UsageError, match="received 'often'"):
        Faults.parse(["drop=often"])
    with pytest.raises(UsageError, match=r"^drop .*received 2"):
        Faults(drop=2)


@pytest.mark.slow
def test_the_simulated_xhand1_follows_and_feels_the_ball_it_holds() -> None:
    from robotics_bridge.hands.scenes import closing

    hand = SimulatedHand()
    hand.drive(closing(hand.hand, 0.6))
    for _ in range(400):
        hand.step()
    values = hand.report()
    pressure = values[24:].reshape(5, 3)
    assert np.linalg.norm(pressure, axis=1).max() > 0.05
    assert np.isfinite(values).all()


@pytest.mark.slow
def test_a_process_of_its_own_serves_the_simulated_xhand1() -> None:
    with simulated_hand(seconds=60) as (*ends, key), UdpDriver(*ends, key) as driver:
        joints = driver.joints
        limits = SafetyLimits(np.full(12, -1.0), np.full(12, 2.2), np.full(12, 8.0), timeout=1.0, rate_share=0.2)
        policy = lambda obs, forget: np.zeros(12)  # noqa: E731
        report = Controller(policy, driver, _contract(joints, 0.3, 0.0), limits).run(1.5)
        assert report.status == "finished", report.reason
        reading = driver.read()
        assert reading is not None
        assert np.abs(reading.position - 0.3).max() < 0.2
