"""The MuJoCo backend against Newton's and Euler's laws."""

import logging
import re
from dataclasses import replace

import numpy as np
import pytest

from brainbench.stimuli import Frames, PlacedObject, Scene, Solid, WhiskerArray, simulate
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.motion.trajectories import Still, Translation
from brainbench.stimuli.objects.obstacle import ConvexPart
from tests.factories.obstacles import post
from tests.factories.swing import Oscillation
from tests.factories.whiskers import C2

STIFF = replace(C2, young_modulus=5e13, damping_ratio=6.0)
COARSE = Fidelity(links=8, time_step=1e-4)


def _run(*jobs, fidelity=COARSE, **options):
    return get_engine("mujoco").run(jobs, fidelity, **options)


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
