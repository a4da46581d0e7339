"""Closed forms that sensors are held against on a machine, for ``brainbench tactile check``.

Each check takes a device and returns (found, truth, relative tolerance).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import torch

from robotics_bridge import hands
from robotics_bridge.hands import layouts
from robotics_bridge.physics import Geometry, HandState, TouchScene
from robotics_bridge.sensors import (
    ContactAudio,
    ContactDepthProbe,
    KinematicTaxel,
    Noise,
    Probes,
    SensorSuite,
    SurfaceDistanceProbe,
    TemperatureGrid,
)
from robotics_bridge.sensors.audio.modes import find_modes
from robotics_bridge.sensors.audio.sensors import ElasticMaterial, Modes
from robotics_bridge.sensors.noise.stages import simulate
from robotics_bridge.sensors.sensor import Sensor
from robotics_bridge.sensors.temperature.materials import ThermalMaterial

Result = tuple[float, float, float]
_GAP = math.hypot(0.003, 0.03) - 0.02
"""Distance (m) of a probe 3 mm off the middle of the pad from a ball of 20 mm, 10 mm above it."""
_OVERLAP = 0.004 - (math.hypot(0.003, 0.018) - 0.02)
"""Depth (m) of a probe of 4 mm there when the ball is pressed in by 2 mm."""


def _felt(device: str, sensor: Sensor, *, depth: float = 2e-3, steps: int = 1) -> torch.Tensor:
    """Return what a sensor reads on a pad at the origin, with a ball of 20 mm above it that overlaps by a depth."""
    shapes = (
        Geometry(name="pad", link="pad", kind="box", size=(0.02, 0.02, 0.005), position=(0, 0, -0.005)),
        Geometry(name="ball", link="ball", kind="sphere", size=(0.02,)),
    )
    suite = SensorSuite(TouchScene(("pad", "ball"), shapes), {"a": sensor}, num_envs=1, device=device)
    state = HandState.empty(1, 2, 4, device)
    pose = np.zeros((2, 7))
    pose[:, 3] = 1
    pose[1, 2] = 0.02 - depth
    state.set_pose(pose)
    if isinstance(sensor, ContactAudio):
        # A blow is a rise of force, so there must be an update before it.
        suite.update(state, 0.01)
    state.set_contacts(
        [0], [[0, 1]], distance=[-depth], position=[[0, 0, -depth / 2]], normal=[[0, 0, 1.0]], force=[1.0]
    )
    for _ in range(steps):
        suite.update(state, 0.01)
    return suite.read("a")


def _probe(radius: float) -> Probes:
    return Probes(np.array([[0.003, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([radius]))


def _distance(device: str) -> Result:
    return float(_felt(device, SurfaceDistanceProbe(link="pad", probes=_probe(1e-3)), depth=-0.01)), _GAP, 1e-5


def _depth(device: str) -> Result:
    return float(_felt(device, ContactDepthProbe(link="pad", probes=_probe(4e-3)))), _OVERLAP, 1e-4


def _force(device: str) -> Result:
    reading = _felt(device, KinematicTaxel(link="pad", probes=_probe(4e-3)))
    return float(reading[0, 0, :3].norm()), 500 * _OVERLAP**1.2, 1e-4


def _hysteresis(device: str) -> Result:
    noise = Noise(hysteresis=0.5, hysteresis_tau=0.05)
    return float(simulate(noise, np.full((5, 1, 1, 1), 0.03), dt=0.01, device=device)[-1, 0, 0, 0]), 0.036740, 1e-4


def _white(device: str) -> Result:
    return float(simulate(Noise(white=1.0), np.zeros((50, 16, 64, 6)), dt=0.01, device=device).std()), 1.0, 0.01


def _cooling(device: str) -> Result:
    grid = TemperatureGrid(
        link="pad", cells=(1, 1, 1), material=ThermalMaterial(1.0, 1000.0, 1000.0, 0.0), convection=100.0,
        base_temperature=60.0, radiates=False, contact_conductance=1e-9,
    )  # fmt: skip
    area, volume = 2 * (0.04 * 0.04 + 2 * 0.04 * 0.01), 0.04 * 0.04 * 0.01
    return float(_felt(device, grid, steps=500)) - 22, 38 * math.exp(-100 * area * 5 / (1e6 * volume)), 1e-3


def _tone(device: str) -> Result:
    heard = _felt(device, ContactAudio(link="pad", modes=Modes((1000.0,), (0.0,), (1.0,)), samples=320))
    spectrum = np.abs(np.fft.rfft(heard[0, 0].cpu().double().numpy(), 1 << 16))
    return float(np.argmax(spectrum)) * 32000 / (1 << 16), 1000.0, 0.02


def _beam(_device: str) -> Result:
    steel = ElasticMaterial(2e11, 0.3, 7850.0, 5.0, 3e-8)
    bar = Geometry(name="bar", link="bar", kind="box", size=(0.1, 0.005, 0.005))
    frequency = find_modes(bar, steel, count=2, cells=16, cache=False).frequency[0]
    return frequency, 4.730041**2 / (2 * math.pi * 0.2**2) * math.sqrt(2e11 * 1e-4 / 12 / 7850), 0.02


def _counts(_device: str) -> Result:
    hand_list = [hands.load(name) for name in ("xhand1", "sharpa")]
    total = sum(layouts.active_count(hand.layout(level)) for hand in hand_list for level in layouts.RESOLUTIONS)
    return float(total), float(90 + 199 + 667 + 98 + 206 + 781), 0.0


CHECKS: Mapping[str, Callable[[str], Result]] = {
    "distance to a ball (m)": _distance,
    "contact depth (m)": _depth,
    "force of a taxel, 4.8 (N)": _force,
    "hysteresis, published sequence (m)": _hysteresis,
    "white noise, standard deviation": _white,
    "Newton cooling of a lump (K)": _cooling,
    "resonance of a struck body (Hz)": _tone,
    "first mode of a free beam (Hz)": _beam,
    "probes of table 4.11": _counts,
}
"""Name → check."""
