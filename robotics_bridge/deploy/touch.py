"""The tactile observation on a real hand: what the hand measures where it can, the simulated reading elsewhere.

The simulator's layout [S, N, C] is kept (thesis, section 4.3.5): one value per finger fills all S slots of its link.
``agg_force`` takes the scaled contact pressure itself, ``agg_bool`` whether its magnitude exceeds a threshold (4.31).
Types with one value per taxel have no faithful counterpart on the XHand1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError, check_each
from brainbench.core.reading.ranges import check_fields, check_number
from robotics_bridge import hands
from robotics_bridge.deploy.driver import HandReading, Source
from robotics_bridge.policies.contract import PolicyContract

REAL_TYPES = ("agg_bool", "agg_force")
"""Observation types that a real hand can measure."""
LARGEST_SCALE = 1e6
"""Largest scale or threshold of a pressure calibration."""


@dataclass(frozen=True)
class PressureCalibration:
    """From the maker's contact pressure to the simulator's ``agg_force``; the published values."""

    scale: float = 1000.0
    """``agg_force`` of one unit of the maker's contact pressure."""
    per_finger: Mapping[str, float] = field(default_factory=dict)
    """Finger → scale of its own."""
    axes: tuple[float, float, float] = (-1.0, -1.0, 1.0)
    """Factor per axis: the hand reports x and y with the opposite sign."""
    threshold: float = 0.05
    """Contact pressure, in the maker's unit, above which a finger touches (η_real of 4.31)."""

    def __post_init__(self) -> None:
        of = "'{}' of a pressure calibration"
        check_fields(self, "threshold", of=of, above=0, most=LARGEST_SCALE)
        check_fields(self, "axes", of=of, items=3)
        factors = [("scale", self.scale), *self.per_finger.items(), *(("axes", factor) for factor in self.axes)]
        for name, factor in factors:
            told = of.replace("{}", name)
            check_number(told, factor, least=-LARGEST_SCALE, most=LARGEST_SCALE)
            if factor == 0:
                raise UsageError(f"{told} must not be 0; received {factor}.")

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
