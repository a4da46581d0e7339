from __future__ import annotations

import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.scenes.scene import Frames, Scene
from brainbench.stimuli.simulation import simulate
from brainbench.stimuli.stimulus_set import read_stimulus_set, to_grid, write_stimulus_set
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.engines import FakeEngine


def _dataset(whiskers="all", side="right", count=110, unstable=None):
    scenes = [
        Scene(label, WhiskerArray.mouse(side=side, whiskers=whiskers), frames=Frames(count=count)) for label in "ab"
    ]
    return simulate(scenes, fidelity=Fidelity(), backend=FakeEngine(unstable))


def test_a_hundred_and_ten_frames_become_twenty_two_steps_of_thirty_channels():
    dataset = _dataset()
    grid = to_grid(dataset)
    assert grid.shape == (2, 22, 30, 5, 7)
    assert grid.dtype == np.float32


def test_frame_channel_and_whisker_find_their_place():
    dataset = _dataset()
    grid = to_grid(dataset)
    rng = np.random.default_rng(0)
    for _ in range(50):
        k, frame, w, c = rng.integers([2, 110, 30, 6])
        row, col = int(dataset["row"][w]), int(dataset["col"][w])
        step, substep = divmod(int(frame), 5)
        assert grid[k, step, substep * 6 + c, row, col] == dataset["wrench"].values[k, frame, w, c]


def test_cells_without_a_whisker_are_zero():
    grid = to_grid(_dataset()).reshape(2, 22, 30, 35)
    assert (grid[..., [5, 6, 12, 13, 34]] == 0).all()
    assert (np.abs(grid).max(axis=(0, 1, 2))[[0, 14, 28]] > 0).all()


def test_whiskers_that_were_not_simulated_are_zero_and_the_others_as_in_the_full_set():
    full, few = to_grid(_dataset()), to_grid(_dataset("C0-C3"))
    np.testing.assert_array_equal(few[..., 2, :4], full[..., 2, :4])
    few[..., 2, :4] = 0
    assert (few == 0).all()


def test_other_sub_steps_divide_time_otherwise():
    assert to_grid(_dataset(), substeps=1).shape == (2, 110, 6, 5, 7)
    with pytest.raises(UsageError, match=r"110 frames .*4 sub-steps"):
        to_grid(_dataset(), substeps=4)


def test_both_sides_do_not_fit_one_grid():
    with pytest.raises(UsageError, match=r"both sides.*one side"):
        to_grid(_dataset(side="both", whiskers="C2"))


def test_an_unstable_whisker_is_refused_unless_zero_is_asked_for():
    dataset = _dataset("C1,C2", unstable={0: "blew up"})
    with pytest.raises(DataError, match=r"'C1 in a'.*blew up.*--whiskers.*unstable='zero'"):
        to_grid(dataset)
    grid = to_grid(dataset, unstable="zero")
    assert np.isfinite(grid).all()
    assert (grid[0, -1, :, 2, 1] == 0).all()


@pytest.mark.parametrize("name", ["fidelity", "note"])
def test_attributes_that_are_no_text_are_refused_in_one_sentence(tmp_path, name):
    path = write_stimulus_set(_dataset(), tmp_path / "set.h5")
    with h5py.File(path, "r+") as file:
        file.attrs.create(name, b"\xff\xfe", dtype=h5py.string_dtype())
    with pytest.raises(DataError, match=r"set\.h5"):
        read_stimulus_set(path)


def test_columns_that_are_not_one_per_whisker_are_refused_in_one_sentence():
    dataset = _dataset()
    longer = dataset.drop_vars("col").assign_coords(col=("column", np.resize(dataset["col"].values, 2 * 30)))
    with pytest.raises(DataError, match="'col'"):
        to_grid(longer)
