"""The hand's end of the link: sessions, commands that may be followed, and reports; the drives are the caller's."""

from __future__ import annotations

import contextlib
import secrets
import socket
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robotics_bridge.deploy import frames
from robotics_bridge.deploy.frames import Frame
from robotics_bridge.deploy.receiver import Receiver
from robotics_bridge.deploy.udp import MOST_AT_ONCE


class HandLink:
    """Serves one controller at a time that holds the same key; the newest session counts.

    Args:
        link: A bound UDP socket.
        key: Shared key (:func:`~robotics_bridge.deploy.frames.read_key`).
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
        self._offered: tuple[Any, bytes, bytes] = ((), b"", b"")  # who may start a session, and its two keys
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
            elif (found := self._command(data, sender, now)) is not None:
                targets = found
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
        self._offered = (sender, *frames.session_keys(self._key, hello.body, self._challenge))
        body = hello.body + self._challenge
        welcome = frames.encode(Frame(frames.WELCOME, self.joints, self.fingers, 0, now, body), self._key)
        with contextlib.suppress(OSError):
            self.link.sendto(welcome, sender)

    def _start(self, data: bytes, sender: Any, now: float) -> bool:
        """Begin the session that was offered to this sender; return False where the datagram starts none."""
        offered, ours, theirs = self._offered
        if sender != offered or (frame := frames.decode(data, ours)) is None or frame.kind != frames.START:
            return False
        self._receiver, self._send_key, self._sequence = Receiver(ours), theirs, 0
        self._receiver.judge(frame, now)
        self.peer, self.stopped = sender, False
        # Used once: what was recorded of this session starts no other.
        self._offered, self._challenge = ((), b"", b""), secrets.token_bytes(frames.NONCE)
        return True

    def _command(self, data: bytes, sender: Any, now: float) -> NDArray[np.float64] | None:
        """Return the targets of a command of this session that is new, young and finite; heed its stop."""
        if self._receiver is None or sender != self.peer:
            return None
        frame = frames.decode(data, self._receiver.key)
        if frame is None or frame.joints != self.joints:
            return None
        verdict, _ = self._receiver.judge(frame, now)
        if frame.kind == frames.STOP:
            # However late it comes: to hold is safe.
            self.stopped = True
        if frame.kind != frames.COMMAND or verdict != "new" or not np.isfinite(frame.values).all():
            return None
        return frame.values
