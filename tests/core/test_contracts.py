from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from brainbench.core.contracts import (
    CHANNELS,
    Trials,
    as_labels,
    check_recordings,
    check_stimulus_set,
    join_labels,
    near_labels,
    read_match,
)
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import open_recordings, write_recordings
from tests.factories.recordings import make_simple_session


def _make_stimulus_set() -> xr.Dataset:
    attributes = ("array", "scene", "fidelity", "seed", "backend", "version", "content_hash")
    return xr.Dataset(
        {"wrench": (("stimulus", "time", "whisker", "channel"), np.zeros((1, 2, 1, 6), np.float32))},
        coords={
            "stimulus": ["a"],
            "time": [0.0, 0.1],
            "whisker": ["C2"],
            "row": ("whisker", [2]),
            "col": ("whisker", [2]),
            "channel": list(CHANNELS),
        },
        attrs=dict.fromkeys(attributes, "x"),
    )


def test_a_stimulus_set_is_checked_against_the_contract():
    good = _make_stimulus_set()
    assert check_stimulus_set(good) is good
    with pytest.raises(DataError, match=r"stimulus set .*'wrench'"):
        check_stimulus_set(good.drop_vars("wrench"))
    with pytest.raises(DataError, match=r"'wrench' .*\('time', 'stimulus',"):
        check_stimulus_set(good.transpose("time", "stimulus", "whisker", "channel"))
    with pytest.raises(DataError, match="coordinate 'row'"):
        check_stimulus_set(good.drop_vars("row"))
    with pytest.raises(DataError, match="expected \\['Fx'"):
        check_stimulus_set(good.assign_coords(channel=list(CHANNELS[::-1])))
    bare = good.copy()
    bare.attrs = {}
    with pytest.raises(DataError, match=r"attribute .*'backend'"):
        check_stimulus_set(bare)


@pytest.mark.parametrize(
    ("coordinate", "values"),
    [("stimulus", ["x" * 201]), ("stimulus", [""] * 0), ("time", [0.1, 0.0]), ("time", [0.0, np.nan]), ("row", [-1]),
     ("row", [5]), ("col", [7]), ("col", [2.0])],
)  # fmt: skip
def test_a_stimulus_set_with_impossible_coordinates_is_refused(coordinate, values):
    good = _make_stimulus_set()
    (dim,) = good[coordinate].dims
    odd = good.isel({dim: slice(len(values))}).assign_coords({coordinate: (dim, np.array(values))})
    with pytest.raises(DataError, match=r"stimulus set|whole number"):
        check_stimulus_set(odd)


def test_names_of_a_stimulus_set_differ():
    good = _make_stimulus_set()
    for dim in ("stimulus", "whisker"):
        with pytest.raises(DataError, match=dim):
            check_stimulus_set(xr.concat([good, good], dim))


def test_recordings_without_duration_are_refused():
    dataset = xr.Dataset({"counts": (("trial", "time", "unit"), np.zeros((1, 1, 1)))})
    with pytest.raises(DataError, match=r"recordings .*'duration'"):
        check_recordings(dataset)


def test_labels_of_recordings_are_those_of_the_vocabulary_each_once(tmp_path):
    good = open_recordings(write_recordings(tmp_path / "a.h5", make_simple_session()), conditions="trials:stimulus")
    for vocabulary, told in ((["a", "b", "c", "a"], "'a' twice"), (["a", "b"], "lacks: 'c'")):
        with pytest.raises(DataError, match=told):
            check_recordings(good.assign_attrs(vocabulary=vocabulary))


def test_trials_are_taken_with_all_that_belongs_to_them():
    trials = Trials(np.arange(12.0).reshape(4, 3), np.array([0, 1, 0, 1]), list("abcd"), {"licks": np.arange(4.0)})
    some = trials.take(trials.labels > 0)
    assert some.keys == ("b", "d")
    np.testing.assert_array_equal(some.responses, trials.responses[[1, 3]])
    np.testing.assert_array_equal(some.covariates["licks"], [1, 3])
    np.testing.assert_array_equal(trials.take([3, 1]).labels, [1, 1])
    assert Trials(trials.responses, trials.labels).take([0]).keys is None


def test_equal_labels_pair_in_the_order_of_the_recordings():
    assert list(join_labels(("b", "a"), ("a", "b"), None).items()) == [("b", "b"), ("a", "a")]


def test_unmatched_labels_list_both_sides():
    with pytest.raises(UsageError) as caught:
        join_labels(("a", "face"), ("a", "cube"), None)
    text = str(caught.value)
    assert "without a stimulus: 'face'" in text
    assert "without recordings: 'cube'" in text
    assert "equal on both sides: 1" in text
    assert "--match" in text


def test_a_match_pairs_drops_and_leaves_extra_stimuli_out():
    pairs = join_labels(("a", "face", "nothing"), ("a", "cube", "spare"), {"face": "cube", "nothing": None})
    assert pairs == {"a": "a", "face": "cube"}


@pytest.mark.parametrize(
    ("match", "message"),
    [
        ({"fcae": "cube"}, "'fcae', which is no label"),
        ({"face": "cubus"}, "'cubus', which is no stimulus"),
        ({"face": "a"}, "Two recording labels"),
    ],
)
def test_a_wrong_match_is_refused(match: dict[str, str], message: str):
    with pytest.raises(UsageError, match=message):
        join_labels(("a", "face"), ("a", "cube"), match)


def test_a_match_leaves_two_labels_at_least():
    with pytest.raises(UsageError, match="drops all but 1 of 2 labels; comparing needs two"):
        join_labels(("a", "b"), ("a", "b"), {"a": None})


def test_match_files_of_three_kinds_say_the_same(tmp_path: Path):
    expected = {"1": "face", "2": None}
    (tmp_path / "m.json").write_text(json.dumps(expected))
    (tmp_path / "m.csv").write_text("1,face\n2,\n")
    (tmp_path / "m.toml").write_text('1 = "face"\n2 = ""\n')
    assert (
        read_match(tmp_path / "m.json") == read_match(tmp_path / "m.csv") == read_match(tmp_path / "m.toml") == expected
    )


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("m.txt", "", "ends in .json, .toml or .csv"),
        ("m.csv", "a,b,c\n", "two columns"),
        ("m.json", "[1]", "holds a list"),
        ("m.csv", "a,x\nb,y\na,z\n", "'a' more than once"),
        ("m.json", '{"a": "x", "b": "y", "a": "z"}', "'a' twice"),
        ("m.toml", "= 3", "not a readable TOML text"),
    ],
)
def test_a_wrong_match_file_is_refused(tmp_path: Path, name: str, text: str, message: str):
    (tmp_path / name).write_text(text)
    with pytest.raises((UsageError, DataError), match=message):
        read_match(tmp_path / name)
    with pytest.raises(DataError, match=r"/none\.json'"):
        read_match(tmp_path / "none.json")


@pytest.mark.parametrize(
    ("values", "labels"),
    [
        (np.array([0.1, 0.3], np.float32), ["0.1", "0.3"]),
        (np.array([0.1, 0.2, 0.3], np.float16), ["0.1", "0.2", "0.3"]),
        (np.arange(1, 4) * 0.1, ["0.1", "0.2", "0.3"]),
        (np.cumsum(np.full(3, 0.1)), ["0.1", "0.2", "0.3"]),
        (np.array([0.301, 0.302]), ["0.301", "0.302"]),
        (np.array([16777217.0, 16777216.0]), ["16777217", "16777216"]),
        (np.array(["15.0", "30.50"]), ["15", "30.5"]),
        (np.array(["1.1", "1.10"]), ["1.1", "1.10"]),
        (np.array(["001", "002", "1e3", "1.0.0"]), ["001", "002", "1e3", "1.0.0"]),
        (np.array(["e\u0301", " \u00e9 "]), ["\u00e9", "\u00e9"]),
        (np.array(["nan", "NaT", "NaN", " ", "None"]), ["", "", "", "", "None"]),
        (np.array([True, False]), ["true", "false"]),
    ],
)
def test_a_value_has_one_label_whatever_form_it_is_stored_in(values, labels):
    assert as_labels(values).tolist() == labels


def test_stimuli_that_were_not_recorded_are_left_out_and_forms_of_a_number_are_equal():
    assert join_labels(("15", "a"), ("a", "15.0", "b"), None) == {"15": "15.0", "a": "a"}
    assert join_labels(("1.1", "2"), ("1.1", "1.10", "2"), None) == {"1.1": "1.1", "2": "2"}


@pytest.mark.parametrize(
    ("vocabulary", "example"), [(("ball", "cat"), "'cat,hook'"), (("ball", "None"), "'None,'"), (("x",), "'x,ball'")]
)
def test_the_example_of_a_pair_pairs_no_label_that_has_its_equal(vocabulary, example):
    with pytest.raises(UsageError, match=example):
        join_labels(vocabulary, ("ball", "hook"), None)


def test_labels_that_nearly_agree_stand_together():
    assert near_labels(["a", "A ", "b", "001", "1", "0.3", "0.3000001", "16777216", "16777217", "", "1.1"]) == [
        ["0.3", "0.3000001"],
        ["001", "1"],
        ["A ", "a"],
    ]
