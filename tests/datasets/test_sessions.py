import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.core.contracts import as_labels, natural_key
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import write_recordings
from brainbench.datasets.nwb import write_nwb
from brainbench.datasets.sessions import SessionTable, decode, make_session


def test_texts_that_are_not_utf8_stay_different():
    for texts in (np.array([b"h\xe4rt", b"h\xf6rt"]), np.array([b"h\xe4rt", b"h\xf6rt"], dtype=object)):
        assert decode(texts).tolist() == ["härt", "hört"]
    assert decode(np.array(["härt".encode(), b""])).tolist() == ["härt", ""]


def test_numbers_become_the_text_a_person_would_write():
    assert as_labels(np.array([1, 2], dtype=np.uint8)).tolist() == ["1", "2"]
    assert as_labels(np.array([1.0, 0.25, np.nan])).tolist() == ["1", "0.25", ""]
    assert as_labels(np.array([True, False])).tolist() == ["true", "false"]
    assert as_labels(np.array([" a ", ""])).tolist() == ["a", ""]


def test_bytes_fixed_text_and_objects_decode_alike():
    expected = ["far", "größer"]
    encoded = [item.encode() for item in expected]
    for values in (np.array(encoded), np.array(encoded, dtype=object), np.array(expected, dtype=object)):
        assert decode(values).tolist() == expected


def test_natural_order_reads_numbers_in_text():
    labels = ["10", "9", "-1", "b10", "b2", "a"]
    assert sorted(labels, key=natural_key) == ["-1", "9", "10", "a", "b2", "b10"]


@settings(max_examples=40)
@given(st.lists(st.text(), unique=True), st.randoms())
def test_natural_order_does_not_depend_on_appearance(labels, random):
    shuffled = labels.copy()
    random.shuffle(shuffled)
    assert sorted(shuffled, key=natural_key) == sorted(labels, key=natural_key)


def test_a_column_of_another_length_is_refused():
    table = SessionTable("trials", {"id": np.arange(3), "stimulus": np.array(["a", "b"])}, "file.nwb")
    with pytest.raises(DataError, match=r"file.nwb has 2 values"):
        table.column("stimulus")


def test_a_list_column_cannot_be_a_label():
    table = SessionTable("trials", {"tags": np.array(["a", "b", "c"]), "tags_index": np.array([1, 3])}, "f")
    assert len(table) == 2
    with pytest.raises(DataError, match=r"'tags' .*list"):
        table.column("tags")


@pytest.mark.parametrize(
    ("ends", "reason"), [([2, 1, 5], "decreasing"), ([1, 2, 4], "the last at 4 of 5"), ([5], "1 ends for 3 rows")]
)
def test_an_inconsistent_ragged_index_is_refused(ends, reason):
    table = SessionTable("units", {"id": np.arange(3), "x": np.zeros(5), "x_index": np.array(ends)}, "f.nwb")
    with pytest.raises(DataError, match=reason):
        table.ends("x")


def test_an_unknown_column_suggests_the_nearest():
    table = SessionTable("trials", {"start_time": np.zeros(1), "stimulus": np.array(["a"])}, "f.nwb")
    with pytest.raises(UsageError, match="did you mean 'stimulus'"):
        table.column("stimulis")


def test_make_session_refuses_columns_of_different_length():
    with pytest.raises(DataError, match=r"'stimulus' .* 1 of 2 rows"):
        make_session("m", "1", [np.zeros(1)], {"trials": {"start_time": [0.0, 1.0], "stimulus": ["a"]}})
    with pytest.raises(UsageError, match=r"'start_time'.*'stimulus'"):
        make_session("m", "1", [np.zeros(1)], {"trials": {"stimulus": ["a"]}})


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("write", [write_recordings, write_nwb])
def test_spike_times_that_no_reader_takes_are_neither_made_nor_written(tmp_path, value, write) -> None:
    table = {"start_time": [0.0], "stop_time": [1.0], "stimulus": ["a"]}
    with pytest.raises(DataError, match=r"1 spike times .*not finite \(first with id 1\)"):
        make_session("m", "1", [np.arange(3.0), np.array([0.5, value])], {"trials": table})
    session = make_session("m", "1", [np.array([-0.5, 0.5])], {"trials": table})
    assert session.units is not None
    session.units.data["spike_times"][1] = value
    with pytest.raises(DataError, match="not finite"):
        write(tmp_path / "a", session)
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"observed": [[[5.0, 1.0]]]}, "earlier time first"),
        ({"observed": [[[np.nan, 1.0]]]}, "earlier time first"),
        ({"observed": [[[0.0, 1.0]], [[0.0, 1.0]]]}, "obs_intervals_index .*2 ends for 1 rows"),
        ({"start": "yesterday"}, "ISO 8601.*'yesterday'"),
    ],
)
def test_spans_and_starts_that_are_no_times_are_refused(options, told) -> None:
    with pytest.raises((DataError, UsageError), match=told):
        make_session("m", "1", [np.arange(3.0)], {}, **options)
    assert make_session("m", "1", [np.arange(3.0)], {}, observed=[[[-np.inf, np.inf]]], start="2025-01-31").start


def test_what_is_no_session_is_not_written(tmp_path) -> None:
    with pytest.raises(UsageError, match="received 'm1'"):
        write_recordings(tmp_path / "a.h5", ["m1"])  # type: ignore[list-item]
