"""PPO of rsl_rl whose adaptive learning rate has bounds of its own."""

from __future__ import annotations

from typing import Any

from rsl_rl.algorithms import PPO


class BoundedPPO(PPO):
    """rsl_rl's PPO, but that the learning rate stays within a range (rsl_rl's own is 1e-5 to 1e-2)."""

    def __init__(self, *parts: Any, learning_rate_range: tuple[float, float], **settings: Any) -> None:
        self._range = learning_rate_range
        super().__init__(*parts, **settings)

    @property
    def learning_rate(self) -> float:
        """Present learning rate."""
        return self._rate

    @learning_rate.setter
    def learning_rate(self, value: float) -> None:
        low, high = self._range
        self._rate = min(max(value, low), high)
