import math
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.stimuli.motion.trajectories import Translation
from brainbench.stimuli.objects.solid import box, capsule, cylinder, rodgers_solid, sphere
from brainbench.stimuli.scenes.scene import Head
from brainbench.stimuli.sweeps.grid import Span, SweepGrid
from brainbench.stimuli.sweeps.sweep_scenes import GRIDS
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
