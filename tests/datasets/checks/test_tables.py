import re
from dataclasses import replace

import h5py
import numpy as np
import pytest

from brainbench.datasets import check, write_recordings
from brainbench.datasets.sessions import SessionTable, ragged
from tests.datasets.checks.healthy_sessions import examine, findings_of, make_healthy, with_spikes
from tests.factories.recording_files import detection, write_rodgers


def with_column(session, table, **columns):
    changed = replace(session.tables[table], data={**session.tables[table].data, **columns})
    return replace(session, tables={**session.tables, table: changed})


# Tables


def test_a_column_that_slipped_by_a_row_is_found(tmp_path):
    session = make_healthy()
    choice = np.roll(session.tables["trials"].data["choice_time"], -1)
    items, text = examine(tmp_path, with_column(session, "trials", choice_time=choice), "tables", "error")
    assert re.search(r"choice_time .* 0 % .*\+1 row", text)
    assert items[0].values["shift"] == 1
    relative = choice - session.tables["trials"].data["start_time"]
    items, text = examine(tmp_path, with_column(session, "trials", choice_time=relative), "tables", "warning")
    assert re.search(r"choice_time .*89 of 90 \(99 %\)", text)


def test_a_column_of_another_length_is_found(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_healthy())
    with h5py.File(path, "a") as file:
        group = file["sessions/synthetic01-01/tables/trials"]
        values = group["stimulus"][:-1]
        del group["stimulus"]
        group["stimulus"] = values
    _, text = findings_of(path, "tables", "error")
    assert "Column 'stimulus' of table 'trials'" in text
    assert "has 89 values for 90 rows" in text


def test_impossible_times_of_trials_are_named(tmp_path):
    session = make_healthy()
    start, stop = (session.tables["trials"].data[name].copy() for name in ("start_time", "stop_time"))
    stop[3], start[5] = start[3] - 1, np.nan
    _, text = examine(tmp_path, with_column(session, "trials", start_time=start, stop_time=stop), "times", "error")
    assert re.search(r"1 of 90 \(1 %\) .*'trials' .*start_time", text)
    assert "stop_time before" in text
    tables = {
        name: with_column(
            session,
            name,
            **{
                key: session.tables[name].data[key] * 1000 for key in session.tables[name].data if key.endswith("_time")
            },
        ).tables[name]
        for name in session.tables
    }
    checkup = check(write_recordings(tmp_path / "b.h5", replace(session, tables=tables)))
    text = str(checkup)
    assert "milliseconds" in text
    assert re.search(r"90 of 90 \(100 %\) trials .*span", text)
    assert checkup.verdict == "error"


def test_rows_without_any_end_and_ids_that_repeat_are_told(tmp_path):
    session = make_healthy()
    plain = replace(session, synthetic=False)  # no layout knows its window
    changed = with_column(plain, "trials", stop_time=np.full(90, np.nan), id=np.arange(90) // 2)
    checkup = check(write_recordings(tmp_path / "a.h5", changed))
    assert re.search(r"'trials' .*\(0, 1, 2, 3, 4 and 40 more\)", str(checkup))
    assert re.search(r"90 trials .*window start\.\.stop", str(checkup))
    units = {**session.units.data, "id": np.zeros(20, dtype=np.int64)}
    _, text = examine(tmp_path, replace(session, units=SessionTable("units", units)), "units", "warning")
    assert text == "1 unit ids occur more than once (0)"


def test_contacts_on_another_clock_than_trials_are_found(tmp_path):
    session = make_healthy()
    contacts = session.tables["contacts_by_whisker_C1"].data
    moved = {name: values + 500.0 for name, values in contacts.items()}
    _, text = examine(tmp_path, with_column(session, "contacts_by_whisker_C1", **moved), "tables", "error")
    assert "90 of 90 (100 %) contacts of contacts_by_whisker_C1" in text


def test_trials_without_recording_and_breaks_are_told(tmp_path):
    session = with_spikes(
        make_healthy(), lambda spikes: [times[(times < 40) | ((times > 80) & (times < 120))] for times in spikes]
    )
    units = {name: values for name, values in session.units.data.items() if not name.startswith("obs")}
    items, text = examine(tmp_path, replace(session, units=SessionTable("units", units)), "coverage")
    assert {item.severity for item in items} == {"warning", "note"}
    assert "recorded span" in text
    assert "(40–80 s)" in text
    assert "no obs_intervals" in text
    shorter = {**session.units.data, **ragged("obs_intervals", [np.array([[0.0, 60.0]])] * 20)}
    _, text = examine(tmp_path, replace(session, units=SessionTable("units", shorter)), "coverage", "warning")
    assert "recorded span" in text


# Labels


def test_labels_that_differ_in_case_or_are_missing_are_named(tmp_path):
    session = make_healthy()
    stimulus = session.tables["trials"].data["stimulus"].astype("U9")
    stimulus[np.flatnonzero(stimulus == "s1")[:3]] = "S1 "
    stimulus[np.flatnonzero(stimulus == "s2")[0]] = ""
    _, text = examine(
        tmp_path, with_column(session, "trials", stimulus=stimulus), "labels", conditions="trials:stimulus"
    )
    assert ": 'S1', 's1'" in text
    assert re.search(r"1 of 90 \(1 %\) trials .*stimulus", text)
    with_one = with_column(session, "trials", stimulus=np.full(90, "a"))
    _, text = examine(tmp_path, with_one, "labels", "error", conditions="trials:stimulus")
    assert "only 1 label has trials" in text
    _, text = examine(tmp_path, session, "labels", "error", conditions="trials:stimulis")
    assert "did you mean 'stimulus'" in text


def test_labels_are_held_against_the_vocabulary_of_the_layout(tmp_path):
    places = np.resize(np.array(["far", "medium", "close"]), 14)
    places[2] = "Close"
    _, text = findings_of(write_rodgers(tmp_path / "a.h5", servo_position=places), "labels")
    assert re.search(r"1 trial.* 'convex-Close'.*did they mean", text)
    path = write_rodgers(tmp_path / "b.h5", **detection())
    assert "nothing" not in findings_of(path, "labels")[1]
    assert "1 labels have fewer than 2 trials" not in findings_of(path, "labels")[1]


@pytest.mark.parametrize("task", ["discrimination", "detection"])
def test_answers_must_agree_with_the_rule_of_the_task(tmp_path, task):
    columns = detection() if task == "detection" else {"stimulus": np.resize(np.repeat(["convex", "concave"], 3), 14)}
    side = np.where(columns["stimulus"] == ("nothing" if task == "detection" else "convex"), "left", "right")
    columns |= {"rewarded_side": side, "choice": side}
    assert not findings_of(write_rodgers(tmp_path / "a.h5", **columns), "labels", "error")[0]
    slipped = columns | {"choice": np.roll(side, 1)}
    assert (
        "outcome contradicts choice" in findings_of(write_rodgers(tmp_path / "b.h5", **slipped), "labels", "error")[1]
    )
    slipped = columns | {"stimulus": np.roll(columns["stimulus"], 1)}
    assert (
        "both sides were rewarded for" in findings_of(write_rodgers(tmp_path / "c.h5", **slipped), "labels", "error")[1]
    )
