import numpy as np
import pytest

from brainbench.datasets import get_recipe, inspect, list_recipes, make_session, open_recordings, write_recordings
from brainbench.errors import UsageError

from .fakes import LABELS

ROWS = 14


def write_rodgers(path, *, contacts=True, **columns):
    """Fourteen trials of 10 s in the layout of Rodgers 2022; contact after 2 s, choice after 3 s."""
    start = 10.0 * np.arange(ROWS)
    trials = {
        "id": np.arange(ROWS) * 2 + 30,
        "start_time": start,
        "stop_time": start + 10,
        "stimulus": np.resize(np.repeat(["convex", "concave"], 3), ROWS),
        "servo_position": np.resize(np.array(["far", "medium", "close"]), ROWS),
        "outcome": np.full(ROWS, "correct"),
        "choice_time": start + 3,
        "direct_delivery": np.zeros(ROWS, dtype=bool),
        "stim_is_random": np.ones(ROWS, dtype=bool),
        "optogenetic": np.zeros(ROWS, dtype=bool),
        "ignore_trial": np.zeros(ROWS, dtype=bool),
    } | {name: np.asarray(values) for name, values in columns.items()}
    tables = {"trials": {name: values for name, values in trials.items() if values.ndim}}
    if contacts:
        tables["contacts_by_whisker_C1"] = {"start_time": start + 2.0, "stop_time": start + 2.1}
        tables["contacts_by_whisker_C2"] = {"start_time": start + 2.5, "stop_time": start + 2.5}
    spikes = np.arange(0.0, 10.0 * ROWS, 0.1) - 0.01
    return write_recordings(path, make_session("231CR", "1", [spikes], tables))


def one(index, value, other):
    return [value if row == index else other for row in range(ROWS)]


def test_the_recipe_prints_every_rule():
    text = get_recipe("rodgers").describe()
    for expected in (
        "conditions: trials:stimulus,servo_position",
        f"vocabulary: {', '.join(LABELS)}",
        "window: first-contact..choice",
        "window of sessions without contact tables: choice-1..+1",
        "trials: stimulus!=nothing",
        "trials: outcome!=spoil",
        "trials: direct_delivery!=true",
        "trials: stim_is_random!=false",
        "trials: optogenetic!=true",
        "trials: ignore_trial!=true",
        "starting_time is never subtracted",
        "doi:10.1038/s41597-022-01728-1",
    ):
        assert expected in text
    assert list_recipes() == ["rodgers"]


def test_the_layout_is_detected_and_said(tmp_path):
    path = write_rodgers(tmp_path / "a.h5")
    dataset = open_recordings(path)
    assert dataset.attrs["recipe"] == "rodgers (detected from the layout)"
    assert dataset.attrs["vocabulary"] == list(LABELS)
    assert dataset.attrs["conditions"] == "trials:stimulus,servo_position"
    np.testing.assert_allclose(dataset["window_start"].values, 10.0 * np.arange(ROWS) + 2)
    np.testing.assert_allclose(dataset["duration"].values, 1.0)
    assert np.all(dataset["counts"].values == 10)
    assert open_recordings(f"rodgers:{path}").attrs["recipe"] == "rodgers"


@pytest.mark.parametrize(
    ("column", "values", "rule"),
    [
        ("stimulus", one(4, "nothing", "convex"), "trials: stimulus!=nothing"),
        ("outcome", one(4, "spoil", "error"), "trials: outcome!=spoil"),
        ("direct_delivery", one(4, True, False), "trials: direct_delivery!=true"),
        ("stim_is_random", one(4, False, True), "trials: stim_is_random!=false"),
        ("optogenetic", one(4, 1, 0), "trials: optogenetic!=true"),
        ("ignore_trial", one(4, True, False), "trials: ignore_trial!=true"),
        ("choice_time", one(4, np.nan, 3.0), "trials: no event for the window first-contact..choice"),
    ],
)
def test_each_rule_removes_its_trial_and_counts_it(tmp_path, column, values, rule):
    if column == "choice_time":
        values = np.array(values) + 10.0 * np.arange(ROWS)
    dataset = open_recordings(write_rodgers(tmp_path / "a.h5", **{column: values}))
    assert {name: number for name, number in dataset.attrs["removed"].items() if number} == {rule: 1}
    assert "38" not in dataset["trial_id"].values
    assert dataset.sizes["trial"] == ROWS - 1


def test_a_position_outside_the_vocabulary_is_not_a_new_condition(tmp_path):
    dataset = open_recordings(write_rodgers(tmp_path / "a.h5", servo_position=one(2, "elsewhere", "far")))
    assert dataset.attrs["removed"]["trials: label outside the vocabulary"] == 1
    assert dataset.attrs["vocabulary"] == list(LABELS)
    assert dataset.attrs["missing"] == {"231CR": ["convex-close", "convex-medium", "concave-close", "concave-medium"]}


def test_absent_optional_columns_are_tolerated_and_said(tmp_path):
    nothing = np.array(0)
    dataset = open_recordings(write_rodgers(tmp_path / "a.h5", optogenetic=nothing, ignore_trial=nothing))
    assert dataset.sizes["trial"] == ROWS
    assert "no column 'optogenetic', so the rule optogenetic!=true did not apply" in "".join(dataset.attrs["notes"])


def test_a_session_without_contact_tables_is_read_before_the_choice(tmp_path):
    dataset = open_recordings(write_rodgers(tmp_path / "a.h5", contacts=False))
    np.testing.assert_allclose(dataset["window_start"].values, 10.0 * np.arange(ROWS) + 2)
    assert f"window choice-1..+1 for its {ROWS} trials" in "".join(dataset.attrs["notes"])


def test_arguments_replace_their_part_of_the_recipe_only(tmp_path):
    path = write_rodgers(tmp_path / "a.h5", outcome=one(0, "spoil", "error"))
    shapes = open_recordings(path, conditions="trials:stimulus")
    assert shapes.attrs["vocabulary"] == ["convex", "concave"]
    assert shapes.attrs["removed"]["trials: outcome!=spoil"] == 1
    everything = open_recordings(path, select="none", window="start..stop")
    assert everything.sizes["trial"] == ROWS - 1
    assert everything.attrs["removed"]["trials: outside the recorded span"] == 1
    outcomes = open_recordings(path, conditions="trials:outcome", select="none")
    assert outcomes.attrs["vocabulary"] == ["error", "spoil"]


def test_a_recipe_that_does_not_fit_names_what_is_missing(tmp_path):
    session = make_session("m", "1", [np.arange(5.0)], {"trials": {"start_time": [0.0, 1.0], "stim": ["a", "b"]}})
    with pytest.raises(UsageError, match="Unknown column 'stimulus'; did you mean 'stim'"):
        open_recordings(f"rodgers:{write_recordings(tmp_path / 'a.h5', session)}")


def test_files_of_different_layouts_are_not_mixed_silently(tmp_path):
    write_rodgers(tmp_path / "a.h5")
    session = make_session("m", "1", [np.arange(5.0)], {"trials": {"start_time": [0.0, 1.0], "stim": ["a", "b"]}})
    write_recordings(tmp_path / "b.h5", session)
    with pytest.raises(UsageError, match=r"b\.h5:m-1 has another layout than"):
        open_recordings(tmp_path)


def test_inspection_proposes_the_conditions_of_the_recipe_first(tmp_path):
    report = inspect(write_rodgers(tmp_path / "a.h5"))
    assert report.recipe == "rodgers"
    assert report.proposals[0].conditions == "trials:stimulus,servo_position"
    assert report.proposals[0].labels == LABELS
