"""MuJoCo's model of a whisker: its follicle is driven along the trajectory."""

from __future__ import annotations

import logging
import re
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from brainbench.stimuli import Frames, PlacedObject, Scene, Solid, WhiskerArray, simulate
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.reach import reachable
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.motion.trajectories import Still, Translation
from brainbench.stimuli.objects.obstacle import ConvexPart
from brainbench.stimuli.whiskers.whisker import build_chain
from tests.factories.engine_scenes import C2, Oscillation, post

COARSE = Fidelity(links=8, time_step=1e-4)


def _run(*jobs, fidelity=COARSE, **options):
    return get_engine("mujoco").run(jobs, fidelity, **options)


def _follow(built, steps):
    """Prescribed coordinates [steps, …] as MuJoCo integrates them from chunk to chunk."""
    mujoco, rollout = import_module("mujoco"), import_module("mujoco.rollout")
    from brainbench.stimuli.engines.mujoco import ARMATURE, CHUNK

    model, drive = built.model, built.drives[-1]
    width = drive.position.shape[1]
    out, state = [], None
    for first in range(0, steps, CHUNK):
        count = min(CHUNK, steps - first)
        if state is None:
            state = np.zeros(1 + model.nq + model.nv)
        state[1 : 1 + width] = drive.position[first]
        state[1 + model.nq : 1 + model.nq + width] = drive.velocity[first]
        force = np.zeros((1, count, model.nv))
        force[0, :, :width] = ARMATURE * drive.acceleration[first : first + count]
        states, _ = rollout.rollout(
            model, mujoco.MjData(model), state[None], force, control_spec=int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        )
        out += [state[None, 1 : 1 + width].copy(), states[0, :-1, 1 : 1 + width]]
        state = states[0, -1].copy()
    return np.concatenate(out)


def test_the_follicle_follows_its_trajectory_to_a_millionth_against_apost():
    follicle = Oscillation(angles=(0.35, 0.1, 0.2), shift=(5e-4, 0, 0))
    times = np.arange(1.0, 101.0) * 1e-3
    smooth = replace(C2, friction=0.0)
    trace = _run(Job(smooth, follicle, (post(0.010, 0.002),), times), record_shape=True)[0]
    assert trace.contact.any()
    assert trace.link_positions is not None
    # The recorded shape uses the prescribed base; the engine's own base is checked through its state.
    from brainbench.stimuli.engines import mujoco as _mujoco_model

    job = Job(C2, follicle, (post(0.010, 0.002),), times)
    steps = np.arange(0.0, 1002.0) * 1e-4
    chain = build_chain(C2, 8)
    reach = reachable(C2, follicle.pose(steps)[0], job.obstacles, steps)
    built = _mujoco_model.build_model(job, chain, reach, 1e-4, steps)
    followed = _follow(built, len(steps) - 1)
    wanted = built.drives[-1].position
    assert np.ptp(wanted, axis=0).min() > 0.1
    assert np.abs(followed - wanted).max() < 1e-6 * np.ptp(wanted, axis=0).max()


def test_refining_step_and_links_converges():
    times = np.arange(1.0, 101.0) * 1e-3
    job = Job(C2, Oscillation(angles=(0.25, 0, 0)), (post(0.0107, 0.0025, friction=0.0),), times)
    best = _run(job, fidelity=Fidelity(links=24, time_step=2e-5))[0].wrench[:, 5]
    assert np.abs(best).max() > 1e-7
    gaps = [
        np.linalg.norm(_run(job, fidelity=Fidelity(links=links, time_step=step))[0].wrench[:, 5] - best)
        / np.linalg.norm(best)
        for links, step in ((5, 2e-4), (8, 1e-4), (14, 5e-5))
    ]
    assert gaps == sorted(gaps, reverse=True)
    assert gaps[-1] < 0.01


def test_frames_between_steps_are_interpolated():
    swing = Oscillation(angles=(0.3, 0, 0))
    fine = np.array([0.0100, 0.01005, 0.0101])
    trace = _run(Job(C2, swing, (), fine))[0]
    np.testing.assert_allclose(trace.wrench[1], trace.wrench[[0, 2]].mean(axis=0), rtol=1e-12)


def test_results_do_not_depend_on_workers_order_or_company():
    times = np.arange(1.0, 31.0) * 1e-3
    jobs = [Job(C2, Oscillation(angles=(a, 0, 0)), (post(0.010, 2e-3),), times) for a in (0.1, 0.2, 0.3)]
    calls = []
    together = _run(*jobs, workers=2, progress=lambda done, total: calls.append((done, total)))
    alone = [_run(job, workers=1)[0] for job in jobs]
    for a, b in zip(together, alone, strict=True):
        np.testing.assert_array_equal(a.wrench, b.wrench)
    assert calls == [(1, 3), (2, 3), (3, 3)]


def test_an_overdamping_step_is_told_in_the_log(caplog):
    with caplog.at_level(logging.WARNING):
        light = replace(C2, damping_ratio=0.1)
        _run(Job(light, StillFollicle(), (), np.array([0.01])), fidelity=Fidelity(links=8, time_step=1e-3))
    assert re.search(r"time step .*0\.001 s .*ratio", caplog.text)


@pytest.mark.slow
def test_a_polygonal_post_is_felt_as_the_rod_engine_feels_it():
    angle = 2 * np.pi * np.arange(64) / 64
    ring = 4e-3 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    ends = [np.column_stack([ring, np.full(64, height)]) for height in (-6e-3, 6e-3)]
    solid, passing = Solid("prism", (ConvexPart(np.vstack(ends)),)), Translation((0, -0.08, 0), 0.005)
    placed = PlacedObject(solid, (13e-3, 6.5e-3, 1e-3), (0.3, 0.2, 0.5), passing, friction=0.0)
    array, frames = WhiskerArray.mouse(whiskers="C1,D2"), Frames(first=0.002, interval=0.004, count=40)
    scene = Scene("post", array, (placed,), Still(), frames=frames)
    # MuJoCo's several contacts of one pair of bodies lay too far apart: moments erred by 39 and 42 % with status ok.
    found, truth = (simulate(scene, backend=name, cache=False) for name in ("mujoco", "rod"))
    assert (found["status"] == "ok").all()
    moments = found["wrench"].values[0, ..., 3:], truth["wrench"].values[0, ..., 3:]
    miss = np.sqrt(np.mean((moments[0] - moments[1]) ** 2, axis=(0, 2)) / np.mean(moments[1] ** 2, axis=(0, 2)))
    assert (miss < 0.1).all()
