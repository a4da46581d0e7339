"""A session of an exported policy on a hand, from two files: what the hand measures becomes what the policy reads."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, check_each, listing
from brainbench.core.files import file_hash
from brainbench.core.limits import Limit, check_value, limited
from robotics_bridge import hands
from robotics_bridge.deploy.controller import (
    Controller,
)
from robotics_bridge.deploy.driver import Driver, HandReading, Source
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.export import read_policy
from robotics_bridge.tasks.task import check_measured

REAL_TYPES = ("agg_bool", "agg_force")  # observation types that a real hand can measure
LARGEST_SCALE = 1e6  # largest scale or threshold of a pressure calibration
_Scale = Annotated[float, Limit(least=-LARGEST_SCALE, most=LARGEST_SCALE)]


@dataclass(frozen=True)
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
        for name, factor in self.per_finger.items():
            check_value(f"'{name}' of a pressure calibration", factor, _Scale)
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
        scales = np.array([self.per_finger.get(finger, self.scale) for finger in fingers])
        return force / (scales[:, None] * np.array(self.axes))


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
