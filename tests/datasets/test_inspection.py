import json

import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import to_json
from brainbench.datasets import inspect, open_recordings, write_recordings
from tests.factories.recordings import detection, make_simple_session, write_nwb, write_rodgers


def test_proposals_put_stimulus_like_columns_first_and_times_nowhere(tmp_path):
    columns = {
        "response": np.resize(np.array(["l", "m", "r"]), 12),
        "block": np.resize(np.array([1, 2, 3]), 12),
        "side": np.resize(np.array(["l", "r"]), 12),  # two labels have one distance: nothing to compare
        "texture": np.resize(np.array(["x", "y", "z", "w"]), 12),  # three trials are too few for the default metric
        "cue_time": np.resize(np.array([0.5, 0.7]), 12),
        "unique": np.arange(12),
        "constant": np.ones(12),
    }
    path = write_recordings(tmp_path / "a.h5", make_simple_session(columns=columns))
    report = inspect(path)
    assert [item.conditions for item in report.proposals] == [
        "trials:stimulus",
        "trials:block",
        "trials:response",
        "trials:texture",
    ]
    assert [line[0] for line in str(report).splitlines() if "--conditions" in line] == ["→", " ", " ", " "]
    assert report.proposals[0].labels == ("a", "b", "c")
    assert report.proposals[0].fewest == 4
    assert open_recordings(path, conditions=report.proposals[0].conditions).sizes["trial"] == 12


def test_an_inspection_is_text_and_json(tmp_path):
    report = inspect(write_nwb(tmp_path / "a.nwb"))
    text = str(report)
    for expected in (
        "NWB 2.7.0",
        "subject m1",
        "1 (120 spikes",
        "texture (text) 2 values: P20, P100",
        "processing/behavior",
    ):
        assert expected in text
    data = json.loads(to_json(report))
    assert data["sessions"][0]["units"]["spikes"] == 120
    assert data["proposals"] == []


def test_signals_are_listed_and_a_broken_link_hides_nothing(tmp_path):
    path = write_nwb(tmp_path / "a.nwb")
    with h5py.File(path, "a") as file:
        file["acquisition/behavior/touch/data"] = np.zeros((1000, 2))
        file["acquisition/behavior/touch"].attrs["neurodata_type"] = "TimeSeries"
        file["acquisition/voltage"] = h5py.ExternalLink("not-here.h5", "/voltage")
    report = inspect(path)
    assert "acquisition/behavior/touch (TimeSeries): 1000 × 2 samples, 0.016 MB" in str(report)
    assert report.sessions[0].units.spikes == 120


def test_problems_are_reported_not_raised(tmp_path):
    path = write_recordings(tmp_path / "a.h5", make_simple_session())
    with h5py.File(path, "a") as file:
        file["sessions/mouse-1/units/spike_times"][3] = np.inf
        del file["sessions/mouse-1/tables/trials/stimulus"]
    missing = " ".join(inspect(path).sessions[0].missing)
    assert "1 spike times" in missing
    assert "3 to 60 values" in missing


def test_proposals_count_only_the_trials_that_the_layout_selects(tmp_path):
    report = inspect(write_rodgers(tmp_path / "a.h5", **detection()))
    # 'nothing' is no stimulus of this layout, so two labels of three remain in the column 'stimulus'.
    assert report.proposals[0].conditions == "trials:stimulus,servo_position"
    assert "trials:stimulus" not in [item.conditions for item in report.proposals]
    recordings = open_recordings(tmp_path / "a.h5")
    assert report.proposals[0].fewest == min(np.unique(recordings["stimulus"], return_counts=True)[1])


def test_a_layout_can_be_named_before_the_path(tmp_path):
    path = write_rodgers(tmp_path / "a.h5", **detection())
    assert inspect(f"rodgers-detection:{path}").layout == "rodgers-detection"
    with pytest.raises(UsageError, match="ask for recordings='demo'"):
        inspect("rodgers-detection:demo")


def test_a_folder_is_inspected_as_a_whole(tmp_path):
    for name in ("m1", "m2"):
        write_recordings(tmp_path / f"{name}.h5", make_simple_session(subject=name))
    report = inspect(tmp_path)
    assert [session.subject for session in report.sessions] == ["m1", "m2"]
    assert len(report.proposals) == 1


def test_a_file_that_holds_no_recordings_is_skipped_and_named(tmp_path):
    for name in ("m1", "m2"):
        write_recordings(tmp_path / f"{name}.h5", make_simple_session(subject=name))
    with h5py.File(tmp_path / "features.h5", "w") as file:
        file["layer"] = np.zeros(3)
    (tmp_path / "torn.h5").write_bytes(b"")
    report = inspect(tmp_path)
    assert [session.subject for session in report.sessions] == ["m1", "m2"]
    opened = open_recordings(tmp_path, conditions="trials:stimulus")
    for skipped in (report.skipped, opened.attrs["skipped"]):
        assert [next(name for name in ("features", "torn") if name in text) for text in skipped] == ["features", "torn"]
    for read in (inspect, lambda path, **how: open_recordings(path, conditions="trials:stimulus", **how)):
        with pytest.raises(DataError, match="features"):
            read(tmp_path, strict=True)
        with pytest.raises(DataError, match="features"):
            read(tmp_path / "features.h5")


def test_counted_recordings_are_described_by_their_labels(tmp_path):
    write_recordings(tmp_path / "a.h5", make_simple_session())
    path = write_recordings(tmp_path / "b.h5", open_recordings(tmp_path / "a.h5", conditions="trials:stimulus"))
    report = inspect(path)
    assert "counted responses" in report.format
    assert report.proposals[0].labels == ("a", "b", "c")


@pytest.mark.shared
def test_the_human_file_proposes_its_stimulus_categories(reference):
    report = inspect(reference / "nwb" / "pynapple_sub-4_ses-4_ecephys+image.nwb")
    session = report.sessions[0]
    assert (session.units.units, session.units.spikes) == (35, 214_278)
    assert [(table.name, table.rows) for table in session.tables] == [
        ("encoding_table", 90),
        ("recognition_table", 180),
        ("timediscrimination_table", 180),
    ]
    assert report.proposals[0].conditions == "encoding_table:stimCategory"
    assert report.proposals[0].labels == ("0", "1", "2")
