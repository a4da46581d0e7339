"""The interface of a robot hand that runs a policy. Radians, seconds."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import unknown_name
from brainbench.core.plugins import load_optional, optional_parts
from robotics_bridge.policies.contract import PolicyContract


@dataclass(frozen=True, eq=False)
class HandReading:
    """One report of a hand. Letters: J joint, F finger."""

    sequence: int
    """Number of the report, counted by the hand."""
    time: float
    """Time of measurement, by the hand's clock [s]."""
    arrived: float
    """Time of arrival, by the controller's clock [s]."""
    position: NDArray[np.float64]
    """Joint positions [J] (rad), in the driver's order."""
    velocity: NDArray[np.float64]
    """Joint velocities [J] (rad/s)."""
    pressure: NDArray[np.float64]
    """Summed contact force of each finger tip [F, 3], as the maker's ``calc_pressure`` gives it."""


Source = Callable[["HandReading"], "NDArray[np.floating]"]  # a group of observations for a report: touch, or the goal


@dataclass
class LinkCounters:
    """Counts of the reports of a hand on their way."""

    received: int = 0
    lost: int = 0
    """Numbers that were skipped and did not come later."""
    late: int = 0
    """Came after a newer one, and were not used."""
    stale: int = 0
    """Older than allowed, by time or number, and not used."""
    replayed: int = 0
    """Authentic but sent again by somebody, and not used."""
    damaged: int = 0
    """Not readable, forged, or of another session, and not used."""
    errors: list[str] = field(default_factory=list)
    """First errors of the connection."""


class Driver(Protocol):
    """A hand, real or simulated. Nothing here blocks longer than sending a message takes."""

    joints: tuple[str, ...]
    """Names of the joints J."""
    fingers: tuple[str, ...]
    """Names of the fingers F with a sensing tip."""
    counters: LinkCounters

    def read(self) -> HandReading | None:
        """Return the newest report, the same one again if nothing came, or None before the first."""
        ...

    def send(self, targets: NDArray[np.float64]) -> None:
        """Ask the position drives for targets [J] (rad).

        Where it also takes ``report`` and ``allowed``, the command carries what it was decided from: the report, and
        how long after it (s, by the hand's clock) the targets may be followed.
        """
        ...

    def stop(self) -> None:
        """Hold where the hand is, and refuse targets until it is connected anew."""
        ...

    def close(self) -> None:
        """End the connection."""
        ...


class Clock:
    """The time of a control loop; tests have one of their own."""

    def __call__(self) -> float:
        """Return the time (s)."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


@dataclass(frozen=True, kw_only=True)
class DriverRequest:
    """What a driver is opened for."""

    contract: PolicyContract
    """Contract of the policy that is to move the hand."""
    address: str = ""
    """Where the hand is, as HOST:PORT or :PORT."""
    key: Path | None = None
    """File with the key that a hand behind a socket holds too."""
    faults: tuple[str, ...] = ()
    """Faults of the simulated hand: drop=0.2, jitter=0.03, silent-after=2, …"""
    seconds: float = 60.0
    """For how long the hand is needed."""


def open_driver(name: str, request: DriverRequest) -> AbstractContextManager[Driver]:
    """Return the connection to a hand, not yet opened, by an entry point of :data:`DRIVERS`.

    An entry point is a function of a :class:`DriverRequest`, which checks it and returns a context manager.
    """
    opener = load_optional(DRIVERS, name, "driver")
    if opener is None:
        raise unknown_name("driver of a hand", name, optional_parts(DRIVERS), hint="Or HOST:PORT, or :PORT.")
    return opener(request)


DRIVERS = "robotics_bridge.drivers"  # group of entry points: name → opener of a driver
