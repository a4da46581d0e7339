from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.ledger import Ledger
from brainbench.datasets.sessions import SessionTable, make_session
from brainbench.datasets.trials.selection import (
    Conditions,
    Rule,
    Selection,
    Window,
    check_values,
    joined_labels,
    natural_vocabulary,
    select_rows,
)
from tests.factories.recordings import make_simple_session


def test_conditions_are_a_table_and_columns():
    parsed = Conditions.parse("trials: stimulus , servo_position")
    assert (parsed.table, parsed.columns) == ("trials", ("stimulus", "servo_position"))
    assert Conditions.parse(str(parsed)) == parsed
    assert Conditions.parse("behavior/poke:side").table == "behavior/poke"


@pytest.mark.parametrize("source", ["stimulus", "trials:", ":stimulus", "trials:a,,b"])
def test_unreadable_conditions_show_the_form(source):
    with pytest.raises(UsageError, match=rf"'{source}' .*TABLE:COLUMN,COLUMN"):
        Conditions.parse(source)


def test_a_column_is_named_once():
    with pytest.raises(UsageError, match="'a' more than once"):
        Conditions.parse("trials:a,a")


def test_a_missing_value_leaves_no_label():
    assert joined_labels(np.array([["a", "1"], ["b", ""]])) == ["a-1", ""]


def test_vocabulary_sorts_column_by_column_and_numbers_as_numbers():
    rows = [("b", "10"), ("a", "9"), ("b", "9"), ("a", "10")]
    assert natural_vocabulary(rows) == ("a-9", "a-10", "b-9", "b-10")
    assert natural_vocabulary(reversed(rows)) == natural_vocabulary(rows)


def test_combinations_that_read_alike_are_refused():
    with pytest.raises(DataError, match="both read 'a-b-c'"):
        natural_vocabulary([("a-b", "c"), ("a", "b-c")])


def make_table(**columns):
    return SessionTable("trials", {name: np.array(values) for name, values in columns.items()}, "f.nwb")


def test_each_row_is_counted_under_the_first_rule_that_removes_it():
    table = make_table(outcome=["spoil", "correct", "spoil", "error"], laser=[True, True, False, False])
    ledger = Ledger()
    rules = (Rule("outcome", refuse=("spoil",)), Rule("laser", refuse=("true",)))
    assert select_rows(table, rules, "trials", ledger).tolist() == [False, False, False, True]
    assert ledger.removed == {"trials: outcome!=spoil": 2, "trials: laser!=true": 1}


@pytest.mark.parametrize("values", [[True, False], [1, 0], [1.0, 0.0], ["True", "False"], ["1", "0"]])
def test_truth_is_recognised_however_the_file_spells_it(values):
    assert Rule("flag", refuse=("true",)).keep(make_table(flag=values)).tolist() == [False, True]


@pytest.mark.parametrize(
    ("value", "column"),
    [
        ("1", [True, False]),
        ("1.0", [True, False]),
        ("1", ["True", "False"]),
        ("1.0", [1, 2]),
        ("01", [1.0, 2.0]),
        (".10", [0.1, 0.2]),
        (".1", np.array([0.1, 0.2], np.float32)),
        ("nan", [np.nan, 2.0]),
    ],
)
def test_a_number_is_recognised_however_the_rule_spells_it(value, column):
    ledger = Ledger()
    assert Rule("a", refuse=(value,)).keep(make_table(a=column), ledger.seen).tolist() == [False, True]
    assert Rule("a", allow=(value,)).keep(make_table(a=column), ledger.seen).tolist() == [True, False]
    assert check_values(ledger) == []


def test_texts_and_numbers_out_of_range_are_compared_as_they_are():
    assert Rule("a", refuse=("001",)).keep(make_table(a=["1", "01"])).all()
    assert Rule("a", refuse=("1e300",)).keep(make_table(a=np.array([1, np.nan], np.float32))).all()
    assert Rule("a", refuse=("nan",)).keep(make_table(a=["", "nan", "b"])).tolist() == [False, False, True]


def test_a_missing_value_fails_what_is_asked_for_and_passes_what_is_refused():
    table = make_table(depth=[100.0, np.nan, 900.0])
    assert Rule("depth", low=50, high=500).keep(table).tolist() == [True, False, False]
    assert Rule("depth", allow=("100",)).keep(table).tolist() == [True, False, False]
    assert Rule("depth", refuse=("100",)).keep(table).tolist() == [False, True, True]


def test_an_optional_rule_without_its_column_says_so():
    ledger = Ledger()
    assert select_rows(make_table(a=[1, 2]), (Rule("b", refuse=("x",), required=False),), "trials", ledger).all()
    assert "rule b!=x" in ledger.doubts[0]
    assert ledger.removed == {}


def test_a_required_rule_without_its_column_suggests_the_nearest():
    with pytest.raises(UsageError, match="did you mean 'outcome'"):
        Rule("outcom", allow=("correct",)).keep(make_table(outcome=["correct"]))


def test_a_range_over_text_is_refused():
    with pytest.raises(DataError, match=r"'layer' .*text .*'2/3'"):
        Rule("layer", low=1, high=4).keep(make_table(layer=["2/3", "4"]))


def test_rules_are_read_from_text():
    selection = Selection.parse(
        "outcome=correct|error; stimulus!=nothing; units.depth=100..; units.layer=4; min_spikes=9"
    )
    assert selection.trials == (Rule("outcome", allow=("correct", "error")), Rule("stimulus", refuse=("nothing",)))
    assert selection.units == (Rule("depth", low=100.0), Rule("layer", allow=("4",)))
    assert selection.min_spikes == 9
    assert Selection.parse("subjects=a|b").subjects == ("a", "b")
    assert next(iter(selection.lines())) == "trials: outcome=correct|error"


def test_a_selection_made_in_python_is_read_from_its_text():
    made = Selection(
        (Rule("outcome", refuse=("spoil",)),), (Rule("depth", low=100.0, high=123.4567891),), 5, ("m1", "m2")
    )
    assert replace(Selection.parse(str(made)), name=made.name) == made
    assert str(Selection.parse("outcome=correct")) == "outcome=correct"


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("outcome", "cannot be read"),
        ("depth!=1..2", "range cannot be refused"),
        ("min_spikes=few", "whole number"),
        ("outcome=|", "'outcome' has an empty value"),
        ("outcome=correct|", "'outcome' has an empty value"),
        ("units.layer!=|", "'layer' has an empty value"),
        ("depth=..", "'depth' has an empty value"),
        ("depth=5..2", "depth=5..2 keeps nothing"),
        ("subjects=|", "subjects are names"),
        ("subjects=m1|", "subjects are names"),
        ("subjects!=m1", "subjects is written subjects="),
        ("min_spikes!=5", "min_spikes is written min_spikes="),
        ("subjects=m1; subjects=m2", "'subjects' more than once"),
        ("min_spikes=5; min_spikes=9", "'min_spikes' more than once"),
    ],
)
def test_unreadable_rules_show_the_form(source, message):
    with pytest.raises(UsageError, match=message):
        Selection.parse(source)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: Selection(min_spikes=-1), "min_spikes .*-1"),
        (lambda: Selection(min_spikes=2.5), r"min_spikes .*2\.5"),
        (lambda: Selection(min_spikes=float("nan")), "min_spikes .*nan"),
        (lambda: Selection(subjects="mouse1"), "subjects .*'mouse1'"),
        (lambda: Rule("layer", allow="4"), "allow .*'4'"),
        (lambda: Selection.parse(" ; "), "states no rule"),
    ],
)  # fmt: skip
def test_selections_that_would_select_something_else_are_refused(make, told):
    with pytest.raises(UsageError, match=told):
        make()


def make_contacts(**tables):
    trials = {"start_time": [0.0, 10.0, 20.0], "stop_time": [9.0, 19.0, 29.0], "choice_time": [5.0, 15.0, np.nan]}
    contacts = {
        f"contacts_by_whisker_{name}": {"start_time": [row[0] for row in rows], "stop_time": [row[1] for row in rows]}
        for name, rows in tables.items()
    }
    return make_session("m", "1", [np.zeros(1)], {"trials": trials, **contacts})


def edges(window, session):
    notes: list[str] = []
    return window.edges(session, session.tables["trials"], notes), notes


@pytest.mark.parametrize(
    "source",
    [
        "first-contact..choice",
        "start+0.2..stop-0.1",
        "cue_time-0.5..+1.5",
        "choice-1..choice",
        "start..stop-1 or +0.5",
        "cue-1e-07..+0.123456789",
    ],
)
def test_windows_are_read_from_text_and_written_back(source):
    assert str(Window.parse(source)) == source


@pytest.mark.parametrize(
    ("source", "part"),
    [
        ("start..+inf", "+inf"),
        ("choice..choice+nan", "choice+nan"),
        ("choice-inf..choice", "choice-inf"),
        ("start+0.1x..stop", "start+0.1x"),
        ("start..+0.5..+0.6", "+0.5.."),
        ("start..choice..stop", "choice..stop"),
        ("start−0.5..+1", "start−0.5"),
    ],
)
def test_a_malformed_number_is_no_event(source, part):
    with pytest.raises(UsageError, match=f"has {re.escape(repr(part))} where an event stands"):
        Window.parse(source)


def test_offsets_may_have_an_exponent_but_no_infinite_value():
    assert Window.parse("start+2e-1..+5E-1") == Window("start", offset=0.2, length=0.5)
    with pytest.raises(UsageError, match=r"offset .*finite"):
        Window.parse("start+1e400..+1")


@pytest.mark.parametrize("source", ["start", "..stop", "start..", "5", "start..+1 or +2", "start..stop or choice"])
def test_unreadable_windows_show_the_form(source):
    with pytest.raises(UsageError, match=rf"'{re.escape(source)}' .*FROM\.\.\+SECONDS"):
        Window.parse(source)


@pytest.mark.parametrize("source", ["start..+500ms", "start+500 ms..stop", "start..+0.5s"])
def test_a_time_with_a_unit_is_told_in_seconds(source):
    with pytest.raises(UsageError, match=re.escape("here +0.5.")):
        Window.parse(source)


def test_an_unknown_event_is_answered_with_the_names_of_events():
    with pytest.raises(UsageError, match="did you mean 'start'"):
        edges(Window.parse("strt..+0.5"), make_contacts())


def test_a_window_needs_an_end_and_a_positive_length():
    with pytest.raises(UsageError, match=r"'start' .*stop .*length"):
        Window("start")
    with pytest.raises(UsageError, match=r"length .*received 0"):
        Window("start", length=0.0)


def test_the_first_contact_is_the_earliest_of_all_whiskers_inside_the_trial():
    session = make_contacts(C0=[(2.0, 2.1), (12.0, 12.1)], C1=[(1.5, 1.6), (9.5, 9.6), (13.0, 13.2)])
    found, _ = edges(Window("first-contact", stop="choice"), session)
    np.testing.assert_allclose(found[:2], [[1.5, 5.0], [12.0, 15.0]])
    assert np.isnan(found[2]).any()


def test_a_contact_of_zero_duration_is_no_contact():
    session = make_contacts(C0=[(1.0, 1.0), (2.0, 2.1)])
    found, notes = edges(Window("first-contact", stop="choice"), session)
    assert found[0, 0] == 2.0
    assert "1 of 2 contacts" in notes[0]


def test_a_contact_after_the_choice_is_not_the_first():
    found, _ = edges(Window("first-contact", stop="choice"), make_contacts(C0=[(6.0, 6.1)]))
    assert np.isnan(found[0, 0])


def test_a_session_without_contact_tables_takes_the_fallback_and_says_so():
    window = Window("first-contact", stop="choice", fallback=Window("choice", offset=-1.0, length=1.0))
    found, notes = edges(window, make_contacts())
    np.testing.assert_allclose(found[0], [4.0, 5.0])
    assert "window choice-1..+1 for its 3 trials" in notes[0]
    with pytest.raises(DataError, match="contacts_by_whisker_"):
        edges(Window("first-contact", stop="choice"), make_contacts())


def test_with_stop_and_length_whichever_comes_first_ends_the_window():
    found, _ = edges(Window("start", stop="choice", length=7.0), make_contacts())
    np.testing.assert_allclose(found[:2, 1], [5.0, 15.0])
    found, _ = edges(Window("start", stop="choice", length=3.0), make_contacts())
    np.testing.assert_allclose(found[:2, 1], [3.0, 13.0])


def test_an_unknown_anchor_suggests_the_nearest_column():
    with pytest.raises(UsageError, match="did you mean 'choice_time'"):
        edges(Window("choice_tim", length=1.0), make_contacts())


def test_an_event_without_its_column_does_not_suggest_itself():
    session = make_session("m", "s", [np.zeros(0)], {"trials": {"start_time": [0.0], "texture": ["a"]}})
    with pytest.raises(UsageError, match="'stop'") as found:
        Window("start", stop="stop").edges(session, session.tables["trials"], [])
    assert "did you mean 'stop'" not in str(found.value)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"length": 1.0, "stop_offset": 0.2}, "stop_offset"),
        ({"stop": "choice", "fallback": Window("start", length=1.0)}, "fallback"),
    ],
)
def test_settings_that_mean_nothing_to_a_window_are_refused(options, told):
    with pytest.raises(UsageError, match=told):
        Window("start", **options)


def test_an_area_that_names_no_unit_is_answered_with_the_nearest(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_simple_session(unit_columns={"area": ["S1", "S1", "M1"]}))
    with pytest.raises(UsageError, match=r"Unknown area value 'S2'; did you mean 'S1'\?"):
        open_recordings(path, conditions="trials:stimulus", select="units.area=S2")


def test_a_window_of_numbers_of_numpy_is_written_as_one_of_python():
    assert str(Window(offset=np.float32(0.5), length=np.float32(1.5))) == str(Window(offset=0.5, length=1.5))
