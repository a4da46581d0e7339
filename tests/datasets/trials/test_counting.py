from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.datasets import export, open_recordings, write_recordings
from brainbench.datasets.sessions import SessionTable, make_session
from brainbench.datasets.trials.counting import SpikeTrains, bin_bounds, mask_missing, merged
from brainbench.datasets.trials.session_trials import trials_by_subject


def _make_file(path, choices):
    starts = np.arange(1.0, 9.0)
    tables = {
        "trials": {
            "start_time": starts,
            "stop_time": starts + 0.5,
            "stimulus": list("abababab"),
            "choice": choices,
        },
        "contacts_by_whisker_C1": {"start_time": [1.1, 1.2, 2.1, 2.2], "stop_time": [1.11, 1.2, 2.11, 2.21]},
        "contacts_by_whisker_C2": {"start_time": [1.3, 3.6], "stop_time": [1.31, 3.7]},
        "licks": {"start_time": [1.4, 8.1, 8.2], "stop_time": [1.4, 8.1, 8.2]},
    }
    spikes = [np.sort(np.random.default_rng(i).uniform(0.5, 9.5, 200)) for i in range(3)]
    return write_recordings(path, make_session("m", "1", spikes, tables))


def test_contacts_licks_and_choices_are_counted_inside_the_window(tmp_path):
    path = _make_file(tmp_path / "a.h5", ["left", "right", "nogo", "left", "right", "left", "right", "left"])
    dataset = open_recordings(path, conditions="trials:stimulus", window="start..stop")
    # A contact of no duration is an empty interval, and 3.6 s lies between two trials.
    assert dataset["contacts"].values.tolist() == [2, 2, 0, 0, 0, 0, 0, 0]
    assert dataset["licks"].values.tolist() == [1, 0, 0, 0, 0, 0, 0, 2]
    np.testing.assert_array_equal(dataset["choice"].values, [0, 1, np.nan, 0, 1, 0, 1, 0])
    (block,) = trials_by_subject(dataset)["m"]
    assert {name: len(values) for name, values in block.covariates.items()} == dict.fromkeys(
        ("contacts", "licks", "choice"), len(block.labels)
    )


def test_what_a_file_does_not_tell_is_left_out(tmp_path):
    path = _make_file(tmp_path / "a.h5", ["yes"] * 8)
    dataset = open_recordings(path, conditions="trials:stimulus")
    assert "choice" not in dataset.coords


@pytest.mark.parametrize("name", ["copy.h5", "copy.nwb"])
def test_copies_keep_them(tmp_path, name):
    path = _make_file(tmp_path / "a.h5", ["left", "right"] * 4)
    (copy,) = export(path, tmp_path / name)
    one, two = (open_recordings(item, conditions="trials:stimulus") for item in (path, copy))
    for covariate in ("contacts", "licks", "choice"):
        np.testing.assert_array_equal(one[covariate].values, two[covariate].values)
    assert one.attrs["content_hash"] == two.attrs["content_hash"]


def count(spikes, edges, covered, bin):
    """Counts [R, T, U] and durations [R, T] of units in windows."""
    bounds = bin_bounds(edges, bin, units=len(spikes))
    trains = SpikeTrains(SessionTable("units", {}), spikes)
    return mask_missing(trains.respond(np.arange(len(edges)), np.arange(len(spikes)), bounds), bounds, covered)


TIMES = st.lists(st.floats(0, 10, width=32), max_size=40).map(sorted).map(np.array)


@given(TIMES, st.floats(0, 5), st.floats(0.1, 5), st.floats(0.05, 3))
def test_binned_counts_and_durations_add_up_to_the_window(times, begin, length, width):
    edges = np.array([[begin, begin + length]])
    binned, duration = count([times.astype(float)], edges, np.ones((1, 1), dtype=bool), width)
    whole, total = count([times.astype(float)], edges, np.ones((1, 1), dtype=bool), None)
    assert np.nansum(binned) == whole[0, 0, 0] == np.sum((times >= begin) & (times < begin + length))
    assert duration.sum() == pytest.approx(total[0, 0]) == pytest.approx(length)


def test_bins_past_the_end_of_a_short_window_are_missing_not_silent():
    edges = np.array([[0.0, 1.0], [0.0, 0.25]])
    counts, duration = count([np.array([0.1, 0.3, 0.9])], edges, np.ones((2, 1), dtype=bool), 0.1)
    assert counts.shape == (2, 10, 1)
    assert np.isnan(counts[1, 3:]).all()
    np.testing.assert_allclose(duration[1], [0.1, 0.1, 0.05] + [0.0] * 7, atol=1e-12)
    # 0.1 is the begin of the second bin, and the last bin may be partial.
    assert counts[1, :3, 0].tolist() == [0.0, 1.0, 0.0]


def test_a_whole_number_of_bins_gives_no_extra_one():
    counts, _ = count([np.zeros(1)], np.array([[0.0, 0.3]]), np.ones((1, 1), dtype=bool), 0.1)
    assert counts.shape[1] == 3


def test_units_that_were_not_recorded_are_missing():
    counts, _ = count([np.zeros(1)] * 2, np.array([[0.0, 1.0]]), np.array([[True, False]]), None)
    assert counts[0, 0, 0] == 1
    assert np.isnan(counts[0, 0, 1])


def test_windows_may_touch_what_lies_beside_them_however_sums_are_rounded(tmp_path):
    starts = np.arange(1.0, 9.0)
    table = {"start_time": starts, "stop_time": starts + 0.5, "stimulus": list("abababab")}
    # The last digit of a border: stretches to be left out end where trials begin, and the recording with the last.
    invalid = {"start_time": starts - 0.1, "stop_time": np.nextafter(starts, 10)}
    spikes = [np.sort(np.random.default_rng(0).uniform(1, 8.5, 200)), np.array([1.0, np.nextafter(8.5, 0)])]
    path = write_recordings(
        tmp_path / "a.h5", make_session("m", "1", spikes, {"trials": table, "invalid_times": invalid})
    )
    assert open_recordings(path, conditions="trials:stimulus", window="start..stop").sizes["trial"] == 8
    assert merged(np.array([[0, 0.3], [0.1 + 0.2, 1]])) == [(0, 1)]
    assert len(merged(np.array([[0, 0.3], [0.301, 1]]))) == 2


def test_a_bin_is_positive():
    with pytest.raises(UsageError, match="received 0"):
        count([np.zeros(1)], np.array([[0.0, 1.0]]), np.ones((1, 1), dtype=bool), 0.0)


def test_bins_that_would_not_fit_in_memory_are_refused_with_their_number():
    edges = np.tile([0.0, 1.0], (100, 1))
    with pytest.raises(UsageError, match=r"1,000,000,000 bins"):
        count([np.zeros(1)] * 5, edges, np.ones((100, 5), dtype=bool), 1e-9)
