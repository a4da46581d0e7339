"""An exported policy on a hand, from its two files: the network and its contract."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.core.files import read_json
from robotics_bridge import hands
from robotics_bridge.deploy.controller import Actuation, Controller, Source
from robotics_bridge.deploy.driver import Driver
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.deploy.touch import Fallback, PressureCalibration, RealTouch
from robotics_bridge.policies.export import read_policy


@dataclass(frozen=True)
class DeployedPolicy:
    """An exported policy with what a robot needs to run it."""

    path: Path
    format: str
    groups: Mapping[str, tuple[int, ...]]
    """Group → shape of what it reads."""
    deployment: Mapping[str, Any]
    """Rate, hand, joints, links, from actions to targets."""

    @property
    def rate(self) -> float:
        """Control steps per second."""
        return float(self.deployment["rate"])

    @property
    def hand(self) -> str:
        """Name of the hand that it was trained on."""
        return str(self.deployment["hand"])

    def controller(
        self,
        driver: Driver,
        *,
        limits: Mapping[str, float] | None = None,
        sources: Mapping[str, Source] | None = None,
        calibration: PressureCalibration | None = None,
        fallback: Fallback | None = None,
        threads: int | None = 1,
        **settings: Any,
    ) -> Controller:
        """Return the control loop of this policy on a hand.

        Args:
            driver: The hand.
            limits: Changes of :class:`~robotics_bridge.deploy.safety.SafetyLimits`, such as ``timeout``.
            sources: Group → what gives it, such as the goal.
            calibration: Of the hand's pressure.
            fallback: Simulated touch where the hand senses nothing.
            threads: Of the network's computations.
            **settings: Further arguments of :class:`~robotics_bridge.deploy.controller.Controller`.

        Raises:
            UsageError: the hand or the sources do not fit the policy.
        """
        body = hands.load(self.hand)
        sources = dict(sources or {})
        if "tactile" in self.groups:
            slots, items, channels = self.groups["tactile"]
            tips = {chain[-1]: finger for finger, chain in body.fingers.items()}
            sources["tactile"] = RealTouch(
                str(self.deployment["observe"]), tuple(self.deployment["links"]), (slots, items, channels), tips=tips,
                fingers=driver.fingers, calibration=calibration, fallback=fallback,
            )  # fmt: skip
        safe = SafetyLimits.of_hand(body, driver.joints, **dict(limits or {}))
        run = read_policy(self.path, self.groups, format=self.format, threads=threads)
        return Controller(
            run, driver, Actuation.of(self.deployment), safe, groups=tuple(self.groups), rate=self.rate,
            sources=sources, **settings,
        )  # fmt: skip


def read_deployed(path: str | Path) -> DeployedPolicy:
    """Read an exported policy's contract, which lies beside the file as ``FILE.json``.

    Raises:
        DataFileNotFoundError: the file or its contract is missing.
        DataError: the contract is of another kind.
        UsageError: the contract does not say what a hand needs; export the policy from a trained run.
    """
    path = Path(path)
    contract = path.with_name(f"{path.name}.json")
    for file in (path, contract):
        if not file.is_file():
            raise DataFileNotFoundError(
                f"There is no file {str(file)!r}; brainbench policy export writes a policy and its contract."
            )
    found = read_json(contract)
    if not isinstance(found, dict) or not {"inputs", "format", "deployment"} <= set(found):
        raise DataError(f"{str(contract)!r} is not the contract of a policy.")
    groups = {name: tuple(int(size) for size in shape) for name, shape in found["inputs"]}
    missing = {"rate", "hand", "joints", "action_map", "frozen"} - set(found["deployment"])
    if missing:
        raise UsageError(
            f"The contract {contract.name!r} does not say {sorted(missing)[0]!r}, so no hand can run the policy; "
            "export it from a trained run."
        )
    return DeployedPolicy(path, str(found["format"]), groups, found["deployment"])


def constant(values: Any, size: int) -> Source:
    """Return a source that always gives the same numbers, such as a goal that does not change.

    Raises:
        UsageError: there are not as many numbers as the policy reads.
    """
    array = np.asarray(values, np.float32).reshape(-1)
    if len(array) != size:
        raise UsageError(f"The policy reads {size} numbers here; received {len(array)}.")
    return lambda reading: array
