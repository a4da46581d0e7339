"""Tactile readings against closed forms, and at the edges of what a user may ask, as two tables.

python -m benchmarks.tactile.extremes [--device cpu] [--write]
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.integrate import dblquad

from benchmarks.report import publish, script_parser, table
from benchmarks.tactile.scene import bumpy_box
from robotics_bridge.physics import Geometry, HandState, TouchScene
from robotics_bridge.sensors import (
    ContactDepthProbe,
    ElastomerTaxel,
    KinematicTaxel,
    Probes,
    ProximityTaxel,
    SensorSuite,
    SurfaceDistanceProbe,
    TemperatureGrid,
)
from robotics_bridge.sensors.checks import CHECKS

PAD = Geometry(name="pad", link="hand", kind="box", size=(0.02, 0.02, 0.005))
LYING = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)
SOLIDS = {
    "sphere": Geometry(name="o", link="o", kind="sphere", size=(0.01,)),
    "cylinder": Geometry(name="o", link="o", kind="cylinder", size=(0.01, 0.007), quaternion=LYING),
    "box": Geometry(name="o", link="o", kind="box", size=(0.007, 0.006, 0.01)),
}
GRID = Probes.grid(4, 5, size=(0.02, 0.03), center=(0, 0, 0.005), radius=0.004)
Row = list[str]


def read(
    sensors: Mapping[str, Any], solids: list[Geometry], at: np.ndarray, device: str, **contact: Any
) -> tuple[dict[str, np.ndarray], SensorSuite]:
    """Readings of sensors on the pad that solids on links of their own touch from places [B, S, 3] (m)."""
    at = np.asarray(at, float).reshape(-1, len(solids), 3)
    scene = TouchScene(("world", "hand", *(solid.link for solid in solids)), (PAD, *solids))
    suite = SensorSuite(scene, sensors, num_envs=len(at), device=device)
    pose = np.zeros((len(at), len(scene.links), 7))
    pose[..., 3] = 1
    pose[:, 2:, :3] = at
    state = HandState.empty(len(at), len(scene.links), max(at.shape[0] * len(solids), 1), device)
    state.set_pose(pose)
    env = np.repeat(np.arange(len(at)), len(solids))
    state.set_contacts(env, np.tile([(0, g + 1) for g in range(len(solids))], (len(at), 1)).reshape(-1, 2), **contact)
    suite.update(state)
    return {name: suite.read(name).cpu().numpy().copy() for name in sensors}, suite


def taxels(**options: Any) -> KinematicTaxel:
    return KinematicTaxel(link="hand", **{"probes": GRID, **options})


def bed(shape: str, depth: float, exponent: float) -> float:
    """∫ overlap^α dA (m^(2+α)) of a solid pressed into a bed of springs, by quadrature."""
    if shape == "box":
        return 4 * 0.007 * 0.006 * depth**exponent
    half = math.sqrt(2 * 0.01 * depth)

    def overlap(x: float, y: float) -> float:
        square = x * x + (y * y if shape == "sphere" else 0)
        return max(depth - 0.01 + math.sqrt(max(1e-4 - square, 0)), 0) ** exponent

    width = half if shape == "sphere" else 0.007
    return 4 * dblquad(overlap, 0, width, 0, half, epsabs=1e-14, epsrel=1e-6)[0]


def truth(device: str) -> Iterator[Row]:
    """What is read beside what should be."""
    for name, check in CHECKS.items():
        found, exact, _allowed = check(device)
        off = 0.0 if found == exact else abs(found - exact) / max(abs(exact), 1e-300)
        yield [name, f"{exact:.6g}", f"{found:.6g}", f"{off:.1e}"]
    pitch, modulus, exponent = 0.0002, 1e7, 1.2
    fine = Probes.grid(81, 81, size=(80 * pitch, 80 * pitch), center=(0, 0, 0.005), radius=1e-9)
    for shape, solid in SOLIDS.items():
        for depth in (1e-4, 3e-4, 5e-4):
            field = taxels(probes=fine, stiffness=modulus * pitch**2, exponent=exponent)
            place = [0.00013, -0.00007, 0.015 - depth]
            found, _suite = read({"t": field}, [solid], np.array(place), device)
            total, load = -found["t"][0].sum((0, 1))[2], modulus * bed(shape, depth, exponent)
            name = f"{shape} pressed {1e3 * depth:g} mm into 81 × 81 taxels: sum of forces (N)"
            yield [name, f"{load:.4g}", f"{total:.4g}", f"{abs(total / load - 1):.1%}"]
    box = Geometry(name="o", link="o", kind="box", size=(0.007, 0.006, 0.01))
    mesh = Geometry(name="o", link="o", kind="mesh", mesh=bumpy_box(0.02, 1200))
    cube = replace(box, size=(0.01, 0.01, 0.01))
    depth = ContactDepthProbe(link="hand", probes=GRID)
    both = {"sdf": depth, "raycast": replace(depth, query="raycast")}
    for shape, solid in SOLIDS.items():
        found, _suite = read(both, [solid], np.array([0.001, 0.002, 0.0145]), device)
        gap = np.abs(found["sdf"] - found["raycast"]).max()
        yield [f"{shape}: depth by closed form and by triangles (m)", "equal", f"{gap:.1e} apart", f"{gap / 4e-3:.1e}"]
    places = np.array([0.0011, 0.0023, 0.0145])
    one, other = (read({"d": depth}, [solid], places, device)[0]["d"] for solid in (cube, mesh))
    gap = np.abs(one - other).max()
    yield ["box and 1,200 triangles of it: depth (m)", "equal", f"{gap:.1e} apart", f"{gap / np.abs(one).max():.1e}"]


def heart(device: str) -> Row:
    """A probe in the middle of a box reads the way to its surface."""
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    big = Geometry(name="o", link="o", kind="box", size=(0.05, 0.04, 0.03))
    sensors = {q: ContactDepthProbe(link="hand", probes=probe, query=q) for q in ("sdf", "raycast")}
    found, _suite = read(sensors, [big], np.array([0, 0, 0.006]), device)
    return ["30 mm of its radius, sdf and raycast", *(f"{1e3 * found[q].item():.4f} mm" for q in sensors)]


def grazing(device: str) -> Row:
    """A ball that touches in one point."""
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    common = {"link": "hand", "probes": probe}
    sensors = {
        "d": ContactDepthProbe(**common),
        "k": KinematicTaxel(**common),
        "p": ProximityTaxel(**common, points=100),
        "e": ElastomerTaxel(**common, points=100),
    }
    found, _suite = read(sensors, [SOLIDS["sphere"]], np.array([0, 0, 0.016]), device)
    most = max(float(np.abs(value).max()) for value in found.values())
    return ["depth, force, proximity and elastomer read nothing", f"at most {most:.1e}", ""]


def counts(device: str) -> Row:
    """One taxel among a hundred thousand, and by itself."""
    many = Probes.grid(250, 400, size=(0.03, 0.03), center=(0, 0, 0.005), radius=0.002)
    one = Probes(many.position[60_215], many.normal[60_215], 0.002)
    sensors = {name: ContactDepthProbe(link="hand", probes=p) for name, p in (("many", many), ("one", one))}
    place = np.array([0.001, 0.002, 0.014])
    found, suite = read(sensors, [SOLIDS["sphere"]], place, device)
    exact = np.maximum(0.012 - np.linalg.norm(np.array(many.position) - place, axis=1), 0)
    worst = np.abs(found["many"].ravel() - exact).max()
    same = "the same" if found["one"].item() == found["many"].ravel()[60_215] else "different"
    return [f"{same} by itself and among {suite.read('many').numel():,}", f"{worst:.1e} m from the closed form", ""]


def fillers(device: str) -> Row:
    """Probes of radius zero."""
    none = Probes(np.zeros((4, 3)), np.zeros((4, 3)), 0.0, (2, 2))
    sensors = {"d": ContactDepthProbe(link="hand", probes=none), "k": taxels(probes=none)}
    found, _suite = read(sensors, [SOLIDS["sphere"]], np.array([0, 0, 0.012]), device)
    return ["read 0", "0" if all((value == 0).all() for value in found.values()) else "NOT 0", ""]


def no_area(device: str) -> Row:
    """A contact of depth zero conducts no heat, and nothing divides by its area."""
    grid = TemperatureGrid(link="hand", cells=(2, 2, 2), convection=0.0, radiates=False)
    touch = {"distance": [0.0], "position": [[0, 0, 0.005]], "normal": [[0, 0, 1.0]], "force": [0.0]}
    found, _suite = read({"t": grid}, [SOLIDS["sphere"]], np.array([0, 0, 0.015]), device, **touch)
    return ["stays at 22 °C", f"{found['t'].min():.6f} to {found['t'].max():.6f} °C", ""]


def steps(device: str) -> Row:
    """Heat of an insulated grid and its evenness at the end, for four time steps."""
    cells = []
    for dt in (1e-5, 1e-3, 1e-2, 0.1):
        grid = TemperatureGrid(link="hand", cells=(4, 4, 4), convection=0.0, radiates=False)
        scene = TouchScene(("world", "hand"), (PAD,))
        suite = SensorSuite(scene, {"t": grid}, num_envs=1, device=device)
        state = HandState.empty(1, 2, 0, device)
        suite.update(state, dt)
        field = suite.runtimes[0]._field  # type: ignore[attr-defined]
        start = 20 + 40 * np.random.default_rng(0).random(field.shape)
        field.assign(start)
        for _ in range(200):
            suite.update(state, dt)
        end = field.numpy()
        inside = start.min() - 1e-9 <= end.min() and end.max() <= start.max() + 1e-9
        cells.append(f"{dt:g} s: {abs(end.mean() - start.mean()):.0e} K" + ("" if inside else " OUTSIDE"))
    return ["insulated: heat kept, no new extremes", "; ".join(cells), ""]


def stiffness(device: str) -> Row:
    """Forces grow with the stiffness alone."""
    sensors = {f"{k:g}": taxels(stiffness=k, damping=0.0, shear=0.0, twist=0.0) for k in (1.0, 1e3, 1e7)}
    found, _suite = read(sensors, [SOLIDS["sphere"]], np.array([0, 0, 0.0145]), device)
    peak = {name: float(np.abs(value[..., :3]).max()) / float(name) for name, value in found.items()}
    spread = max(peak.values()) / min(peak.values()) - 1
    return ["force / stiffness is the same from 1 to 10⁷ N/m^α", f"within {spread:.0e}", ""]


def crowd(device: str) -> Row:
    """Three thousand balls around the pad."""
    rng = np.random.default_rng(0)
    balls = [Geometry(name=f"b{i}", link=f"b{i}", kind="sphere", size=(0.002,)) for i in range(3000)]
    places = rng.uniform(-0.3, 0.3, (1, 3000, 3))
    sensors = {"far": SurfaceDistanceProbe(link="hand", probes=GRID)}
    start = time.perf_counter()
    found, _suite = read(sensors, balls, places, device)
    exact = np.linalg.norm(np.array(GRID.position)[:, None] - places[0][None], axis=2).min(axis=1) - 0.002
    worst = np.abs(found["far"].ravel() - exact).max()
    return ["nearest of 3,000 balls", f"{worst:.0e} m off", f"built and read in {time.perf_counter() - start:.1f} s"]


def empty(device: str) -> Row:
    """Nothing to touch."""
    sensors = {"d": ContactDepthProbe(link="hand", probes=GRID), "s": SurfaceDistanceProbe(link="hand", probes=GRID)}
    scene = TouchScene(("world", "hand"), (PAD,))
    suite = SensorSuite(scene, sensors, num_envs=2, device=device)
    suite.update(HandState.empty(2, 2, 0, device))
    depth, far = (float(suite.read(name).abs().max()) for name in sensors)
    return ["depth 0, distance infinite", f"{depth:g}, {far:g}", ""]


def diverged(device: str) -> Row:
    """A pose that is no number, between two environments that are well."""
    places = np.array([[0, 0, 0.0145], [np.nan, 0, 0.0145], [0, 0, 0.0145]])
    found, suite = read({"k": taxels()}, [SOLIDS["sphere"]], places, device)
    alone, _suite = read({"k": taxels()}, [SOLIDS["sphere"]], places[:1], device)
    same = np.array_equal(found["k"][0], alone["k"][0]) and np.array_equal(found["k"][2], alone["k"][0])
    flags = "".join("!" if flag else "·" for flag in suite.diverged.tolist())
    marked = "NaN" if np.isnan(found["k"][1]).all() else "NOT NaN"
    return [
        "flagged and NaN; others bit for bit as alone",
        f"{flags}, {marked}, {'equal' if same else 'DIFFERENT'}",
        "",
    ]


EXTREMES: dict[str, Callable[[str], Row]] = {
    "deep penetration": heart,
    "grazing contact": grazing,
    "1 and 100,000 taxels": counts,
    "fillers": fillers,
    "contact without area": no_area,
    "time steps of the heat solver": steps,
    "stiffness": stiffness,
    "thousands of objects": crowd,
    "empty scene": empty,
    "diverged engine": diverged,
}


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    known, edges = [], []
    for row in truth(options.device):
        known.append(row)
        print(*row, sep=" | ", flush=True)
    for name, extreme in EXTREMES.items():
        edges.append([name, *extreme(options.device)])
        print(*edges[-1], sep=" | ", flush=True)
    note = "A bed of springs presses along its normal; a taxel along the normal of what it meets, by its distance."
    body = note + "\n\n" + table(["case", "exact", "read", "off"], known)
    publish(options, "Tactile readings against closed forms", body)
    publish(options, "Tactile extremes", table(["extreme", "expected", "read", ""], edges))


if __name__ == "__main__":
    main()
