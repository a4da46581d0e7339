"""The interface of a robot hand that runs a policy, and the one way to it. Radians, seconds.

Limits of safety, finiteness and age are checked where a command is sent, after all that could take time.
"""

from __future__ import annotations

import contextlib
import inspect
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_each, unknown_name
from brainbench.core.limits import Limit, limited, limits_of
from brainbench.core.plugins import load_optional, optional_parts
from robotics_bridge.hands import Hand
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
    """File with the key that the hand holds too."""
    faults: tuple[str, ...] = ()
    """Faults of a simulated hand, as ``drop=0.2``."""
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


DRIFT = 2e-4
"""Largest difference of the rates of two clocks (s/s): quartz is right to 50 ppm, and the system's time service adds
its own. A delay that grows more slowly than this is not seen."""


@dataclass(frozen=True, eq=False)
@limited(of="The safety limit '{}'")
class SafetyLimits:
    """Limits of joints, readings and timing.

    Each has a largest value: a hand must not run on for longer, or press harder, because of a slip of the keys.
    """

    low: NDArray[np.float64]
    """[J] (rad)."""
    high: NDArray[np.float64]
    """[J] (rad)."""
    speed: NDArray[np.float64]
    """[J] (rad/s): fastest change of a target; twice that measured is absurd."""
    pressure: Annotated[float, Limit(above=0, most=1000)] = 30.0
    """Largest reading of a finger tip, in the maker's unit."""
    margin: Annotated[float, Limit(above=0, most=1)] = 0.15
    """Distance beyond its limits at which a joint may be measured (rad; of a slide by its lever)."""
    timeout: Annotated[float, Limit(above=0, most=2)] = 0.1
    """Oldest report to act upon (s)."""
    start_timeout: Annotated[float, Limit(above=0, most=60)] = 3.0
    """Longest wait for the first report (s)."""
    rate_share: Annotated[float, Limit(above=0, most=1)] = 0.8
    """Smallest share of the nominal control rate over the window."""
    rate_window: Annotated[float, Limit(above=0, most=60)] = 1.0
    """Seconds over which the rate is judged."""
    lever: NDArray[np.float64] | float = 1.0
    """[J] factor on the margin (:meth:`~robotics_bridge.hands.hand.Hand.lever`)."""

    def __post_init__(self) -> None:
        if not (len(self.low) == len(self.high) == len(self.speed)):
            raise UsageError("Limits of position and speed need one number per joint each.")
        ends = np.array([self.low, self.high, self.speed], float)
        if not (np.isfinite(ends).all() and (ends[0] < ends[1]).all() and (ends[2] > 0).all()):
            raise UsageError("Every joint needs a finite lower limit below its upper one and a finite positive speed.")

    @classmethod
    def of_hand(cls, hand: Hand, joints: tuple[str, ...], **changes: float) -> SafetyLimits:
        """Return the limits of a hand's joints, in a given order."""
        model = hand.model
        names = {model.joint(index).name: index for index in range(model.njnt)}
        if missing := [name for name in joints if name not in names]:
            raise UsageError(f"The hand {hand.name!r} has no joint {missing[0]!r}.")
        ranges = np.array([model.jnt_range[names[name]] for name in joints])
        check_each("safety limit", changes, [name for name in limits_of(cls) if name != "lever"])
        return cls(ranges[:, 0], ranges[:, 1], hand.rated_speeds(joints), lever=hand.lever(joints), **changes)

    def fault(self, reading: HandReading, age: float) -> str | None:
        """Return why a report must not be acted upon, in words; None if it may."""
        # Numbers that are not finite are looked for first: every later comparison with NaN is false and would let them
        # pass.
        values = (reading.position, reading.velocity, reading.pressure)
        if not all(np.isfinite(value).all() for value in values) or not math.isfinite(reading.time):
            return "the hand reports values that are no numbers"
        if age > self.timeout:
            return f"the newest report is {1e3 * age:.0f} ms old (allowed {1e3 * self.timeout:.0f} ms)"
        beyond = np.maximum(self.low - reading.position, reading.position - self.high) - self.margin * self.lever
        if (beyond > 0).any():
            joint = int(beyond.argmax())
            return f"joint {joint} is reported at {reading.position[joint]:.3g} rad, beyond its limits"
        fast = np.abs(reading.velocity) - 2 * self.speed
        if (fast > 0).any():
            joint = int(fast.argmax())
            return f"joint {joint} is reported to move at {reading.velocity[joint]:.3g} rad/s"
        strongest = float(np.linalg.norm(reading.pressure, axis=1).max()) if reading.pressure.size else 0.0
        if strongest > self.pressure:
            return f"a finger tip is pressed with {strongest:.3g} (allowed {self.pressure:g})"
        return None

    def limit(self, targets: NDArray[np.float64], before: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        """Return targets [J] within the limits of position, and of speed from the targets before."""
        step = self.speed * dt
        # Speed first, position last: whatever the targets before were, the outcome lies within the joint's range.
        return np.clip(np.clip(targets, before - step, before + step), self.low, self.high)

    def allows(self, targets: NDArray[np.float64]) -> bool:
        """Return whether targets [J] are finite numbers within the limits of position."""
        # As the joints get them, in single precision; a comparison with NaN is false.
        single = np.asarray(targets, np.float32)
        return bool(np.all((single >= np.float32(self.low)) & (single <= np.float32(self.high))))


class ClockOffset:
    """Lateness of reports, although the hand's clock and ours have different zeros.

    The smallest difference between arrival and measurement seen so far counts as no delay; it may grow by
    :data:`DRIFT`, because the clocks of two computers run at different rates.
    """

    def __init__(self) -> None:
        self._least, self._asked = math.inf, 0.0

    def age(self, stamp: float, arrived: float, now: float) -> float:
        """Return how long ago something was sent (s, ``stamp`` by the sender's clock), beyond the shortest way seen."""
        # The offset of the clocks is not known. Least of all differences: the way of the fastest report counts as none.
        self._least = min(self._least + DRIFT * max(0.0, now - self._asked), arrived - stamp)
        self._asked = now
        return now - stamp - self._least


@dataclass(frozen=True, eq=False)
class Command:
    """What a hand is asked for, with the report that it was decided from and the time until which it holds."""

    targets: NDArray[np.float64]
    """[J] (rad)."""
    reading: HandReading
    """Carries the time of the report."""
    deadline: float
    """Latest time (s, by the link's clock) at which it may be sent (:meth:`SafeLink.deadline`)."""


SILENCE = 0.25  # longest time without a command (s) after which the link stops the hand, in a thread of its own


class SafeLink:
    """The one way to a hand, which lets no command pass that is unsafe or comes from an old report.

    ``driver`` is the hand, ``clock`` that by which its reports are stamped when they arrive; ``step`` is the time of a
    control step (s), for which a target may move on. A stop is final.
    """

    def __init__(self, driver: Driver, limits: SafetyLimits, clock: Clock, step: float) -> None:
        self._driver, self._limits, self._clock, self._step = driver, limits, clock, step
        self._offset = ClockOffset()
        self._carries = {"report", "allowed"} <= {*inspect.signature(driver.send).parameters}
        self._before: NDArray[np.float64] | None = None
        self._turn = threading.Lock()
        self._due = math.inf
        self._stopped = ""

    def read(self) -> HandReading | None:
        """Return the newest report, or None before the first."""
        return self._driver.read()

    def fault(self, reading: HandReading) -> str | None:
        """Return why a report must not be acted upon now, in words; None if it may."""
        return self._stopped or self._limits.fault(reading, self._age(reading))

    def deadline(self, reading: HandReading) -> float:
        """Return the latest time (s) at which a command from a report may be sent."""
        return self._clock() - self._age(reading) + self._limits.timeout

    def send(self, command: Command) -> str | None:
        """Send a command; return why it was not sent, or None."""
        targets, limits = command.targets, self._limits
        if not limits.allows(targets):
            return "a command would be no numbers or beyond the joints' limits"
        before = command.reading.position if self._before is None else self._before
        # From outside its range a joint is brought back at once.
        way = np.abs(targets - np.clip(before, limits.low, limits.high)) - limits.speed * self._step
        if (way > 1e-6).any():
            return f"a command would move joint {int(way.argmax())} faster than allowed"
        with self._turn:
            if self._stopped:
                return self._stopped
            # Measured last: all that happened since the report was read counts, and the hand has moved on meanwhile.
            now, timeout = self._clock(), limits.timeout
            if not now <= command.deadline:
                age = now - command.deadline + timeout
                return (
                    f"a command came {1e3 * age:.0f} ms after the report it was decided from (allowed "
                    f"{1e3 * timeout:.0f} ms)"
                )
            origin: dict[str, Any] = {"report": command.reading, "allowed": timeout} if self._carries else {}
            self._driver.send(targets, **origin)
            self._before, self._due = np.array(targets), now + self._step + SILENCE
        return None

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Stop the hand if the next command does not come in time, whatever holds the loop up, until the block ends.

        A clock of tests moves when it is told to, and no thread waits for it.
        """
        ended = threading.Event()

        def watch() -> None:
            while not ended.wait(SILENCE / 10):
                with self._turn:
                    if self._clock() > self._due and not self._stopped:
                        self._stopped = f"no command came for {1e3 * (self._step + SILENCE):.0f} ms"
                        self._driver.stop()

        thread = threading.Thread(target=watch, daemon=True) if type(self._clock) is Clock else None
        if thread is not None:
            thread.start()
        try:
            yield
        finally:
            ended.set()
            if thread is not None:
                thread.join(1.0)

    def stop(self) -> None:
        """Tell the hand to hold where it is."""
        self._stopped = self._stopped or "the hand was stopped"
        self._driver.stop()

    def _age(self, reading: HandReading) -> float:
        return self._offset.age(reading.time, reading.arrived, self._clock())
