"""Speed and memory of the tactile sensors on the published pyramid scene, on a GPU or on processors.

    python -m benchmarks.tactile.throughput --device cuda --part check        # the same readings as on the processor
    python -m benchmarks.tactile.throughput --device cuda --part sensors      # sensor time alone, against its roofline
    python -m benchmarks.tactile.throughput --device cuda --part totals       # engine totals beside the law of depths
    python -m benchmarks.tactile.throughput --device cuda --part step         # whole step against the engine alone
    python -m benchmarks.tactile.throughput --device cuda --part scaling      # taxels, environments, triangles, points

Every case is printed, and with ``--out FILE`` appended as a JSON line, as soon as it is measured. ``--from FILE`` lays
out records that were measured elsewhere, ``--write`` puts tables into RESULTS.md.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.report import script_parser, write_section
from benchmarks.tactile.scene import (
    CELLS,
    CLASSES,
    FULL,
    engine_of,
    episode,
    grid,
    replay,
    restore,
    scene_of,
    sensors,
    settled,
    totals_cases,
    with_mesh,
)
from benchmarks.tactile.tables import plot_scaling, tables
from brainbench.core.devices import pick_device, warp
from robotics_bridge.physics import HandState, TouchScene
from robotics_bridge.sensors import KinematicTaxel, Noise, SensorSuite

ROOFLINE = {False: 0.018e-3, True: 0.085e-3}
"""Seconds that the issue allows 100 taxels of 6 channels and 16,384 environments at the H200's bandwidth, clean and
with full noise; goals are multiples of these."""
MOVED = {False: 24, True: 144}
"""Bytes that an update of one taxel cannot but move: six readings without noise; with it also six measured ones, and
hysteresis and walk both read and written."""
BANDWIDTH = {"H200": 1.0, "H100": 4.8 / 3.35}
"""Roofline of a device in that of the H200."""
H200_BYTES = 4.8e12
"""Bytes per second of its memory."""
GROUP = 0.15
"""Seconds of one timed group of calls."""
Row = dict[str, Any]


def measure(function: Callable[[], object], device: str, groups: int = 7) -> float:
    """Median seconds of one call over groups of calls; on a processor its own time, not that of other work."""
    wp = warp()
    where = pick_device(device)
    clock = time.perf_counter if where.is_cuda else time.process_time

    def run(times: int) -> float:
        wp.synchronize_device(where)
        start = clock()
        for _ in range(times):
            function()
        wp.synchronize_device(where)
        return (clock() - start) / times

    run(3)
    repeats = min(max(round(GROUP / run(3)), 3), 400)
    return statistics.median(run(repeats) for _ in range(groups))


def timed(scene: TouchScene, config: dict, state: HandState, device: str) -> tuple[float, float, SensorSuite]:
    """Seconds of an update, seconds of the first one, and the suite."""
    suite = SensorSuite(scene, config, num_envs=state.num_envs, device=device)
    start = time.perf_counter()
    suite.update(state, 0.01)
    warp().synchronize_device(pick_device(device))
    first = time.perf_counter() - start
    return measure(lambda: suite.update(state, 0.01), device), first, suite


def part_check(options: argparse.Namespace) -> Iterable[Row]:
    """Readings on the device against those on the processor, clean and noisy, over updates that replay a graph."""
    states = episode()
    truth = replay(states, "cpu")
    for name, there in replay(states, options.device).items():
        here = truth[name]
        scale = np.abs(here[np.isfinite(here)]).max() + 1e-12
        same = np.nan_to_num(np.abs(here - there), nan=0.0, posinf=0.0) / scale
        lost = np.isfinite(here) != np.isfinite(there)
        same[lost] = 1.0
        yield {"case": name, "relative": float(np.quantile(same, 0.999)), "largest": float(same.max())}


def part_sensors(options: argparse.Namespace) -> Iterable[Row]:
    """Sensor time alone at one number of environments."""
    found = settled(min(options.envs, 64), options.device, options.settle)
    state, scene = restore(found, options.envs, options.device), scene_of()
    few = options.taxels[0]
    cases = [("kinematic", few, scene, None), ("kinematic", few, scene, FULL)]
    cases += [(name, 100, scene, None) for name in CLASSES[1:]]
    cases += [("proximity", 100, scene, FULL)]
    meshed = with_mesh(scene, "box1", 5000)
    cases += [("kinematic", n, meshed, None) for n in options.taxels[:2]]
    cases += [("kinematic", n, scene, noise) for n in options.taxels[1:] for noise in (None, FULL)]
    faster = next((scale for name, scale in BANDWIDTH.items() if name in options.name), 0.0)
    for name, count, where, noise in cases:
        if options.only and name not in options.only:
            continue
        label = name if name in CELLS else f"{name} {count}"
        label += (" noisy" if noise else "") + (" mesh 5k" if where is meshed else "")
        seconds, first, suite = timed(where, sensors(name, count, noise=noise), state, options.device)
        numbers = CELLS.get(name, 0) or count
        ratio = own = None
        if name == "kinematic" and faster:
            taxels = options.envs * count
            ratio = seconds / (ROOFLINE[noise is not None] * faster * taxels / (100 * 16384))
            own = seconds / (MOVED[noise is not None] * faster * taxels / H200_BYTES)
        row = {"case": label, "envs": options.envs, "ms": seconds * 1e3, "roofline_ratio": ratio, "moved_ratio": own}
        row["bytes"] = suite.state_bytes / numbers
        yield row | {"ns": seconds / options.envs / numbers * 1e9, "first_s": first}
        del suite


def part_totals(options: argparse.Namespace) -> Iterable[Row]:
    """Engine totals and the law of depths, sensor time alone."""
    for label, (scene, found, taxels) in totals_cases(options.settle).items():
        state = restore(found, options.envs, options.device)
        for noise in (Noise(), FULL):
            times = {}
            for total in ("law", "engine"):
                config = {n: replace(taxel, total=total, noise=noise) for n, taxel in taxels.items()}
                times[total] = 1e6 * timed(scene, config, state, options.device)[0]
            name = f"{label}, {'noisy' if noise.active else 'clean'}"
            yield {"case": name, "envs": options.envs, **times, "ratio": times["engine"] / times["law"]}


def part_step(options: argparse.Namespace) -> Iterable[Row]:
    """Engine alone, and engine and one sensor read every step, taken in turns."""
    for envs in options.env_list:
        engine = engine_of(envs, options.device)
        engine.step(options.settle)
        alone = measure(engine.step, options.device)
        yield {"case": "none", "envs": envs, "env_steps_per_s": envs / alone, "share": 1.0}
        for name in CLASSES:
            suite = SensorSuite(engine.scene, sensors(name), num_envs=envs, device=options.device)

            def both(engine: Any = engine, suite: Any = suite, name: str = name) -> None:
                engine.step()
                suite.update(engine.state, engine.timestep)
                suite.read(name)

            seconds = measure(both, options.device)
            alone = (alone + measure(engine.step, options.device, 3)) / 2
            yield {"case": name, "envs": envs, "env_steps_per_s": envs / seconds, "share": alone / seconds}
            del suite
        del engine


def part_scaling(options: argparse.Namespace) -> Iterable[Row]:
    """Cost against taxels, environments, triangles and points."""
    envs = options.envs
    found, scene = settled(min(envs, 64), options.device, options.settle), scene_of()
    state = restore(found, envs, options.device)

    def case(axis: str, value: int, scene: TouchScene, config: dict, where: HandState) -> Row:
        seconds, _first, _suite = timed(scene, config, where, options.device)
        return {"case": axis, "value": value, "envs": where.num_envs, "ms": seconds * 1e3}

    if not options.only or "kinematic" in options.only:
        for count in (256, 1024, 4096, 16_384, 32_768):
            yield case("environments", count, scene, sensors("kinematic"), restore(found, count, options.device))
        for count in (100, 400, 1024, 4096, 10_000):
            yield case("taxels", count, scene, sensors("kinematic", count), state)
        for triangles in (300, 1200, 5000, 20_000, 80_000):
            meshed = with_mesh(scene, "box1", triangles)
            raycast = {"k": KinematicTaxel(link="box0", probes=grid(100), track=("box1",), query="raycast")}
            yield case("triangles (raycast)", triangles, meshed, raycast, state)
            yield case("triangles (sdf)", triangles, meshed, sensors("kinematic"), state)
    for points in (250, 1000, 4000, 16_000):
        if not options.only or "proximity" in options.only:
            yield case("points (proximity)", points, scene, sensors("proximity", 100, points), state)
        if not options.only or "elastomer" in options.only:
            # Anchors of many points in many environments would fill a GPU's memory.
            some = state if envs <= 2048 else restore(found, 2048, options.device)
            yield case("points (elastomer)", points, scene, sensors("elastomer", 100, points), some)


PARTS = {
    "check": part_check,
    "sensors": part_sensors,
    "totals": part_totals,
    "step": part_step,
    "scaling": part_scaling,
}


def lay_out(rows: list[Row], options: argparse.Namespace) -> None:
    """Write the tables of every device, and the figure of scaling."""
    for device in dict.fromkeys(row["device"] for row in rows):
        kept = [row for row in rows if row["device"] == device]
        for part, (heading, body) in tables(kept).items():
            flag = "cpu" if "cores" in device else "cuda"
            if (part, flag) == ("check", "cpu"):
                continue
            command = f"python -m benchmarks.tactile.throughput --device {flag} --part {part}"
            write_section(heading, command, body, where=f"one {device}" if flag == "cuda" else "", subject="tactile")
    if options.figure:
        plot_scaling([row for row in rows if row["part"] == "scaling"], options.figure)


def main() -> None:
    parser = script_parser(__doc__)
    parser.add_argument("--part", choices=[*PARTS, "all"], default="all")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--envs", type=int)
    parser.add_argument("--env-list", type=int, nargs="+")
    parser.add_argument("--taxels", type=int, nargs="+", default=[100, 1000, 10_000])
    parser.add_argument("--settle", type=int, default=200, help="steps before anything is measured")
    parser.add_argument("--only", nargs="+", choices=CLASSES[:-1], help="classes of --part sensors and scaling")
    parser.add_argument("--from", type=Path, nargs="+", dest="records")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--figure", type=Path, help="draw the figure of scaling")
    options = parser.parse_args()
    rows: list[Row] = []
    if options.records:
        rows = [json.loads(line) for path in options.records for line in path.read_text("utf-8").splitlines()]
        lay_out(rows, options)
        return
    small = options.device == "cpu"
    options.envs = options.envs or (64 if small else 16_384)
    options.env_list = options.env_list or ([64, 256] if small else [1024, 4096, 8192, 16_384])
    where = pick_device(options.device)
    options.name = where.name if where.is_cuda else "2 shared cores"
    chosen = list(PARTS) if options.part == "all" else [options.part]
    for part in chosen:
        print(f"# {part} on {options.name}", flush=True)
        start = time.perf_counter()
        for row in PARTS[part](options):
            found = {"device": options.name, "part": part, **row}
            rows.append(found)
            shown = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()}
            print(f"{time.perf_counter() - start:6.1f} s", *(f"{k}={v}" for k, v in shown.items()), flush=True)
            if options.out:
                with options.out.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(found) + "\n")
    if options.write or options.figure:
        if not options.write:
            plot_scaling([row for row in rows if row["part"] == "scaling"], options.figure)
        else:
            lay_out(rows, options)


if __name__ == "__main__":
    main()
