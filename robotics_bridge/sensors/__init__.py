"""Tactile sensors: frozen configurations, one :class:`SensorSuite` that reads them all, and a noise model.

An update lists what each link meets (``queries``), then every kind of sensor reads it (``probes``, ``taxels``,
``temperature``, ``audio``) by its ``kernels``, and ``noise`` turns the truth into a measurement. ``calibration`` fits
the noise to a real device, ``afferents`` splits signals into the bands of the hand's nerves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from robotics_bridge.sensors.afferents import AfferentFilter
    from robotics_bridge.sensors.audio.runtime import Microphone
    from robotics_bridge.sensors.audio.sensors import ActuationAudio, ContactAudio
    from robotics_bridge.sensors.noise.model import Noise
    from robotics_bridge.sensors.probes.placement import Probes
    from robotics_bridge.sensors.probes.sensors import ContactDepthProbe, ContactProbe, SurfaceDistanceProbe
    from robotics_bridge.sensors.sensor import Fidelity
    from robotics_bridge.sensors.suite import SensorSuite
    from robotics_bridge.sensors.taxels.sensors import ElastomerTaxel, KinematicTaxel, ProximityTaxel
    from robotics_bridge.sensors.temperature.grid import TemperatureGrid

__all__ = [
    "ActuationAudio",
    "AfferentFilter",
    "ContactAudio",
    "ContactDepthProbe",
    "ContactProbe",
    "ElastomerTaxel",
    "Fidelity",
    "KinematicTaxel",
    "Microphone",
    "Noise",
    "Probes",
    "ProximityTaxel",
    "SensorSuite",
    "SurfaceDistanceProbe",
    "TemperatureGrid",
]

__getattr__, __dir__ = lazy_exports(__name__)
