"""Noise, temperature and sound of the tactile simulator against closed forms, tables and planted values.

python -m benchmarks.tactile.closed_forms [--write]
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from scipy.special import erf

from benchmarks.report import publish, script_parser, table
from robotics_bridge.physics import Geometry, HandState, MujocoEngine, TouchScene
from robotics_bridge.sensors import ContactAudio, Noise, SensorSuite, TemperatureGrid
from robotics_bridge.sensors.audio.modes import find_modes
from robotics_bridge.sensors.audio.sensors import ElasticMaterial
from robotics_bridge.sensors.calibration.calibrate import Log, calibrate
from robotics_bridge.sensors.noise.stages import simulate
from robotics_bridge.sensors.temperature.materials import ThermalBody, ThermalMaterial, material

STEEL = ElasticMaterial(2e11, 0.3, 7850.0, 5.0, 3e-8)
PLAIN = ThermalMaterial(2.0, 1000.0, 1000.0, 0.8)


def _solid(kind: str, *size: float) -> Geometry:
    return Geometry(name="solid", link="solid", kind=kind, size=size)


def modes() -> list[list[str]]:
    rows = []

    def add(what: str, cells: int, truth: float, found: float) -> None:
        rows.append([what, f"{cells}", f"{truth:.4g}", f"{found:.4g}", f"{abs(found / truth - 1):.2%}"])

    for cells in (8, 16, 32):
        found = find_modes(_solid("box", 0.1, 0.005, 0.005), STEEL, count=2, cells=cells, cache=False).frequency[0]
        exact = 4.730041**2 / (2 * math.pi * 0.04) * math.sqrt(2e11 * 1e-4 / 12 / 7850)
        add("free beam 20:1, first bending (Hz; Euler-Bernoulli)", cells, exact, found)
    rigid = 2e11 * 0.002**3 / 12 / 0.91
    for cells in (6, 10, 14):
        found = find_modes(_solid("box", 0.1, 0.1, 0.001), STEEL, count=4, cells=cells, cache=False).frequency
        for mode, exact in enumerate((13.49, 19.79, 24.43)):
            number = found[mode] * 2 * math.pi * 0.04 * math.sqrt(7850 * 0.002 / rigid)
            add(f"free square plate 100:1, mode {mode + 1} (Leissa)", cells, exact, number)
    shear = math.sqrt(2e11 / 2.6 / 7850)
    for cells in (4, 6):
        found = find_modes(_solid("sphere", 0.05), STEEL, count=6, cells=cells, cache=False).frequency
        for mode, exact, name in ((0, 2.501, "torsional"), (5, 2.640, "spheroidal")):
            add(f"free ball, {name} (Lamb)", cells, exact, found[mode] * 2 * math.pi * 0.05 / shear)
    return rows


def half_spaces() -> list[list[str]]:
    rows = []
    shapes = (
        Geometry(name="pad", link="pad", kind="box", size=(1.0, 1.0, 0.012)),
        Geometry(name="object", link="object", kind="sphere", size=(0.04,)),
    )
    for name in ("aluminium", "steel", "glass", "wood"):
        grid = TemperatureGrid(
            link="pad", cells=(1, 1, 240), material=PLAIN, convection=0.0, radiates=False, base_temperature=33.0,
            bodies={"object": ThermalBody(name, 13.0)},
        )  # fmt: skip
        suite, state = (
            SensorSuite(TouchScene(("pad", "object"), shapes), {"t": grid}, num_envs=1),
            HandState.empty(1, 2, 4),
        )
        corners = [[x, y, 0.012] for x in (-1, 1) for y in (-1, 1)]
        state.set_contacts([0] * 4, [[0, 1]] * 4, distance=[0.0] * 4, position=corners, normal=[[0, 0, 1.0]] * 4)
        for _ in range(1000):
            suite.update(state, 2e-3)
        e1, e2 = PLAIN.effusivity, material(name).effusivity
        face = (e1 * 33 + e2 * 13) / (e1 + e2)
        depth = (np.arange(240)[::-1] + 0.5) * 1e-4
        exact = face + (33 - face) * erf(depth / (2 * math.sqrt(PLAIN.diffusivity * 2.0)))
        read = suite.read_ground_truth("t")[0, 0, 0].numpy()
        off = np.abs(read - exact).max()
        rows.append([f"touch {name}: face after 2 s (°C)", f"{exact[-1]:.3f}", f"{read[-1]:.3f}", f"{off / 20:.2%}"])
    return rows


def taken_up() -> list[list[str]]:
    """Heat that a pad of default cells takes up in short touches, over that of two half-spaces (Carslaw & Jaeger)."""
    rows, half = [], (0.2, 0.2, 0.01)
    shapes = (
        Geometry(name="pad", link="pad", kind="box", size=half),
        Geometry(name="object", link="object", kind="sphere", size=(0.04,)),
    )
    for own in ("silicone", "skin", "glass"):
        for name in ("aluminium", "steel", "wood"):
            grid = TemperatureGrid(
                link="pad", material=own, convection=0.0, radiates=False, base_temperature=33.0,
                bodies={"object": ThermalBody(name, 13.0)},
            )  # fmt: skip
            suite = SensorSuite(TouchScene(("pad", "object"), shapes), {"t": grid}, num_envs=1)
            state = HandState.empty(1, 2, 4)
            corners = [[x, y, half[2]] for x in (-half[0], half[0]) for y in (-half[1], half[1])]
            state.set_contacts([0] * 4, [[0, 1]] * 4, position=corners, normal=[[0, 0, 1.0]] * 4)
            thermal, e2, found = material(own), material(name).effusivity, []
            unit = thermal.density * thermal.specific_heat * np.prod(half) * 8
            for step in range(1, 501):
                suite.update(state, 0.01)
                if step in (1, 10, 100, 500):
                    heat = unit * (33 - suite.read_ground_truth("t").double().mean().item())
                    e1, root = thermal.effusivity, math.sqrt(step * 0.01 / math.pi)
                    found.append(f"{heat / (40 * 0.16 * e1 * e2 / (e1 + e2) * root):.3f}")
            rows.append([f"{own} on {name}", *found])
    return rows


def planted() -> list[list[str]]:
    truth = Noise(
        white=0.02, walk=0.002, bias=0.05, quantum=0.01, gain=(0.8, 1.2), dead_probability=0.15, dead_range=(0.1, 0.6),
        hysteresis=0.4, hysteresis_tau=0.06, read_delay=0.03,
    )  # fmt: skip
    rng, x, at = np.random.default_rng(0), np.zeros(6000), 40
    while at < 5700:
        length, rise, deep = rng.integers(60, 200), rng.integers(2, 20), rng.uniform(0.5, 2.0)
        x[at : at + length] = deep * np.minimum(np.minimum(np.arange(length) / rise, 1), np.arange(length)[::-1] / rise)
        at += length + int(rng.integers(30, 150))
    y = simulate(truth, np.broadcast_to(x[:, None, None, None], (6000, 1, 60, 1)), dt=0.005)[:, 0, :, 0]
    found = calibrate(Log(np.arange(6000) * 0.005, y.astype(float), x)).estimates
    planted_values = {"gain_low": 0.8, "gain_high": 1.2, "dead_low": 0.1, "dead_high": 0.6}
    rows = []
    for name, item in found.items():
        value = planted_values[name] if name in planted_values else getattr(truth, name)
        rows.append([name, f"{value:g}", f"{item.value:.4g}", f"{item.low:.4g} … {item.high:.4g}"])
    return rows


def impact_sounds(half: tuple[float, float, float], seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return band powers, material and whether the impact was slow, of a ball that bounces and rolls on a slab."""
    model = mujoco.MjModel.from_xml_string(f"""
    <mujoco><option timestep="0.005"/><worldbody>
      <body name="slab"><geom type="box" size="{half[0]} {half[1]} {half[2]}"/></body>
      <body name="ball" pos="0.03 0.02 {half[2] + 0.021}"><freejoint/><geom size="0.02" mass="0.05"/></body>
    </worldbody></mujoco>""")
    names, envs, rng = ("wood", "metal", "glass"), 96, np.random.default_rng(seed)
    sensors = {name: ContactAudio(link="slab", modes=find_modes(_solid("box", *half), name, cells=8)) for name in names}
    engine = MujocoEngine(model, envs, threads=1)
    suite = SensorSuite(engine.scene, sensors, num_envs=envs)
    velocity = np.zeros((envs, 6))
    velocity[:, 2], velocity[:, :2] = -rng.uniform(0.3, 3.0, envs), rng.normal(0, 0.2, (envs, 2))
    engine.set(qvel=velocity)
    blocks: dict[str, list] = {name: [] for name in names}
    for _ in range(60):
        engine.step()
        suite.update(engine.state, engine.timestep)
        for name in names:
            blocks[name].append(suite.read(name)[:, 0].numpy().copy())
    features = []
    for name in names:
        power = np.abs(np.fft.rfft(np.concatenate(blocks[name], axis=1), axis=1)[:, 1:]) ** 2
        bands = np.log(power[:, : power.shape[1] // 64 * 64].reshape(envs, 64, -1).mean(axis=2) + 1e-20)
        features.append(bands - bands.mean(axis=1, keepdims=True))
    slow = np.tile(-velocity[:, 2] < np.median(-velocity[:, 2]), 3)
    return np.concatenate(features), np.repeat(range(3), envs), slow


def classifier() -> list[list[str]]:
    from sklearn.linear_model import LogisticRegression
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    def right(train: tuple[np.ndarray, np.ndarray], test: tuple[np.ndarray, np.ndarray]) -> float:
        return make_pipeline(StandardScaler(), LogisticRegression(max_iter=1000)).fit(*train).score(*test)

    x, y, slow = impact_sounds((0.15, 0.1, 0.015), 1)
    other, materials, _ = impact_sounds((0.12, 0.12, 0.02), 2)
    draws = (np.random.default_rng(seed).permutation(y) for seed in range(20))
    chance = [right((x[slow], drawn[slow]), (x[~slow], drawn[~slow])) for drawn in draws]
    return [
        ["slow → fast impacts", f"{right((x[slow], y[slow]), (x[~slow], y[~slow])):.1%}", f"{(~slow).sum()} sounds"],
        ["fast → slow impacts", f"{right((x[~slow], y[~slow]), (x[slow], y[slow])):.1%}", f"{slow.sum()} sounds"],
        ["this slab → another shape", f"{right((x, y), (other, materials)):.1%}", f"{len(other)} sounds"],
        ["slow → fast, labels shuffled", f"{np.mean(chance):.1%}, at most {max(chance):.1%}", "20 shuffles"],
    ]


def main() -> None:
    options = script_parser(__doc__).parse_args()
    parts = [
        ("Modes by quadratic tetrahedra", ["body", "elements along it", "truth", "found", "error"], modes()),
        (
            "A grid touches a half-space (33 °C on 13 °C; largest error over 240 cells, of the step of 20 K)",
            ["contact", "closed form", "found", "error"],
            half_spaces(),
        ),
        (
            "Heat taken up by a pad of 2 × 2 × 2 cells (each 10 mm deep, steps of 10 ms) over that of two half-spaces",
            ["contact", ".01 s", ".1 s", "1 s", "5 s"],
            taken_up(),
        ),
        ("Calibration of planted noise (6000 readings, 60 probes)", ["knob", "planted", "found", "95 %"], planted()),
        (
            "Linear classifier of wood, metal and glass from 64 band powers",
            ["train → test", "right", "of"],
            classifier(),
        ),
    ]
    body = "\n\n".join(f"{title}:\n\n{table(columns, rows)}" for title, columns, rows in parts)
    publish(options, "Tactile: noise, temperature, sound", body)


if __name__ == "__main__":
    main()
