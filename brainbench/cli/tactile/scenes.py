"""Scenes of the tactile commands: a hand that closes around a ball with every sensor class on it, and the demo.

Each job of the demo draws a picture and returns the numbers it shows.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path
from typing import Any

import numpy as np

from brainbench.cli.tactile import figures
from brainbench.core.devices import mujoco_module as mujoco
from brainbench.core.devices import warp
from brainbench.core.errors import check_name
from robotics_bridge import hands, sensors
from robotics_bridge.hands.scenes import closing, holding
from robotics_bridge.physics import Geometry, HandState, MujocoEngine, MujocoWarpEngine, TouchScene
from robotics_bridge.sensors import ContactAudio, ElastomerTaxel, Noise, Probes, SensorSuite, TemperatureGrid
from robotics_bridge.sensors.audio.modes import find_modes
from robotics_bridge.sensors.audio.sensors import Modes
from robotics_bridge.sensors.temperature.materials import ThermalBody

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
        self.hand, self.device, self.radius = hands.load(hand), device, radius
        self.model = holding(self.hand, radius=radius, reach=0.9)
        self.engine: Any = (
            MujocoEngine(self.model, envs) if device == "cpu" else MujocoWarpEngine(self.model, envs, device=device)
        )
        self._closed = closing(self.hand, 0.72)
        # What slides has the ball between its jaws at once; fingers close by and by.
        moved = self.model.actuator_trnid[:, 0]
        self._slow = self.model.jnt_type[moved] != mujoco().mjtJoint.mjJNT_SLIDE
        self._steps = 0

    def run(self, steps: int) -> None:
        """Advance, closing the fingers over the first 200 steps."""
        for _ in range(steps):
            self._steps += 1
            if self.model.nu:
                self.engine.set(ctrl=self._closed * np.where(self._slow, min(self._steps / 200, 1.0), 1.0))
            self.engine.step()

    def sensors(self, name: str, resolution: str, placement: str, *, noisy: bool = False) -> dict[str, Any]:
        """Return a sensor of one class on every link of a layout, by link."""
        check_name("sensor class", name, CLASSES)
        kind = getattr(sensors, name)
        layout = self.hand.layout(resolution, placement)
        common = {"noise": sensors.Noise.preset(CLASSES[name])} if noisy else {}
        if name == "TemperatureGrid":
            body = {"object": ThermalBody("steel", 45.0)}
            return {link: kind(link=link, cells=(3, 3, 3), bodies=body, **common) for link in layout}
        if name == "ContactAudio":
            modes = Modes(tuple(np.geomspace(300, 9000, 16).tolist()), (30.0,) * 16, (1.0,) * 16)
            return {"object": kind(link="object", modes=modes, **common)}
        extra: dict[str, Any] = {"track": ("object",)}
        if name in ("ElastomerTaxel", "ProximityTaxel"):
            extra["points"] = 500
        return {link: kind(link=link, probes=probes, **extra, **common) for link, probes in layout.items()}


def time_class(grip: Grip, name: str, resolution: str, placement: str, *, noisy: bool, repeats: int) -> dict[str, Any]:
    """Return the median time of an update of one class and its memory per environment."""
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


def forces(path: Path, hand: str, resolution: str, *, noisy: bool) -> dict[str, float]:
    """Draw the forces on all taxels of a hand that holds a ball."""
    grip = Grip(hand)
    members = grip.sensors("KinematicTaxel", resolution, "hand", noisy=noisy)
    suite = SensorSuite(grip.engine.scene, members, num_envs=1)
    for _ in range(300):
        grip.run(1)
        suite.update(grip.engine.state, grip.engine.timestep)
    readings = {link: suite.read(link)[0].reshape(-1, 6).numpy()[:, :3].copy() for link in members}
    pose = grip.engine.state.pose_torch[0].numpy().copy()
    probes = {link: sensor.probes for link, sensor in members.items()}
    figures.draw_forces(path, grip.engine.scene, pose, probes, readings)
    true = [suite.read_ground_truth(link)[0].reshape(-1, 6)[:, :3].norm(dim=1) for link in members]
    touched = sum(int((force > 1e-3).sum()) for force in true)
    total = max(float(np.linalg.norm(force, axis=1).max()) for force in readings.values())
    taxels = sum(int(item.active.sum()) for item in probes.values())
    return {"taxels": taxels, "in contact": touched, "largest force (N)": total}


def markers(path: Path, *, noisy: bool) -> dict[str, float]:
    """Draw the markers of an elastomer pad that a ball presses, drags and twists."""
    probes = Probes.grid(15, 15, size=(0.018, 0.018), radius=0.001)
    shapes = (
        Geometry(name="pad", link="pad", kind="box", size=(0.012, 0.012, 0.002), position=(0, 0, -0.002)),
        Geometry(name="ball", link="ball", kind="sphere", size=(0.006,)),
    )
    noise = Noise.preset("published-elastomer") if noisy else Noise()
    # A soft thin gel: markers move by tenths of a millimetre, and shear stays near where it is applied.
    gel: dict[str, Any] = {"dilate_scale": 8.0, "dilate_spread": 1e5, "shear_scale": 8.0, "shear_spread": 1e5}
    sensor = ElastomerTaxel(link="pad", probes=probes, noise=noise, points=2000, **gel)
    suite = SensorSuite(TouchScene(("pad", "ball"), shapes), {"pad": sensor}, num_envs=1)
    state = HandState.empty(1, 2, 1)
    state.set_contacts([0], [[0, 1]])
    moves = {"pressed": (0.0, 0.0), "dragged": (0.0015, 0.0), "twisted": (0.0, 0.6)}
    fields = {}
    for name, (shift, twist) in moves.items():
        suite.reset()
        for share in np.linspace(0, 1, 21):
            pressed, moved = min(2 * share, 1.0), max(2 * share - 1, 0.0)
            pose = np.zeros((2, 7))
            pose[:, 3] = 1
            pose[1, :3] = moved * shift, 0, 0.006 - 0.0008 * pressed
            pose[1, [3, 6]] = np.cos(moved * twist / 2), np.sin(moved * twist / 2)
            state.set_pose(pose)
            suite.update(state, 0.01)
        fields[name] = suite.read("pad")[0].reshape(-1, 3).numpy().copy()
    figures.draw_markers(path, probes.position, fields)
    return {f"{name} (mm)": 1e3 * float(np.linalg.norm(field[:, :2], axis=1).max()) for name, field in fields.items()}


def temperature(path: Path, hand: str) -> dict[str, float]:
    """Draw the warming of the finger tips by a ball of 45 °C, for three materials."""
    grip = Grip(hand)
    tips = grip.hand.tips
    members: dict[str, TemperatureGrid] = {}
    skin: dict[str, Any] = {"cells": (12, 12, 12), "material": "steel"}
    for name in ("aluminium", "glass", "wood"):
        bodies = {"object": ThermalBody(name, 45.0)}
        members |= {f"{name}/{link}": TemperatureGrid(link=link, bodies=bodies, **skin) for link in tips}
    suite = SensorSuite(grip.engine.scene, members, num_envs=1)
    times, traces = [], {name: [] for name in members}
    for step in range(1500):
        grip.run(1)
        suite.update(grip.engine.state, grip.engine.timestep)
        if step % 10 == 0:
            times.append(step * grip.engine.timestep)
            for name, trace in traces.items():
                trace.append(float(suite.read(name).max()))
    maps: dict[str, Any] = {name: suite.read(name)[0].numpy().copy() for name in members}
    warmest = max(tips, key=lambda link: maps[f"aluminium/{link}"].max())
    chosen = {name: maps[f"{name}/{warmest}"] for name in ("aluminium", "glass", "wood")}
    lines = {name: np.array(traces[f"{name}/{warmest}"]) for name in chosen}
    figures.draw_temperature(path, warmest, np.array(times), lines, chosen)
    return {f"{name} (°C)": float(field.max()) for name, field in chosen.items()}


def sound(path: Path) -> dict[str, float]:
    """Draw spectrograms of a ball that bounces on plates of wood, metal and glass."""
    model = mujoco().MjModel.from_xml_string("""
    <mujoco><option timestep="0.005"/><worldbody>
      <body name="slab"><geom type="box" size="0.15 0.1 0.01" solref="0.004 0.3"/></body>
      <body name="ball" pos="0.03 0.02 0.12"><freejoint/>
        <geom size="0.02" mass="0.05" solref="0.004 0.3"/></body>
    </worldbody></mujoco>""")
    engine = MujocoEngine(model, 1, threads=1)
    solid = engine.scene.geometries[0]
    sensors = {
        name: ContactAudio(link="slab", samples=160, modes=find_modes(solid, name, count=24, cells=10))
        for name in ("wood", "metal", "glass")
    }
    suite = SensorSuite(engine.scene, sensors, num_envs=1)
    blocks: dict[str, list[Any]] = {name: [] for name in sensors}
    for _ in range(240):
        engine.step()
        suite.update(engine.state, engine.timestep)
        for name, heard in blocks.items():
            heard.append(suite.read(name)[0, 0].numpy().copy())
    signals = {name: np.concatenate(heard) for name, heard in blocks.items()}
    figures.draw_sound(path, signals, 160 / engine.timestep)
    return {f"{name}: first mode (Hz)": sensor.modes.frequency[0] for name, sensor in sensors.items()}
