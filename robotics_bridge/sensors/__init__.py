"""Tactile sensors: frozen configurations, one :class:`SensorSuite` that reads them all, and a noise model."""

from __future__ import annotations

from robotics_bridge.sensors.afferents import AfferentFilter, Band
from robotics_bridge.sensors.audio.materials import Modes
from robotics_bridge.sensors.audio.microphone import Microphone
from robotics_bridge.sensors.audio.modes import ElasticSolid, find_modes
from robotics_bridge.sensors.audio.sensors import ActuationAudio, ContactAudio, joint_drive
from robotics_bridge.sensors.elastomer.taxel import ElastomerTaxel, Layer
from robotics_bridge.sensors.fidelity import SensorFidelity
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.probes.placement import Probes
from robotics_bridge.sensors.probes.sensors import ContactDepthProbe, ContactProbe, SurfaceDistanceProbe
from robotics_bridge.sensors.sensor import Sensor
from robotics_bridge.sensors.suite import SensorSuite
from robotics_bridge.sensors.taxels.kinematic import KinematicTaxel
from robotics_bridge.sensors.taxels.proximity import ProximityTaxel
from robotics_bridge.sensors.temperature.grid import TemperatureGrid, link_temperature
from robotics_bridge.sensors.temperature.materials import ThermalBody, ThermalMaterial

__all__ = [
    "ActuationAudio",
    "AfferentFilter",
    "Band",
    "ContactAudio",
    "ContactDepthProbe",
    "ContactProbe",
    "ElasticSolid",
    "ElastomerTaxel",
    "KinematicTaxel",
    "Layer",
    "Microphone",
    "Modes",
    "Noise",
    "Probes",
    "ProximityTaxel",
    "Sensor",
    "SensorFidelity",
    "SensorSuite",
    "SurfaceDistanceProbe",
    "TemperatureGrid",
    "ThermalBody",
    "ThermalMaterial",
    "find_modes",
    "joint_drive",
    "link_temperature",
]
