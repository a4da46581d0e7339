from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.trajectories import Still, Translation
from brainbench.stimuli.objects.solid import box, capsule, cylinder, rodgers_solid, sphere
from brainbench.stimuli.scenes.recipes import describe_recipe, get_recipe
from brainbench.stimuli.scenes.scene import Frames, Head
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, Span, SweepGrid, SweepScenes, counts
from brainbench.stimuli.whiskers.array import WhiskerArray

SOLIDS = [sphere(1.0), box((1.0, 2.0, 3.0)), cylinder(0.3, 1.0), capsule(0.3, 1.0), rodgers_solid()]


def test_draws_depend_on_seed_and_object_and_nothing_else():
    grid = GRIDS["thesis-high"]
    assert grid.sweeps("mug") == grid.sweeps("mug")
    assert grid.sweeps("mug") != grid.sweeps("chair")
    assert SweepGrid(size=Span(0.02, 0.06, 0.001), seed=1).sweeps() != SweepGrid(size=Span(0.02, 0.06, 0.001)).sweeps()
    code = "from brainbench.stimuli.sweeps.sweep_scenes import GRIDS; print(GRIDS['thesis-high'].sweeps('mug')[100])"
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == repr(grid.sweeps("mug")[100])


def test_every_value_of_a_span_is_drawn_about_equally_often():
    values = [sweep.size for sweep in SweepGrid(size=Span(0.020, 0.024, 0.001), draws=5000).sweeps()]
    found, times = np.unique(np.round(values, 9), return_counts=True)
    np.testing.assert_allclose(found, [0.020, 0.021, 0.022, 0.023, 0.024])
    assert abs(times - 1000).max() < 5 * math.sqrt(1000)


@given(st.integers(1, 3), st.lists(st.floats(0.001, 0.1), min_size=1, max_size=3), st.integers(1, 4))
def test_a_grid_has_as_many_sweeps_as_it_says(draws, speeds, turns):
    grid = SweepGrid(speed=tuple(speeds), turns=tuple(range(turns)), draws=draws, size=Span(0.02, 0.06, 0.001))
    assert len(grid.sweeps("x")) == grid.count == draws * len(speeds) * turns


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size": Span(-0.01, 0.02, 0.01)}, r"size .*received -0\.01"),
        ({"heights_per_draw": 2}, r"heights_per_draw .*got 2"),
        ({"head": Head(motion=Translation((0.0, 0.1, 0.0)))}, "choose mover='head'"),
    ],
)
def test_impossible_grids_are_refused(changes, message):
    with pytest.raises(UsageError, match=message):
        SweepGrid(**changes)


def test_spans_ascend():
    with pytest.raises(UsageError, match=r"received Span\(low="):
        Span(2.0, 1.0, 1.0)


def test_a_grid_takes_any_array():
    array = WhiskerArray.rat(whiskers="C1")
    scene = SweepGrid().scene(SOLIDS[0], SweepGrid().sweeps()[0], array=array, label="x")
    assert scene.array is array
    assert scene.label == "x"


def _in_units(sweeps):
    """Speed, height, rotation, distance, size in mm/s, mm, degrees, mm, mm."""
    scale = np.array([1e3, 1e3, 180 / math.pi, 1e3, 1e3])
    return np.array([[s.speed, s.height, s.rotation, s.distance, s.size] for s in sweeps]) * scale


def _world_bounds(scene):
    (obstacle,) = scene.objects
    corners = np.array([part.bounds() for part in obstacle.obstacle().parts])
    return corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)


def test_the_low_grid_is_the_published_list():
    sweeps = GRIDS["thesis-low"].sweeps("any")
    assert len(sweeps) == GRIDS["thesis-low"].count == 16
    expected = {(30, h, t, d, 40) for h in (-5, 0) for t in (0, 30, 90, 120) for d in (5, 8)}
    assert {tuple(row) for row in _in_units(sweeps).round(9)} == expected


def test_the_high_grid_is_208_sweeps_within_the_published_ranges():
    grid = GRIDS["thesis-high"]
    sweeps = grid.sweeps("mug")
    speed, height, rotation, distance, size = _in_units(sweeps).T
    assert len(sweeps) == grid.count == 208
    assert len(set(sweeps)) == 208
    for values, low, high in ((speed, 30, 60), (rotation, 0, 359), (size, 20, 60)):
        assert values.min() >= low - 1e-9
        assert values.max() <= high + 1e-9
        np.testing.assert_allclose(values, values.round(), atol=1e-9)
    assert set(distance.round(9)) == {5}
    # Each of the 26 draws has one speed, one size, four quarter turns and two heights.
    for draw in range(26):
        chosen = [i for i, sweep in enumerate(sweeps) if sweep.draw == draw]
        assert len(set(speed[chosen])) == len(set(size[chosen])) == 1
        assert len(set((rotation[chosen] % 90).round(6))) == 1
        assert len(chosen) == 8
    used = [int((height.round() == value).sum()) for value in (-3, 0, 3)]
    assert max(used) - min(used) <= 4


def test_the_published_totals_follow_from_the_grids():
    assert 9981 * GRIDS["thesis-high"].count == 2_076_048
    assert 9981 * GRIDS["thesis-low"].count == 159_696
    for name, published in (("thesis-low", "316,192"), ("thesis-high", "288")):
        text = describe_recipe(name)
        assert f"Here: {GRIDS[name].count} sweeps per object" in text
        assert published in text
    assert "312" in describe_recipe("thesis-high")
    assert "78" in describe_recipe("thesis-high")


def test_enumerating_all_of_the_thesis_loads_no_object():
    def refuse():
        raise AssertionError("the object was loaded")

    recipe = get_recipe("thesis-high", objects={f"object{i}": refuse for i in range(9981)})
    assert len(recipe.scenes) == 2_076_048
    summary = counts(recipe.scenes)
    assert summary["scenes"] == 2_076_048
    # A sweep of 110 × 30 × 6 float32 is 79 kB: 164 GB in all.
    assert summary["bytes"] / len(recipe.scenes) == 79_200
    assert recipe.scenes.grid.sweeps("object0")[0].draw == 0
    with pytest.raises(AssertionError, match="was loaded"):
        recipe.scenes[0]


def test_an_object_is_loaded_once_for_all_of_its_sweeps():
    loads = []
    scenes = get_recipe("thesis-low", objects={"a": lambda: loads.append(1) or sphere(1.0), "b": sphere(1.0)}).scenes
    assert [scene.label for scene in scenes] == list(scenes.labels)
    assert len(loads) == 1
    assert len(set(scenes.labels)) == 32
    assert scenes.labels[0] == "a/n0_h-5_d5_t0_v30_s40"
    assert [scene.label for scene in scenes[14:18]] == list(scenes.labels[14:18])
    with pytest.raises(IndexError):
        scenes[32]


@pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: solid.name)
def test_objects_have_their_size_and_stand_at_their_distance_in_front_of_the_array(solid):
    grid = GRIDS["thesis-low"]
    for sweep in grid.sweeps(solid.name):
        scene = grid.scene(solid, sweep)
        low, high = _world_bounds(scene)
        assert scene.objects[0].solid.diagonal == pytest.approx(sweep.size)
        assert low[0] == pytest.approx(sweep.distance, abs=1e-9)
        assert low[1] == pytest.approx(0.016, abs=1e-9)
        assert scene.objects[0].position[2] == sweep.height
        assert high[1] > low[1]


def test_no_whisker_starts_inside_an_object_that_starts_clear_of_the_array():
    scene = next(iter(get_recipe("thesis-low", objects=[sphere(1.0)]).scenes))
    tips = []
    for mount in scene.array:
        line = mount.whisker.centre_line(np.linspace(0, mount.whisker.arc_length, 30))
        local = np.column_stack([line, np.zeros(30)]) @ base_rotation(mount.angles).T + mount.position
        tips.append(local @ scene.head.matrix.T + scene.head.position)
    assert np.concatenate(tips)[:, 1].max() < 0.016
    assert GRIDS["thesis-high"].start > 0.016


def test_the_released_placing_puts_the_origin_where_the_released_simulator_does():
    grid = SweepGrid(start=0.016, placing="released", size=(0.040,), rotation=(0.3,))
    (sweep,) = grid.sweeps()
    clear = SweepGrid(start=0.016, size=(0.040,), rotation=(0.3,)).scene(SOLIDS[1], sweep)
    released = grid.scene(SOLIDS[1], sweep)
    half = clear.objects[0].position[1] - 0.016
    assert released.objects[0].position[1] == pytest.approx(0.016 - half)
    # The object reaches back from y = 16 mm, over whiskers that end at 6 mm: the reason for our default.
    assert _world_bounds(released)[1][1] == pytest.approx(0.016)
    assert _world_bounds(released)[0][1] < 0


def test_the_head_of_the_sweeps_is_the_released_one():
    head = GRIDS["thesis-low"].head
    assert np.degrees(head.rotation) == pytest.approx((0, 15.366, -16.198))
    back = np.linalg.inv(head.matrix) @ (np.array(head.position) * 1e3 - [-6.934, -11.642, -2.598])
    np.testing.assert_allclose(back, [0, 13, 1.5], atol=1e-9)


def test_frames_are_those_of_the_released_data():
    assert GRIDS["thesis-low"].frames == Frames(0.001, 0.009, 110)
    np.testing.assert_allclose(GRIDS["thesis-high"].frames.times, np.arange(110) / 110)


def test_moving_the_array_is_moving_the_object_the_other_way():
    moving, still = SweepGrid(mover="head"), SweepGrid()
    (sweep,) = still.sweeps()
    first, second = moving.scene(SOLIDS[1], sweep), still.scene(SOLIDS[1], sweep)
    assert first.objects[0].motion == Still()
    assert first.head.motion == Translation((0.0, 0.03, 0.0), 0.01)
    assert second.objects[0].motion == Translation((0.0, -0.03, 0.0), 0.0)
    assert first.objects[0].position == second.objects[0].position


def test_one_sweep_is_simulated_end_to_end():
    scenes = get_recipe("thesis-low", objects={"ball": sphere(1.0)}, whiskers="C2-C3").scenes
    scene = next(scene for scene in scenes if "_h0_d5_t0_" in scene.label)
    dataset = simulate(scene, fidelity=Fidelity.preset("fast"), cache=False)
    assert (dataset["status"] == "ok").all()
    touched = dataset["contact"].values[0].any(axis=1)
    assert touched.any()
    assert not touched[:10].any()
    wrench = dataset["wrench"].values[0]
    np.testing.assert_array_equal(wrench[:10], 0)
    # The object pushes the whiskers towards −y, and they their bases.
    assert wrench[touched, :, 1].sum() < 0
    assert np.abs(wrench[..., :3]).max() < 5e-3


def test_recipes_say_which_of_them_take_objects():
    with pytest.raises(UsageError, match=r"'thesis-low'.*objects="):
        get_recipe("thesis-low")
    with pytest.raises(UsageError, match=r"'rodgers' .*thesis-low, thesis-high"):
        get_recipe("rodgers", objects=SOLIDS)
    with pytest.raises(UsageError, match=r"Several .*'sphere'"):
        get_recipe("thesis-low", objects=[sphere(1.0), sphere(2.0)])
    with pytest.raises(UsageError, match="at least one object"):
        SweepScenes(SweepGrid(), [])
    with pytest.raises(UsageError, match="'cat'; did you mean 'rat'"):
        SweepScenes(SweepGrid(species="cat"), SOLIDS)
