"""The loop of a session on a hand: it reads, checks, decides, limits and sends, at a steady rate.

A stop is final for the session: the hand holds where it is, and the reason is kept in words. A session of an exported
policy is made from two files; what the hand measures becomes what the policy reads.
"""

from __future__ import annotations

import contextlib
import gc
import logging
import math
import os
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, check_each, check_number, listing
from brainbench.core.files import file_hash
from brainbench.core.limits import Limit, limited
from robotics_bridge import hands
from robotics_bridge.deploy.driver import Clock, Driver, HandReading, Source
from robotics_bridge.deploy.safety import SafeLink, SafetyLimits
from robotics_bridge.envs.step import VELOCITY
from robotics_bridge.policies.contract import RATE, PolicyContract
from robotics_bridge.policies.export import Runner, read_policy
from robotics_bridge.tasks import list_tasks, load
from robotics_bridge.tasks.task import check_measured

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
        self._full = False

    def tick(self, now: float) -> float:
        """Count a tick; return the rate over the window [Hz], the nominal one until a window has passed."""
        # A window that is not full yet would count too few ticks and stop every session at its beginning.
        self._times.append(now)
        while self._times[0] <= now - self.window:
            self._times.popleft()
            self._full = True
        return len(self._times) / self.window if self._full else self.rate


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
    """Ticks per second from the first report on."""
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
            :class:`~robotics_bridge.deploy.controller.RealTouch`.
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
        self._order = [driver.joints.index(name) for name in contract.joints]
        self._action = np.zeros(len(contract.moved), np.float32)
        self._targets: NDArray[np.float64] | None = None
        self._limited = -math.inf  # time of these targets (s)
        self._monitor = RateMonitor(self.rate, limits.rate_window)
        self.latency, self.processor = LatencyHistogram(), LatencyHistogram()
        self.limited = self.overruns = self.ticks = 0

    def run(self, seconds: float) -> Report:
        """Control for so many seconds, or until something is wrong; the hand is told to hold in the end."""
        check_duration(seconds)
        begun = start = self.clock()
        reason: str | None = "the control loop was interrupted"
        try:
            with self.link.watched():
                reason = self._wait()
                due = start = self.clock()
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
        ended = self.clock()
        return Report(
            "stopped" if reason else "finished", reason or "", self.ticks, ended - begun, self.latency.summary(),
            self.processor.summary(), self.ticks / (ended - start) if ended > start else math.nan, self.overruns,
            self.limited, dict(vars(self.driver.counters)),
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
        moved = zip(self.contract.moved, self.contract.action_map.targets(action).tolist(), strict=True)
        targets, limited = self._limit({**self.contract.frozen, **dict(moved)}, reading)
        # Whatever took its time since the report was read: sources, the policy, or this computer.
        if (reason := self.link.send(targets, reading, deadline)) is not None:
            return reason
        self.latency.append(self.clock() - begun)
        self.processor.append(time.thread_time() - busy)
        self.ticks += 1
        self.limited += limited
        if self.record is not None:
            self.record(reading, obs, action, targets)
        return None

    def _observe(self, reading: HandReading) -> dict[str, NDArray[np.float32]]:
        position, velocity = reading.position[self._order], reading.velocity[self._order]
        proprio = np.concatenate([position, VELOCITY * velocity, self._action]).astype(np.float32)
        groups = {name: np.asarray(source(reading), np.float32) for name, source in self.sources.items()}
        return {name: groups.get(name, proprio) for name in self.contract.inputs}

    def _limit(self, targets: Mapping[str, float], reading: HandReading) -> tuple[NDArray[np.float64], bool]:
        """Return the targets [J] within the limits of speed and position, and whether these changed any.

        Joints without a target stay.
        """
        wanted = np.array([targets.get(name, reading.position[i]) for i, name in enumerate(self.driver.joints)])
        # The speed limit runs from target to target: measured from the joints, a load that holds them would slow the
        # targets.
        before = reading.position if self._targets is None else self._targets
        # Ticks that are made up for come at once: a target moves on for the time that has passed since the last.
        now = self.clock()
        self._targets = self.limits.limit(wanted, before, min(1 / self.rate, max(0.0, now - self._limited)))
        self._limited = now
        return self._targets, bool(np.any(np.abs(self._targets - wanted) > 1e-9))


REAL_TYPES = ("agg_bool", "agg_force")  # observation types that a real hand can measure
LARGEST_SCALE = 1e6  # largest scale or threshold of a pressure calibration
_Scale = Annotated[float, Limit(least=-LARGEST_SCALE, most=LARGEST_SCALE)]


@limited(of="'{}' of a pressure calibration")
class PressureCalibration:
    """From the maker's contact pressure to the simulator's ``agg_force``; the published values."""

    scale: _Scale = 1000.0
    """``agg_force`` of one unit of the maker's contact pressure."""
    per_finger: Mapping[str, _Scale] = field(default_factory=dict)
    """Finger → scale of its own."""
    axes: tuple[_Scale, _Scale, _Scale] = (-1.0, -1.0, 1.0)
    """Factor per axis: the hand reports x and y with the opposite sign."""
    threshold: Annotated[float, Limit(above=0, most=LARGEST_SCALE)] = 0.05
    """Contact pressure, in the maker's unit, above which a finger touches (η_real of 4.31)."""

    def __post_init__(self) -> None:
        factors = [("scale", self.scale), *self.per_finger.items(), *(("axes", factor) for factor in self.axes)]
        if zero := [name for name, factor in factors if factor == 0]:
            raise UsageError(f"{zero[0]!r} of a pressure calibration must not be 0; received 0.")

    def force(self, fingers: tuple[str, ...], pressure: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the simulator's ``agg_force`` [F, 3] of pressures [F, 3]."""
        scales = np.array([self.per_finger.get(finger, self.scale) for finger in fingers])
        # Linear per finger and axis; the pressure comes in a unit of the maker's, so its scale is calibrated.
        return pressure * scales[:, None] * np.array(self.axes)

    def pressure(self, fingers: tuple[str, ...], force: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the pressures [F, 3] that give an ``agg_force`` [F, 3]."""
        return force / self.force(fingers, np.ones_like(force))


class RealTouch:
    """Makes the tactile group of a policy from reports.

    Args:
        contract: Of the policy: what it observes on which links of its hand.
        fingers: Fingers whose tips the hand senses, in the order of the reports.
        calibration: From the maker's unit to the simulator's.
        fallback: Simulated group [S, N, C], used where the hand senses nothing; None leaves those items zero.
    """

    def __init__(
        self,
        contract: PolicyContract,
        fingers: tuple[str, ...],
        *,
        calibration: PressureCalibration | None = None,
        fallback: Source | None = None,
    ) -> None:
        self.observe, self.shape, self.fallback = contract.observe, contract.inputs["tactile"], fallback
        self.calibration, self.fingers = calibration or PressureCalibration(), fingers
        check_each("finger of a pressure calibration", self.calibration.per_finger, fingers)
        real = contract.observe in REAL_TYPES
        if not real and fallback is None:
            raise UsageError(
                f"A real hand cannot measure {contract.observe!r}, one value per taxel; deploy a policy that was "
                "trained on 'agg_force' or 'agg_bool', or simulate its touch beside the hand."
            )
        hand = hands.load(contract.hand)
        finger_of = dict(zip(hand.tips, hand.fingers, strict=True))
        sensed = [(item, finger_of.get(link, "")) for item, link in enumerate(contract.links if real else ())]
        self.measured = [(item, fingers.index(finger)) for item, finger in sensed if finger in fingers]

    def __call__(self, reading: HandReading) -> NDArray[np.float32]:
        """Return the tactile group [S, N, C]."""
        group = np.zeros(self.shape, np.float32)
        if self.fallback is not None:
            group[...] = self.fallback(reading)
        if self.measured:
            items, rows = (list(part) for part in zip(*self.measured, strict=True))
            if self.observe == "agg_bool":
                # agg_bool of a real hand: |f| > η_real (4.31).
                touching = np.linalg.norm(reading.pressure, axis=1) > self.calibration.threshold
                group[:, items, 0] = touching[rows]
            else:
                group[:, items] = self.calibration.force(self.fingers, reading.pressure)[rows]
        return group


LARGEST_INPUT = 1e6  # largest magnitude of a constant in place of an observation
_MEANINGS = {
    "thermal": "temperatures of the skin",
    "command": "what the hand is told",
    "link_pose": "poses of the tactile links",
}


@dataclass(frozen=True)
class DeployedPolicy:
    """An exported policy with what a robot needs to run it."""

    path: Path
    contract: PolicyContract

    def require(self, given: Collection[str], fingers: Sequence[str] | None = None) -> dict[str, str]:
        """Return group → what a hand with these sensing fingers (all by default) cannot measure of it, in words."""
        contract = self.contract
        check_measured(contract.inputs, "A policy on a hand")
        # Contracts of earlier versions name the task alone.
        if contract.starts or (contract.task in list_tasks() and load(contract.task).starts):
            raise UsageError(
                f"The policy was trained on {str(contract.task)[:80]!r}, whose episodes begin with sampled grasps; its "
                "actions are counted from each, and no hand tells its own: run it in the simulation (policy play)."
            )
        # What is told to the hand is no measurement; a contract that states it needs no word of the user.
        answered = ("proprio", "tactile", *(("command",) if contract.command is not None else ()))
        unmeasured = {
            name: f"{list(shape)}, {_MEANINGS.get(name, 'known to the simulation alone')}"
            for name, shape in contract.inputs.items()
            if name not in answered
        }
        chains = hands.load(contract.hand).fingers
        tips = {chain[-1] for finger, chain in chains.items() if fingers is None or finger in fingers}
        if blind := [link for link in contract.links if contract.observe not in REAL_TYPES or link not in tips]:
            unmeasured["tactile"] = f"{contract.observe!r} of {listing(blind, limit=3)}"
        if missing := [f"{name} ({what})" for name, what in unmeasured.items() if name not in given]:
            raise UsageError(
                f"The policy was trained with what the hand cannot measure: {'; '.join(missing)}. Give each a constant "
                "with --input NAME=NUMBER,NUMBER… (touch also with --shadow)."
            )
        return unmeasured

    def controller(
        self,
        driver: Driver,
        *,
        limits: Mapping[str, float] | None = None,
        sources: Mapping[str, Source] | None = None,
        calibration: PressureCalibration | None = None,
        fallback: Source | None = None,
        threads: int | None = 1,
        **settings: Any,
    ) -> Controller:
        """Return the control loop of this policy on a hand.

        Args:
            driver: The hand.
            limits: Changes of :class:`~robotics_bridge.deploy.safety.SafetyLimits`, such as ``timeout``.
            sources: Group → what gives it, for every group of :meth:`require` but ``tactile``.
            calibration: Of the hand's pressure.
            fallback: Simulated or constant touch where the hand senses nothing.
            threads: Of the network's computations.
            **settings: Further arguments of :class:`~robotics_bridge.deploy.controller.Controller`.
        """
        contract, body, sources = self.contract, hands.load(self.contract.hand), dict(sources or {})
        inputs = contract.inputs
        self.require({*sources, *(("tactile",) if fallback is not None else ())}, driver.fingers)
        if "tactile" in sources:
            raise UsageError("Touch is measured; give what stands in where it is not as fallback, not among sources.")
        if "tactile" not in inputs and (calibration is not None or fallback is not None):
            raise UsageError("The policy reads no touch, so a calibration or fallback of it reaches nothing.")
        if "command" in inputs and contract.command is not None:
            sources.setdefault("command", constant("command", contract.command, inputs["command"]))
        if "tactile" in inputs:
            sources["tactile"] = RealTouch(contract, driver.fingers, calibration=calibration, fallback=fallback)
        safe = SafetyLimits.of_hand(body, driver.joints, **dict(limits or {}))
        run = read_policy(self.path, inputs, threads=threads, actions=len(contract.moved))
        return Controller(run, driver, contract, safe, sources=sources, **settings)


def read_deployed(path: str | Path) -> DeployedPolicy:
    """Read an exported policy's contract, which lies beside the file as ``FILE.json``."""
    path = Path(path)
    contract = path.with_name(f"{path.name}.json")
    for file in (path, contract):
        if not file.is_file():
            raise DataFileNotFoundError(
                f"There is no file {str(file)!r}; brainbench policy export writes a policy and its contract."
            )
    stated = PolicyContract.read(contract)
    if stated.sha256 and stated.sha256 != file_hash(path, length=64):
        raise DataError(f"{str(path)!r} is not the file that its contract describes; export the policy again.")
    return DeployedPolicy(path, stated)


def constant(name: str, values: Sequence[float], shape: tuple[int, ...]) -> Source:
    """Return a source that always gives a group the same numbers, such as a command: one for all, or one for each."""
    size, given = math.prod(shape), np.asarray(values, np.float64).reshape(-1)
    if len(given) not in (1, size) or not (np.abs(given) <= LARGEST_INPUT).all():
        raise UsageError(
            f"The policy reads {size} numbers of {name!r}, from {-LARGEST_INPUT:g} to {LARGEST_INPUT:g}: give one for "
            f"all, or {size}; received {str(list(values))[:80]}."
        )
    array = np.broadcast_to(given if len(given) == 1 else given.reshape(shape), shape).astype(np.float32)
    return lambda reading: array
