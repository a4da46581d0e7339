"""What only the ``rod`` backend promises: exact surfaces, large steps, one result whatever the batch and the device."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.collections import resolve_objects
from brainbench.stimuli.objects.obstacle import Box, Capsule, Obstacle
from brainbench.stimuli.sweeps.grid import SweepGrid
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes
from brainbench.stimuli.validation import bench_tests
from brainbench.stimuli.whiskers.chain import build_chain
from tests.factories.whiskers import C2

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
    times = np.arange(1, 61) * 1e-3
    jobs = [Job(replace(C2, friction=mu), StillFollicle(), (thing,), times) for thing in things for mu in (0.0, 0.48)]
    alone = [_run(job)[0].wrench.tobytes() for job in jobs]
    assert [trace.wrench.tobytes() for trace in _run(jobs, workers=1)] == alone
    assert [trace.wrench.tobytes() for trace in _run(jobs, workers=2)] == alone


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


def test_sweeps_through_the_fast_path_equal_their_scenes():
    from brainbench.stimuli import simulate
    from brainbench.stimuli.sweeps.simulation import simulate_sweeps

    objects = resolve_objects(["ellipsoid-1"], surfaces=True)
    grid = SweepGrid(speed=(0.05,), rotation=(0.0, 0.7), distance=(0.005,), size=(0.03,))
    scenes = SweepScenes(grid, {name: item.load for name, item in objects.items()}, whiskers="C1,C2,D2")
    fidelity = Fidelity(links=10, time_step=5e-4)
    fast = simulate_sweeps(scenes, [0, 1], fidelity=fidelity)
    slow = simulate([scenes[0], scenes[1]], fidelity=fidelity, backend="rod", cache=False)
    assert not fast.unstable.any()
    assert (fast.contact > 0).any()
    assert fast.steps < 0.6 * fast.steps_in_full
    peak = np.abs(slow["wrench"].values[..., :3]).max()
    # The same contacts, rounded differently: friction makes a few readings differ by more.
    assert np.median(np.abs(fast.wrench - slow["wrench"].values)[..., :3]) < 1e-4 * peak
    assert np.abs(fast.wrench - slow["wrench"].values)[..., :3].mean() < 2e-3 * peak


def test_sweeps_do_not_depend_on_which_share_a_launch():
    from brainbench.stimuli.sweeps.simulation import simulate_sweeps

    objects = resolve_objects(["ellipsoid-1", "brick-2"], surfaces=True)
    grid = SweepGrid(speed=(0.05,), rotation=(0.0, 0.7), distance=(0.005,), size=(0.03,))
    scenes = SweepScenes(grid, {name: item.load for name, item in objects.items()}, whiskers="C1,D2")
    together = simulate_sweeps(scenes, [0, 1, 2, 3], fidelity=COARSE, workers=2)
    single = [simulate_sweeps(scenes, [index], fidelity=COARSE) for index in range(4)]
    assert np.concatenate([batch.wrench for batch in single]).tobytes() == together.wrench.tobytes()


def test_whiskers_that_cannot_be_trusted_are_simulated_again_and_no_other_changes():
    from brainbench.stimuli.sweeps.simulation import simulate_sweeps

    objects = resolve_objects(["chair-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
    fidelity, chosen = Fidelity(links=10, time_step=5e-4), [0, 140]
    once = simulate_sweeps(scenes, chosen, fidelity=fidelity)
    again = simulate_sweeps(scenes, chosen, fidelity=fidelity, retry=5)
    bad, left = once.unstable, again.unstable
    assert left.sum() <= bad.sum() / 2
    assert (again.retried, once.retried) == (2, 0)
    assert [bool(words) for words in again.reasons] == left.any(axis=1).tolist()
    # What was simulated again is what a finer simulation of everything gives; nothing else changes.
    runs = [once, *(simulate_sweeps(scenes, chosen, fidelity=Fidelity(links=10, time_step=h)) for h in (1e-4, 5e-5))]
    same = np.array([(run.wrench == again.wrench).all(axis=(1, 3)) for run in runs])
    assert (same[0] | same[1:].any(axis=0) | left).all()
    assert (same[1:].any(axis=0) & ~left)[bad].sum() >= bad.sum() / 2
    assert same[0][~bad].mean() > 0.9


def test_whiskers_of_a_scene_that_cannot_be_trusted_are_simulated_again_and_no_other_changes():
    from brainbench.stimuli import simulate

    objects = resolve_objects(["chair-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
    some, fidelity = [scenes[0], scenes[140]], Fidelity(links=10, time_step=5e-4)
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


def test_whiskers_that_finer_steps_do_not_mend_take_steps_twice_as_fine(monkeypatch):
    from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

    # Without steps that only compare.
    monkeypatch.setattr("brainbench.stimuli.engines.trust.SUSPICIOUS_PEAK", 1e9)
    objects = resolve_objects(["brick-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
    launcher = SweepLauncher(scenes, Fidelity(links=12, time_step=5e-4))
    chosen = [("brick-0", [scenes.grid.sweeps("brick-0")[74]])]
    once = launcher.launch(chosen)
    bad = once.verdict.unstable
    five = launcher.launch(chosen, [(bad, 5)])
    left = bad.copy()
    left[bad] = five.verdict.unstable[:, 0]
    assert left.any()
    result = launcher.trusted(chosen, 5)
    assert (result.unstable.any(), result.reasons, result.retried) == (False, ("",), 1)
    ten = launcher.launch(chosen, [(left, 10)])
    np.testing.assert_array_equal(np.moveaxis(result.wrench[0], 1, 0)[left[0]], ten.wrench[:, :, 0])
    # All that was computed is counted.
    assert result.steps == once.steps.sum() + five.steps.sum() + ten.steps.sum()


def test_a_whisker_that_cannot_be_trusted_says_why():
    from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

    objects = resolve_objects(["brick-0", "chair-0"], surfaces=True)
    scenes = SweepScenes(GRIDS["thesis-high"], {name: item.load for name, item in objects.items()})
    launcher = SweepLauncher(scenes, Fidelity(links=12, time_step=5e-4))
    found = set()
    for name, index in (("brick-0", 74), ("chair-0", 168)):
        result = launcher.launch([(name, [scenes.grid.sweeps(name)[index]])])
        status, unstable, reasons = result.counts["status"][0], result.verdict.unstable[0], result.verdict.reasons[0]
        first = int(np.argmax(unstable))
        told = f"{scenes.array.names[first]}: {reasons[first]}"
        assert launcher.batch(result).reasons[0].startswith(told)
        assert [bool(reason) for reason in reasons] == unstable.tolist()
        assert ["a joint bent by" in reason for reason in reasons] == (status == 1).tolist()
        found |= {reason.split(" ")[0] for reason in reasons[unstable]}
    assert len(found) > 1


def _few_sweeps(**grid):
    objects = resolve_objects(["ellipsoid-1"], surfaces=True)
    grid = SweepGrid(**{"speed": (0.05,), "rotation": (0.0,), "distance": (0.005,), "size": (0.03,), **grid})
    return SweepScenes(grid, {name: item.load for name, item in objects.items()}, whiskers="C1,C2,D2")


@pytest.mark.parametrize(("speed", "step", "way"), [(3.0, 5e-3, "0.938 mm"), (4.0, 1e-4, "0.4 mm")])
@pytest.mark.parametrize("path", ["sweeps", "scenes"])
def test_an_object_too_fast_to_be_followed_is_told_of_in_sweeps_as_in_scenes(path, speed, step, way):
    from brainbench.stimuli import simulate
    from brainbench.stimuli.sweeps.simulation import simulate_sweeps

    scenes, fidelity = _few_sweeps(speed=(0.05, speed)), Fidelity(links=10, time_step=step)
    if path == "sweeps":
        batch = simulate_sweeps(scenes, [0, 1], fidelity=fidelity, retry=5)
        unstable, reasons = batch.unstable.any(axis=1), batch.reasons
    else:
        dataset = simulate([scenes[0], scenes[1]], fidelity=fidelity, cache=False)
        unstable = (dataset["status"].values != "ok").any(axis=1)
        reasons = ["".join(words) for words in dataset["reason"].values]
    assert unstable.tolist() == [False, True]
    assert f"moves by {way}" in reasons[1]
    assert not reasons[0]


def test_a_force_that_no_whisker_bears_is_flagged_in_sweeps_and_not_tried_again():
    from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

    scenes = _few_sweeps()
    launcher = SweepLauncher(scenes, COARSE)
    (name,) = scenes.objects
    sound = launcher.trusted([(name, scenes.grid.sweeps(name))], 5)
    assert not sound.unstable.any()
    peaks = np.linalg.norm(sound.wrench[0, ..., :3], axis=-1).max(axis=0)
    launcher.solver.strongest[:] = 0.5 * peaks.max()
    found = launcher.trusted([(name, scenes.grid.sweeps(name))], 5)
    assert found.unstable.tolist() == [(peaks > 0.5 * peaks.max()).tolist()]
    assert "stretch the whisker" in found.reasons[0]
    assert found.retried == 0


def test_an_unknown_device_is_refused_in_words():
    with pytest.raises(UsageError, match="received 'tpu'"):
        RodEngine(device="tpu").run([Job(C2, StillFollicle(), (), np.array([1e-3]))], COARSE)


def test_more_precision_than_there_is_is_refused_in_words():
    with pytest.raises(UsageError, match=r"'quad'.*'single', 'double'"):
        Fidelity(precision="quad")


@pytest.mark.parametrize("budget", [None, 4])
def test_whiskers_that_pause_for_every_look_at_a_mesh_feel_the_same(budget):
    from brainbench.stimuli.engines.rod.sweeps import SweepLauncher

    objects = resolve_objects(["torus-1", "gear-0"], surfaces=True)
    grid = SweepGrid(speed=(0.06,), rotation=(0.0, 0.4), distance=(0.005,), size=(0.04,))
    scenes = SweepScenes(grid, {name: item.load for name, item in objects.items()})
    results = []
    for sliced in (False, True):
        launcher = SweepLauncher(scenes, COARSE, sliced=sliced)
        launcher.solver.tuning = {"budget": budget}
        results.append(launcher.launch([(name, grid.sweeps(name)) for name in scenes.objects]))
        assert (launcher.solver.slices > 1) == sliced
    whole, parts = results
    assert whole.counts["touching"].sum() > 100
    for name in ("wrench", "contact", "depth", "residual"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name))
    for name, values in whole.counts.items():
        np.testing.assert_array_equal(values, parts.counts[name])


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


def test_sweeps_through_the_fast_path_may_leave_inertia_out():
    from brainbench.stimuli.sweeps.simulation import simulate_sweeps

    objects = resolve_objects(["ellipsoid-1"], surfaces=True)
    grid = SweepGrid(speed=(0.03,), rotation=(0.0,), distance=(0.005,), size=(0.03,))
    scenes = SweepScenes(grid, {name: item.load for name, item in objects.items()}, whiskers="C1,C2")
    moving, still = (
        simulate_sweeps(scenes, [0], fidelity=Fidelity(links=10, time_step=5e-4, solver=solver))
        for solver in ("dynamic", "quasistatic")
    )
    peak = np.abs(moving.wrench[..., 3:]).max()
    assert 0 < np.median(np.abs(moving.wrench - still.wrench)[..., 3:][moving.wrench[..., 3:] != 0]) < 0.02 * peak


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
