"""What only the ``rod`` backend promises: exact surfaces, large steps, one result whatever the batch and the device."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.devices import pick_device
from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.engine import PackedTasks, RodEngine, make_task
from brainbench.stimuli.engines.rod.launch import WhiskerSolver
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.objects.obstacle import Box, Capsule, Obstacle
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes
from brainbench.stimuli.validation import bench_tests
from brainbench.stimuli.whiskers.whisker import build_chain
from tests.factories.engine_scenes import C2

pytest.importorskip("warp")

COARSE = Fidelity(links=10, time_step=1e-3)


def _moving(parts, velocity, surface=None, friction=0.0):
    velocity = np.array(velocity)

    def motion(times):
        return times[:, None] * velocity, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    return Obstacle(parts, motion, friction=friction, surface=surface)


def _box_mesh(low, high):
    import trimesh

    mesh = trimesh.creation.box(bounds=[low, high])
    return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def _run(jobs, fidelity=COARSE, **options):
    return RodEngine().run(jobs if isinstance(jobs, list) else [jobs], fidelity, **options)


@pytest.mark.parametrize("step", [1e-4, 1e-3, 2e-3])
def test_a_steady_load_does_not_depend_on_the_time_step(step):
    found = bench_tests.peg(
        C2, 0.5 * C2.arc_length, 0.1 * C2.arc_length, peg_radius=5e-5, backend="rod",
        fidelity=Fidelity(links=20, time_step=step),
    )  # fmt: skip
    assert found.moment_error < 5e-3
    assert found.force_error < 5e-3


def test_a_run_takes_the_memory_of_the_last_one_and_leaves_its_results_as_they_were():
    def job(speed, size):
        peg = _moving((Capsule((0.01, -0.004, -0.01), (0.01, -0.004, 0.01), 5e-4),), (0.0, speed, 0.0))
        still = Obstacle((Box((0.012, size, 0.0), (1e-3, 1e-3, 1e-3)),))
        return Job(C2, StillFollicle(), (peg, still), np.linspace(0.002, 0.04, 20))

    packed = [PackedTasks.of([make_task(each, COARSE, {})]) for each in (job(0.1, 0.004), job(0.2, 0.003))]
    packed.append(packed[0])
    task = packed[0].tasks[0]
    make = partial(WhiskerSolver, packed[0].chains, COARSE, pick_device("cpu"), 1, twists=task.twists)
    solver = make()
    results = [each.launch(solver, record_shape=True) for each in packed]
    alone = [each.launch(make(), record_shape=True) for each in packed]
    assert vars(solver.rooms)["last"].results is not None
    for name in ("wrench", "contact", "points", "contact_wrench", "depth"):
        after, fresh = ([getattr(result, name).tobytes() for result in some] for some in (results, alone))
        assert after == fresh
    assert (results[0].contact >= 0).any()
    assert results[0].wrench.tobytes() == results[2].wrench.tobytes() != results[1].wrench.tobytes()


def test_a_recorded_launch_takes_the_gravity_of_its_own_job():
    jobs = [Job(C2, StillFollicle(), (), np.array([0.01]), gravity=(0.0, pull, 0.0)) for pull in (-9.81, 9.81, -9.81)]
    down, up, again = (_run(job)[0].wrench for job in jobs)
    assert down[0, 1] < 0 < up[0, 1]
    assert down.tobytes() == again.tobytes()


@pytest.mark.parametrize("kind", ["peg", "knife"])
def test_nothing_thin_passes_through_a_whisker_in_steps_of_a_millisecond(kind):
    """60 mm/s in steps of 1 ms: each step is longer than the peg is thick, and sixty times the knife's edge."""
    if kind == "peg":
        thing = _moving((Capsule((0.008, -0.002, -0.02), (0.008, -0.002, 0.02), 5e-5),), (0.0, 0.06, 0.0))
    else:
        blade = _box_mesh((0.008, -0.0035, -0.02), (0.0081, -0.002, 0.02))
        edge = blade.vertices.copy()
        front = edge[:, 1] > -0.003
        edge[front, 0] = 0.00805 + np.sign(edge[front, 0] - 0.00805) * 5e-7
        thing = _moving((), (0.0, 0.06, 0.0), Mesh(edge, blade.faces))
    trace = _run(Job(C2, StillFollicle(), (thing,), np.arange(1, 61) * 1e-3))[0]
    assert trace.status == "ok"
    # From y = -2 mm at 60 mm/s it reaches the whisker after 33 ms and has pushed it by 1.6 mm at the end.
    assert trace.contact[40:].all()
    assert (np.diff(trace.wrench[36:, 1]) > 0).all()
    assert trace.penetration < 2e-5


def test_a_whisker_feels_the_wall_of_a_slot_and_not_its_hull():
    """A U of three boxes as one closed surface: inside its slot there is nothing until the wall comes."""
    import trimesh

    u = trimesh.boolean.difference(
        [
            trimesh.creation.box(bounds=[(0.004, -0.004, -0.01), (0.012, 0.004, 0.01)]),
            trimesh.creation.box(bounds=[(0.0, -0.003, -0.02), (0.02, 0.002, 0.02)]),
        ],
        engine="manifold",
    )
    surface = Mesh(np.asarray(u.vertices), np.asarray(u.faces))
    thing = _moving((), (0.0, 0.05, 0.0), surface)
    # Its lower wall starts 3 mm below the whisker: after 60 ms it arrives.
    trace = _run(Job(C2, StillFollicle(), (thing,), np.arange(1, 91) * 1e-3))[0]
    assert trace.status == "ok"
    assert not trace.contact[:57].any()
    assert not trace.wrench[:57].any()
    assert trace.contact[65:].all()
    assert trace.wrench[-1, 1] > 0


def test_a_box_and_its_triangles_are_felt_alike():
    box = Box((0.009, -0.004, 0.0), (0.001, 0.001, 0.02))
    mesh = _box_mesh((0.008, -0.005, -0.02), (0.010, -0.003, 0.02))
    times = np.arange(1, 81) * 1e-3
    jobs = [
        Job(C2, StillFollicle(), (_moving((box,), (0.0, 0.05, 0.0), friction=0.4),), times),
        Job(C2, StillFollicle(), (_moving((), (0.0, 0.05, 0.0), mesh, friction=0.4),), times),
    ]
    of_box, of_mesh = _run(jobs, Fidelity(links=10, time_step=2e-4))
    peak = np.abs(of_box.wrench).max(axis=0)
    assert peak[1] > 1e-5
    assert np.abs(of_box.wrench - of_mesh.wrench)[:, [0, 1, 5]].max(axis=0) == pytest.approx(0, abs=0.02 * peak[1])


def test_jobs_give_the_same_bytes_alone_together_and_on_two_threads():
    things = [_moving((Capsule((x, -0.002, -0.02), (x, -0.002, 0.02), 3e-4),), (0.0, 0.05, 0.0)) for x in (0.006, 0.01)]
    whiskers = [
        replace(C2, friction=mu, arc_length=s * C2.arc_length) for mu in (0.0, 0.48) for s in (1, 0.9, 0.8, 0.6)
    ]
    for frames, fidelity in ((60, COARSE), (6, replace(COARSE, steps_per_period=400.0))):
        times = np.arange(1, frames + 1) * 1e-3
        jobs = [Job(whisker, StillFollicle(), (thing,), times) for whisker in whiskers for thing in things]
        assert max(map(len, RodEngine("cpu").groups(jobs, fidelity, 1))) > 1
        alone = [_run(job, fidelity)[0].wrench.tobytes() for job in jobs]
        assert [trace.wrench.tobytes() for trace in _run(jobs, fidelity, workers=1)] == alone
        assert [trace.wrench.tobytes() for trace in _run(jobs, fidelity, workers=2)] == alone


def test_whiskers_that_take_long_share_no_launch_on_a_processor():
    jobs = [Job(C2, StillFollicle(), (), np.arange(1, 1001) * 1e-3)] * 64
    sizes = [max(map(len, RodEngine("cpu").groups(jobs, replace(COARSE, time_step=step), 1))) for step in (1e-3, 1e-4)]
    assert sizes == [9, 1]


@pytest.mark.slow
def test_threads_that_start_side_by_side_on_a_fresh_machine_make_kernels_once(tmp_path):
    """A process of its own, with nothing compiled, whose threads take turns as often as they can."""
    code = (
        "import sys; sys.setswitchinterval(1e-6)\n"
        "from brainbench.stimuli.engines.rod.engine import RodEngine\n"
        "from tests.stimuli.engines.rod import test_engine as t\n"
        "job = t.Job(t.C2, t.StillFollicle(), (), t.np.array([2e-3]), gravity=(0.0, 0.0, -9.81))\n"
        "RodEngine().run([job] * 6, t.COARSE, workers=6)\n"
    )
    root = Path(__file__).parents[4]
    environment = {**os.environ, "PYTHONPATH": str(root), "WARP_CACHE_PATH": str(tmp_path)}
    ended = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr[-2000:]
    assert len(list(tmp_path.rglob("*.o"))) == 1


@pytest.mark.slow
def test_single_precision_loses_nothing_that_matters():
    thing = _moving((Capsule((0.009, -0.002, -0.02), (0.009, -0.002, 0.02), 3e-4),), (0.0, 0.05, 0.0), friction=0.48)
    job = Job(C2, StillFollicle(), (thing,), np.arange(1, 81) * 1e-3)
    single = _run(job, Fidelity(links=20, time_step=2e-4))[0].wrench
    double = _run(job, Fidelity(links=20, time_step=2e-4, precision="double"))[0].wrench
    assert np.abs(single - double).max(axis=0) == pytest.approx(0, abs=2e-3 * np.abs(double[:, :3]).max())


def test_whiskers_of_a_scene_that_cannot_be_trusted_are_simulated_again_and_no_other_changes():
    from brainbench.stimuli import simulate

    objects = resolve_objects(["chair-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
    some, fidelity = [scenes[0]], Fidelity(links=10, time_step=5e-4)
    once = simulate(some, fidelity=fidelity, backend=RodEngine(retry=1), cache=False)
    again = simulate(some, fidelity=fidelity, backend="rod", cache=False)
    bad, left = (some["status"].values != "ok" for some in (once, again))
    assert 0 < bad.sum() < 10
    assert left.sum() <= bad.sum() / 2
    same = (once["wrench"].values == again["wrench"].values).all(axis=(1, 3))
    # Whiskers that looked sound and told another force with half the step are simulated again too.
    assert same[~bad].mean() > 0.9
    assert not same[bad].any()
    assert (np.isfinite(again["wrench"].values).all(axis=(1, 3)) == ~left).all()


def test_an_unknown_device_is_refused_in_words():
    with pytest.raises(UsageError, match="received 'tpu'"):
        RodEngine(device="tpu").run([Job(C2, StillFollicle(), (), np.array([1e-3]))], COARSE)


def test_more_precision_than_there_is_is_refused_in_words():
    with pytest.raises(UsageError, match=r"'quad'.*'single', 'double'"):
        Fidelity(precision="quad")


@pytest.mark.parametrize("step", [2e-4, 2e-3])
def test_without_inertia_a_whisker_is_in_balance_at_any_step(step):
    still = Fidelity(links=20, time_step=step, solver="quasistatic")
    found = bench_tests.peg(
        C2, 0.5 * C2.arc_length, 0.2 * C2.arc_length, peg_radius=5e-5, backend="rod", fidelity=still
    )
    assert found.moment_error < 5e-3
    assert found.force_error < 5e-3


def test_a_slow_sweep_gives_the_same_with_and_without_inertia_and_a_fast_one_does_not():
    def passing(speed):
        thing = _moving((Capsule((0.009, -0.002, -0.02), (0.009, -0.002, 0.02), 3e-4),), (0.0, speed, 0.0))
        times = np.linspace(0.05, 1.0, 40) * 3.5e-3 / speed
        dynamic, balance = (
            _run(Job(C2, StillFollicle(), (thing,), times), Fidelity(links=10, time_step=1e-4, solver=solver))[0]
            for solver in ("dynamic", "quasistatic")
        )
        return np.abs(dynamic.wrench - balance.wrench).max(axis=0)[5] / np.abs(balance.wrench).max(axis=0)[5]

    assert passing(0.01) < 0.005
    assert passing(1.0) > 0.05


def test_a_weight_bends_a_whisker_without_inertia_as_it_does_with():
    jobs = [Job(replace(C2, damping_ratio=1.0), StillFollicle(), (), np.array([0.05, 0.2]), gravity=(0.0, -9.81, 0.0))]
    dynamic, balance = (
        _run(jobs, Fidelity(links=10, time_step=1e-4, solver=solver))[0] for solver in ("dynamic", "quasistatic")
    )
    np.testing.assert_allclose(balance.wrench[-1], dynamic.wrench[-1], atol=1e-3 * np.abs(dynamic.wrench[-1]).max())


@pytest.mark.parametrize("name", ["mujoco", "bullet"])
def test_other_engines_refuse_to_leave_inertia_out(name):
    from brainbench.stimuli.engines import get_engine

    if name == "bullet":
        pytest.importorskip("pybullet")
    job = Job(C2, StillFollicle(), (), np.array([0.01]))
    with pytest.raises(UsageError, match=rf"'{name}' .*'quasistatic', .*'dynamic'; .*'rod'"):
        get_engine(name).run([job], Fidelity(solver="quasistatic"))


@pytest.mark.parametrize("friction", [0.0, 0.48])
def test_the_base_feels_contacts_less_the_rate_of_momentum_in_every_frame(friction):
    """Newton and Euler for the whole whisker, from its recorded shape alone, through a blow at 60 mm/s."""
    peg = _moving((Capsule((0.009, 5e-4, -0.02), (0.009, 5e-4, 0.02), 3e-4),), (0.0, 0.06, 0.03), friction=friction)
    step = 1e-5
    whisker = replace(C2, curvature=12.0)
    fidelity = Fidelity(links=10, time_step=step, precision="double")
    job = Job(whisker, StillFollicle(), (peg,), step * np.arange(1, 1001))
    trace = _run(job, fidelity, record_shape=True)[0]
    chain = build_chain(whisker, 10)
    nodes, lengths = trace.link_positions, chain.lengths[:, None]
    along = np.diff(nodes, axis=1) / lengths
    centres = nodes[:, :-1] + along * chain.centres[:, None]

    def rate(values):
        return (values[2:] - 2 * values[1:-1] + values[:-2]) / step**2

    masses = chain.masses[:, None]
    pushed, turned = masses * rate(centres), chain.inertias[:, 1:2] * np.cross(along[1:-1], rate(along))
    momentum = np.concatenate([pushed.sum(axis=1), (np.cross(centres[1:-1], pushed) + turned).sum(axis=1)], axis=1)
    expected = trace.contact_wrench[1:-1] - momentum
    assert np.linalg.norm(momentum[:, :3], axis=1).max() > 0.1 * np.linalg.norm(trace.wrench[:, :3], axis=1).max()
    for part in (slice(0, 3), slice(3, 6)):
        peak = np.linalg.norm(trace.wrench[:, part], axis=1).max()
        assert np.linalg.norm((expected - trace.wrench[1:-1])[:, part], axis=1).max() < 1e-3 * peak
