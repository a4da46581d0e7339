from __future__ import annotations

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import (
    inspect,
    open_recordings,
)
from brainbench.datasets.layouts.adapted import recorded_runs
from brainbench.datasets.sessions import Series
from tests.factories.dandi_files import make_pole_task, write_area2, write_hires, write_yu


@pytest.mark.parametrize("write", [write_yu, write_hires])
def test_pole_tasks_are_counted_while_the_pole_is_there(tmp_path, write):
    spikes, _ = write(tmp_path / "a.nwb")
    spikes = spikes if write is write_yu else [spikes]
    columns, _ = make_pole_task()
    dataset = open_recordings(tmp_path / "a.nwb")
    assert dataset.attrs["vocabulary"] == ["Go", "Nogo"]
    assert dataset.attrs["removed"]["trials: stim_present!=true"] == 3
    kept = columns["stim_present"] == 0
    low, high = columns["pole_in_time"][kept], columns["pole_out_time"][kept]
    expected = [
        [np.sum((times >= begin) & (times < end)) for times in spikes] for begin, end in zip(low, high, strict=True)
    ]
    np.testing.assert_array_equal(dataset["counts"].values[:, 0], expected)


def test_a_spike_train_of_zeros_and_ones_is_a_unit_recorded_in_trials_only(tmp_path):
    spikes, touches = write_hires(tmp_path / "a.nwb")
    dataset = open_recordings(tmp_path / "a.nwb", window="first-contact..+0.1", select="none")
    assert dataset.sizes["unit"] == 1
    assert "acquisition/SpikeTrain" in "".join(dataset.attrs["notes"])
    np.testing.assert_allclose(
        dataset["window_start"].values, touches[np.searchsorted(touches, make_pole_task()[0]["start_time"])]
    )
    low = dataset["window_start"].values
    np.testing.assert_array_equal(
        dataset["counts"].values[:, 0, 0], [np.sum((spikes >= begin) & (spikes < begin + 0.1)) for begin in low]
    )
    # Between trials nothing was sampled: that is missing, not silence.
    with pytest.raises(DataError, match=r"a\.nwb: trials: .*span .*24"):
        open_recordings(tmp_path / "a.nwb", window="stop-0.2..+0.4", select="none")


def test_series_of_zeros_and_ones_say_what_is_wrong_with_them():
    flags, stamps = np.array([0, 1, 0, 1]), np.array([0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(Series("s", "", flags, stamps).active_times(), [0.1, 0.3])
    np.testing.assert_allclose(Series("s", "", flags, start=5.0, rate=10.0).active_times(), [5.1, 5.3])
    with pytest.raises(DataError, match="4 samples"):
        Series("s", "", flags, stamps[:3]).active_times()
    with pytest.raises(DataError, match=r"series s .*rate"):
        Series("s", "", flags).active_times()
    with pytest.raises(DataError, match="it reaches 7"):
        Series("s", "", flags * 7, stamps).active_times()
    np.testing.assert_allclose(recorded_runs(np.array([0, 0.1, 0.2, 5, 5.1])), [[0, 0.3], [5, 5.2]])


def test_every_whisker_of_the_probe_recordings_has_its_contacts(tmp_path):
    _, touches = write_yu(tmp_path / "a.nwb")
    tables = {table.name: table.rows for table in inspect(tmp_path / "a.nwb").sessions[0].tables}
    assert tables["contacts_by_whisker_C1"] == len(touches)
    assert tables["contacts_by_whisker_C2"] == len(touches[::3])


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
