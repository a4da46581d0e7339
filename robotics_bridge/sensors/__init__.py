"""Tactile sensors: frozen configurations, one :class:`SensorSuite` that reads them all, and a noise model."""

from __future__ import annotations

from robotics_bridge.sensors._base import Sensor
from robotics_bridge.sensors.elastomer import ElastomerTaxel, Layer
from robotics_bridge.sensors.kinematic import KinematicTaxel
from robotics_bridge.sensors.noise import Noise
from robotics_bridge.sensors.placement import Probes
from robotics_bridge.sensors.probes import ContactDepthProbe, ContactProbe, SurfaceDistanceProbe
from robotics_bridge.sensors.proximity import ProximityTaxel
from robotics_bridge.sensors.suite import SensorSuite

__all__ = [
    "ContactDepthProbe",
    "ContactProbe",
    "ElastomerTaxel",
    "KinematicTaxel",
    "Layer",
    "Noise",
    "Probes",
    "ProximityTaxel",
    "Sensor",
    "SensorSuite",
    "SurfaceDistanceProbe",
]
