"""Rules of a receiver of authentic frames: each number once, in order, and nothing old."""

from __future__ import annotations

from typing import Literal

from robotics_bridge.deploy.frames import Frame
from robotics_bridge.deploy.safety import ClockOffset

Verdict = Literal["new", "late", "replayed", "stale"]
"""``late``: came after a newer one for the first time; ``replayed``: again; ``stale``: too old, by number or time."""
MAX_AGE = 0.25
"""Oldest frame that has an effect (s); as long as a hand without commands moves on."""


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
