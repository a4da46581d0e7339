"""The driver and the hand's end over real sockets of this computer: with a simulated hand, and under attack."""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import re
import socket
import threading
import time
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import DataError, UsageError
from robotics_bridge.deploy.controller import Controller
from robotics_bridge.deploy.driver import Clock
from robotics_bridge.deploy.links import udp
from robotics_bridge.deploy.links.simulated_hand import Faults, SimulatedHand, serve, simulated_hand
from robotics_bridge.deploy.links.udp import (
    COMMAND,
    Frame,
    HandLink,
    Receiver,
    SequenceWindow,
    UdpDriver,
    decode,
    encode,
    new_key,
    pack_values,
    read_key,
)
from robotics_bridge.deploy.safety import SafeLink, SafetyLimits
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
    actions: Any = {name: (value,) * len(joints) for name, value in values.items()}
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
        (Faults(silent_after=0.3), "ms old|ms after the report"),
        (Faults(frozen_after=0.3), "ms old|ms after the report"),
        (Faults(delay=0.4, delay_after=0.3), "ms old|ms after the report"),
    ],
)
def test_what_cannot_be_trusted_stops_the_hand_where_it_is(faults, message) -> None:
    with _hand(faults, 1.5) as (hand, driver):
        report = _control(driver, seconds=1.2, timeout=0.2)
        assert report.status == "stopped"
        assert re.search(message, report.reason)
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
    with pytest.raises(UsageError, match=r"'drop' .*received 2"):
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
    """A busy machine may hold the loop up for longer than the link waits; the hand is then connected anew."""
    policy = lambda obs, forget: np.zeros(12)  # noqa: E731
    stops: list[str] = []
    for _ in range(4):
        with simulated_hand(seconds=60) as (*ends, key), UdpDriver(*ends, key) as driver:
            joints = driver.joints
            limits = SafetyLimits(np.full(12, -1.0), np.full(12, 2.2), np.full(12, 8.0), timeout=1.0, rate_share=0.2)
            report = Controller(policy, driver, _contract(joints, 0.3, 0.0), limits).run(1.5)
            stops.append(report.reason)
            if report.status == "finished":
                reading = driver.read()
                assert reading is not None
                assert np.abs(reading.position - 0.3).max() < 0.2
                return
        assert report.reason.startswith("no command came for"), stops
    pytest.fail(str(stops))


J, F = 2, 1
_VALUES = np.arange(2 * J + 3 * F) / 10


def _socket() -> socket.socket:
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.bind(("127.0.0.1", 0))
    return link


class Wire:
    """A hand, a controller, and somebody between them who sees all frames and may send any."""

    def __init__(self, stack: contextlib.ExitStack) -> None:
        enter = stack.enter_context
        hand, self.front, self.back, self.stranger = (enter(_socket()) for _ in range(4))
        for link in (self.front, self.back):
            link.setblocking(False)
        self.hand_address = hand.getsockname()
        self.hand = HandLink(hand, KEY, J, F)
        self.seen: list[bytes] = []
        """Frames to the hand."""
        self.reports: list[bytes] = []
        """Frames to the controller."""
        self._stack = stack
        self.driver = self.connect()

    def connect(self) -> UdpDriver:
        driver = UdpDriver(self.front.getsockname(), ("a", "b"), ("thumb",), KEY)
        self._stack.callback(driver.close)
        self.controller = driver._socket.getsockname()
        for _ in range(2):  # greeting and welcome, start
            self.pass_on()
            self.hand.receive(time.monotonic())
            self.pass_on()
            driver.read()
        self.pass_on()
        self.hand.receive(time.monotonic())
        return driver

    def pass_on(self) -> None:
        for link, kept, target in (
            (self.front, self.seen, self.hand_address),
            (self.back, self.reports, self.controller),
        ):
            # On loopback a datagram is there when it was sent.
            with contextlib.suppress(BlockingIOError):
                while True:
                    kept.append(link.recv(8192))
                    (self.back if link is self.front else self.front).sendto(kept[-1], target)

    def capture(self, target: float) -> bytes:
        """A genuine command that never arrived."""
        self.driver.send(np.full(J, target))
        return self.front.recv(8192)

    def told(self, *data: bytes, source: socket.socket | None = None, later: float = 0.0):
        """What the hand follows after these datagrams came."""
        for each in data:
            (source or self.back).sendto(each, self.hand_address)
        return self.hand.receive(time.monotonic() + later)

    def report(self, values=_VALUES, later: float = 0.0) -> None:
        self.hand.send(self.hand.report(values, time.monotonic() + later))
        self.pass_on()


@pytest.fixture
def wire():
    with contextlib.ExitStack() as stack:
        yield Wire(stack)


def test_genuine_commands_are_followed_and_reports_are_read(wire) -> None:
    np.testing.assert_allclose(wire.told(wire.capture(0.5)), 0.5)
    wire.report()
    np.testing.assert_allclose(wire.driver.read().position, [0.0, 0.1])
    assert wire.driver.counters.received == 1


def test_forged_truncated_and_oversized_commands_move_nothing(wire) -> None:
    genuine = wire.capture(0.5)
    forged = udp.encode(Frame(udp.COMMAND, J, 0, 9, time.monotonic(), udp.pack_command([1, 1])), new_key())
    with_master = udp.encode(Frame(udp.COMMAND, J, 0, 9, time.monotonic(), udp.pack_command([1, 1])), KEY)
    changed = bytearray(genuine)
    changed[-40] ^= 1
    bad = [forged, with_master, bytes(changed), b"", genuine[:-1], genuine[:20], genuine + b"\0", genuine * 40]
    bad += [genuine + bytes(60_000)]
    for data in bad:
        assert wire.told(data) is None
    assert not wire.hand.stopped
    assert wire.told(genuine) is not None  # what was tried did not use its number up


def test_a_command_counts_once_in_order_while_young_and_from_its_own_source(wire) -> None:
    first, second, third, fourth = (wire.capture(target) for target in (0.1, 0.2, 0.3, 0.4))
    np.testing.assert_allclose(wire.told(second), 0.2)
    assert wire.told(second) is None  # replayed
    assert wire.told(first) is None  # reordered
    assert wire.told(third, source=wire.stranger) is None
    assert wire.told(third, later=0.3) is None  # stale
    np.testing.assert_allclose(wire.told(fourth), 0.4)


def test_an_earlier_session_cannot_be_repeated(wire) -> None:
    wire.told(wire.capture(0.5))
    recorded = [*wire.seen, wire.capture(0.6)]
    wire.driver.stop()
    wire.pass_on()
    assert wire.told() is None
    assert wire.hand.stopped
    for _ in range(3):
        for data in recorded:
            assert wire.told(data) is None
            assert wire.told(data, source=wire.stranger) is None
    assert wire.hand.stopped
    wire.pass_on()
    second = wire.connect()
    assert not wire.hand.stopped
    second.send(np.full(J, -0.2))
    wire.pass_on()
    np.testing.assert_allclose(wire.told(), -0.2)
    for data in recorded:
        assert wire.told(data) is None
    assert not wire.hand.stopped  # nor does an old stop end the new session


def test_a_repeated_greeting_leaves_the_session_as_it_is(wire) -> None:
    hello = wire.seen[0]
    for source in (wire.back, wire.stranger):
        assert wire.told(hello, source=source) is None
    np.testing.assert_allclose(wire.told(wire.capture(0.5)), 0.5)
    wire.report()
    assert wire.driver.read().sequence == 1


def test_greetings_that_are_repeated_while_a_session_begins_do_not_prevent_it(wire) -> None:
    recorded = wire.seen[0]
    driver = UdpDriver(wire.front.getsockname(), ("a", "b"), ("thumb",), KEY)
    wire._stack.callback(driver.close)
    wire.controller = driver._socket.getsockname()
    for _ in range(3):  # between greeting, welcome and start
        wire.pass_on()
        for source in (wire.back, wire.stranger):
            wire.told(recorded, source=source)
        wire.pass_on()
        driver.read()
    wire.pass_on()
    wire.hand.receive(time.monotonic())
    driver.send(np.full(J, 0.4))
    np.testing.assert_allclose(wire.told(wire.front.recv(8192)), 0.4)


def test_stop_is_heeded_even_late(wire) -> None:
    command = wire.capture(0.5)
    wire.driver.stop()
    assert wire.told(wire.front.recv(8192), later=10.0) is None
    assert wire.hand.stopped
    assert wire.told(command) is None


def test_only_new_and_young_reports_of_this_hand_are_read(wire) -> None:
    wire.report()
    wire.driver.read()
    genuine = wire.reports[-1]
    forged = udp.encode(Frame(udp.STATE, J, F, 99, time.monotonic(), udp.pack_values(_VALUES + 1)), new_key())
    reflected = wire.capture(0.5)
    for data in (genuine, forged, reflected, genuine[:-1], genuine + b"\0", genuine + bytes(60_000), b""):
        wire.front.sendto(data, wire.controller)
        assert wire.driver.read().sequence == 1
    wire.stranger.sendto(genuine, wire.controller)
    counters = wire.driver.counters
    assert (counters.received, counters.replayed) == (1, 1)
    assert counters.damaged == 6
    wire.report(_VALUES + 1, later=-0.5)  # measured half a second ago
    assert wire.driver.read().sequence == 1
    assert counters.stale == 1
    wire.report(_VALUES + 1)
    assert wire.driver.read().sequence == 3


def test_numbers_begin_anew_without_losing_a_report(wire) -> None:
    wire.hand._sequence = (1 << 32) - 3
    for _ in range(5):
        wire.report()
        wire.driver.read()
    assert wire.driver.read().sequence == 2
    assert wire.driver.counters.received == 5


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e39])
def test_commands_without_finite_targets_stop_the_hand_at_either_end(wire, value) -> None:
    with pytest.raises(UsageError, match="finite"):
        wire.driver.send(np.array([0.0, value]))
    wire.pass_on()
    assert wire.told() is None
    assert wire.hand.stopped
    again = wire.connect()
    body = udp.pack_command(np.array([0.0, np.nan]))
    again._command(udp.COMMAND, body)
    wire.pass_on()
    assert wire.told() is None


def test_a_command_is_followed_until_the_hand_is_too_far_beyond_its_report(wire) -> None:
    wire.report()
    reading = wire.driver.read()
    for allowed, followed in ((0.1, True), (-0.001, False), (np.nan, False)):
        wire.driver.send(np.full(J, 0.3), report=reading, allowed=allowed)
        wire.pass_on()
        assert (wire.told() is not None) == followed
    # The hand's own clock counts, not the way.
    wire.driver.send(np.full(J, 0.3), report=reading, allowed=0.1)
    wire.pass_on()
    assert wire.told(later=0.2) is None


def test_a_safe_link_tells_the_hand_what_a_command_comes_from(wire) -> None:
    wire.report()
    link = SafeLink(wire.driver, SafetyLimits(np.full(J, -1.0), np.full(J, 1.0), np.full(J, 9.0)), Clock(), 0.05)
    reading = link.read()
    assert link.send(reading.position, reading, link.deadline(reading)) is None
    wire.pass_on()
    frame = udp.decode(wire.seen[-1], wire.driver._send_key)
    assert frame.origin == (reading.sequence, reading.time + link._limits.timeout)


@pytest.mark.parametrize("shape", [(0,), (1,), (3,), (2, 2), (100_000,)])
def test_commands_of_another_size_are_refused(wire, shape) -> None:
    with pytest.raises(UsageError, match="2 finite targets"):
        wire.driver.send(np.zeros(shape))


def test_the_controller_listens_on_loopback_alone_and_bad_addresses_are_refused(wire) -> None:
    assert wire.controller[0] == "127.0.0.1"
    for address in (("127.0.0.1", 70_000), ("no such host", 5000), ("x" * 300, 5000)):
        with pytest.raises(UsageError, match=str(address[1])):
            UdpDriver(address, ("a",), (), KEY)


@pytest.mark.parametrize("key", [b"", b"short", "k" * 32, bytes(33)])
def test_a_hand_without_a_whole_key_is_open_to_nobody(key) -> None:
    with pytest.raises(UsageError, match="key of a hand is 32 bytes"):
        UdpDriver(("", 9), ("a",), (), key)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link, pytest.raises(UsageError, match="32 bytes"):
        HandLink(link, key, 1, 0)


@pytest.mark.parametrize(
    ("address", "joints", "fingers", "told"),
    [
        (("", 0), ("a",), (), "port of a hand .*received 0"), (("", "9"), ("a",), (), "port of a hand .*'9'"),
        (("", 9), ("a", "a"), (), "joints of a hand names 'a'"), (("", 9), ("a",), ("f", "f"), "fingers .*'f'"),
    ],
)  # fmt: skip
def test_a_hand_that_cannot_be_told_apart_is_not_called(address, joints, fingers, told) -> None:
    with pytest.raises(UsageError, match=told):
        UdpDriver(address, joints, fingers, KEY)


SHARED = bytes(range(32))


@given(st.binary(max_size=200))
def test_no_datagram_breaks_the_reader(data) -> None:
    assert decode(data, SHARED) is None


@given(st.integers(0, 12), st.integers(0, 5), st.data())
def test_frames_survive_the_way_and_every_change_is_noticed(joints, fingers, data) -> None:
    values = np.arange(2 * joints + 3 * fingers, dtype=np.float32)
    sent = encode(Frame(udp.STATE, joints, fingers, 7, 1.5, pack_values(values)), SHARED)
    frame = decode(sent, SHARED)
    assert frame is not None
    assert (frame.sequence, frame.time) == (7, 1.5)
    np.testing.assert_array_equal(frame.values, values)
    place = data.draw(st.integers(0, len(sent) - 1))
    damaged = bytearray(sent)
    damaged[place] ^= data.draw(st.integers(1, 255))
    for changed in (bytes(damaged), sent[:place], sent + sent[: place + 1], sent[place:] + sent[:place][1:]):
        assert changed == sent or decode(changed, SHARED) is None
    assert decode(sent, new_key()) is None


def test_a_frame_ends_with_the_standard_hmac_of_the_rest() -> None:
    sent = encode(Frame(udp.COMMAND, 1, 0, 1 << 32, 2.0, udp.pack_command([0.5], 7, 2.25)), SHARED)
    # RFC 2104 by its definition: H(key ⊕ opad ‖ H(key ⊕ ipad ‖ text)).
    padded = SHARED.ljust(64, b"\0")
    inner = hashlib.sha256(bytes(byte ^ 0x36 for byte in padded) + sent[:-32]).digest()
    assert sent[-32:] == hashlib.sha256(bytes(byte ^ 0x5C for byte in padded) + inner).digest()
    assert sent[8:12] == bytes(4)  # the number goes on from 0
    frame = decode(sent, SHARED)
    assert (frame.origin, frame.values.tolist()) == ((7, 2.25), [0.5])
    # Ends of an earlier version get no answer.
    assert decode(sent.replace(b"BBH3", b"BBH2")[:-32], SHARED) is None


@pytest.mark.parametrize("time", [np.nan, np.inf])
@pytest.mark.parametrize("kind", [0, udp.STATE, 77, 255])
def test_authentic_frames_of_no_known_form_are_not_read(kind, time) -> None:
    for body in (b"", bytes(4), bytes(5000)):
        assert decode(encode(Frame(kind, 1, 1, 0, time, body), SHARED), SHARED) is None


def test_sessions_and_directions_have_keys_of_their_own() -> None:
    nonces = [bytes([number]) * udp.NONCE for number in range(3)]
    found = {key for a in nonces for b in nonces for key in udp.session_keys(SHARED, a, b)}
    assert len(found) == 18
    assert hmac.compare_digest(udp.session_keys(SHARED, *nonces[:2])[0], udp.session_keys(SHARED, *nonces[:2])[0])


def test_a_key_is_read_from_a_private_file(tmp_path) -> None:
    path = tmp_path / "hand.key"
    with pytest.raises(FileNotFoundError, match=r"hand\.key"):
        read_key(path)
    for text in ("", "12", "zz" * 32, "00" * 33, "é" * 64):
        path.write_text(text, encoding="utf-8")
        path.chmod(0o600)
        with pytest.raises(DataError, match=r"hand\.key"):
            read_key(path)
    path.write_text(f"{SHARED.hex()}\n")
    assert read_key(path) == SHARED
    path.chmod(0o644)
    if os.name == "posix":
        with pytest.raises(DataError, match="chmod 600"):
            read_key(path)


@pytest.mark.parametrize("first", [0, 1, 5000, (1 << 32) - 300, (1 << 32) - 1])
def test_numbers_are_judged_as_a_list_of_all_of_them_would(first) -> None:
    random = np.random.default_rng(first % 97)
    window, seen, came, newest, lost, begin = SequenceWindow(), set(), set(), None, 0, 0
    for _ in range(3000):
        # Without wrap-around, and with a memory of everything: what the window must agree with.
        number = (newest if newest is not None else first) + int(random.integers(-1200, 30))
        number = max(number, first)
        if newest is None or number > newest:
            expected, begin = "new", number if newest is None else begin
        elif newest - number >= SequenceWindow.SIZE:
            expected = "stale"
        else:
            expected = "replayed" if number in seen else "late"
        verdict, skipped = window.judge(number % (1 << 32))
        assert verdict == expected
        lost += skipped
        seen.add(number)
        came |= {number} if verdict in ("new", "late") and number >= begin else set()
        newest = number if newest is None else max(newest, number)
        # Lost is what has not come of all from the first on; what is older than it was never counted.
        assert lost == newest - begin + 1 - len(came)


def test_a_jump_by_half_of_all_numbers_takes_no_memory_and_no_number_from_behind() -> None:
    window = SequenceWindow()
    window.judge(0)
    assert window.judge((1 << 31) - 1) == ("new", (1 << 31) - 2)
    assert window.judge(0)[0] == "stale"
    assert window.judge((1 << 31) - 1)[0] == "replayed"
    assert window.judge((1 << 31) - 2)[0] == "late"


def test_old_frames_are_stale_although_their_number_is_new() -> None:
    receiver = Receiver(b"")

    def judge(number, sent, arrived):
        return receiver.judge(Frame(COMMAND, 1, 0, number, sent), arrived)[0]

    assert judge(1, 10.0, 500.0) == "new"
    assert judge(2, 10.1, 500.2) == "new"
    assert judge(3, 10.2, 500.5) == "stale"
    assert judge(4, 10.6, 500.6) == "new"
    # All numbers were used once: one that comes back is new again by number, and old by time.
    for number in (0x5000_0000, 0xA000_0000, 0xF000_0000, 1):
        verdict = judge(number, 10.61 if number == 1 else 10.6, 500.6 if number != 1 else 900.0)
    assert verdict == "stale"
