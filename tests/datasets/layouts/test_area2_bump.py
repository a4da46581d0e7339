import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import (
    open_recordings,
)
from tests.factories.dandi_files import write_area2


def test_bumps_and_reaches_are_told_apart_by_direction(tmp_path):
    spikes, columns = write_area2(tmp_path / "a.nwb")
    dataset = open_recordings(tmp_path / "a.nwb")
    assert len(dataset.attrs["vocabulary"]) == 16
    assert dataset.attrs["vocabulary"][:2] == ["active-0", "active-45"]
    removed = {rule: number for rule, number in dataset.attrs["removed"].items() if number}
    assert removed == {"trials: result=R": 8, "trials: no event for the window move_onset_time-0.1..+0.6": 4}
    onset = columns["move_onset_time"]
    kept = (columns["result"] == "R") & np.isfinite(onset)
    expected = [[np.sum((times >= at - 0.1) & (times < at + 0.5)) for times in spikes] for at in onset[kept]]
    np.testing.assert_array_equal(dataset["counts"].values[:, 0], expected)
    bumped = columns["ctr_hold_bump"][kept]
    np.testing.assert_array_equal(np.char.startswith(dataset["stimulus"].values.astype(str), "passive"), bumped)


def test_the_test_trials_of_the_benchmark_are_refused_in_words(tmp_path):
    write_area2(tmp_path / "a.nwb", test=True)
    with pytest.raises(DataError, match=r"a\.nwb .*interval .*'trials'"):
        open_recordings(tmp_path / "a.nwb")
    with pytest.raises(UsageError, match="column 'movement'"):
        open_recordings(f"area2-bump:{tmp_path / 'a.nwb'}")
