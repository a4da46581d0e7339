from __future__ import annotations

import dataclasses
import json
import re
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError, UsageError
from brainbench.geometry import Mesh
from brainbench.stimuli import simulation
from brainbench.stimuli.engines import reach as _reach
from brainbench.stimuli.engines import stepping
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.mujoco import build_model
from brainbench.stimuli.engines.reach import Reach
from brainbench.stimuli.explain import Explanation, plan, reach_of
from brainbench.stimuli.motion.trajectories import Still, Translation, Whisking
from brainbench.stimuli.objects.obstacle import Obstacle, Sphere
from brainbench.stimuli.objects.solid import PlacedObject, Solid, box, rodgers_solid, sphere
from brainbench.stimuli.scenes.recipes import get_recipe
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.whiskers.array import WhiskerArray
from brainbench.stimuli.whiskers.whisker import build_chain
from tests.factories.engines import FakeEngine


def _make_scene(label, position):
    ball = PlacedObject(Solid("ball", (Sphere((0.0, 0.0, 0.0), 1e-3),)), position=position)
    return Scene(label, WhiskerArray.mouse(whiskers="C1,C2"), whisking=Whisking(), objects=(ball,))


def test_whiskers_that_reach_nothing_do_the_same_in_every_scene():
    scenes = [_make_scene(label, (1.0, 0.0, z)) for label, z in (("far", 0.0), ("farther", 1.0))]
    schedule = plan(scenes)
    assert len(schedule.jobs) == 2
    assert schedule.places[0] == schedule.places[1]
    assert not any(reach for row in schedule.reaches for reach in row)


def test_whiskers_of_another_motion_or_near_an_object_have_jobs_of_their_own():
    far = _make_scene("far", (1.0, 0.0, 0.0))
    faster = replace(far, whisking=Whisking(frequency=10.0))
    mount = far.mounts[1]
    near = _make_scene("near", tuple(float(x) for x in mount.position))
    schedule = plan([far, faster, near])
    assert len(set(schedule.places[0]) | set(schedule.places[1])) == 4
    assert schedule.places[2][1] not in schedule.places[0]


# The same step on every whisker, so that steps can be counted by hand.
FAST = Fidelity(links=6, time_step=2e-4)
ARRAY = WhiskerArray.mouse(whiskers="C1,C2,D6")
FRAMES = Frames(0.0, 0.01, 10)
NEAR = PlacedObject(sphere(2e-3), position=(0.015, 0.002, 0.003))
FAR = PlacedObject(sphere(2e-3), position=(1.0, 0.0, 0.0))


def _scene(label, *objects, **changes):
    return Scene(label, **{"array": ARRAY, "objects": objects, "frames": FRAMES, **changes})


@pytest.fixture
def in_full(monkeypatch):
    """Make the engine simulate every whisker with every object, whether it can be reached or not."""
    monkeypatch.setattr(stepping, "reachable", lambda whisker, base, obstacles, times: Reach(obstacles, 0.0))


def test_runs_are_counted_as_simulated_shared_or_silent():
    scenes = [_scene("near", NEAR), _scene("far", FAR), _scene("nothing")]
    told = Explanation.of(simulate(scenes, fidelity=FAST, backend="mujoco", cache=False))
    # C1 and C2 reach the ball; all three whisk through air once, for both other scenes and D6 for all.
    assert (told.stimuli * told.whiskers, told.simulated, told.shared, told.silent) == (9, 5, 4, 0)
    assert told.out_of_reach == {"near": ("D6",), "far": ("C1", "C2", "D6"), "nothing": ("C1", "C2", "D6")}
    assert told.steps == 5 * told.steps_in_full // 9
    assert told.links == (6, 6)


def test_whiskers_without_motion_or_object_are_silent_and_a_full_simulation_feels_nothing_either(in_full, monkeypatch):
    scene = _scene("far", FAR, NEAR, whisking=Still(), array=ARRAY.select("C1,D6"))
    full = simulate(scene, fidelity=FAST, backend="mujoco", cache=False)
    monkeypatch.setattr(stepping, "reachable", _reach.reachable)
    pruned = simulate(scene, fidelity=FAST, backend="mujoco", cache=False)
    told = Explanation.of(pruned)
    assert told.silent == 1
    assert told.out_of_reach == {"far": ("D6",)}
    assert Explanation.of(full).silent == 0
    assert told.steps < Explanation.of(full).steps
    np.testing.assert_allclose(full["wrench"], pruned["wrench"], atol=1e-12)
    assert (pruned["wrench"].sel(whisker="D6") == 0).all()
    assert not full["contact"].any()


@pytest.mark.slow
@pytest.mark.parametrize("label", ["convex-far", "concave-far"])
def test_whiskers_that_the_rodgers_solid_cannot_touch_feel_the_same_in_a_full_simulation(in_full, monkeypatch, label):
    (scene,) = (scene for scene in get_recipe("rodgers").scenes if scene.label == label)
    out = Explanation.of(simulate(scene, fidelity=FAST, backend=FakeEngine())).out_of_reach[label]
    assert 5 < len(out) < 30
    short = Scene(
        label, scene.array.select(",".join(out)), scene.objects, scene.whisking, scene.head, Frames(0, 2e-3, 30)
    )
    full = simulate(short, fidelity=FAST, backend="mujoco", cache=False)
    monkeypatch.setattr(stepping, "reachable", _reach.reachable)
    pruned = simulate(short, fidelity=FAST, backend="mujoco", cache=False)
    assert not full["contact"].any()
    scale = np.abs(pruned["wrench"].values).max(axis=(0, 1, 2))
    np.testing.assert_allclose(full["wrench"] / scale, pruned["wrench"] / scale, atol=1e-6)
    assert Explanation.of(pruned).pairs == 0


def test_the_pairs_told_are_the_pairs_the_engine_builds():
    scene = Scene(
        "solid", ARRAY, (PlacedObject(rodgers_solid(0.055), position=(0.0137, 0.0045, 0.003)),), frames=FRAMES
    )
    dataset = simulate(scene, fidelity=FAST, backend="mujoco", cache=False)
    built = 0
    for job in scene.jobs():
        chain = build_chain(job.whisker, FAST.links)
        times = FAST.time_step * np.arange(round(job.times[-1] / FAST.time_step) + 2)
        reach = _reach.reachable(job.whisker, job.follicle.pose(times)[0], job.obstacles, times)
        model = build_model(job, chain, reach, FAST.time_step, times).model
        objects = int((model.geom_conaffinity > 0).sum())
        built += objects * (model.ngeom - objects)
    told = Explanation.of(dataset)
    assert told.pairs == built > 0
    assert told.pairs_in_full == 3 * FAST.links * 24


def test_pairs_of_an_engine_that_touches_surfaces_are_counted_in_triangles():
    class Touching(FakeEngine):
        surfaces = True

    crescent = PlacedObject(rodgers_solid(0.055), position=(0.0137, 0.0045, 0.003))
    far = PlacedObject(rodgers_solid(0.055), position=(1.0, 0.0, 0.0))
    told = Explanation.of(simulate(_scene("solid", crescent, far, NEAR), fidelity=FAST, backend=Touching()))
    triangles = len(crescent.solid.surface.faces)
    assert told.bodies == "convex parts and triangles"
    assert told.pairs_in_full == 3 * FAST.links * (2 * triangles + 1)
    assert triangles < told.pairs < 3 * FAST.links * (triangles + 1)
    assert "links × convex parts and triangles" in str(told)


def test_a_whisker_inside_the_bounds_of_a_surface_but_far_from_its_triangles_does_not_reach_it():
    # A square ring in the plane of the base, 80 mm wide: its bounds hold the whisker, its bars are too far away.
    bars = [PlacedObject(box(size), place) for size, place in _RING]
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.vstack([quads[:, :3], quads[:, [0, 2, 3]]])
    vertices = np.concatenate([corners * size + place for size, place in _RING])
    ring = Mesh(vertices, np.concatenate([faces + 8 * bar for bar in range(4)]))
    (job,) = _scene("ring", *bars, array=ARRAY.select("C2")).jobs()
    times = np.array([0.0, 1e-3])
    base = np.tile(np.zeros(3), (2, 1))
    for size, hit in ((1.0, False), (0.3, True)):
        obstacle = Obstacle((), surface=ring.scaled(size))
        reach = _reach.reachable(job.whisker, base, (obstacle,), times, surfaces=True)
        assert bool(reach) is hit
        assert reach.triangles == 48 * hit


_RING = [((0.08, 2e-3, 2e-3), (0, side * 0.04, 0)) for side in (-1, 1)]
_RING += [((2e-3, 0.08, 2e-3), (side * 0.04, 0, 0)) for side in (-1, 1)]


def test_reach_is_not_missed_between_two_instants():
    # In 1 ms the ball flies 4 mm: at no instant judged is it within reach, in between it passes the tip.
    whisker = WhiskerArray.mouse(whiskers="D6").replace(position=(0.0, 0.0, 0.0))
    length = whisker["D6"].whisker.arc_length
    speed, aside = 4.0, length - 0.1e-3
    flying = PlacedObject(box((1e-4, 1e-4, 1e-4)), (aside, -0.034, 0.0), motion=Translation((0.0, speed, 0.0), 0.0))
    scene = Scene("flying", whisker, (flying,), Still(), frames=Frames(0.001, 0.001, 20))
    (job,) = scene.jobs()
    assert reach_of(job)
    beyond = PlacedObject(
        box((1e-4, 1e-4, 1e-4)), (aside + 3e-3, -0.034, 0.0), motion=Translation((0.0, speed, 0.0), 0.0)
    )
    (job,) = Scene("beyond", whisker, (beyond,), Still(), frames=Frames(0.001, 0.001, 20)).jobs()
    assert not reach_of(job)


def test_equal_runs_are_planned_once():
    planned = plan([_scene("a", NEAR), _scene("b", NEAR)])
    assert len(planned.jobs) == 3
    assert planned.places == ((0, 1, 2), (0, 1, 2))


def test_the_same_simulation_is_explained_in_the_same_words_and_survives_the_cache(monkeypatch, tmp_path):
    monkeypatch.setattr(simulation, "get_engine", lambda name, **options: FakeEngine())
    monkeypatch.setenv("BRAINBENCH_CACHE", str(tmp_path))
    first = simulate(_scene("near", NEAR), fidelity=FAST, backend="fake")
    second = simulate(_scene("near", NEAR), fidelity=FAST, backend="fake")
    xr.testing.assert_identical(first, second)
    fresh, read = Explanation.of(first), Explanation.of(second)
    assert fresh.source is None
    assert set(fresh.seconds) == {"plan", "simulate", "assemble", "processor"}
    assert read.source is not None
    assert read.source.startswith(str(tmp_path))
    assert set(read.seconds) == {"read"}
    assert read.out_of_reach == fresh.out_of_reach
    assert "D6" in str(read)
    assert f"read from {read.source}" in str(read)


def test_the_text_says_what_was_saved():
    text = str(
        Explanation.of(
            simulate([_scene("near", NEAR), _scene("far", FAR)], fidelity=FAST, backend="mujoco", cache=False)
        )
    )
    assert "2 stimuli × 3 whiskers = 6 runs of 6 links" in text
    assert re.search("saved +17 %", text)
    assert "near: D6" in text


def test_steps_that_had_to_be_shorter_are_no_saving():
    told = Explanation.of(simulate(_scene("near", NEAR), fidelity=FAST, backend=FakeEngine()))
    more = dataclasses.replace(told, steps=told.steps_in_full * 106 // 100)
    assert re.search(r"saved +none .*6 % more", str(more))


def test_a_set_without_or_with_a_damaged_explanation_is_refused_in_words():
    dataset = simulate(_scene("near", NEAR), fidelity=FAST, backend=FakeEngine())
    data = json.loads(dataset.attrs["explanation"])
    del data["steps"]
    with pytest.raises(DataError, match=r"damaged \(.*steps"):
        Explanation.of(dataset.assign_attrs(explanation=json.dumps(data)))
    del dataset.attrs["explanation"]
    with pytest.raises(UsageError, match="simulate it again"):
        Explanation.of(dataset)


@pytest.mark.slow
def test_steps_whose_contact_forces_were_not_solved_are_told():
    pytest.importorskip("warp")
    scene = get_recipe("rodgers").scenes[0].select("C1,C2")
    few, solved = (
        Explanation.of(simulate(scene, fidelity=f"balanced,contact_tolerance={tolerance}", cache=False))
        for tolerance in ("none", "1e-6")
    )
    assert few.unsolved > 0 == solved.unsolved
    assert f"not solved     contact forces of {few.unsolved:,} time steps" in str(few).splitlines()
    assert "not solved" not in str(solved)
