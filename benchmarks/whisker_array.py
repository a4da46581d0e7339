"""30 mouse whiskers of 20 links against the Rodgers solid: our backends against plain MuJoCo models of the whole array.

``PYTHONPATH=. python benchmarks/whisker_array.py`` rewrites its section of RESULTS.md.
The plain models hold all 30 whiskers in one MJCF (written by :func:`plain_model`), with the same step, integrator,
joints and collision filter (only object against whisker) and a dense or a sparse Jacobian, and whisk alike.
``--mjcf plain.xml`` writes that model to look at or to time elsewhere.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from results import table, write_section

from brainbench.stimuli.engines import get_backend
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.mujoco import model as _mujoco_model
from brainbench.stimuli.engines.mujoco.drive import ARMATURE
from brainbench.stimuli.engines.protocol import Job
from brainbench.stimuli.engines.trust import MILLI
from brainbench.stimuli.scenes.recipes import get_recipe
from brainbench.stimuli.whiskers.chain import build_chain

FIDELITY = Fidelity(links=20, time_step=5e-5)
"""Preset ``accurate`` with one step for all whiskers, as one model of all of them must have."""


def jobs(duration: float) -> list[Job]:
    scene = get_recipe("rodgers").scenes[0]
    return [replace(job, times=np.arange(1e-3, duration, 1e-3)) for job in scene.jobs()]


def plain_model(array: list[Job], duration: float, jacobian: str) -> tuple[str, np.ndarray]:
    """Return the MJCF of all whiskers in one model, and the driving forces [n, drives] of its prescribed joints."""
    step = FIDELITY.time_step
    times = step * np.arange(round(duration / step) + 2)
    root = ElementTree.Element("mujoco")
    _mujoco_model._add(root, "compiler", angle="radian")
    option = _mujoco_model._add(
        root, "option", timestep=step * MILLI, integrator="discrete", solver="Newton", tolerance=1e-14,
        cone="elliptic", impratio=_mujoco_model.FRICTION_STIFFNESS, gravity=(0, 0, 0), jacobian=jacobian,
    )  # fmt: skip
    _mujoco_model._add(option, "flag", autoreset="disable", refsafe="disable", diagexact="enable")
    assets, world = (_mujoco_model._add(root, tag) for tag in ("asset", "worldbody"))
    _mujoco_model._add_obstacles(world, assets, array[0].obstacles, array[0].whisker.friction, times, step * MILLI)
    sensors = _mujoco_model._add(root, "sensor")
    forces = []
    for number, job in enumerate(array):
        position, euler = job.follicle.pose(times)
        base, path = _mujoco_model._add_follicle(world, position * MILLI, euler)
        base.set("name", f"base{number}")
        _mujoco_model._add(base, "site", name=f"site{number}", size=1e-3)
        chain = build_chain(job.whisker, FIDELITY.links)
        cores = [(0.0, 0.0)] * chain.links
        _mujoco_model._add_links(base, assets, job, chain, chain.damping(step), 0.0, cores)
        for kind in ("force", "torque"):
            _mujoco_model._add(sensors, kind, site=f"site{number}")
        drive = _mujoco_model.drive_scalars(path, step * MILLI)
        forces.append((drive.position[0], drive.velocity[0], ARMATURE * drive.acceleration))
    return ElementTree.tostring(root, encoding="unicode"), np.array(forces, dtype=object)


def time_plain(array: list[Job], duration: float, jacobian: str) -> tuple[float, float]:
    """Return wall seconds per simulated second of the plain model, and its largest hinge angle."""
    mujoco = _mujoco_model.engine()
    text, forces = plain_model(array, duration, jacobian)
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    width = model.nv // len(array)
    driven = width - 2 * FIDELITY.links
    for number, (position, velocity, _) in enumerate(forces):
        data.qpos[number * width : number * width + driven] = position
        data.qvel[number * width : number * width + driven] = velocity
    steps = round(duration / FIDELITY.time_step)
    started = time.perf_counter()
    for n in range(steps):
        for number in range(len(array)):
            data.qfrc_applied[number * width : number * width + driven] = forces[number][2][n]
        mujoco.mj_step(model, data)
    if data.warning.number.any() or not np.isfinite(data.qpos).all():
        raise SystemExit(f"The plain model ({jacobian}) failed.")
    return (time.perf_counter() - started) / duration, float(np.abs(data.qpos).max())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=0.1, help="simulated seconds of our backend")
    parser.add_argument("--plain-duration", type=float, default=0.02, help="simulated seconds of the plain models")
    parser.add_argument("--mjcf", type=Path, help="also write the plain model here")
    options = parser.parse_args()
    array = jobs(options.duration)
    if options.mjcf:
        options.mjcf.write_text(plain_model(array, options.plain_duration, "sparse")[0])
    rows, seconds, used_by_ours = [], {}, {}
    # Kernels are compiled once per machine and kept: not part of a simulation's time.
    get_backend("rod").run(array, FIDELITY, workers=1)
    for name, workers in (("mujoco", 1), ("mujoco", 2), ("rod", 1), ("rod", 2)):
        # Processor time excludes what others take from a busy machine; wall time does not.
        started, used = time.perf_counter(), time.process_time()
        traces = get_backend(name).run(array, FIDELITY, workers=workers)
        wall = (time.perf_counter() - started) / options.duration
        seconds[name, workers] = wall
        cpu = (time.process_time() - used) / options.duration
        used_by_ours[name, workers] = cpu
        touching = sum(bool(trace.contact.any()) for trace in traces)
        rows.append([f"ours, {name}, {workers} threads", f"{wall:.1f}", f"{cpu:.1f}", f"{touching} whiskers touch"])
    plain = {}
    for jacobian in ("dense", "sparse"):
        used = time.process_time()
        wall, _ = time_plain(array, options.plain_duration, jacobian)
        cpu = (time.process_time() - used) / options.plain_duration
        plain[jacobian] = cpu
        rows.append([f"plain MuJoCo, {jacobian}", f"{wall:.1f}", f"{cpu:.1f}", ""])
    text = table(["engine", "wall s / simulated s", "processor s / simulated s", ""], rows)
    best = min(plain.values())
    for name in ("rod", "mujoco"):
        text += f"\n\nProcessor time of the best plain model over `{name}`, one thread each: "
        text += f"{best / used_by_ours[name, 1]:.2f}× (the goal is 3×); wall time of `{name}` on one thread over two: "
        text += f"{seconds[name, 1] / seconds[name, 2]:.2f}×."
    text += " `mujoco` includes compiling 30 models. The plain model: benchmarks/plain_array.xml (`--mjcf`)."
    write_section("30 whiskers against plain MuJoCo", "PYTHONPATH=. python benchmarks/whisker_array.py", text)
    print(text)


if __name__ == "__main__":
    main()
