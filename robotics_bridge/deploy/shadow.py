"""Simulated touch beside a real hand: joints follow the reports, skin gives what the real one does not measure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from robotics_bridge.deploy.driver import HandReading
from robotics_bridge.deploy.simulated_hand import SimulatedHand


class ShadowTouch:
    """The tactile group [S, N, C] of a simulated hand that holds a ball and follows the reported joints.

    What lies in the real hand is not known to it: the ball stands for the object, so touch that is not measured is a
    guess.

    Args:
        hand: Name of the hand.
        observe: Observation type of the policy.
        placement: Of its taxels.
        resolution: Of its taxels.
        joints: Names of the joints in the order of the reports.
        rate: Control steps per second.
        sub_steps: S.
    """

    def __init__(
        self,
        hand: str,
        observe: str,
        placement: str,
        resolution: str,
        *,
        joints: tuple[str, ...],
        rate: float = 40.0,
        sub_steps: int = 5,
    ) -> None:
        self.sub_steps = sub_steps
        self.hand = SimulatedHand(hand, rate * sub_steps, observe=observe, placement=placement, resolution=resolution)
        self._order = [joints.index(name) for name in self.hand.joints]

    def __call__(self, reading: HandReading) -> NDArray[np.float32]:
        """Advance by one control step towards the reported joints and return what is felt on the way."""
        self.hand.drive(reading.position[self._order])
        felt = []
        for _ in range(self.sub_steps):
            self.hand.step()
            felt.append(self.hand.touch().copy())
        return np.stack(felt)
