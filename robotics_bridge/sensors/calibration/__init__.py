"""Noise knobs fitted to a recording of a real device.

``log`` reads it, ``delays`` and ``likelihood`` fit, ``calibrate`` decides and reports.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from robotics_bridge.sensors.calibration.calibrate import Calibration, describe
    from robotics_bridge.sensors.calibration.log import Log, read_log

__all__ = ["Calibration", "Log", "describe", "read_log"]

__getattr__, __dir__ = lazy_exports(
    __name__, {"Calibration": ".calibrate", "Log": ".log", "describe": ".calibrate", "read_log": ".log"}
)
