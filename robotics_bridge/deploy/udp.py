"""A driver over a local or remote UDP socket (:mod:`~robotics_bridge.deploy.messages`)."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from brainbench.core.errors import UsageError
from robotics_bridge.deploy.driver import HandReading, LinkCounters
from robotics_bridge.deploy.messages import COMMAND, STATE, STOP, decode, encode

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LARGEST = 4096
_MOST = 256
"""Datagrams read at once; a flood must not hold the control loop up."""
_ERRORS = 8


class UdpDriver:
    """Speaks to a hand that sends its state to whoever last sent it a command.

    Args:
        address: Host and port of the hand.
        joints: Names of its joints, in its order.
        fingers: Names of its sensing fingers, in its order.
        clock: Seconds; of the controller.
    """

    def __init__(
        self,
        address: tuple[str, int],
        joints: tuple[str, ...],
        fingers: tuple[str, ...],
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.address, self.joints, self.fingers, self.clock = address, joints, fingers, clock
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
        if message.sequence <= last:
            counters.late += 1
            counters.lost = max(0, counters.lost - 1)
            return
        counters.received += 1
        counters.lost += message.sequence - last - 1
        position, velocity, pressure = np.split(message.values, [joints, 2 * joints])
        self._newest = HandReading(
            message.sequence, message.time, self.clock(), position, velocity, pressure.reshape(fingers, 3)
        )

    def send(self, targets: NDArray[np.float64]) -> None:
        """Ask the position drives for targets [J] (rad).

        Raises:
            UsageError: there are not as many targets as joints.
        """
        if np.shape(targets) != (len(self.joints),):
            raise UsageError(f"A command has {len(self.joints)} targets; received {np.shape(targets)}.")
        if not self._stopped:
            self._sequence += 1
            self._send(encode(COMMAND, targets, joints=len(self.joints), sequence=self._sequence, time=self.clock()))

    def stop(self) -> None:
        """Hold where the hand is, and refuse targets until it is connected anew."""
        self._stopped = True
        where = self._newest.position if self._newest is not None else np.zeros(len(self.joints))
        self._sequence += 1
        message = encode(
            COMMAND, where, joints=len(self.joints), sequence=self._sequence, time=self.clock(), flags=STOP
        )
        # The one message that must not be lost; the hand's own watchdog is behind it.
        for _ in range(5):
            self._send(message)

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
