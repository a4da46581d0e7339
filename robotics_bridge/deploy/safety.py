"""Limits of safety, and the one way to a hand on which they are checked. Radians, seconds.

Limits, finiteness and age are checked where a command is sent, after all that could take time.
"""

from __future__ import annotations

import contextlib
import inspect
import math
import threading
from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_each
from brainbench.core.limits import Limit, limited, limits_of
from robotics_bridge.deploy.driver import Clock, Driver, HandReading
from robotics_bridge.hands import Hand

DRIFT = 2e-4
"""Largest difference of the rates of two clocks (s/s): quartz is right to 50 ppm, and the system's time service adds
its own. A delay that grows more slowly than this is not seen."""


@limited(of="The safety limit '{}'", eq=False)
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

    def send(self, targets: NDArray[np.float64], reading: HandReading, deadline: float) -> str | None:
        """Send targets [J] (rad), decided from a report, until their :meth:`deadline` (s); return why not, or None."""
        limits = self._limits
        if not limits.allows(targets):
            return "a command would be no numbers or beyond the joints' limits"
        before = reading.position if self._before is None else self._before
        # From outside its range a joint is brought back at once.
        way = np.abs(targets - np.clip(before, limits.low, limits.high)) - limits.speed * self._step
        if (way > 1e-6).any():
            return f"a command would move joint {int(way.argmax())} faster than allowed"
        with self._turn:
            if self._stopped:
                return self._stopped
            # Measured last: all that happened since the report was read counts, and the hand has moved on meanwhile.
            now, timeout = self._clock(), limits.timeout
            if not now <= deadline:
                age = now - deadline + timeout
                return (
                    f"a command came {1e3 * age:.0f} ms after the report it was decided from (allowed "
                    f"{1e3 * timeout:.0f} ms)"
                )
            if self._overdue(now):
                return self._stopped
            origin: dict[str, Any] = {"report": reading, "allowed": timeout} if self._carries else {}
            self._driver.send(targets, **origin)
            self._before, self._due = np.array(targets), now + self._step + SILENCE
        return None

    @contextlib.contextmanager
    def watched(self) -> Iterator[None]:
        """Stop the hand if the next command does not come in time, whatever holds the loop up, until the block ends.

        A clock of tests moves when it is told to, and no thread waits for it.
        """
        ended = threading.Event()

        def _watch() -> None:
            while not ended.wait(SILENCE / 10):
                with self._turn:
                    if self._overdue(self._clock()):
                        self._driver.stop()

        thread = threading.Thread(target=_watch, daemon=True) if type(self._clock) is Clock else None
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

    def _overdue(self, now: float) -> bool:
        """Note that no command came in time, once; whoever has the turn then stops the hand.

        In a process that was suspended and goes on, the loop may come before the thread that watches it.
        """
        if overdue := now > self._due and not self._stopped:
            self._stopped = f"no command came for {1e3 * (self._step + SILENCE):.0f} ms"
        return overdue

    def _age(self, reading: HandReading) -> float:
        return self._offset.age(reading.time, reading.arrived, self._clock())
