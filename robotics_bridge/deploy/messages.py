"""The messages between a controller and a hand: one datagram each, little-endian, with a checksum.

Header: 4 bytes ``BBH1``, kind (u8), joints J (u8), fingers F (u8), flags (u8), sequence (u32), time (f64, s). A state
carries positions f32[J], velocities f32[J] and pressures f32[F·3]; a command f32[J] targets. CRC-32 of all ends it.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

MAGIC = b"BBH1"
STATE, COMMAND = 1, 2
STOP = 1
"""Flag of a command: hold, and refuse what follows."""
_HEADER = struct.Struct("<4sBBBBId")
_END = struct.Struct("<I")


@dataclass(frozen=True, eq=False)
class Message:
    """A message that was read."""

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
    """Of the sender's clock (s)."""
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
