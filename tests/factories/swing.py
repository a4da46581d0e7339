"""Motions of a follicle that engines must follow."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

FLAT = (math.pi / 2, 0.0, -math.pi / 2)
"""Angles of a whisker along +x."""


@dataclass(frozen=True)
class _Motion:
    angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rest: tuple[float, float, float] = FLAT


@dataclass(frozen=True)
class Swing(_Motion):
    """Angles and displacement that swing out smoothly and stay: amplitude × 6u⁵ − 15u⁴ + 10u³."""

    duration: float = 0.04

    def pose(self, times):
        u = np.clip(times / self.duration, 0, 1)[:, None]
        ramp = u**3 * (10 - 15 * u + 6 * u**2)
        return ramp * np.array(self.shift), ramp * np.array(self.angles) + np.array(self.rest)


@dataclass(frozen=True)
class Oscillation(_Motion):
    """Sinusoidal angles (rad) about a rest pose and a sinusoidal displacement (m) at ``frequency`` (Hz)."""

    frequency: float = 20.0

    def pose(self, times):
        phase = 2 * np.pi * self.frequency * times
        euler = np.sin(phase)[:, None] * np.array(self.angles) + np.array(self.rest)
        return np.sin(phase + 0.3)[:, None] * np.array(self.shift), euler
