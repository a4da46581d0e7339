"""The loop of a session on a hand: it reads, checks, decides, limits and sends, at a steady rate.

A stop is final for the session: the hand holds where it is, and the reason is kept in words.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_each, check_number
from robotics_bridge.deploy.driver import Clock, Driver, HandReading, Source
from robotics_bridge.deploy.safety import Command, SafeLink, SafetyLimits
from robotics_bridge.envs import ActionMap
from robotics_bridge.envs.step import VELOCITY
from robotics_bridge.policies.contract import RATE, PolicyContract
from robotics_bridge.policies.export import Runner

PRIORITY = 20  # priority under SCHED_FIFO (1–99); above ordinary threads, below the kernel's own (50)


@contextlib.contextmanager
def realtime() -> Iterator[None]:
    """Run the calling thread ahead of all ordinary ones (SCHED_FIFO) and without garbage collection, until it leaves.

    Processes that it starts meanwhile are ordinary. A loop that never sleeps would keep a processor to itself.
    """
    if not hasattr(os, "SCHED_FIFO"):
        raise UsageError("Real-time scheduling is Linux's; leave realtime out on this system.")
    before, parameters, collecting = os.sched_getscheduler(0), os.sched_getparam(0), gc.isenabled()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except PermissionError as error:
        raise UsageError(
            f"This user may not run threads at real-time priority {PRIORITY}; allow it with the line "
            f"'{os.environ.get('USER', 'USER')} - rtprio {PRIORITY}' in /etc/security/limits.conf, or leave realtime "
            "out."
        ) from error
    gc.disable()
    try:
        yield
    finally:
        os.sched_setscheduler(0, before, parameters)
        if collecting:
            gc.enable()


class LatencyHistogram(list[float]):
    """Durations of ticks (s) in logarithmic buckets, 10 per decade from 10 µs to 10 s. Percentiles are exact."""

    EDGES = np.logspace(-5, 1, 61)
    """[61] (s)."""

    def summary(self) -> dict[str, Any]:
        """Return the number of ticks, percentiles and the longest in milliseconds; NaN without any."""
        parts = {f"p{share:g}": 1e3 * float(np.percentile(self or [math.nan], share)) for share in (50, 90, 99, 99.9)}
        return {"ticks": len(self), **parts, "max": 1e3 * max(self, default=math.nan)}

    def text(self, width: int = 40) -> str:
        """Return the histogram as lines of text, without empty ends."""
        # Durations below each edge, and beyond the last.
        counts = np.bincount(np.searchsorted(self.EDGES, self, side="right"), minlength=len(self.EDGES) + 1)
        used = np.flatnonzero(counts)
        if not len(used):
            return "no ticks"
        lines = []
        for bucket in range(used[0], used[-1] + 1):
            top = f"{1e3 * self.EDGES[bucket]:8.3g} ms" if bucket < len(self.EDGES) else "    more    "
            bar = "█" * round(width * counts[bucket] / counts.max())
            lines.append(f"< {top} {counts[bucket]:6d} {bar}")
        return "\n".join(lines)


class RateMonitor:
    """The rate of ticks [Hz] over a sliding window (s), beside a nominal one."""

    def __init__(self, rate: float, window: float = 1.0) -> None:
        self.rate, self.window = rate, window
        self._times: deque[float] = deque()
        self._begun: float | None = None

    def tick(self, now: float) -> float:
        """Count a tick; return the rate over the window [Hz], the nominal one until a window has passed."""
        # A window that is not full yet would count too few ticks and stop every session at its beginning.
        self._begun = now if self._begun is None else self._begun
        self._times.append(now)
        while self._times and self._times[0] <= now - self.window:
            self._times.popleft()
        if now - self._begun < self.window:
            return self.rate
        return len(self._times) / self.window


_log = logging.getLogger(__name__)


@dataclass
class Report:
    """Outcome of a session."""

    status: str
    """``finished`` or ``stopped``."""
    reason: str
    """Why it was stopped; empty if not."""
    ticks: int
    """Control steps that were decided."""
    seconds: float
    """Time of the session."""
    latency: dict[str, Any]
    """Latency of reading, deciding and sending (ms)."""
    processor: dict[str, Any]
    """The same in processor time of the loop's thread, which does not count waiting for a busy machine."""
    rate: float
    """Ticks per second."""
    overruns: int
    """Ticks that took longer than a control step."""
    limited: int
    """Ticks whose targets a limit of speed or position changed."""
    link: dict[str, Any]
    """Counters of the driver."""


def check_duration(seconds: float) -> None:
    """Raise :class:`UsageError` unless a session can last so long (s)."""
    check_number("length of a session (s)", seconds, above=0, most=86400)


class Controller:
    """Runs a policy on a hand.

    Args:
        run: The policy: groups → action [A] (:func:`~robotics_bridge.policies.export.read_policy`).
        driver: The hand.
        contract: What the policy reads and moves, and how often.
        limits: One of each kind per joint of the driver, in its order.
        sources: Group → what gives it, for groups other than ``proprio``: for ``tactile`` a
            :class:`~robotics_bridge.deploy.session.RealTouch`.
        clock: Tells the time and waits.
        record: Called after each tick with (reading, groups, action, targets [J]).
    """

    def __init__(
        self,
        run: Runner,
        driver: Driver,
        contract: PolicyContract,
        limits: SafetyLimits,
        *,
        sources: Mapping[str, Source] | None = None,
        clock: Clock | None = None,
        record: Callable[..., None] | None = None,
    ) -> None:
        self.run_policy, self.driver, self.contract, self.limits = run, driver, contract, limits
        self.clock = clock or Clock()
        check_number("control steps per second", contract.rate, least=RATE[0], most=RATE[1])
        self.link = SafeLink(driver, limits, self.clock, 1 / contract.rate)
        self.rate, self.sources, self.record = contract.rate, dict(sources or {}), record
        if missing := [name for name in contract.inputs if name not in {"proprio", *self.sources}]:
            raise UsageError(f"The policy reads the group {missing[0]!r}, and nothing here gives it.")
        check_each("group of a policy with a source", self.sources, {*contract.inputs} - {"proprio"})
        if len(limits.low) != len(driver.joints):
            raise UsageError(f"There are limits of {len(limits.low)} joints; the hand has {len(driver.joints)}.")
        if missing := [name for name in contract.joints if name not in driver.joints]:
            raise UsageError(f"The policy moves the joint {missing[0]!r}, which the hand does not have.")
        self.actions = ActionMap(contract.moved, **{name: np.array(row) for name, row in contract.action_map.items()})
        """From actions to targets, as the policy was trained."""
        self._order = [driver.joints.index(name) for name in contract.joints]
        self._action = np.zeros(len(contract.moved), np.float32)
        self._targets: NDArray[np.float64] | None = None
        self._monitor = RateMonitor(self.rate, limits.rate_window)
        self.latency, self.processor = LatencyHistogram(), LatencyHistogram()
        self.limited = self.overruns = self.ticks = 0

    def run(self, seconds: float) -> Report:
        """Control for so many seconds, or until something is wrong; the hand is told to hold in the end."""
        check_duration(seconds)
        begun = self.clock()
        reason: str | None = "the control loop was interrupted"
        try:
            with self.link.watched():
                reason = self._wait()
                start = self.clock()
                due = start
                while reason is None and self.clock() - start < seconds:
                    before = self.clock()
                    reason = self._tick()
                    spent = self.clock() - before
                    self.overruns += spent > 1 / self.rate
                    # Due times lie on a fixed raster, so late ticks do not lower the rate; after a long stall at most
                    # one is made up for.
                    due = max(due + 1 / self.rate, self.clock() - 1 / self.rate)
                    self.clock.sleep(max(0.0, due - self.clock()))
        finally:
            # Whatever happened, an exception included: the hand holds.
            self.link.stop()
            if reason:
                _log.warning("Safe stop: %s.", reason)
        elapsed = self.clock() - begun
        return Report(
            "stopped" if reason else "finished", reason or "", self.ticks, elapsed, self.latency.summary(),
            self.processor.summary(), self.ticks / elapsed if elapsed > 0 else math.nan, self.overruns, self.limited,
            dict(vars(self.driver.counters)),
        )  # fmt: skip

    def _wait(self) -> str | None:
        start = self.clock()
        while self.link.read() is None:
            if self.clock() - start > self.limits.start_timeout:
                return f"the hand said nothing for {self.limits.start_timeout:g} s"
            self.clock.sleep(0.005)
        return None

    def _tick(self) -> str | None:
        """Do a control step; return why the session must stop, or None."""
        begun, busy = self.clock(), time.thread_time()
        reading = self.link.read()
        if reading is None:
            return "the hand gave no report"
        reason, rate = self.link.fault(reading), self._monitor.tick(begun)
        if reason is None and rate < self.limits.rate_share * self.rate:
            reason = f"control runs at {rate:.1f} Hz instead of {self.rate:g}"
        if reason is not None:
            return reason
        deadline = self.link.deadline(reading)
        obs = self._observe(reading)
        if fault := next((name for name, value in obs.items() if not np.isfinite(value).all()), None):
            return f"the observation {fault!r} holds values that are no numbers"
        action = np.asarray(self.run_policy(obs, self.ticks == 0))
        if action.shape != self._action.shape:
            return f"the policy gave actions of shape {action.shape} instead of {self._action.shape}"
        if not np.isfinite(action).all():
            return "the policy gave values that are no numbers"
        if (limit := self.contract.action_limit) is not None:
            # What counts and is observed as the last action, as in training (``Task.action_limit``).
            action = np.clip(action, -limit, limit)
        self._action = action.astype(np.float32)
        moved = zip(self.contract.moved, self.actions.targets(action).tolist(), strict=True)
        targets = self._limit({**self.contract.frozen, **dict(moved)}, reading)
        # Whatever took its time since the report was read: sources, the policy, or this computer.
        if (reason := self.link.send(Command(targets, reading, deadline))) is not None:
            return reason
        self.latency.append(self.clock() - begun)
        self.processor.append(time.thread_time() - busy)
        self.ticks += 1
        if self.record is not None:
            self.record(reading, obs, action, targets)
        return None

    def _observe(self, reading: HandReading) -> dict[str, NDArray[np.float32]]:
        position, velocity = reading.position[self._order], reading.velocity[self._order]
        proprio = np.concatenate([position, VELOCITY * velocity, self._action]).astype(np.float32)
        groups = {name: np.asarray(source(reading), np.float32) for name, source in self.sources.items()}
        return {name: groups.get(name, proprio) for name in self.contract.inputs}

    def _limit(self, targets: Mapping[str, float], reading: HandReading) -> NDArray[np.float64]:
        """Return the targets [J] within the limits of speed and position; joints without one stay."""
        wanted = np.array([targets.get(name, reading.position[i]) for i, name in enumerate(self.driver.joints)])
        # The speed limit runs from target to target: measured from the joints, a load that holds them would slow the
        # targets.
        before = reading.position if self._targets is None else self._targets
        self._targets = self.limits.limit(wanted, before, 1 / self.rate)
        self.limited += bool(np.any(np.abs(self._targets - wanted) > 1e-9))
        return self._targets
