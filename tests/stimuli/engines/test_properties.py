"""What holds of every scene, on random ones: mirror images, rigid motions, batches, and balance without inertia."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, Obstacle, Sphere
from tests.factories.engine_scenes import C2

pytest.importorskip("warp")

TIMES = np.arange(1, 41) * 2e-3
SPEED = 0.05

SCENES = st.builds(
    dict,
    curvature=st.floats(-20, 20),
    # A ball without friction throws the whisker off to either side; rounding decides which.
    kind=st.sampled_from(["post", "box"]),
    at=st.floats(0.006, 0.012),
    size=st.floats(3e-4, 3e-3),
    lift=st.floats(-5e-4, 5e-4),
)


FEW_OR_MANY = pytest.mark.parametrize("examples", [4, pytest.param(15, marks=pytest.mark.slow)])


def _for_all(examples, check, *more):
    settings(max_examples=examples, derandomize=examples < 10)(given(SCENES, *more)(check))()


def _job(curvature, kind, at, size, lift, *, side=1.0, friction=0.0, turn=None, place=(0.0, 0.0, 0.0), **options):
    """A whisker in the base frame that a body pushes towards +y (``side`` −1: −y), all turned and moved."""
    whisker = replace(C2, curvature=side * curvature)
    # It begins 1 mm below the lowest point of the unbent whisker.
    start = np.array([at, side * (-1.5e-3 - size - 0.5 * abs(curvature) * C2.arc_length**2), lift])
    body = {
        "post": lambda: Capsule((at, start[1], -0.02), (at, start[1], 0.02), size),
        "ball": lambda: Sphere(tuple(start), size),
        "box": lambda: Box(tuple(start), (size, size, 2 * size)),
    }[kind]()
    euler = StillFollicle().euler if turn is None else turn
    rotation = base_rotation(euler)
    velocity = rotation @ [0.0, side * SPEED, 0.0]

    def motion(times):
        return np.outer(times, velocity), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    obstacle = Obstacle((body.moved(rotation, np.asarray(place)),), motion, friction)
    return Job(whisker, StillFollicle(tuple(place), tuple(euler)), (obstacle,), TIMES, **options)


def _run(*jobs, **options):
    return RodEngine(retry=1).run(list(jobs), Fidelity(links=8, **({"time_step": 5e-4} | options)), record_shape=True)


FINE = {"time_step": 2e-5, "precision": "double", "contact_tolerance": 1e-9}
"""At an edge longer steps make as much of rounding as the force itself: in 3 % of these scenes with steps of .5 ms."""


def _peak(trace):
    return np.abs(trace.wrench).max(axis=0).reshape(2, 3).max(axis=1).repeat(3)


@FEW_OR_MANY
def test_a_mirrored_scene_gives_the_mirrored_wrench(examples):
    def check(scene):
        a, b = _run(_job(**scene), _job(**scene, side=-1.0), **FINE)
        assert a.status == b.status
        if a.status == "ok":
            # Forces mirror in y, moments as pseudo-vectors.
            miss = np.abs(b.wrench - a.wrench * [1, -1, 1, -1, 1, -1])
            assert (miss <= 1e-6 * _peak(a) + 1e-12).all()

    _for_all(examples, check)


@FEW_OR_MANY
def test_a_scene_turned_and_moved_gives_the_turned_wrench(examples):
    def check(scene, turn, place):
        here, there = _run(_job(**scene), _job(**scene, turn=turn, place=place), **FINE)
        assert here.status == there.status
        if here.status == "ok":
            turned = (here.wrench.reshape(-1, 2, 3) @ base_rotation(turn).T).reshape(-1, 6)
            assert (np.abs(there.wrench - turned) <= 1e-6 * _peak(here) + 1e-12).all()

    angle, shift = st.floats(-3, 3), st.floats(-0.02, 0.02)
    _for_all(examples, check, st.tuples(angle, st.floats(-1.2, 1.2), angle), st.tuples(shift, shift, shift))


def test_a_tip_at_an_edge_is_not_thrown_out_along_the_whisker_by_a_hundred_times_the_force():
    tip = {"curvature": -19.333, "kind": "box", "at": 0.009239, "size": 0.0019467, "lift": -0.00041778}
    job = replace(_job(**tip), times=np.arange(1, 401) * 2e-4)
    coarse = Fidelity(links=8, time_step=5e-4, twist=True)
    (alone,), (checked,) = (RodEngine(retry=retry).run([job], coarse) for retry in (1, 5))
    (fine,) = _run(job, **FINE)
    assert np.abs(alone.wrench[:, :3]).max() > 50 * np.abs(fine.wrench[:, :3]).max()
    assert checked.status == "ok"
    assert np.abs(checked.wrench[:, :3]).max() < 1.1 * np.abs(fine.wrench[:, :3]).max()


@FEW_OR_MANY
def test_neither_batch_nor_order_changes_a_byte(examples):
    def check(scene, order):
        jobs = [_job(**scene, friction=0.3), _job(**(scene | {"at": 0.008})), _job(**(scene | {"kind": "ball"}))]
        together = RodEngine().run([jobs[k] for k in order], Fidelity(links=8, time_step=5e-4), workers=2)
        for k, trace in zip(order, together, strict=True):
            (alone,) = RodEngine().run([jobs[k]], Fidelity(links=8, time_step=5e-4), workers=1)
            assert alone.wrench.tobytes() == trace.wrench.tobytes()
            assert alone.reason == trace.reason

    _for_all(examples, check, st.permutations([0, 1, 2]))


@FEW_OR_MANY
def test_without_inertia_the_base_bears_what_the_contacts_give(examples):
    felt = []

    def check(scene):
        (trace,) = _run(_job(**scene, friction=0.3), solver="quasistatic")
        if trace.status == "ok":
            felt.append(trace.contact.any())
            # Steps keep a share of the mass (LIGHT), so slips leave a little.
            miss = np.linalg.norm(trace.wrench[:, :3] - trace.contact_wrench[:, :3], axis=1)
            assert np.median(miss) <= 1e-3 * np.abs(trace.wrench[:, :3]).max() + 1e-12
            assert (miss <= 0.05 * np.abs(trace.wrench[:, :3]).max() + 1e-12).mean() > 0.9

    _for_all(examples, check)
    assert np.mean(felt) > 0.5
