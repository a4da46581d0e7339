"""Tactile sensors: frozen configurations, one :class:`SensorSuite` that reads them all, and a noise model."""

from __future__ import annotations

from robotics_bridge.sensors._base import Sensor
from robotics_bridge.sensors.audio import ActuationAudio, ContactAudio, joint_drive
from robotics_bridge.sensors.audio_materials import Modes
from robotics_bridge.sensors.audio_microphone import Microphone
from robotics_bridge.sensors.elastomer import ElastomerTaxel, Layer
from robotics_bridge.sensors.fidelity import Fidelity
from robotics_bridge.sensors.filters import AfferentFilter, Band
from robotics_bridge.sensors.kinematic import KinematicTaxel
from robotics_bridge.sensors.modes import Solid, find_modes
from robotics_bridge.sensors.noise import Noise
from robotics_bridge.sensors.placement import Probes
from robotics_bridge.sensors.probes import ContactDepthProbe, ContactProbe, SurfaceDistanceProbe
from robotics_bridge.sensors.proximity import ProximityTaxel
from robotics_bridge.sensors.suite import SensorSuite
from robotics_bridge.sensors.temperature import TemperatureGrid, link_temperature
from robotics_bridge.sensors.thermal_materials import Body, ThermalMaterial

__all__ = [
    "ActuationAudio",
    "AfferentFilter",
    "Band",
    "Body",
    "ContactAudio",
    "ContactDepthProbe",
    "ContactProbe",
    "ElastomerTaxel",
    "Fidelity",
    "KinematicTaxel",
    "Layer",
    "Microphone",
    "Modes",
    "Noise",
    "Probes",
    "ProximityTaxel",
    "Sensor",
    "SensorSuite",
    "Solid",
    "SurfaceDistanceProbe",
    "TemperatureGrid",
    "ThermalMaterial",
    "find_modes",
    "joint_drive",
    "link_temperature",
]
