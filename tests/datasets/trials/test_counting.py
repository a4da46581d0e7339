import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.datasets.trials.counting import count

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


def test_a_bin_is_positive():
    with pytest.raises(UsageError, match="received 0"):
        count([np.zeros(1)], np.array([[0.0, 1.0]]), np.ones((1, 1), dtype=bool), 0.0)


def test_bins_that_would_not_fit_in_memory_are_refused_with_their_number():
    edges = np.tile([0.0, 1.0], (100, 1))
    with pytest.raises(UsageError, match=r"1,000,000,000 bins"):
        count([np.zeros(1)] * 5, edges, np.ones((100, 5), dtype=bool), 1e-9)
