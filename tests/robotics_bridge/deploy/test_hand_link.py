"""Attacks on the link between controller and hand, over real sockets of this computer: none has an effect."""

from __future__ import annotations

import contextlib
import socket
import time

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.deploy import frames
from robotics_bridge.deploy.frames import Frame, new_key
from robotics_bridge.deploy.hand_link import HandLink
from robotics_bridge.deploy.udp import UdpDriver

KEY, J, F = new_key(), 2, 1
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
    forged = frames.encode(Frame(frames.COMMAND, J, 0, 9, time.monotonic(), frames.pack_values([1, 1])), new_key())
    with_master = frames.encode(Frame(frames.COMMAND, J, 0, 9, time.monotonic(), frames.pack_values([1, 1])), KEY)
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
    forged = frames.encode(Frame(frames.STATE, J, F, 99, time.monotonic(), frames.pack_values(_VALUES + 1)), new_key())
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
    body = frames.pack_values(np.array([0.0, np.nan]))
    again._command(frames.COMMAND, body)
    wire.pass_on()
    assert wire.told() is None


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
