"""The driver of a hand behind a UDP socket, local or remote; frames are authenticated with a key that both sides hold.

A session begins with three frames: greeting, welcome, start. Its keys come from the shared key and a fresh nonce of
either side.

A frame is one datagram, little-endian. Header: 4 bytes ``BBH3``, kind, joints J, fingers F, 0 (u8 each), sequence
(u32), time of the sender's clock (f64, s). A state carries positions f32[J], velocities f32[J] and pressures f32[F·3];
a command the number of the report that it was decided from (u32), the time of the hand's clock until which it holds
(f64, s; infinite for none) and f32[J] targets; a greeting the controller's nonce (16 bytes), a welcome the controller's
and the hand's. HMAC-SHA256 (RFC 2104) of all of it ends the frame, 32 bytes.
"""

from __future__ import annotations

import contextlib
import hmac
import math
import os
import secrets
import socket
import struct
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, check_number, check_once
from robotics_bridge import hands
from robotics_bridge.deploy.driver import DriverRequest, HandReading, LinkCounters
from robotics_bridge.deploy.safety import ClockOffset

MAGIC = b"BBH3"
"""Version of the frames; either end drops those of another one. In ``BBH2`` commands were targets alone."""
HELLO, WELCOME, START, STATE, COMMAND, STOP = range(1, 7)
"""Kinds: the controller asks for a session, the hand offers one, the controller takes it; then states and commands."""
LARGEST = 8192  # bytes of the largest datagram that is read: more than a state of MOST joints and fingers
MOST = 255  # most joints and fingers of a hand
NONCE, KEY = 16, 32  # bytes of a nonce and of a key
_HEADER = struct.Struct("<4sBBBxId")
_TAG = 32
_ORIGIN = struct.Struct("<Id")  # what a command comes from: number of its report, time until which it holds


@dataclass(frozen=True, eq=False)
class Frame:
    """An authentic datagram."""

    kind: int
    """:data:`HELLO` to :data:`STOP`."""
    joints: int
    """J."""
    fingers: int
    """F."""
    sequence: int
    """Number of the frame in its session and direction; goes on from 0 after 2³² − 1."""
    time: float
    """Time of the sender's clock (s)."""
    body: bytes = b""
    """Nonces, or values as f32."""

    @property
    def values(self) -> NDArray[np.float64]:
        """Positions (rad), velocities (rad/s) and pressures of a state, targets (rad) of a command, in this order."""
        return np.frombuffer(self.body, "<f4", offset=_ORIGIN.size * (self.kind == COMMAND)).astype(np.float64)

    @property
    def origin(self) -> tuple[int, float]:
        """Number of the report that a command was decided from, and the time (s, of the hand) until which it holds."""
        return _ORIGIN.unpack_from(self.body)


def pack_command(targets: ArrayLike, report: int = 0, until: float = math.inf) -> bytes:
    """Return targets (rad) as the body of a command."""
    return _ORIGIN.pack(report & 0xFFFFFFFF, until) + pack_values(targets)


def pack_values(values: ArrayLike) -> bytes:
    """Return values as the body of a frame; what is too large for it becomes infinite."""
    with np.errstate(over="ignore"):
        return np.asarray(values, dtype="<f4").tobytes()


def encode(frame: Frame, key: bytes) -> bytes:
    """Return the bytes of a frame, authenticated by a key."""
    head = _HEADER.pack(MAGIC, frame.kind, frame.joints, frame.fingers, frame.sequence & 0xFFFFFFFF, frame.time)
    return head + frame.body + hmac.digest(key, head + frame.body, "sha256")


def decode(data: bytes, key: bytes) -> Frame | None:
    """Return what a datagram says; None if it has another size or form, or was not made with this key."""
    if not _HEADER.size + _TAG <= len(data) <= LARGEST:
        return None
    signed, tag = data[:-_TAG], data[-_TAG:]
    if not hmac.compare_digest(hmac.digest(key, signed, "sha256"), tag):
        return None
    magic, kind, joints, fingers, sequence, time = _HEADER.unpack_from(signed)
    sizes = {
        HELLO: NONCE,
        WELCOME: 2 * NONCE,
        START: 0,
        STATE: 4 * (2 * joints + 3 * fingers),
        COMMAND: _ORIGIN.size + 4 * joints,
    }
    size = {**sizes, STOP: 0}.get(kind)
    if magic != MAGIC or len(signed) - _HEADER.size != size or not np.isfinite(time):
        return None
    return Frame(kind, joints, fingers, sequence, time, signed[_HEADER.size :])


def session_keys(key: bytes, controller: bytes, hand: bytes) -> tuple[bytes, bytes]:
    """Return the keys (to the hand, to the controller) of a session from the shared key and both nonces."""
    # Both sides add a fresh nonce, so frames of an earlier session fit no later one; one key per direction, so that no
    # frame can be sent back to its sender.
    first, second = (hmac.digest(key, label + controller + hand, "sha256") for label in (b"to hand", b"to controller"))
    return first, second


def new_key() -> bytes:
    """Return a new random key."""
    return secrets.token_bytes(KEY)


def check_key(key: bytes) -> None:
    """Raise UsageError unless a key has :data:`KEY` bytes: a short one, or none, would let strangers move the hand."""
    if not isinstance(key, bytes) or len(key) != KEY:
        raise UsageError(f"The key of a hand is {KEY} bytes, as new_key and read_key give it; another came.")


def read_key(path: str | os.PathLike[str]) -> bytes:
    """Read a key from a file of 64 hexadecimal digits that nobody but its owner can read."""
    path = Path(path)
    hint = f"Make one with: (umask 077; openssl rand -hex {KEY} > hand.key), and copy it to the hand's computer."
    if not path.is_file():
        raise DataFileNotFoundError(f"There is no key file {str(path)!r}. {hint}")
    if os.name == "posix" and path.stat().st_mode & 0o077:
        raise DataError(f"Other users of this computer can read the key {str(path)!r}; run: chmod 600 {path.name}")
    try:
        with path.open("rb") as stream:
            key = bytes.fromhex(stream.read(LARGEST).decode("ascii"))
    except (OSError, ValueError):
        key = b""
    if len(key) != KEY:
        raise DataError(f"{str(path)!r} holds no key of {2 * KEY} hexadecimal digits. {hint}")
    return key


Verdict = Literal["new", "late", "replayed", "stale"]
"""``late``: came after a newer one for the first time; ``replayed``: again; ``stale``: too old, by number or time."""
MAX_AGE = 0.25  # oldest frame that has an effect (s); as long as a hand without commands moves on


class SequenceWindow:
    """Numbers of 32 bits that were seen, with wrap-around (RFC 1982) and a window as in RFC 4303, section 3.4.3."""

    SIZE = 1024
    """Numbers behind the newest that are told apart."""
    _NUMBERS = 1 << 32

    def __init__(self) -> None:
        self.newest: int | None = None
        self._seen = 0  # bit i: newest - i was seen
        self._span = 0  # numbers from the first that was seen to the newest

    def judge(self, number: int) -> tuple[Verdict, int]:
        """Count a number; return what it is, and how many were skipped: if it is new, or −1 if it was one of them."""
        if self.newest is None:
            self.newest, self._seen = number, 1
            return "new", 0
        ahead = (number - self.newest) % self._NUMBERS
        if 0 < ahead < self._NUMBERS // 2:
            # Shifted by the whole window at most: a jump must not build a number of 2³¹ bits.
            self._seen = (self._seen << min(ahead, self.SIZE)) & ((1 << self.SIZE) - 1) | 1
            self.newest, self._span = number, self._span + ahead
            return "new", ahead - 1
        behind = (self.newest - number) % self._NUMBERS
        if behind >= self.SIZE:
            return "stale", 0
        if self._seen >> behind & 1:
            return "replayed", 0
        self._seen |= 1 << behind
        return "late", -(behind < self._span)


class Receiver:
    """One direction of one session; ``offset`` is what is known already of the sender's clock."""

    def __init__(self, key: bytes, offset: ClockOffset | None = None) -> None:
        self.key = key
        self._window, self._offset = SequenceWindow(), offset or ClockOffset()

    def judge(self, frame: Frame, now: float) -> tuple[Verdict, int]:
        """Return what an authentic frame that arrives now is, and how many more it says were skipped."""
        verdict, skipped = self._window.judge(frame.sequence)
        # A number comes back after 2³² frames, a time never does.
        age = self._offset.age(frame.time, now, now) if verdict in ("new", "late") else 0.0
        return ("stale", skipped) if age > MAX_AGE else (verdict, skipped)


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
    """Shared key (:func:`~robotics_bridge.deploy.links.udp.read_key`)."""


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
    return UdpDriver((host, int(port)), hand.joints, tuple(hand.fingers), read_key(request.key))


class UdpDriver:
    """Speaks to a hand that holds the same key; arguments as of :class:`HandEnd`."""

    def __init__(self, address: tuple[str, int], joints: tuple[str, ...], fingers: tuple[str, ...], key: bytes) -> None:
        check_number("joints of a hand", len(joints), least=1, most=MOST)
        check_number("fingers of a hand", len(fingers), most=MOST)
        check_once("joints of a hand", joints)
        check_once("fingers of a hand", fingers)
        check_number("port of a hand", address[1], least=1, most=65535, whole=True)
        check_key(key)
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
                data = self._socket.recv(LARGEST + 1)
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
        self._nonce, self._greeted = secrets.token_bytes(NONCE), now
        hello = Frame(HELLO, len(self.joints), len(self.fingers), 0, now, self._nonce)
        self._send(encode(hello, self._key))

    def _welcomed(self, data: bytes, now: float) -> bool:
        """Begin the session that the hand offers; return False where the datagram offers none."""
        welcome = decode(data, self._key)
        if welcome is None or welcome.kind != WELCOME:
            return False
        ours, theirs = welcome.body[:NONCE], welcome.body[NONCE:]
        if ours != self._nonce or now - self._greeted > GREET_EVERY:
            self.counters.stale += 1
            return True
        self._send_key, key = session_keys(self._key, ours, theirs)
        self._nonce = b""  # a greeting begins one session
        # The welcome was under way for at most GREET_EVERY: later reports cannot all be much older unnoticed.
        offset = ClockOffset()
        offset.age(welcome.time, now, now)
        self._receiver, self._sequence = Receiver(key, offset), 0
        self._command(START)
        return True

    def _take(self, data: bytes, now: float) -> bool:
        """Take a report; return False where the datagram is none of this session and hand."""
        frame = decode(data, self._receiver.key) if self._receiver is not None else None
        joints, fingers = len(self.joints), len(self.fingers)
        if frame is None or self._receiver is None or frame.kind != STATE:
            return False
        if (frame.joints, frame.fingers) != (joints, fingers):
            return False
        counters = self.counters
        verdict, skipped = self._receiver.judge(frame, now)
        counters.lost += skipped
        if verdict != "new":
            setattr(counters, verdict, getattr(counters, verdict) + 1)
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
        if not (fits and np.isfinite(np.frombuffer(pack_values(targets), "<f4")).all()):
            self.stop()
            raise UsageError(f"A command is {len(self.joints)} finite targets (rad); received {str(targets)[:80]}.")
        if not self._stopped:
            number, until = (0, math.inf) if report is None else (report.sequence, report.time + allowed)
            self._command(COMMAND, pack_command(targets, number, until))

    def stop(self) -> None:
        """Hold where the hand is, and refuse targets until it is connected anew."""
        self._stopped = True
        # The one frame that must not be lost; the hand's own watchdog is behind it.
        for _ in range(5):
            self._command(STOP)

    def _command(self, kind: int, body: bytes = b"") -> None:
        if not self._send_key:
            return  # no session yet: nothing can move
        self._sequence += 1
        frame = Frame(kind, len(self.joints), len(self.fingers), self._sequence, time.monotonic(), body)
        self._send(encode(frame, self._send_key))

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
        key: Shared key (:func:`~robotics_bridge.deploy.links.udp.read_key`).
        joints: J.
        fingers: F.
    """

    def __init__(self, link: socket.socket, key: bytes, joints: int, fingers: int) -> None:
        check_key(key)
        link.setblocking(False)
        self.link, self.joints, self.fingers = link, joints, fingers
        self.peer: Any = ()
        """Address of the controller; empty without a session."""
        self.stopped = True
        """True until a session begins, and after its stop: the hand holds where it is."""
        self._key, self._challenge = key, secrets.token_bytes(NONCE)
        self._offered: dict[tuple[Any, bytes], tuple[bytes, bytes]] = {}  # who may start a session → its two keys
        self._receiver: Receiver | None = None
        self._send_key = b""
        self._sequence = 0

    def receive(self, now: float) -> NDArray[np.float64] | None:
        """Return the newest targets [J] (rad) to follow, or None without any; ``now`` is of the reports' clock (s)."""
        targets = None
        for _ in range(MOST_AT_ONCE):
            try:
                data, sender = self.link.recvfrom(LARGEST + 1)
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
        state = Frame(STATE, self.joints, self.fingers, self._sequence, time, pack_values(values))
        return encode(state, self._send_key)

    def send(self, data: bytes) -> None:
        """Send a frame to the controller, if there is one."""
        if self.peer:
            with contextlib.suppress(OSError):
                self.link.sendto(data, self.peer)

    def _offer(self, data: bytes, sender: Any, now: float) -> None:
        """Answer a greeting. A greeting that is repeated by a stranger ends no session and begins none."""
        hello = decode(data, self._key)
        if hello is None or (hello.kind, hello.joints, hello.fingers) != (HELLO, self.joints, self.fingers):
            return
        # Each greeting has an offer of its own: one that a stranger repeats takes no place of another.
        self._offered.pop((sender, hello.body), None)
        self._offered[sender, hello.body] = session_keys(self._key, hello.body, self._challenge)
        if len(self._offered) > MOST_OFFERS:
            del self._offered[next(iter(self._offered))]
        body = hello.body + self._challenge
        welcome = encode(Frame(WELCOME, self.joints, self.fingers, 0, now, body), self._key)
        with contextlib.suppress(OSError):
            self.link.sendto(welcome, sender)

    def _start(self, data: bytes, sender: Any, now: float) -> bool:
        """Begin the session that was offered to this sender; return False where the datagram starts none."""
        for (offered, _), keys in self._offered.items():
            frame = decode(data, keys[0]) if sender == offered else None
            if frame is not None and frame.kind == START:
                break
        else:
            return False
        ours, theirs = keys
        self._receiver, self._send_key, self._sequence = Receiver(ours), theirs, 0
        self._receiver.judge(frame, now)
        self.peer, self.stopped = sender, False
        # Used once: what was recorded of this session starts no other.
        self._offered, self._challenge = {}, secrets.token_bytes(NONCE)
        return True

    def _command(self, data: bytes, sender: Any, now: float) -> NDArray[np.float64] | None:
        """Return the targets of a command of this session that is new, young and possible; heed its stop."""
        if self._receiver is None or sender != self.peer:
            return None
        frame = decode(data, self._receiver.key)
        if frame is None or frame.joints != self.joints:
            return None
        verdict, _ = self._receiver.judge(frame, now)
        if frame.kind == STOP:
            # However late it comes: to hold is safe.
            self.stopped = True
        # A comparison with NaN is false.
        if frame.kind != COMMAND or verdict != "new" or not (np.abs(frame.values) <= FARTHEST).all():
            return None
        return frame.values if now <= frame.origin[1] else None
