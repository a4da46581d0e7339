"""Tactile sensors: frozen configurations, one :class:`SensorSuite` that reads them all, and a noise model.

An update lists what each link meets (``queries``), then every kind of sensor reads it (``probes``, ``taxels``,
``elastomer``, ``temperature``, ``audio``), and ``noise`` turns the truth into a measurement. ``calibration`` fits the
noise to a real device, ``afferents`` splits signals into the bands of the hand's nerves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from robotics_bridge.sensors.afferents import AfferentFilter, Band
    from robotics_bridge.sensors.audio.materials import Modes
    from robotics_bridge.sensors.audio.microphone import Microphone
    from robotics_bridge.sensors.audio.modes import ElasticSolid, find_modes
    from robotics_bridge.sensors.audio.sensors import ActuationAudio, ContactAudio, joint_drive
    from robotics_bridge.sensors.elastomer.taxel import ElastomerTaxel, Layer
    from robotics_bridge.sensors.fidelity import Fidelity, SensorFidelity
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
    "Fidelity",
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

_MODULES = {
    ".afferents": ("AfferentFilter", "Band"),
    ".audio.materials": ("Modes",),
    ".audio.microphone": ("Microphone",),
    ".audio.modes": ("ElasticSolid", "find_modes"),
    ".audio.sensors": ("ActuationAudio", "ContactAudio", "joint_drive"),
    ".elastomer.taxel": ("ElastomerTaxel", "Layer"),
    ".fidelity": ("Fidelity", "SensorFidelity"),
    ".noise.model": ("Noise",),
    ".probes.placement": ("Probes",),
    ".probes.sensors": ("ContactDepthProbe", "ContactProbe", "SurfaceDistanceProbe"),
    ".sensor": ("Sensor",),
    ".suite": ("SensorSuite",),
    ".taxels.kinematic": ("KinematicTaxel",),
    ".taxels.proximity": ("ProximityTaxel",),
    ".temperature.grid": ("TemperatureGrid", "link_temperature"),
    ".temperature.materials": ("ThermalBody", "ThermalMaterial"),
}
__getattr__, __dir__ = lazy_exports(__name__, {name: path for path, names in _MODULES.items() for name in names})
