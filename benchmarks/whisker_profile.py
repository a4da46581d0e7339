"""Where the time of the mujoco backend goes: per whisker-step by what the whisker meets, and by stage of MuJoCo's step.

``PYTHONPATH=. python benchmarks/whisker_profile.py`` rewrites its section of RESULTS.md. Jobs and fidelity are those of
``whisker_array.py``; processor time, one thread.
"""

from __future__ import annotations

import time
from importlib import import_module

import numpy as np
from results import table, write_section
from whisker_array import FIDELITY, jobs

from brainbench.stimuli.engines.mujoco import engine as mujoco
from brainbench.stimuli.engines.mujoco import model as _mujoco_model
from brainbench.stimuli.engines.protocol import Job
from brainbench.stimuli.engines.reach import reachable
from brainbench.stimuli.whiskers.chain import build_chain

STAGES = {
    "kinematics": "POS_KINEMATICS",
    "joint-space inertia and its factors": "POS_INERTIA",
    "collision": "POS_COLLISION",
    "contact rows": "POS_MAKE",
    "velocities and bias forces": "VELOCITY",
    "contact solver": "CONSTRAINT",
    "whole step": "STEP",
}
"""Stage → MuJoCo's timer. What the whole step has beyond the others is mostly a second factorisation, of M + hD + h²K,
and the sensors."""


def build(job: Job) -> tuple[_mujoco_model.WhiskerModel, np.ndarray]:
    chain = build_chain(job.whisker, FIDELITY.links)
    times = FIDELITY.time_step * np.arange(round(job.times[-1] / FIDELITY.time_step) + 2)
    reach = reachable(job.whisker, job.follicle.pose(times)[0], job.obstacles, times)
    return _mujoco_model.build_model(job, chain, reach, FIDELITY.time_step, times), times


def stages(job: Job) -> dict[str, float]:
    """Microseconds per step of each stage; reading the clock adds some tenths to each."""
    engine = import_module("mujoco")
    built, times = build(job)
    model, data = built.model, engine.MjData(built.model)
    data.qpos[:] = model.qpos0
    q = v = 0
    for drive in built.drives:
        width, freedom = drive.position.shape[1], drive.velocity.shape[1]
        data.qpos[q : q + width], data.qvel[v : v + freedom] = drive.position[0], drive.velocity[0]
        q, v = q + width, v + freedom
    forces = mujoco._control(built, job, times[:-2], 0)
    engine.set_mjcb_time(lambda: time.perf_counter() * 1e6)
    try:
        for force in forces:
            data.qfrc_applied[:] = force[: model.nv]
            engine.mj_step(model, data)
    finally:
        engine.set_mjcb_time(None)
    timers = {name: int(getattr(engine.mjtTimer, f"mjTIMER_{timer}")) for name, timer in STAGES.items()}
    return {name: float(data.timer[index].duration) / len(forces) for name, index in timers.items()}


def main() -> None:
    array = jobs(0.1)
    traces = mujoco.MujocoBackend().run(array, FIDELITY, workers=1)
    builds = []
    for job in array:
        started = time.thread_time()
        build(job)
        builds.append(time.thread_time() - started)
    cost = np.array([trace.seconds for trace in traces]) - builds
    micro = 1e6 * cost / [trace.steps for trace in traces]
    reach = np.array([reachable_parts(job) > 0 for job in array])
    share = np.array([trace.contact.mean() for trace in traces])
    groups = {
        "no object in reach": ~reach,
        "in reach, never in contact": reach & (share == 0),
        "in contact less than a quarter of the time": (share > 0) & (share < 0.25),
        "in contact longer": share >= 0.25,
    }
    rows = [[name, str(int(group.sum())), f"{micro[group].mean():.1f}"] for name, group in groups.items()]
    text = table(["whiskers", "number", "processor µs per step"], rows)
    text += f"\n\nCompiling a model takes {1e3 * np.mean(builds):.1f} ms. Stages of one step, µs:\n\n"
    free, touching = (stages(array[index]) for index in (int(np.argmin(reach)), int(np.argmax(share))))
    rows = [[name, f"{free[name]:.1f}", f"{touching[name]:.1f}"] for name in STAGES]
    columns = ["stage", "no object in reach", f"in contact {share.max():.0%} of the time"]
    text += table(columns, rows)
    text += (
        "\n\nA free whisker of 20 links (43 degrees of freedom on one branch, whose inertia is a full matrix) costs"
        f" {micro[~reach].mean():.0f} µs per step whatever flags are off, so if contacts cost nothing 30 of them would"
        f" still take {30 * micro[~reach].mean() * 1e-6 / FIDELITY.time_step:.1f} s per simulated second."
    )
    write_section("Where the time of a whisker goes", "PYTHONPATH=. python benchmarks/whisker_profile.py", text)
    print(text)


def reachable_parts(job: Job) -> int:
    times = np.linspace(0.0, job.times[-1], 100)
    return reachable(job.whisker, job.follicle.pose(times)[0], job.obstacles, times).parts


if __name__ == "__main__":
    main()
