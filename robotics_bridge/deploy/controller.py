"""The control loop of a deployed policy: read, check, decide, limit, send; stop safely when anything is wrong.

A stop is final for the session: the hand holds where it is, and the reason is kept in words.
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_each
from brainbench.core.reading.ranges import check_number
from robotics_bridge.deploy.driver import Driver, HandReading, Source
from robotics_bridge.deploy.safety import ClockOffset, SafetyLimits
from robotics_bridge.deploy.timing import LatencyHistogram, RateMonitor
from robotics_bridge.envs import ActionMap
from robotics_bridge.envs.observations import VELOCITY
from robotics_bridge.policies.contract import RATE, PolicyContract
from robotics_bridge.policies.runners import Runner

_log = logging.getLogger(__name__)


class Clock:
    """The time of a control loop; tests have one of their own."""

    def __call__(self) -> float:
        """Return the time (s)."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


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
            :class:`~robotics_bridge.deploy.touch.RealTouch`.
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
        check_number("control steps per second", contract.rate, least=RATE[0], most=RATE[1])
        self.rate, self.sources, self.clock, self.record = contract.rate, dict(sources or {}), clock or Clock(), record
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
        self._offset, self._monitor = ClockOffset(), RateMonitor(self.rate, limits.rate_window)
        self.latency, self.processor = LatencyHistogram(), LatencyHistogram()
        self.limited = self.overruns = self.ticks = 0

    def run(self, seconds: float) -> Report:
        """Control for so many seconds, or until something is wrong; the hand is told to hold in the end."""
        check_duration(seconds)
        begun = self.clock()
        reason: str | None = "the control loop was interrupted"
        try:
            reason = self._wait()
            start = self.clock()
            due = start
            while reason is None and self.clock() - start < seconds:
                before = self.clock()
                reason = self._tick(before)
                spent = self.clock() - before
                self.overruns += spent > 1 / self.rate
                # Due times lie on a fixed raster, so late ticks do not lower the rate; after a long stall at most one
                # is made up for.
                due = max(due + 1 / self.rate, self.clock() - 1 / self.rate)
                self.clock.sleep(max(0.0, due - self.clock()))
        finally:
            # Whatever happened, an exception included: the hand holds.
            self.driver.stop()
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
        while self.driver.read() is None:
            if self.clock() - start > self.limits.start_timeout:
                return f"the hand said nothing for {self.limits.start_timeout:g} s"
            self.clock.sleep(0.005)
        return None

    def _tick(self, now: float) -> str | None:
        busy = time.thread_time()
        reading = self.driver.read()
        if reading is None:
            return "the hand gave no report"
        reason = self.limits.fault(reading, self._offset.age(reading.time, reading.arrived, now))
        rate = self._monitor.tick(now)
        if reason is None and rate < self.limits.rate_share * self.rate:
            reason = f"control runs at {rate:.1f} Hz instead of {self.rate:g}"
        if reason is not None:
            return reason
        obs = self._observe(reading)
        if fault := next((name for name, value in obs.items() if not np.isfinite(value).all()), None):
            return f"the observation {fault!r} holds values that are no numbers"
        action = np.asarray(self.run_policy(obs, self.ticks == 0))
        if action.shape != self._action.shape:
            return f"the policy gave actions of shape {action.shape} instead of {self._action.shape}"
        if not np.isfinite(action).all():
            return "the policy gave values that are no numbers"
        if (limit := self.contract.more.get("action_limit")) is not None:
            # What counts and is observed as the last action, as in training (``Task.action_limit``).
            action = np.clip(action, -limit, limit)
        self._action = action.astype(np.float32)
        moved = zip(self.contract.moved, self.actions.targets(action).tolist(), strict=True)
        targets = self._limit({**self.contract.frozen, **dict(moved)}, reading)
        # The last look before anything moves, whatever the parts before it did.
        if not self.limits.allows(targets):
            return "a command would be no numbers or beyond the joints' limits"
        self.driver.send(targets)
        self.latency.append(self.clock() - now)
        self.processor.append(time.thread_time() - busy)
        self.ticks += 1
        if self.record is not None:
            self.record(reading, obs, action, targets)
        return None

    def _observe(self, reading: HandReading) -> dict[str, NDArray[np.float32]]:
        position, velocity = reading.position[self._order], reading.velocity[self._order]
        proprio = np.concatenate([position, VELOCITY * velocity, self._action]).astype(np.float32)
        found = {name: np.asarray(source(reading), np.float32) for name, source in self.sources.items()}
        return {name: found.get(name, proprio) for name in self.contract.inputs}

    def _limit(self, targets: Mapping[str, float], reading: HandReading) -> NDArray[np.float64]:
        wanted = np.array([targets.get(name, reading.position[i]) for i, name in enumerate(self.driver.joints)])
        # The speed limit runs from target to target: measured from the joints, a load that holds them would slow the
        # targets.
        before = reading.position if self._targets is None else self._targets
        self._targets = self.limits.limit(wanted, before, 1 / self.rate)
        self.limited += bool(np.any(np.abs(self._targets - wanted) > 1e-9))
        return self._targets
