"""Datagrams between a controller and a hand, and the driver that speaks them over a local or remote UDP socket.

A message is one datagram, little-endian, with a checksum. Header: 4 bytes ``BBH1``, kind (u8), joints J (u8), fingers F
(u8), flags (u8), sequence (u32), time (f64, s). A state carries positions f32[J], velocities f32[J] and pressures
f32[F·3]; a command f32[J] targets. CRC-32 of all ends it.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import time
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError
from robotics_bridge.deploy.driver import HandReading, LinkCounters

MAGIC = b"BBH1"
STATE, COMMAND = 1, 2
STOP = 1
"""Flag of a command: hold, and refuse what follows."""
_HEADER = struct.Struct("<4sBBBBId")
_END = struct.Struct("<I")
_LARGEST = 4096
_MOST = 256
"""Datagrams read at once; a flood must not hold the control loop up."""
_ERRORS = 8
"""Errors of the connection that are kept."""


@dataclass(frozen=True, eq=False)
class Message:
    """A datagram that was read."""

    kind: int
    """:data:`STATE` or :data:`COMMAND`."""
    joints: int
    """J."""
    fingers: int
    """F."""
    flags: int
    """:data:`STOP`, or 0."""
    sequence: int
    """Number of the message; goes on from 0 after 2³²."""
    time: float
    """Time of the sender's clock (s)."""
    values: NDArray[np.float64]
    """Positions (rad), velocities (rad/s) and pressures of a state, targets (rad) of a command, one after another."""


def encode(
    kind: int, values: ArrayLike, *, joints: int, fingers: int = 0, sequence: int = 0, time: float = 0.0, flags: int = 0
) -> bytes:
    """Return the bytes of a message."""
    head = _HEADER.pack(MAGIC, kind, joints, fingers, flags, sequence & 0xFFFFFFFF, time)
    body = head + np.asarray(values, dtype="<f4").tobytes()
    return body + _END.pack(zlib.crc32(body))


def decode(data: bytes) -> Message | None:
    """Return what a datagram says; None when it is damaged, cut short or of another kind."""
    if len(data) < _HEADER.size + _END.size:
        return None
    body, (checksum,) = data[: -_END.size], _END.unpack(data[-_END.size :])
    magic, kind, joints, fingers, flags, sequence, time = _HEADER.unpack(body[: _HEADER.size])
    count = {STATE: 2 * joints + 3 * fingers, COMMAND: joints}.get(kind)
    if magic != MAGIC or count is None or zlib.crc32(body) != checksum or len(body) != _HEADER.size + 4 * count:
        return None
    values = np.frombuffer(body, dtype="<f4", offset=_HEADER.size).astype(np.float64)
    return Message(kind, joints, fingers, flags, sequence, time, values)


class UdpDriver:
    """Speaks to a hand that sends its state to whoever last sent it a command.

    Args:
        address: Host and port of the hand.
        joints: Names of its joints, in its order.
        fingers: Names of its sensing fingers, in its order.
    """

    def __init__(self, address: tuple[str, int], joints: tuple[str, ...], fingers: tuple[str, ...]) -> None:
        self.address, self.joints, self.fingers = address, joints, fingers
        self.counters = LinkCounters()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._newest: HandReading | None = None
        self._sequence = 0
        self._stopped = False
        # An empty greeting tells the hand where to send its state, and moves nothing.
        self._send(encode(COMMAND, [], joints=0))

    def read(self) -> HandReading | None:
        """Return the newest report, the same one again if nothing came, or None before the first."""
        for _ in range(_MOST):
            try:
                data = self._socket.recv(_LARGEST)
            except BlockingIOError:
                break
            except OSError as error:  # nobody listens there (any more): silence, which the watchdog hears
                self._note(error)
                break
            self._take(data)
        return self._newest

    def _take(self, data: bytes) -> None:
        message, counters = decode(data), self.counters
        joints, fingers = len(self.joints), len(self.fingers)
        if message is None or (message.kind, message.joints, message.fingers) != (STATE, joints, fingers):
            counters.damaged += 1
            return
        last = self._newest.sequence if self._newest is not None else message.sequence - 1
        # UDP may change the order: an older report that comes late is dropped, and was counted as lost before.
        if message.sequence <= last:
            counters.late += 1
            counters.lost = max(0, counters.lost - 1)
            return
        counters.received += 1
        counters.lost += message.sequence - last - 1
        position, velocity, pressure = np.split(message.values, [joints, 2 * joints])
        self._newest = HandReading(
            message.sequence, message.time, time.monotonic(), position, velocity, pressure.reshape(fingers, 3)
        )

    def send(self, targets: NDArray[np.float64]) -> None:
        """Ask the position drives for targets [J] (rad).

        Raises:
            UsageError: there are not as many targets as joints.
        """
        if np.shape(targets) != (len(self.joints),):
            raise UsageError(f"A command has {len(self.joints)} targets; received {np.shape(targets)}.")
        if not self._stopped:
            self._send(self._command(targets))

    def stop(self) -> None:
        """Hold where the hand is, and refuse targets until it is connected anew."""
        self._stopped = True
        where = self._newest.position if self._newest is not None else np.zeros(len(self.joints))
        message = self._command(where, STOP)
        # The one message that must not be lost; the hand's own watchdog is behind it.
        for _ in range(5):
            self._send(message)

    def _command(self, targets: NDArray[np.float64], flags: int = 0) -> bytes:
        self._sequence += 1
        facts = {"sequence": self._sequence, "time": time.monotonic(), "flags": flags}
        return encode(COMMAND, targets, joints=len(self.joints), **facts)

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
            self._socket.sendto(data, self.address)
        except OSError as error:
            self._note(error)

    def _note(self, error: OSError) -> None:
        if len(self.counters.errors) < _ERRORS:
            self.counters.errors.append(str(error))
