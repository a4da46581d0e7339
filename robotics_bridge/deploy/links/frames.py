"""Datagrams between a controller and a hand: their layout, and the keys that authenticate them.

A frame is one datagram, little-endian. Header: 4 bytes ``BBH3``, kind, joints J, fingers F, 0 (u8 each), sequence
(u32), time of the sender's clock (f64, s). A state carries positions f32[J], velocities f32[J] and pressures f32[F·3];
a command the number of the report that it was decided from (u32), the time of the hand's clock until which it holds
(f64, s; infinite for none) and f32[J] targets; a greeting the controller's nonce (16 bytes), a welcome the controller's
and the hand's.
HMAC-SHA256 (RFC 2104) of all of it ends the frame, 32 bytes.
"""

from __future__ import annotations

import hmac
import math
import os
import secrets
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
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
    """Read a key from a file of 64 hexadecimal digits that nobody but its owner can read.

    Raises:
        DataFileNotFoundError: there is no such file.
    """
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
    _SPAN = 1 << 32

    def __init__(self) -> None:
        self.newest: int | None = None
        self._seen = 0  # bit i: newest - i was seen

    def judge(self, number: int) -> tuple[Verdict, int]:
        """Count a number; return what it is, and how many were skipped if it is new."""
        if self.newest is None:
            self.newest, self._seen = number, 1
            return "new", 0
        ahead = (number - self.newest) % self._SPAN
        if 0 < ahead < self._SPAN // 2:
            # Shifted by the whole window at most: a jump must not build a number of 2³¹ bits.
            self._seen = (self._seen << min(ahead, self.SIZE)) & ((1 << self.SIZE) - 1) | 1
            self.newest = number
            return "new", ahead - 1
        behind = (self.newest - number) % self._SPAN
        if behind >= self.SIZE:
            return "stale", 0
        if self._seen >> behind & 1:
            return "replayed", 0
        self._seen |= 1 << behind
        return "late", 0


class Receiver:
    """One direction of one session; ``offset`` is what is known already of the sender's clock."""

    def __init__(self, key: bytes, offset: ClockOffset | None = None) -> None:
        self.key = key
        self._window, self._offset = SequenceWindow(), offset or ClockOffset()

    def judge(self, frame: Frame, now: float) -> tuple[Verdict, int]:
        """Return what an authentic frame that arrives now is, and how many were skipped if it is new."""
        verdict, skipped = self._window.judge(frame.sequence)
        # A number comes back after 2³² frames, a time never does.
        age = self._offset.age(frame.time, now, now) if verdict in ("new", "late") else 0.0
        return ("stale", skipped) if age > MAX_AGE else (verdict, skipped)
