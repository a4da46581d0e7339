"""The scene of the tactile commands: a hand that closes around a ball, and every sensor class on it."""

from __future__ import annotations

import statistics
import time
from typing import Any

from brainbench.core.errors import unknown_name

CLASSES = {
    "ContactProbe": "published-bool",
    "ContactDepthProbe": "published-depth",
    "SurfaceDistanceProbe": "none",
    "KinematicTaxel": "published-force",
    "ProximityTaxel": "published-proximity",
    "ElastomerTaxel": "published-elastomer",
    "TemperatureGrid": "none",
    "ContactAudio": "none",
}
"""Sensor class → its published noise."""


class Grip:
    """A hand, palm up, that closes around a ball in every environment."""

    def __init__(self, hand: str, *, envs: int = 1, device: str = "cpu", radius: float = 0.028) -> None:
        from robotics_bridge import hands
        from robotics_bridge.hands.scenes import closing, holding
        from robotics_bridge.physics import MujocoEngine, MujocoWarpEngine

        self.hand, self.device, self.radius = hands.load(hand), device, radius
        self.model = holding(self.hand, radius=radius, reach=0.9)
        self.engine: Any = (
            MujocoEngine(self.model, envs) if device == "cpu" else MujocoWarpEngine(self.model, envs, device=device)
        )
        self._closed = closing(self.hand, 0.72)
        self._steps = 0

    def run(self, steps: int) -> None:
        """Advance, closing the fingers over the first 200 steps."""
        for _ in range(steps):
            self._steps += 1
            if self.model.nu:
                self.engine.set(ctrl=self._closed * min(self._steps / 200, 1.0))
            self.engine.step()

    def sensors(self, name: str, resolution: str, placement: str, *, noisy: bool = False) -> dict[str, Any]:
        """Return a sensor of one class on every link of a layout, by link."""
        import numpy as np

        from robotics_bridge import sensors

        if name not in CLASSES:
            raise unknown_name("sensor class", name, CLASSES)
        kind = getattr(sensors, name)
        layout = self.hand.layout(resolution, placement)
        common = {"noise": sensors.Noise.preset(CLASSES[name])} if noisy else {}
        if name == "TemperatureGrid":
            body = {"object": sensors.ThermalBody("steel", 45.0)}
            return {link: kind(link=link, cells=(3, 3, 3), bodies=body, **common) for link in layout}
        if name == "ContactAudio":
            modes = sensors.Modes(tuple(np.geomspace(300, 9000, 16).tolist()), (30.0,) * 16, (1.0,) * 16)
            return {"object": kind(link="object", modes=modes, **common)}
        extra: dict[str, Any] = {"track": ("object",)}
        if name == "ElastomerTaxel":
            extra["points"] = 500
        if name == "ProximityTaxel":
            extra["points"] = 500
        return {link: kind(link=link, probes=probes, **extra, **common) for link, probes in layout.items()}


def time_class(grip: Grip, name: str, resolution: str, placement: str, *, noisy: bool, repeats: int) -> dict[str, Any]:
    """Return the median time of an update of one class and its memory per environment."""
    from brainbench.core.devices import warp
    from robotics_bridge.sensors import SensorSuite

    wp, engine = warp(), grip.engine
    members = grip.sensors(name, resolution, placement, noisy=noisy)
    suite = SensorSuite(engine.scene, members, num_envs=engine.state.num_envs, device=grip.device)
    times = []
    for _ in range(repeats + 3):
        wp.synchronize()
        start = time.perf_counter()
        suite.update(engine.state, engine.timestep)
        wp.synchronize()
        times.append(time.perf_counter() - start)
    seconds = statistics.median(times[3:])
    probes = sum(runtime.slices[key].count for runtime in suite.runtimes for key in runtime.slices)
    envs = engine.state.num_envs
    return {
        "sensor": name, "probes": probes, "seconds": seconds, "per_probe_ns": 1e9 * seconds / (probes * envs),
        "state_bytes": suite.state_bytes["sensors"],
    }  # fmt: skip
