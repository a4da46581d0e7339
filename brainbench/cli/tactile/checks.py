"""Checks of ``brainbench tactile check``: each returns (found, truth, relative tolerance)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

Result = tuple[float, float, float]


def _ball(device: str, sensors: dict[str, Any], *, depth: float = 2e-3, steps: int = 1) -> Any:
    """Return a suite that has read a pad at the origin and a ball of 20 mm above it, overlapping by a depth."""
    from robotics_bridge.physics import Geometry, HandState, TouchScene
    from robotics_bridge.sensors import SensorSuite

    shapes = (
        Geometry(name="pad", link="pad", kind="box", size=(0.02, 0.02, 0.005), position=(0, 0, -0.005)),
        Geometry(name="ball", link="ball", kind="sphere", size=(0.02,)),
    )
    suite = SensorSuite(TouchScene(("pad", "ball"), shapes), sensors, num_envs=1, device=device)
    state = HandState.empty(1, 2, 4, device)
    pose = np.zeros((2, 7))
    pose[:, 3] = 1
    pose[1, 2] = 0.02 - depth
    state.set_pose(pose)
    state.set_contacts(
        [0], [[0, 1]], distance=[-depth], position=[[0, 0, -depth / 2]], normal=[[0, 0, 1.0]], force=[1.0]
    )
    for _ in range(steps):
        suite.update(state, 0.01)
    return suite


def _probe(radius: float) -> Any:
    from robotics_bridge.sensors import Probes

    return Probes(np.array([[0.003, 0.0, 0.0]]), np.array([[0.0, 0.0, 1.0]]), np.array([radius]))


def _distance(device: str) -> Result:
    from robotics_bridge.sensors import SurfaceDistanceProbe

    suite = _ball(device, {"a": SurfaceDistanceProbe(link="pad", probes=_probe(1e-3))}, depth=-0.01)
    return float(suite.read("a")), math.hypot(0.003, 0.03) - 0.02, 1e-5


def _depth(device: str) -> Result:
    from robotics_bridge.sensors import ContactDepthProbe

    suite = _ball(device, {"a": ContactDepthProbe(link="pad", probes=_probe(4e-3))})
    return float(suite.read("a")), 0.004 - (math.hypot(0.003, 0.018) - 0.02), 1e-4


def _force(device: str) -> Result:
    from robotics_bridge.sensors import KinematicTaxel

    suite = _ball(device, {"a": KinematicTaxel(link="pad", probes=_probe(4e-3))})
    found = float(suite.read("a")[0, 0, :3].norm())
    return found, 500 * (0.004 - (math.hypot(0.003, 0.018) - 0.02)) ** 1.2, 1e-4


def _hysteresis(device: str) -> Result:
    from robotics_bridge.sensors import Noise
    from robotics_bridge.sensors.noise import simulate

    noise = Noise(hysteresis=0.5, hysteresis_tau=0.05)
    return float(simulate(noise, np.full((5, 1, 1, 1), 0.03), dt=0.01, device=device)[-1, 0, 0, 0]), 0.036740, 1e-4


def _white(device: str) -> Result:
    from robotics_bridge.sensors import Noise
    from robotics_bridge.sensors.noise import simulate

    read = simulate(Noise(white=1.0), np.zeros((50, 16, 64, 6)), dt=0.01, device=device)
    return float(read.std()), 1.0, 0.01


def _cooling(device: str) -> Result:
    from robotics_bridge.sensors import TemperatureGrid
    from robotics_bridge.sensors.temperature.materials import ThermalMaterial

    material = ThermalMaterial(1.0, 1000.0, 1000.0, 0.0)
    grid = TemperatureGrid(
        link="pad", cells=(1, 1, 1), material=material, convection=100.0, base_temperature=60.0, radiates=False,
        contact_conductance=1e-9,
    )  # fmt: skip
    suite = _ball(device, {"a": grid}, steps=500)
    area, volume = 2 * (0.04 * 0.04 + 2 * 0.04 * 0.01), 0.04 * 0.04 * 0.01
    return float(suite.read("a")) - 22, 38 * math.exp(-100 * area * 5 / (1e6 * volume)), 1e-3


def _tone(device: str) -> Result:
    from robotics_bridge.sensors import ContactAudio
    from robotics_bridge.sensors.audio.materials import Modes

    suite = _ball(device, {"a": ContactAudio(link="pad", modes=Modes((1000.0,), (0.0,), (1.0,)), samples=320)})
    heard = suite.read("a")[0, 0].cpu().double().numpy()
    spectrum = np.abs(np.fft.rfft(heard, 1 << 16))
    return float(np.argmax(spectrum)) * 32000 / (1 << 16), 1000.0, 0.02


def _beam(device: str) -> Result:
    del device
    from robotics_bridge.sensors.audio.materials import ElasticMaterial
    from robotics_bridge.sensors.audio.modes import ElasticSolid, find_modes

    steel = ElasticMaterial(2e11, 0.3, 7850.0, 5.0, 3e-8)
    found = find_modes(ElasticSolid("box", (0.1, 0.005, 0.005)), steel, count=2, cells=16, cache=False).frequency[0]
    return found, 4.730041**2 / (2 * math.pi * 0.2**2) * math.sqrt(2e11 * 1e-4 / 12 / 7850), 0.02


def _counts(device: str) -> Result:
    del device
    from robotics_bridge import hands
    from robotics_bridge.hands import layouts

    total = sum(
        layouts.active_count(hands.load(name).layout(level))
        for name in ("xhand1", "sharpa")
        for level in layouts.RESOLUTIONS
    )
    return float(total), float(90 + 199 + 667 + 98 + 206 + 781), 0.0


CHECKS = {
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
