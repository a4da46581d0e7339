import re

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets.sessions import make_session
from brainbench.datasets.trials.windows import Window


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


def test_a_contact_of_zero_duration_is_no_contact_unless_asked_for():
    session = make_contacts(C0=[(1.0, 1.0), (2.0, 2.1)])
    found, notes = edges(Window("first-contact", stop="choice"), session)
    assert found[0, 0] == 2.0
    assert "1 of 2 contacts" in notes[0]
    found, _ = edges(Window("first-contact", stop="choice", shortest_contact=-1.0), session)
    assert found[0, 0] == 1.0


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
        ({"length": 1.0, "shortest_contact": 0.01}, "shortest_contact"),
        ({"stop": "choice", "fallback": Window("start", length=1.0)}, "fallback"),
    ],
)
def test_settings_that_mean_nothing_to_a_window_are_refused(options, told):
    with pytest.raises(UsageError, match=told):
        Window("start", **options)
