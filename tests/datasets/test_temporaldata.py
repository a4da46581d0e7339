from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError
from brainbench.datasets import (
    StoredRDMs,
    check,
    export,
    inspect,
    open_recordings,
    write_rdms,
    write_recordings,
)
from brainbench.datasets.sessions import make_session
from brainbench.datasets.temporaldata import write_temporaldata
from tests.factories.recordings import make_simple_session

NAMES = np.array(["ball", "comb", "disk"])


def put(parent, name, kind, columns=(), times=None, **attributes):
    """Write one object: its class, its columns, and which of these are times or were Unicode."""
    group = parent.create_group(name)
    columns = dict(columns)
    for key, values in columns.items():
        group[key] = np.asarray(values).astype("S") if np.asarray(values).dtype.kind == "U" else values
    group.attrs.update({"object": kind, **attributes})
    if kind == "Data":
        group.attrs["absolute_start"] = 0.0
    elif kind != "RegularTimeSeries":
        texts = [key for key, values in columns.items() if np.asarray(values).dtype.kind == "U"]
        group.attrs["_unicode_keys"] = np.array(texts, dtype="S")
    if times:
        group.attrs["timekeys"] = np.array(times, dtype="S")
    return group


def interval(parent, name, start, end, **columns):
    return put(parent, name, "Interval", {"start": start, "end": end, **columns}, ["start", "end"])


def series(parent, name, times, columns, end):
    """Write samples at their times, or at a rate, with the time over which they are known."""
    kind = "RegularTimeSeries" if isinstance(times, float) else "IrregularTimeSeries"
    if kind == "RegularTimeSeries":
        group = put(parent, name, kind, columns, sampling_rate=times)
    else:
        group = put(parent, name, kind, {"timestamps": times, **columns}, ["timestamps"])
        group["timestamp_indices_1s"] = np.searchsorted(times, np.arange(0.0, end + 1))
    interval(group, "domain", np.array([0.0]), np.array([end]))
    return group


def write_lab_file(path: Path, *, spikes=True, traces=None, subject="m1") -> Path:
    """Twelve trials of half a second, four units or seven imaged cells, a running wheel and licks.

    ``traces`` is a rate (1/s), or "irregular" for frames with times of their own.
    """
    random = np.random.default_rng(0)
    start = 2 + np.cumsum(random.uniform(1.2, 1.6, 12))
    end = start[-1] + 3
    with h5py.File(path, "w") as file:
        file.attrs.update({"object": "Data", "absolute_start": 0.0})
        for name in ("brainset", "subject", "session"):
            put(file, name, "Data", id=subject if name == "subject" else f"{name}-1", species="mouse")
        file["session"].attrs["recording_date"] = "2026-03-02 10:00:00"
        interval(file, "domain", np.array([0.0]), np.array([end]))
        interval(file, "trials", start, start + 0.5, stimulus=NAMES[np.arange(12) % 3])
        interval(file, "train_domain", np.array([0.0]), np.array([10.0]))
        file["images"] = np.zeros((3, 4, 4))
        wheel = np.arange(0, end, 0.1)
        series(file, "running", wheel, {"speed": wheel * 0, "position": np.zeros((len(wheel), 2))}, end)
        series(file, "licks", np.sort(random.uniform(0, end, 9)), {}, end)
        if spikes:
            times, index = np.sort(random.uniform(0, end, 480)), random.integers(0, 4, 480)
            series(file, "spikes", times, {"unit_index": index, "waveforms": np.zeros((480, 3))}, end)
            put(file, "units", "ArrayDict", {"id": np.array(list("abcd")), "brain_region": np.array(["S1"] * 4)})
        if traces:
            frames = np.arange(0, end, 1 / 30)
            values = {"df_over_f": random.normal(size=(len(frames), 7)).astype(np.float32)}
            series(file, "calcium_traces", frames if traces == "irregular" else traces, values, end)
            put(file, "rois", "ArrayDict", {"id": np.arange(7), "area": np.array(["S1"] * 7)})
    return path


def counted(path, **options):
    return open_recordings(path, conditions="trials:stimulus", **options)


def same(left, right):
    xr.testing.assert_identical(left.drop_attrs(), right.drop_attrs())
    assert left.attrs["content_hash"] == right.attrs["content_hash"]


def test_spikes_of_each_unit_are_counted_in_the_windows_of_intervals(tmp_path):
    path = write_lab_file(tmp_path / "a.h5")
    recordings = counted(path)
    with h5py.File(path) as file:
        times, index, start = (file[name][...] for name in ("spikes/timestamps", "spikes/unit_index", "trials/start"))
    expected = [
        [((times[index == unit] >= t) & (times[index == unit] < t + 0.5)).sum() for unit in range(4)] for t in start
    ]
    np.testing.assert_array_equal(recordings["counts"].values[:, 0], expected)
    assert recordings["unit_id"].values.tolist() == list("abcd")
    assert set(recordings["area"].values.tolist()) == {"S1"}
    assert (recordings["subject"].values[0], recordings["session"].values[0]) == ("m1", "session-1")
    assert "licks" in recordings.coords
    assert recordings.attrs["ledger"]["spikes"]["found"] == 480


@pytest.mark.parametrize("traces", [30.0, "irregular"])
def test_columns_that_a_table_describes_are_cells_and_behaviour_is_none(tmp_path, traces):
    path = write_lab_file(tmp_path / "a.h5", spikes=False, traces=traces)
    recordings = counted(path, window="start..+0.5 minus start-0.3..start")
    assert recordings.sizes["unit"] == 7
    assert set(recordings["area"].values.tolist()) == {"S1"}
    assert recordings.attrs["measure"].startswith("calcium_traces/df_over_f")
    (session,) = inspect(path).sessions
    assert {item.name for item in session.acquired} >= {"running/position", "running/speed"}


def observed():
    """Units of which one was lost for a while, trials in no order, contacts, texts and missing times."""
    session = make_simple_session(
        columns={"choice_time": np.where(np.arange(12) % 4, 1.5 + 2 * np.arange(12.0), np.nan)},
        tables={"contacts_by_whisker_C1": {"start_time": np.arange(1.1, 20), "stop_time": np.arange(1.2, 20)}},
        unit_columns={"depth": [100.0, 400.0, 500.0], "area": ["S1", "M1", "M1"]},
        observed=[np.array([[0.0, 30.0]]), np.array([[0.0, 9.0], [15.0, 30.0]]), np.array([[0.0, 30.0]])],
        start="2026-01-01T12:00:00+00:00",
        stimuli="objects",
        synthetic=True,
    )
    trials = session.tables["trials"]
    for name in trials.data:
        trials.data[name] = trials.data[name][::-1]
    return session


def responses():
    table = {"start_time": np.arange(30.0), "stop_time": np.arange(30.0) + 0.5, "stimulus": list("abc") * 10}
    values = np.random.default_rng(0).normal(size=(30, 5, 4))
    more = {"time": np.arange(5) * 0.1, "unit": "dF/F", "unit_columns": {"area": ["S1", "S1", "M1", "M1"]}}
    return make_session("m1", "1", None, {"trials": table}, response=values, **more)


@pytest.mark.parametrize("session", [make_simple_session, observed, responses])
@pytest.mark.parametrize("select", [None, "stimulus=a|b"])
def test_a_copy_of_any_session_is_counted_to_the_same_numbers(tmp_path, session, select):
    path = write_recordings(tmp_path / "a.h5", session())
    (copy,) = export(path, tmp_path / "b.h5", format="temporaldata", select=select)
    same(counted(path, select=select), counted(copy))
    (again,) = export(copy, tmp_path / "c.h5", format="temporaldata")
    same(counted(copy), counted(again))


def test_signals_are_copied_where_there_are_no_spikes(tmp_path):
    for traces in (30.0, "irregular"):
        path = write_lab_file(tmp_path / f"{traces}.h5", spikes=False, traces=traces)
        (copy,) = export(path, tmp_path / f"{traces} copy.h5", format="temporaldata")
        same(counted(path), counted(copy))
    with pytest.raises(DataError, match="temporaldata holds signals too"):
        export(path, tmp_path / "folder")


def test_whatever_holds_times_states_over_which_they_are_known(tmp_path):
    """``temporaldata`` refuses a group with intervals or series and without a domain."""
    session = make_simple_session(tables={"behavior/pokes": {"start_time": [1.0, 3.0], "stop_time": [2.0, 4.0]}})
    with h5py.File(write_temporaldata(tmp_path / "a.h5", session)) as file:
        for place in (file, file["behavior"]):
            assert place.attrs["object"] == "Data"
            assert file["behavior/domain/end"][0] == place["domain/end"][0] == 26.0
        assert [text.decode() for text in file["trials"].attrs["_unicode_keys"]] == ["stimulus"]
        assert {*file["trials"].attrs["timekeys"]} == {b"start", b"end"}
        assert np.all(np.diff(file["spikes/timestamps"]) >= 0)
        grid = np.searchsorted(file["spikes/timestamps"], np.arange(0.0, 27.0))
        np.testing.assert_array_equal(file["spikes/timestamp_indices_1s"], grid)


def index(values):
    def edit(file):
        del file["spikes/unit_index"]
        file["spikes/unit_index"] = values

    return edit


def without(place):
    def edit(file):
        del file[place]

    return edit


def linked(file):
    del file["trials"]
    file["trials"] = h5py.SoftLink("/elsewhere")


BROKEN = {
    "units that are not there": (index(np.full(480, 4)), "480 of 480 spikes .* none of the 4 units"),
    "an index of numbers": (index(np.zeros(480)), "unit_index"),
    "a short index": (index(np.zeros(3, int)), "480 timestamps and 3 unit_index"),
    "no timestamps": (without("spikes/timestamps"), "lacks a part: .*timestamps"),
    "a dead link": (linked, "trials of .* is a link to '/elsewhere', which is not there"),
    "no start": (without("trials/start"), "no start_time"),
    "no spikes": (without("spikes"), "no units table with spike_times"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_file_is_one_sentence(tmp_path, name):
    edit, expected = BROKEN[name]
    with h5py.File(write_lab_file(tmp_path / "a.h5"), "a") as file:
        edit(file)
    with pytest.raises(DataError, match=expected):
        counted(tmp_path / "a.h5")
    assert check(tmp_path / "a.h5").verdict == "error"


def test_a_class_that_nobody_knows_is_left_out_by_name(tmp_path):
    with h5py.File(write_lab_file(tmp_path / "a.h5"), "a") as file:
        put(file, "video", "MovieSeries")
    (entry,) = (entry for entry in counted(tmp_path / "a.h5").attrs["ledger"]["tables"]["left_out"] if entry["lost"])
    assert "'MovieSeries'" in entry["reason"]
    with pytest.raises(DataError, match="MovieSeries"):
        counted(tmp_path / "a.h5", strict=True)


def test_what_temporaldata_cannot_hold_is_refused(tmp_path):
    with pytest.raises(DataError, match=r"'é' of 'stimulus' is no ASCII text"):
        write_temporaldata(tmp_path / "a.h5", make_simple_session(columns={"stimulus": ["é", "b", "c"] * 4}))
    session = make_simple_session()
    del session.tables["trials"].data["stop_time"]
    with pytest.raises(DataError, match="rows without start_time or stop_time"):
        write_temporaldata(tmp_path / "a.h5", session)
    assert [*tmp_path.iterdir()] == []


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("stimuli", "stimuli"),
        ("synthetic", "synthetic"),
        ("a/b", "a/b"),
        ("session", "intervals/session_table"),
        ("units/x", "intervals/units/x_table"),
        ("domain", "intervals/domain_table"),
        ("trials/inner", "intervals/trials/inner_table"),
        ("obs_intervals", "intervals/obs_intervals_table"),
    ],
)
def test_a_table_of_any_name_is_in_the_copy(tmp_path, caplog, name, place):
    session = make_simple_session(stimuli="objects", synthetic=True)
    path = write_temporaldata(
        tmp_path / "a.h5",
        replace(session, tables=session.tables | {name: replace(session.tables["trials"], name=name)}),
    )
    copy = open_recordings(path, conditions=f"{place}:stimulus")
    same(copy, counted(path))
    assert (copy.attrs["stimuli"], bool(copy.attrs["synthetic"])) == ("objects", True)
    assert (f"is called {place!r} in the copy" in caplog.text) == (name != place)


def test_formats_mix_in_a_folder_and_the_same_spikes_twice_are_refused(tmp_path):
    for number, format in enumerate(("nwb", "brainbench", "temporaldata")):
        path = write_recordings(tmp_path / f"{number}.h5", make_simple_session(subject=f"m{number}"))
        export(path, tmp_path / "mixed" / f"{number}{'.nwb' if format == 'nwb' else '.h5'}", format=format)
    mixed = counted(tmp_path / "mixed", strict=True)
    assert sorted({*mixed["subject"].values.tolist()}) == ["m0", "m1", "m2"]
    export(path, tmp_path / "mixed" / "again.nwb")
    with pytest.raises(DataError, match="hold the same spikes"):
        counted(tmp_path / "mixed")
    write_rdms(tmp_path / "rdms.h5", StoredRDMs(np.ones((1, 3)), ("a", "b", "c"), ("m0",)))
    (tmp_path / "rdms.h5").rename(tmp_path / "mixed" / "rdms.h5")
    (tmp_path / "mixed" / "again.nwb").unlink()
    with pytest.raises(DataError, match="RDMs without trials"):
        counted([path for path in (tmp_path / "mixed").iterdir() if path.suffix == ".h5"], strict=True)
    (reason,) = counted(tmp_path / "mixed").attrs["skipped"]
    assert "RDMs without trials" in reason
