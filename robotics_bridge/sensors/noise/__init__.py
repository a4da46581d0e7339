"""Noise of readings: ``model`` holds the knobs of a sensor, ``stages`` applies them to whole readings.

Sensors that fuse the noise into their own kernels call the functions of ``kernels.noise``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports
from robotics_bridge.sensors.noise.model import PRESETS, Noise

if TYPE_CHECKING:
    from robotics_bridge.sensors.noise.stages import simulate

__all__ = ["PRESETS", "Noise", "simulate"]

__getattr__, __dir__ = lazy_exports(__name__)
