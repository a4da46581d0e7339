"""What an action means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class ActionMap:
    """How actions become targets of the position drives: target = clip(default + scale · action, low, high)."""

    names: tuple[str, ...]
    """Joints A."""
    default: np.ndarray
    """[A] (rad)."""
    scale: np.ndarray
    low: np.ndarray
    high: np.ndarray

    def targets(self, action: np.ndarray) -> np.ndarray:
        """Return the targets [..., A] (rad) of actions [..., A]."""
        return np.clip(self.default + self.scale * action, self.low, self.high)
