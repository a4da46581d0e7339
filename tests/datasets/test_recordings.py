import re

import h5py
import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from brainbench.core.contracts import check_recordings
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import check, export, inspect, open_recordings, write_recordings
from brainbench.datasets.sessions import Session, make_session
from brainbench.datasets.trials.selection import Selection
from tests.factories.recordings import make_simple_session, write_nwb


def export_to(path):
    return export(path, path.with_name("copy.h5"))


def write(path, made=None, **options):
    return write_recordings(path, made or make_simple_session(**options))


def shuffled(session: Session, random: np.random.Generator) -> Session:
    """The same session with rows of the tables and units in another order."""
    units = dict(session.units.data)
    spikes = np.split(units["spike_times"], units["spike_times_index"][:-1])
    order = random.permutation(len(spikes))
    moved = {name: units[name][order] for name in units if not name.startswith("spike_times")}
    moved["spike_times"] = np.concatenate([spikes[index] for index in order])
    moved["spike_times_index"] = np.cumsum([len(spikes[index]) for index in order])
    table = session.tables["trials"]
    rows = random.permutation(len(table))
    tables = {"trials": type(table)("trials", {name: values[rows] for name, values in table.data.items()})}
    return Session(session.subject, session.session, type(table)("units", moved), tables)


@settings(max_examples=4, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 2**16))
def test_order_of_trials_units_sessions_and_files_changes_nothing(tmp_path_factory, seed):
    random = np.random.default_rng(seed)
    folder = tmp_path_factory.mktemp("order")
    sessions = [make_simple_session(subject=name, seed=index) for index, name in enumerate(("m10", "m9", "m2"))]
    plain = write_recordings(folder / "plain.h5", sessions)
    names = random.permutation(3)
    for name, session in zip(names, sessions, strict=True):
        write_recordings(folder / "mixed" / f"{name}.h5", shuffled(session, random))
    one = open_recordings(plain, conditions="trials:stimulus", bin=0.3)
    two = open_recordings(folder / "mixed", conditions="trials:stimulus", bin=0.3)
    xr.testing.assert_identical(one.drop_attrs(), two.drop_attrs())
    assert one.attrs["content_hash"] == two.attrs["content_hash"]
    assert list(dict.fromkeys(one["subject"].values)) == ["m2", "m9", "m10"]


def test_what_another_session_did_not_record_is_missing(tmp_path):
    write(tmp_path / "a.h5", session="1")
    write(tmp_path / "b.h5", session="2", seed=1)
    dataset = check_recordings(open_recordings(tmp_path, conditions="trials:stimulus"))
    same = dataset["session"].values[:, None] == dataset["unit_session"].values[None]
    np.testing.assert_array_equal(np.isfinite(dataset["counts"].values[:, 0]), same)


def test_trials_outside_the_recorded_span_are_excluded_not_read_as_silence(tmp_path):
    start = 1.0 + 2.0 * np.arange(12)
    spikes = np.linspace(5.0, 15.5, 400)
    table = {"start_time": start, "stop_time": start + 1, "stimulus": np.resize(["a", "b"], 12)}
    dataset = open_recordings(
        write(tmp_path / "a.h5", make_session("m", "1", [spikes], {"trials": table})), conditions="trials:stimulus"
    )
    assert dataset["window_start"].values.tolist() == [5.0, 7.0, 9.0, 11.0, 13.0]
    assert dataset.attrs["removed"]["trials: outside the recorded span"] == 7
    assert "5.000–15.500 s" in "".join(dataset.attrs["notes"])


def test_a_unit_lost_before_the_end_is_missing_from_then_on(tmp_path):
    session = make_simple_session(observed=[[[0, 100]], [[0, 10.5]], [[0, 4.0], [4.0, 9.0], [12.0, 100.0]]])
    dataset = open_recordings(write(tmp_path / "a.h5", session), conditions="trials:stimulus")
    recorded = np.isfinite(dataset["counts"].values[:, 0])
    start = dataset["window_start"].values
    assert recorded[:, 0].all()
    np.testing.assert_array_equal(recorded[:, 1], start + 1 <= 10.5)
    np.testing.assert_array_equal(recorded[:, 2], (start + 1 <= 9.0) | (start >= 12.0))


def test_trials_that_overlap_invalid_times_are_removed(tmp_path):
    session = make_simple_session(tables={"invalid_times": {"start_time": [3.5], "stop_time": [5.2]}})
    dataset = open_recordings(write(tmp_path / "a.h5", session), conditions="trials:stimulus")
    assert dataset.attrs["removed"]["trials: overlap with invalid_times"] == 2


def test_a_missing_label_removes_the_trial_and_is_counted(tmp_path):
    stimulus = np.resize(np.array(["a", "b"]), 12)
    stimulus[3] = ""
    path = write(tmp_path / "a.h5", columns={"stimulus": stimulus})
    dataset = open_recordings(path, conditions="trials:stimulus")
    assert dataset.attrs["removed"]["trials: no value of stimulus"] == 1
    assert dataset.sizes["trial"] == 11


def test_a_subject_without_a_stimulus_is_kept_and_named(tmp_path):
    write(tmp_path / "a.h5", subject="m1")
    write(tmp_path / "b.h5", subject="m2", columns={"stimulus": np.resize(np.array(["a", "b"]), 12)})
    dataset = open_recordings(tmp_path, conditions="trials:stimulus")
    assert dataset.attrs["vocabulary"] == ["a", "b", "c"]
    assert dataset.attrs["missing"] == {"m2": ["c"]}


def test_units_with_no_spikes_are_removed_and_counted_or_kept_on_request(tmp_path):
    session = make_simple_session()
    silent = dict(session.units.data)
    silent["id"] = np.arange(4)
    silent["spike_times_index"] = np.append(silent["spike_times_index"], len(silent["spike_times"]))
    session = Session("m", "1", type(session.units)("units", silent), session.tables)
    path = write(tmp_path / "a.h5", session)
    dataset = open_recordings(path, conditions="trials:stimulus")
    assert (dataset.sizes["unit"], dataset.attrs["removed"]["units: no spikes"]) == (3, 1)
    kept = open_recordings(path, conditions="trials:stimulus", select="none")
    assert np.all(kept["counts"].values[:, 0, 3] == 0)


def test_a_session_of_silent_units_has_no_recorded_span(tmp_path):
    table = {"start_time": np.arange(4.0), "stop_time": np.arange(4.0) + 1, "stimulus": ["a", "b", "a", "b"]}
    path = write(tmp_path / "a.h5", make_session("m", "1", [np.zeros(0)] * 2, {"trials": table}))
    with pytest.raises(DataError, match=r"a\.h5: units: .*2; trials: .*4"):
        open_recordings(path, conditions="trials:stimulus")
    path = write(tmp_path / "b.h5", make_session("m", "1", [], {"trials": table}))
    with pytest.raises(DataError, match=r"b\.h5:.*spike_times"):
        open_recordings(path, conditions="trials:stimulus")


def test_units_are_chosen_by_layer_depth_and_number_of_spikes(tmp_path):
    columns = {"layer": ["2/3", "4", "4"], "depth": [100.0, 400.0, 500.0], "inhibitory": [False, True, False]}
    path = write(tmp_path / "a.h5", unit_columns=columns)
    chosen = open_recordings(path, conditions="trials:stimulus", select="units.layer=4; units.inhibitory=false")
    assert chosen["depth"].values.tolist() == [500.0]
    assert chosen.attrs["removed"]["units: layer=4"] == 1
    with pytest.raises(DataError, match=r"units: .*9999 .*3"):
        open_recordings(path, conditions="trials:stimulus", select="min_spikes=9999")


def test_one_subject_can_be_chosen_and_an_unknown_one_is_named(tmp_path):
    write(tmp_path / "a.h5", subject="m1")
    write(tmp_path / "b.h5", subject="m2", seed=1)
    dataset = open_recordings(tmp_path, conditions="trials:stimulus", select=Selection(subjects=("m2",)))
    assert set(dataset["subject"].values) == {"m2"}
    with pytest.raises(UsageError, match="'m3'; did you mean 'm"):
        open_recordings(tmp_path, conditions="trials:stimulus", select=Selection(subjects=("m3",)))


def test_without_conditions_the_message_proposes_some(tmp_path):
    with pytest.raises(UsageError, match=r"as 'trials:stimulus'"):
        open_recordings(write(tmp_path / "a.h5"))


def test_unknown_tables_and_columns_suggest_the_nearest(tmp_path):
    path = write(tmp_path / "a.h5")
    with pytest.raises(UsageError, match="'trails'; did you mean 'trials'"):
        open_recordings(path, conditions="trails:stimulus")
    with pytest.raises(UsageError, match="'stimuls'; did you mean 'stimulus'"):
        open_recordings(path, conditions="trials:stimuls")


def test_one_condition_only_is_refused(tmp_path):
    path = write(tmp_path / "a.h5", columns={"stimulus": ["a"] * 12})
    with pytest.raises(DataError, match=r"the one condition 'a'"):
        open_recordings(path, conditions="trials:stimulus")


def test_no_trial_left_tells_which_rules_removed_them(tmp_path):
    with pytest.raises(DataError, match=r"start_time=99\.\. .*12"):
        open_recordings(write(tmp_path / "a.h5"), conditions="trials:stimulus", select="start_time=99..")


@pytest.mark.parametrize("job", ["open", "export"])
def test_a_misspelt_name_among_several_is_refused(tmp_path, job):
    def read(path, select):
        if job == "export":
            return export(path, tmp_path / "copies", select=select)
        return open_recordings(path, conditions="trials:stimulus", select=select)

    write(tmp_path / "a.h5", subject="m1", columns={"light": ["on", "off"] * 6})
    write(tmp_path / "b.h5", subject="m2", seed=1, columns={"light": ["off", "off"] * 6})
    with pytest.raises(UsageError, match="subject 'm3'; did you mean 'm"):
        read(tmp_path, "subjects=m1|m3")
    with pytest.raises(UsageError, match=r"stimulus value 'zz'.*'a', 'b', 'c'"):
        read(tmp_path, "stimulus=a|b|zz")
    # In one of the sessions is enough.
    read(tmp_path, "light=On|off; subjects=m1|m2")


def test_a_misspelt_value_to_remove_is_told_and_one_that_is_absent_is_not(tmp_path):
    path = write(tmp_path / "a.h5", columns={"texture": ["rough", "smooth"] * 6})
    notes = open_recordings(path, conditions="trials:stimulus", select="texture!=smoth|spoil").attrs["notes"]
    assert [note for note in notes if "'smoth'" in note and "did you mean 'smooth'" in note]
    assert not [note for note in notes if "'spoil'" in note]


def test_files_of_animals_that_may_be_one_are_told(tmp_path):
    def doubts(*subjects):
        for number, subject in enumerate(subjects):
            write(tmp_path / f"day{number}.h5", subject=subject, session=str(number), seed=number)
        dataset = open_recordings(tmp_path, conditions="trials:stimulus")
        return sorted(set(dataset["subject"].values.tolist())), " ".join(dataset.attrs["doubts"])

    assert doubts("m1", "m1 ", " m1") == (["m1"], "")
    names, told = doubts("m1", "M1", "m2")
    assert names == ["M1", "m1", "m2"]
    assert "'M1', 'm1'" in told
    assert "m2" not in told
    names, told = doubts("", "", "m2")
    assert len(names) == 3
    assert all(name in told for name in names if name != "m2")


def test_one_session_under_the_names_of_two_animals_is_told(tmp_path):
    start = np.cumsum(np.random.default_rng(0).uniform(2, 3, 12))
    for name, begin in (("m1", start), ("m2", start), ("m3", start[::-1].max() + 3 - start[::-1])):
        columns = {"start_time": begin, "stop_time": begin + 1}
        write(tmp_path / f"{name}.h5", subject=name, session=name, columns=columns)
    told = open_recordings(tmp_path, conditions="trials:stimulus").attrs["doubts"]
    assert [("m1" in doubt, "m2" in doubt, "m3" in doubt) for doubt in told] == [(True, True, False)]


def test_trials_whose_windows_overlap_are_told(tmp_path):
    # Twelve trials of 1 s every 2 s, with the labels a, b and c by turns.
    path = write(tmp_path / "a.h5")
    expected = {"start..stop": (0, 0), "start..+2": (0, 0), "start..+3": (11, 0), "start..+6.5": (9, 7)}
    for window, (every, alike) in expected.items():
        found = open_recordings(path, conditions="trials:stimulus", window=window)
        trials = found.sizes["trial"]
        assert found.attrs["overlap"] == alike / trials
        told = f"{every} of {trials} trials begin before that of an earlier one ends ({alike} of"
        assert any(told in doubt for doubt in found.attrs["doubts"]) == (every > 0), found.attrs["doubts"]


def test_a_session_that_loses_all_trials_is_told(tmp_path):
    write(tmp_path / "a.h5", subject="m1")
    write(tmp_path / "b.h5", subject="m2", columns={"stimulus": np.array([""] * 12)})
    assert "of m2" in " ".join(open_recordings(tmp_path, conditions="trials:stimulus").attrs["doubts"])


def test_a_chosen_animal_without_units_is_told_and_not_called_unknown(tmp_path):
    write_nwb(tmp_path / "a.nwb", subject="m1", units=False)
    export(write(tmp_path / "b.h5", subject="m2"), tmp_path / "b.nwb")
    with pytest.raises(DataError, match=r"a\.nwb has no units table"):
        open_recordings(tmp_path, conditions="trials:stimulus", select="subjects=m1")


def test_depths_are_numbers_whatever_type_a_session_stores_them_in(tmp_path):
    columns = {"depth": [100.0, 400.0, 500.0], "inhibitory": [True, False, True]}
    write(tmp_path / "a.h5", session="1", unit_columns=columns)
    columns = {"depth": ["150", "unknown", ""], "inhibitory": ["True", "false", "?"]}
    write(tmp_path / "b.h5", session="2", seed=1, unit_columns=columns)
    found = open_recordings(tmp_path, conditions="trials:stimulus")
    np.testing.assert_array_equal(found["depth"].values, [100.0, 400.0, 500.0, 150.0, np.nan, np.nan])
    np.testing.assert_array_equal(found["inhibitory"].values, [1.0, 0.0, 1.0, 1.0, 0.0, np.nan])
    notes = " ".join(found.attrs["notes"])
    assert re.search(r"b\.h5.*'depth'.*'unknown'", notes)
    assert "'inhibitory' holds numbers; missing where it says '?'" in notes


def test_unsorted_spikes_are_sorted_and_said(tmp_path):
    session = make_simple_session()
    units = dict(session.units.data)
    units["spike_times"] = units["spike_times"].copy()
    units["spike_times"][:480] = units["spike_times"][:480][::-1]
    mixed = Session("mouse", "1", type(session.units)("units", units), session.tables)
    plain = open_recordings(write(tmp_path / "a.h5", session), conditions="trials:stimulus")
    dataset = open_recordings(write(tmp_path / "b.h5", mixed), conditions="trials:stimulus")
    xr.testing.assert_identical(plain.drop_attrs(), dataset.drop_attrs())
    assert re.search("spike times of 1 unit.* sorted", "".join(dataset.attrs["notes"]))


def test_spike_times_that_are_not_finite_are_refused(tmp_path):
    path = write(tmp_path / "a.h5", unit_columns={"id": [7, 8, 9]})
    with h5py.File(path, "a") as file:
        file["sessions/mouse-1/units/spike_times"][500] = np.nan
    with pytest.raises(DataError, match=r"\(first with id 8\)"):
        open_recordings(path, conditions="trials:stimulus")


def test_recorded_spans_without_a_beginning_hold_nothing_and_spoil_no_others(tmp_path):
    spikes, table = (
        [np.arange(0.0, 12.0, 0.1)],
        {"start_time": [1.0, 3.0], "stop_time": [2.0, 4.0], "stimulus": ["a", "b"]},
    )
    session = make_session("m", "1", spikes, {"trials": table}, observed=[[[0.0, 0.5], [0.9, 10.0]]])
    path = write_recordings(tmp_path / "a.h5", session)
    with h5py.File(path, "a") as file:
        file["sessions/m-1/units/obs_intervals"][0] = [np.nan, 0.95]
    assert open_recordings(path, conditions="trials:stimulus").sizes["trial"] == 2


def test_an_inconsistent_ragged_index_is_refused(tmp_path):
    path = write(tmp_path / "a.h5")
    with h5py.File(path, "a") as file:
        file["sessions/mouse-1/units/spike_times_index"][-1] = 7
    with pytest.raises(DataError, match=r"spike_times_index"):
        open_recordings(path, conditions="trials:stimulus")


def test_the_same_session_twice_is_refused(tmp_path):
    write(tmp_path / "a.h5")
    (tmp_path / "copy.h5").write_bytes((tmp_path / "a.h5").read_bytes())
    with pytest.raises(DataError, match=r"a\.h5.* and .*copy\.h5.* hold the same spikes \(3 of 3 units\)"):
        open_recordings(tmp_path, conditions="trials:stimulus")


@pytest.mark.parametrize("use", [lambda path: open_recordings(path, conditions="trials:stimulus"), inspect, export_to])
def test_damage_inside_a_file_names_the_file(tmp_path, use):
    path = write(tmp_path / "a.h5")
    with h5py.File(path) as file:
        chunk = file["sessions/mouse-1/units/spike_times"].id.get_chunk_info(0)
    with path.open("r+b") as stream:
        stream.seek(chunk.byte_offset)
        stream.write(bytes(chunk.size))
    with pytest.raises(DataError, match=r"a\.h5. .*damaged"):
        use(path)
    assert "damaged" in check(path).findings[0].message
