"""The driver of a hand behind a UDP socket, local or remote; frames are authenticated with a key that both sides hold.

A session begins with three frames: greeting, welcome, start. Its keys come from the shared key and a fresh nonce of
either side (:mod:`~robotics_bridge.deploy.links.frames`).
"""

from __future__ import annotations

import contextlib
import math
import secrets
import socket
import time
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, check_once
from brainbench.core.reading.ranges import check_number
from robotics_bridge import hands
from robotics_bridge.deploy.driver import DriverRequest, HandReading, LinkCounters
from robotics_bridge.deploy.links import frames
from robotics_bridge.deploy.links.frames import Frame, Receiver
from robotics_bridge.deploy.safety import ClockOffset

LOOPBACK = "127.0.0.1"
GREET_EVERY = 0.2
"""Seconds from one greeting to the next, until the hand reports. An answer that takes longer is not accepted."""
MOST_AT_ONCE = 256  # datagrams read at once; a flood must not hold the control loop up
FARTHEST = 4 * math.pi  # targets further from zero have no effect (rad or m): no joint of a hand has such a range
MOST_OFFERS = 64  # greetings that a hand remembers until a session starts; the oldest goes first
_ERRORS = 8  # errors of the connection that are kept


class HandEnd(NamedTuple):
    """A hand's end of a link."""

    address: tuple[str, int]
    """Host and port; without a host, this computer."""
    joints: tuple[str, ...]
    """Names of its joints, in its order."""
    fingers: tuple[str, ...]
    """Names of its sensing fingers, in its order."""
    key: bytes
    """Shared key (:func:`~robotics_bridge.deploy.links.frames.read_key`)."""


def open_remote(request: DriverRequest) -> UdpDriver:
    """Return the driver of a hand behind a socket; its joints and fingers are those of the contract's hand."""
    host, _, port = request.address.rpartition(":")
    if not (port.isascii() and port.isdigit() and 0 < int(port[:6]) < 65536):
        raise UsageError(f"A driver is 'sim', HOST:PORT, or :PORT on this computer; received {request.address[:80]!r}.")
    if request.key is None:
        raise UsageError("A hand behind a socket needs --key FILE: the key that its computer holds too.")
    if request.faults:
        raise UsageError("--fault is of the simulated hand; a hand behind a socket has faults of its own.")
    hand = hands.load(request.contract.hand)
    return UdpDriver((host, int(port)), hand.joints, tuple(hand.fingers), frames.read_key(request.key))


class UdpDriver:
    """Speaks to a hand that holds the same key; arguments as of :class:`HandEnd`."""

    def __init__(self, address: tuple[str, int], joints: tuple[str, ...], fingers: tuple[str, ...], key: bytes) -> None:
        check_number("joints of a hand", len(joints), least=1, most=frames.MOST)
        check_number("fingers of a hand", len(fingers), most=frames.MOST)
        check_once("joints of a hand", joints)
        check_once("fingers of a hand", fingers)
        check_number("port of a hand", address[1], least=1, most=65535, whole=True)
        frames.check_key(key)
        self.address, self.joints, self.fingers = (address[0] or LOOPBACK, address[1]), joints, fingers
        self.counters = LinkCounters()
        self._key = key
        self._nonce, self._greeted = b"", -np.inf
        self._send_key = b""
        self._receiver: Receiver | None = None
        self._newest: HandReading | None = None
        self._sequence = 0
        self._stopped = False
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            # Connected: the system binds it to the one interface on the way and drops what other sources send.
            self._socket.connect(self.address)
        except (OSError, UnicodeError) as error:
            self._socket.close()
            raise UsageError(f"There is no way to a hand at {self.address[0]}:{self.address[1]} ({error}).") from error
        self._greet(time.monotonic())

    def read(self) -> HandReading | None:
        """Return the newest report, the same one again if nothing came, or None before the first."""
        for _ in range(MOST_AT_ONCE):
            try:
                data = self._socket.recv(frames.LARGEST + 1)
            except BlockingIOError:
                break
            except OSError as error:  # nobody listens there (any more): silence, which the watchdog hears
                self._note(error)
                break
            now = time.monotonic()
            if not (self._take(data, now) or self._welcomed(data, now)):
                self.counters.damaged += 1
        if self._newest is None and not self._stopped and time.monotonic() - self._greeted > GREET_EVERY:
            self._greet(time.monotonic())
        return self._newest

    def _greet(self, now: float) -> None:
        # A new nonce each time, so that the answer is as young as its greeting.
        self._nonce, self._greeted = secrets.token_bytes(frames.NONCE), now
        hello = Frame(frames.HELLO, len(self.joints), len(self.fingers), 0, now, self._nonce)
        self._send(frames.encode(hello, self._key))

    def _welcomed(self, data: bytes, now: float) -> bool:
        """Begin the session that the hand offers; return False where the datagram offers none."""
        welcome = frames.decode(data, self._key)
        if welcome is None or welcome.kind != frames.WELCOME:
            return False
        ours, theirs = welcome.body[: frames.NONCE], welcome.body[frames.NONCE :]
        if ours != self._nonce or now - self._greeted > GREET_EVERY:
            self.counters.stale += 1
            return True
        self._send_key, key = frames.session_keys(self._key, ours, theirs)
        self._nonce = b""  # a greeting begins one session
        # The welcome was under way for at most GREET_EVERY: later reports cannot all be much older unnoticed.
        offset = ClockOffset()
        offset.age(welcome.time, now, now)
        self._receiver, self._sequence = Receiver(key, offset), 0
        self._command(frames.START)
        return True

    def _take(self, data: bytes, now: float) -> bool:
        """Take a report; return False where the datagram is none of this session and hand."""
        frame = frames.decode(data, self._receiver.key) if self._receiver is not None else None
        joints, fingers = len(self.joints), len(self.fingers)
        if frame is None or self._receiver is None or frame.kind != frames.STATE:
            return False
        if (frame.joints, frame.fingers) != (joints, fingers):
            return False
        counters = self.counters
        verdict, skipped = self._receiver.judge(frame, now)
        counters.lost += skipped
        if verdict != "new":
            setattr(counters, verdict, getattr(counters, verdict) + 1)
            # UDP may change the order: an older report that comes late was counted as lost before.
            counters.lost = max(0, counters.lost - (verdict == "late"))
            return True
        counters.received += 1
        position, velocity, pressure = np.split(frame.values, [joints, 2 * joints])
        self._newest = HandReading(frame.sequence, frame.time, now, position, velocity, pressure.reshape(fingers, 3))
        return True

    def send(self, targets: NDArray[np.float64], report: HandReading | None = None, allowed: float = math.inf) -> None:
        """Ask the position drives for targets [J] (rad).

        The hand follows them until its own clock is ``allowed`` seconds beyond the report that they were decided from.
        """
        fits = np.shape(targets) == (len(self.joints),)
        # As they would be sent: a large double is infinite as a float.
        if not (fits and np.isfinite(np.frombuffer(frames.pack_values(targets), "<f4")).all()):
            self.stop()
            raise UsageError(f"A command is {len(self.joints)} finite targets (rad); received {str(targets)[:80]}.")
        if not self._stopped:
            number, until = (0, math.inf) if report is None else (report.sequence, report.time + allowed)
            self._command(frames.COMMAND, frames.pack_command(targets, number, until))

    def stop(self) -> None:
        """Hold where the hand is, and refuse targets until it is connected anew."""
        self._stopped = True
        # The one frame that must not be lost; the hand's own watchdog is behind it.
        for _ in range(5):
            self._command(frames.STOP)

    def _command(self, kind: int, body: bytes = b"") -> None:
        if not self._send_key:
            return  # no session yet: nothing can move
        self._sequence += 1
        frame = Frame(kind, len(self.joints), len(self.fingers), self._sequence, time.monotonic(), body)
        self._send(frames.encode(frame, self._send_key))

    def close(self) -> None:
        """End the connection."""
        self._socket.close()

    def __enter__(self) -> UdpDriver:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self.stop()
        self.close()

    def _send(self, data: bytes) -> None:
        try:
            self._socket.send(data)
        except OSError as error:
            self._note(error)

    def _note(self, error: OSError) -> None:
        if len(self.counters.errors) < _ERRORS:
            self.counters.errors.append(str(error))


class HandLink:
    """Serves one controller at a time that holds the same key; the newest session counts.

    Args:
        link: A bound UDP socket.
        key: Shared key (:func:`~robotics_bridge.deploy.links.frames.read_key`).
        joints: J.
        fingers: F.
    """

    def __init__(self, link: socket.socket, key: bytes, joints: int, fingers: int) -> None:
        frames.check_key(key)
        link.setblocking(False)
        self.link, self.joints, self.fingers = link, joints, fingers
        self.peer: Any = ()
        """Address of the controller; empty without a session."""
        self.stopped = True
        """True until a session begins, and after its stop: the hand holds where it is."""
        self._key, self._challenge = key, secrets.token_bytes(frames.NONCE)
        self._offered: dict[tuple[Any, bytes], tuple[bytes, bytes]] = {}  # who may start a session → its two keys
        self._receiver: Receiver | None = None
        self._send_key = b""
        self._sequence = 0

    def receive(self, now: float) -> NDArray[np.float64] | None:
        """Return the newest targets [J] (rad) to follow, or None without any; ``now`` is of the reports' clock (s)."""
        targets = None
        for _ in range(MOST_AT_ONCE):
            try:
                data, sender = self.link.recvfrom(frames.LARGEST + 1)
            except ConnectionError:
                continue
            except OSError:  # nothing more
                break
            if self._start(data, sender, now):
                targets = None
            elif (command := self._command(data, sender, now)) is not None:
                targets = command
            else:
                self._offer(data, sender, now)
        return None if self.stopped else targets

    def report(self, values: ArrayLike, time: float) -> bytes:
        """Return the frame of a report: positions, velocities and pressures [2J + 3F], measured at a time (s)."""
        self._sequence += 1
        state = Frame(frames.STATE, self.joints, self.fingers, self._sequence, time, frames.pack_values(values))
        return frames.encode(state, self._send_key)

    def send(self, data: bytes) -> None:
        """Send a frame to the controller, if there is one."""
        if self.peer:
            with contextlib.suppress(OSError):
                self.link.sendto(data, self.peer)

    def _offer(self, data: bytes, sender: Any, now: float) -> None:
        """Answer a greeting. A greeting that is repeated by a stranger ends no session and begins none."""
        hello = frames.decode(data, self._key)
        if hello is None or (hello.kind, hello.joints, hello.fingers) != (frames.HELLO, self.joints, self.fingers):
            return
        # Each greeting has an offer of its own: one that a stranger repeats takes no place of another.
        self._offered.pop((sender, hello.body), None)
        self._offered[sender, hello.body] = frames.session_keys(self._key, hello.body, self._challenge)
        if len(self._offered) > MOST_OFFERS:
            del self._offered[next(iter(self._offered))]
        body = hello.body + self._challenge
        welcome = frames.encode(Frame(frames.WELCOME, self.joints, self.fingers, 0, now, body), self._key)
        with contextlib.suppress(OSError):
            self.link.sendto(welcome, sender)

    def _start(self, data: bytes, sender: Any, now: float) -> bool:
        """Begin the session that was offered to this sender; return False where the datagram starts none."""
        for (offered, _), keys in self._offered.items():
            frame = frames.decode(data, keys[0]) if sender == offered else None
            if frame is not None and frame.kind == frames.START:
                break
        else:
            return False
        ours, theirs = keys
        self._receiver, self._send_key, self._sequence = Receiver(ours), theirs, 0
        self._receiver.judge(frame, now)
        self.peer, self.stopped = sender, False
        # Used once: what was recorded of this session starts no other.
        self._offered, self._challenge = {}, secrets.token_bytes(frames.NONCE)
        return True

    def _command(self, data: bytes, sender: Any, now: float) -> NDArray[np.float64] | None:
        """Return the targets of a command of this session that is new, young and possible; heed its stop."""
        if self._receiver is None or sender != self.peer:
            return None
        frame = frames.decode(data, self._receiver.key)
        if frame is None or frame.joints != self.joints:
            return None
        verdict, _ = self._receiver.judge(frame, now)
        if frame.kind == frames.STOP:
            # However late it comes: to hold is safe.
            self.stopped = True
        # A comparison with NaN is false.
        if frame.kind != frames.COMMAND or verdict != "new" or not (np.abs(frame.values) <= FARTHEST).all():
            return None
        return frame.values if now <= frame.origin[1] else None
