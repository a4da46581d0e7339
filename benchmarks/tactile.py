"""Speed and memory of the tactile sensors on the published pyramid scene, on a GPU or on processors.

One sensor of 10 × 10 taxels on the top of ``box0``, which ``box1`` half covers; sensors are read every step.

    python benchmarks/tactile.py --device cuda --part check        # the same readings as on the processor
    python benchmarks/tactile.py --device cuda --part sensors      # sensor time alone, against its roofline
    python benchmarks/tactile.py --device cuda --part step         # whole step against the engine alone
    python benchmarks/tactile.py --device cuda --part published    # configurations of thesis figure 4.4
    python benchmarks/tactile.py --device cuda --part scaling      # taxels, environments, triangles, points
    python benchmarks/tactile.py --device cpu --part peer --genesis rates.jsonl

``--out FILE`` appends what was measured as JSON lines; ``--write`` puts the tables into RESULTS.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.results import table, write_section
from brainbench.geometry import Mesh
from robotics_bridge._device import pick_device, warp
from robotics_bridge.physics import (
    Geometry,
    HandState,
    MujocoEngine,
    MujocoWarpEngine,
    Scene,
    initial_velocities,
    pyramid,
)
from robotics_bridge.sensors import (
    ContactAudio,
    ContactDepthProbe,
    ContactProbe,
    ElastomerTaxel,
    KinematicTaxel,
    Noise,
    Probes,
    ProximityTaxel,
    SensorSuite,
    SurfaceDistanceProbe,
    TemperatureGrid,
)
from robotics_bridge.sensors.audio_materials import Modes

ROOFLINE = {False: 0.018e-3, True: 0.085e-3}
"""Seconds at the H200's bandwidth for 100 taxels of 6 channels and 16,384 environments, clean and with full noise."""
FULL = Noise.preset("published-force")
DEVICE = ""


def grid(count: int, radius: float = 0.004) -> Probes:
    side = round(count**0.5)
    return Probes.grid(side, max(1, round(count / side)), size=(0.2, 0.2), center=(0, 0, 0.125), radius=radius)


def sensors(name: str, count: int = 100, points: int = 500, noise: Noise | None = None) -> dict:
    common = {"link": "box0", "probes": grid(count), "track": ("box1",)}
    if noise is not None:
        common["noise"] = noise
    makers = {
        "distance": lambda: SurfaceDistanceProbe(**common),
        "contact": lambda: ContactProbe(**common),
        "depth": lambda: ContactDepthProbe(**common),
        "kinematic": lambda: KinematicTaxel(**common),
        "proximity": lambda: ProximityTaxel(**common, points=points),
        "elastomer": lambda: ElastomerTaxel(**common, points=points),
        "temperature": lambda: _temperature(2),
        "audio": _audio,
    }
    return {name: makers[name]()}


def _temperature(cells: int, link: str = "box0") -> TemperatureGrid:
    return TemperatureGrid(link=link, cells=(cells,) * 3)


def _audio() -> ContactAudio:
    modes = Modes(tuple(200.0 * k for k in range(1, 17)), (40.0,) * 16, (1.0,) * 16)
    return ContactAudio(link="box0", modes=modes, samples=160)


CLASSES = ("distance", "contact", "depth", "kinematic", "proximity", "elastomer", "temperature", "audio")


def engine_of(envs: int, device: str) -> Any:
    model = pyramid()
    if device == "cpu":
        engine = MujocoEngine(model, envs, contacts=128)
    else:
        engine = MujocoWarpEngine(model, envs, device=device, contacts=128)
    engine.set(qvel=initial_velocities(envs, model.nv))
    return engine


def settle(envs: int, device: str, steps: int) -> Any:
    engine = engine_of(envs, device)
    engine.step(steps)
    return engine


def repeated(state: HandState, envs: int, device: str) -> HandState:
    """A state of ``envs`` environments that repeats a settled smaller one."""
    small, links = state.num_envs, state.num_links
    count = min(int(state.contact_count.numpy()[0]), state.contact_env.shape[0])
    order = np.arange(envs) % small
    target = HandState.empty(envs, links, (count // small + 8) * envs, device)
    target.set_pose(state.pose.numpy()[order])
    target.set_velocity(state.velocity.numpy()[order])
    env = state.contact_env.numpy()[:count]
    pairs = state.contact_geom.numpy()[:count]
    order_of = np.argsort(env, kind="stable")
    env, pairs = env[order_of], pairs[order_of]
    start = np.searchsorted(env, np.arange(small + 1))
    rows = [np.arange(start[s], start[s + 1]) for s in range(small)]
    chosen = np.concatenate([rows[e] for e in order])
    owner = np.repeat(np.arange(envs), [len(rows[e]) for e in order])
    target.set_contacts(owner, pairs[chosen])
    return target


def measure(function: Callable[[], object], device: str, repeats: int, groups: int = 7) -> float:
    """Median seconds of one call over groups of calls."""
    wp = warp()
    where = pick_device(device)
    for _ in range(3):
        function()
    wp.synchronize_device(where)
    seconds = []
    for _ in range(groups):
        start = time.perf_counter()
        for _ in range(repeats):
            function()
        wp.synchronize_device(where)
        seconds.append((time.perf_counter() - start) / repeats)
    return statistics.median(seconds)


def moving(engine: Any, suite: SensorSuite, steps: int) -> float:
    """Median processor seconds of an update while the scene moves."""
    seconds = []
    for _ in range(steps):
        engine.step()
        start = time.process_time()
        suite.update(engine.state, engine.timestep)
        seconds.append(time.process_time() - start)
    return statistics.median(seconds[3:])


def timed(scene: Scene, config: dict, state: HandState, device: str, repeats: int) -> tuple[float, SensorSuite]:
    suite = SensorSuite(scene, config, num_envs=state.num_envs, device=device)
    return measure(lambda: suite.update(state, 0.01), device, repeats), suite


def bumpy_box(edge: float, triangles: int) -> Mesh:
    """A box whose faces are cut into about as many triangles."""
    import trimesh

    solid = trimesh.creation.box((edge,) * 3)
    side = max(1, round((triangles / 12) ** 0.5))
    points = np.linspace(-0.5, 0.5, side + 1) * edge
    corners, faces = [], []
    u, v = (axis.ravel() for axis in np.meshgrid(points, points, indexing="ij"))
    for axis in range(3):
        for sign in (-1, 1):
            start = len(corners) * (side + 1) ** 2
            sheet = np.zeros(((side + 1) ** 2, 3))
            sheet[:, axis], sheet[:, (axis + 1) % 3], sheet[:, (axis + 2) % 3] = sign * edge / 2, u, v
            corners.append(sheet)
            for i in range(side):
                for j in range(side):
                    a = start + i * (side + 1) + j
                    b, c, d = a + side + 1, a + side + 2, a + 1
                    faces += [(a, b, c), (a, c, d)] if sign > 0 else [(a, c, b), (a, d, c)]
    del solid
    vertices = np.concatenate(corners)
    merged, index = np.unique(np.round(vertices, 9), axis=0, return_inverse=True)
    return Mesh(merged, index.reshape(-1)[np.array(faces)])


def with_mesh(scene: Scene, name: str, triangles: int) -> Scene:
    number = scene.geometry_index(name)
    old = scene.geometries[number]
    new = Geometry(name=old.name, link=old.link, kind="mesh", mesh=bumpy_box(0.25, triangles))
    return replace(scene, geometries=(*scene.geometries[:number], new, *scene.geometries[number + 1 :]))


def part_sensors(options: argparse.Namespace, record: Callable[..., None]) -> None:
    """Sensor time alone at one number of environments."""
    engine = settle(min(options.envs, 256), options.device, options.settle)
    state = repeated(engine.state, options.envs, options.device)
    scene, rows = engine.scene, []
    cases = [
        (f"kinematic {n}{' noisy' if noise else ''}", "kinematic", n, scene, noise)
        for n in options.taxels
        for noise in (None, FULL)
    ]
    meshed = with_mesh(scene, "box1", 5000)
    cases += [(f"kinematic {n} mesh 5k", "kinematic", n, meshed, None) for n in options.taxels[:2]]
    cases += [(name, name, 100, scene, None) for name in CLASSES if name != "kinematic"]
    for label, name, count, where, noise in cases:
        config = sensors(name, count, noise=noise)
        seconds, suite = timed(where, config, state, options.device, options.repeats)
        held = suite.state_bytes
        scale = options.envs / 16384 * count / 100
        ratio = (
            seconds / (ROOFLINE[noise is not None] * scale)
            if name == "kinematic" and options.device != "cpu"
            else float("nan")
        )
        per = (held["sensors"] + held["shared"]) / count
        record(
            part="sensors", case=label, envs=options.envs, ms=seconds * 1e3, roofline_ratio=ratio, bytes_per_taxel=per
        )
        taxel = seconds / options.envs / count * 1e9
        against = "–" if np.isnan(ratio) else f"{ratio:.2f}"
        rows.append([label, f"{seconds * 1e3:.3f}", f"{taxel:.3g}", against, f"{per:.0f}"])
        print(*rows[-1], sep="  ", flush=True)
        del suite
    columns = ["sensor", "ms / update", "ns / taxel", "time / H200 roofline", "bytes / taxel"]
    finish(options, f"Tactile sensors alone, {options.envs:,} environments", table(columns, rows))


def part_check(options: argparse.Namespace, record: Callable[..., None]) -> None:
    """Readings on the device against those on the processor, clean and noisy, over updates that replay a graph."""
    engine = engine_of(32, "cpu")
    engine.step(30)
    config = {name: made for kind in CLASSES[:6] for name, made in sensors(kind, points=300).items()}
    config |= {f"{name} noisy": replace(made, noise=Noise(white=1e-3, walk=1e-3)) for name, made in config.items()}
    config["kinematic raycast"] = replace(config["kinematic"], query="raycast")
    config["kinematic engine"] = replace(config["kinematic"], total="engine")
    suites = [SensorSuite(engine.scene, config, num_envs=32, device=where) for where in ("cpu", options.device)]
    state = HandState.empty(32, engine.state.num_links, engine.state.contact_env.shape[0], options.device)
    worst: dict[str, float] = {}
    for step in range(12):
        engine.step()
        source = engine.state
        count = min(int(source.contact_count.numpy()[0]), source.contact_env.shape[0])
        names = ("distance", "force", "position", "normal")
        optional = {name: getattr(source, f"contact_{name}").numpy()[:count] for name in names}
        state.set_pose(source.pose.numpy())
        state.set_velocity(source.velocity.numpy())
        state.set_contacts(source.contact_env.numpy()[:count], source.contact_geom.numpy()[:count], **optional)
        suites[0].update(source)
        suites[1].update(state)
        if step == 6:
            for suite in suites:
                suite.reset([3, 5])
        for name in config:
            here, there = (suite.read(name).cpu().numpy() for suite in suites)
            scale = np.abs(here[np.isfinite(here)]).max() + 1e-12
            same = np.nan_to_num(np.abs(here - there), nan=0.0, posinf=0.0) / scale
            worst[name] = max(worst.get(name, 0.0), float(np.quantile(same, 0.999)))
    for name, error in worst.items():
        record(part="check", case=name, relative=error)
        print(f"{name:24} 99.9 % of readings agree within {error:.1e} of the largest", flush=True)


def part_step(options: argparse.Namespace, record: Callable[..., None]) -> None:
    """Engine alone, then engine and one sensor read every step."""
    rows = []
    for envs in options.env_list:
        engine = settle(envs, options.device, options.settle)
        alone = envs / measure(engine.step, options.device, options.repeats)
        record(part="step", case="none", envs=envs, env_steps_per_s=alone)
        rows.append([f"{envs:,}", "none", f"{alone:,.0f}", "100 %"])
        print(*rows[-1], sep="  ", flush=True)
        for name in CLASSES:
            config = sensors(name)
            suite = SensorSuite(engine.scene, config, num_envs=envs, device=options.device)

            def both(engine: Any = engine, suite: Any = suite, name: str = name) -> None:
                engine.step()
                suite.update(engine.state, engine.timestep)
                suite.read(name)

            rate = envs / measure(both, options.device, options.repeats)
            record(part="step", case=name, envs=envs, env_steps_per_s=rate, share=rate / alone)
            rows.append([f"{envs:,}", name, f"{rate:,.0f}", f"{100 * rate / alone:.0f} %"])
            print(*rows[-1], sep="  ", flush=True)
            del suite
        del engine
    body = table(["environments", "sensor (100 taxels)", "env-steps/s", "of the engine alone"], rows)
    finish(options, "Tactile whole step on the pyramid", body)


def part_published(options: argparse.Namespace, record: Callable[..., None]) -> None:
    """Configurations of thesis figure 4.4, sensor time and memory."""
    rows = []
    envs = options.envs
    engine = settle(min(envs, 256), options.device, options.settle)
    common = {"track": ("box1",)}
    five = [f"box{i}" for i in range(5)]
    patch = Probes.grid(5, 4, size=(0.2, 0.16), center=(0, 0, 0.125))
    depths = {f"d{i}": ContactDepthProbe(link=link, probes=grid(2025)) for i, link in enumerate(five)}
    gels = {f"e{i}": ElastomerTaxel(link=link, probes=patch, points=1000) for i, link in enumerate(five)}
    cases = {
        "5 depth sensors, 10,000 taxels (1024)": (1024, depths),
        "5 elastomers 5 × 4 (1024)": (1024, gels),
        f"kinematic 10 × 10 ({envs})": (envs, {"k": KinematicTaxel(link="box0", probes=grid(100), **common)}),
        f"kinematic 100 × 100 ({envs})": (envs, {"k": KinematicTaxel(link="box0", probes=grid(10_000), **common)}),
    }
    grids = {f"t{i}": _temperature(2, link) for i, link in enumerate(five)}
    cases[f"5 temperature grids 2 × 2 × 2 ({envs})"] = (envs, grids)
    for label, (count, config) in cases.items():
        state = repeated(engine.state, count, options.device)
        seconds, suite = timed(engine.scene, config, state, options.device, options.repeats)
        held = suite.state_bytes
        total = (held["sensors"] + held["shared"]) / 1024
        record(part="published", case=label, envs=count, ms=seconds * 1e3, kib_per_env=total)
        rows.append([label, f"{seconds * 1e3:.3f}", f"{count / seconds:,.0f}", f"{total:.1f}"])
        print(*rows[-1], sep="  ", flush=True)
        del suite, state
    columns = ["configuration (environments)", "ms / update", "sensor updates/s", "KiB / environment"]
    finish(options, "Tactile published configurations", table(columns, rows))


def part_scaling(options: argparse.Namespace, record: Callable[..., None]) -> None:
    """Cost against taxels, environments, triangles and points."""
    engine = settle(64, options.device, options.settle)
    rows, envs = [], options.envs
    state = repeated(engine.state, envs, options.device)

    def case(axis: str, value: int, scene: Scene, config: dict, where: HandState) -> None:
        seconds, _suite = timed(scene, config, where, options.device, options.repeats)
        record(part="scaling", axis=axis, value=value, envs=where.num_envs, ms=seconds * 1e3)
        rows.append([axis, f"{value:,}", f"{where.num_envs:,}", f"{seconds * 1e3:.3f}"])
        print(*rows[-1], sep="  ", flush=True)

    for count in (100, 400, 1024, 4096, 10_000):
        case("taxels", count, engine.scene, sensors("kinematic", count), state)
    for count in [n for n in (256, 1024, 4096, 16_384, 32_768) if n <= max(2 * envs, 1024)]:
        case("environments", count, engine.scene, sensors("kinematic"), repeated(engine.state, count, options.device))
    for triangles in (300, 1200, 5000, 20_000, 80_000):
        scene = with_mesh(engine.scene, "box1", triangles)
        raycast = {"k": KinematicTaxel(link="box0", probes=grid(100), track=("box1",), query="raycast")}
        case("triangles (raycast)", triangles, scene, raycast, state)
        case("triangles (sdf)", triangles, scene, sensors("kinematic"), state)
    for points in (250, 1000, 4000, 16_000):
        case("points (proximity)", points, engine.scene, sensors("proximity", 100, points), state)
        case("points (elastomer)", points, engine.scene, sensors("elastomer", 100, points), state)
    columns = ["axis", "value", "environments", "ms / update"]
    finish(options, "Tactile scaling", table(columns, rows))


def part_peer(options: argparse.Namespace, record: Callable[..., None]) -> None:
    """The same scene beside Genesis on the processor, by processor time, which other work does not lengthen."""
    lines = Path(options.genesis).read_text(encoding="utf-8").splitlines()
    peer = {row["sensor"]: row["processor_us"] for row in map(json.loads, lines)}
    envs, rows, steps = 64, [], 40
    engine = settle(envs, "cpu", options.settle)
    start = time.process_time()
    engine.step(1)
    for _ in range(steps):
        engine.step()
    alone = (time.process_time() - start) / (steps + 1) / envs * 1e6
    for name in ("none", *CLASSES):
        if name not in peer:
            continue
        cells = ["–"] * 3
        whole = alone
        if name != "none":
            own = moving(engine, SensorSuite(engine.scene, sensors(name), num_envs=envs), steps) / envs * 1e6
            theirs, whole = peer[name] - peer["none"], alone + own
            cells = [f"{own:.1f}", f"{theirs:.0f}", f"{theirs / own:.0f} ×"]
        record(part="peer", case=name, ours_us=whole, genesis_us=peer[name])
        rows.append([name, f"{whole:.0f}", f"{peer[name]:.0f}", f"{peer[name] / whole:.1f} ×", *cells])
        print(*rows[-1], sep="  ", flush=True)
    columns = ["sensor", "step and sensor, ours", "Genesis 1.4.5", "ratio", "sensor alone, ours", "Genesis", "ratio"]
    body = "Processor µs per environment and step (all threads), 64 environments, 100 taxels, 500 points.\n\n"
    finish(options, "Tactile sensors on the processor beside Genesis", body + table(columns, rows))


def finish(options: argparse.Namespace, title: str, body: str) -> None:
    if options.write:
        command = f"python benchmarks/tactile.py --device {options.device} --part {options.part}"
        write_section(f"{title} ({DEVICE})", command, body)


def main() -> None:
    parser = argparse.ArgumentParser()
    parts = {
        "check": part_check,
        "sensors": part_sensors,
        "step": part_step,
        "published": part_published,
        "scaling": part_scaling,
    }
    parts["peer"] = part_peer
    parser.add_argument("--part", choices=[*parts, "all"], default="all")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--envs", type=int)
    parser.add_argument("--env-list", type=int, nargs="+")
    parser.add_argument("--taxels", type=int, nargs="+", default=[100, 1000, 10_000])
    parser.add_argument("--repeats", type=int)
    parser.add_argument("--settle", type=int, default=200)
    parser.add_argument("--genesis")
    parser.add_argument("--out")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    small = options.device == "cpu"
    options.envs = options.envs or (256 if small else 16_384)
    options.env_list = options.env_list or ([64, 256] if small else [1024, 4096, 8192, 16_384])
    options.repeats = options.repeats or (3 if small else 100)
    global DEVICE  # noqa: PLW0603
    where = pick_device(options.device)
    DEVICE = where.name if where.is_cuda else "2 shared cores"

    def record(**values: Any) -> None:
        if options.out:
            with Path(options.out).open("a", encoding="utf-8") as stream:
                stream.write(json.dumps({"device": DEVICE, **values}) + "\n")

    for name, part in parts.items():
        if options.part == name or (options.part == "all" and name != "peer"):
            print(f"# {name} on {DEVICE}", flush=True)
            chosen = argparse.Namespace(**{**vars(options), "part": name})
            part(chosen, record)


if __name__ == "__main__":
    main()
