"""Scores over time through files, as a user would run them."""

import shutil

import h5py
import numpy as np
import pytest

import brainbench
from brainbench.cli import main
from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.models.features import write_features
from brainbench.scoring.scores import score_record
from leaderboards.site.score_page import write_report
from tests.factories.moving_geometry import BIN, DIMENSIONS, lagged, make_path

LABELS = tuple("abcdefghij")
BINS, LAG = 10, 1


@pytest.fixture(scope="module")
def moving(tmp_path_factory):
    """Four animals that follow one layer by one bin, in files of spike times; and the layers in a file."""
    folder = tmp_path_factory.mktemp("moving")
    rng = np.random.default_rng(0)
    path = make_path(rng, len(LABELS), BINS)
    for animal in range(4):
        own = np.random.default_rng([1, animal])
        rates = 20 * np.exp(0.5 * lagged(path, LAG) @ own.normal(size=(DIMENSIONS, 40))).swapaxes(0, 1)
        order = own.permutation(np.repeat(np.arange(len(LABELS)), 12))
        starts = 1.0 + np.arange(len(order))
        counts = own.poisson(rates[order] * BIN)
        spikes = []
        for unit in range(counts.shape[2]):
            trial, bin = np.nonzero(counts[:, :, unit])
            times = np.repeat(starts[trial] + bin * BIN, counts[trial, bin, unit])
            spikes.append(np.sort(times + BIN * own.random(len(times))))
        table = {"start_time": starts, "stop_time": starts + BINS * BIN, "stimulus": [LABELS[k] for k in order]}
        span = np.array([[0.0, starts[-1] + 2]])
        session = make_session(f"m{animal}", "s", spikes, {"trials": table}, observed=[span] * len(spikes))
        write_recordings(folder / f"m{animal}.h5", session)
    layers = {
        "unrelated": make_path(rng, len(LABELS), BINS).swapaxes(0, 1),
        "followed": (path @ rng.normal(size=(DIMENSIONS, 50))).swapaxes(0, 1),
    }
    write_features(folder / "layers.hdf5", LABELS, layers)
    return folder


def _score(folder, **changes):
    files, layers = str(folder / "m*.h5"), folder / "layers.hdf5"
    return score_record(str(layers), recordings=files, conditions="trials:stimulus", over_time=True, **changes)


def _latency(folder, **changes):
    course = _score(folder, baselines=False, **changes).score.provenance.statistics["time_course"]
    return next(item["latency"] for item in course["latencies"] if item["layer"] == "followed")


def test_a_score_over_time_is_in_the_record_and_in_its_report(moving, tmp_path):
    record = _score(moving, baselines=False)
    course = record.score.provenance.statistics["time_course"]
    assert course["layer"] == "followed"
    assert len(course["points"]) == BINS
    assert course["bin"] == pytest.approx(BIN)
    found = {item["layer"]: item for item in course["latencies"]}
    assert found["followed"]["latency"] == pytest.approx(LAG * BIN, abs=0.35 * BIN)
    assert found["unrelated"]["latency"] is None
    page = write_report(record, tmp_path / "report.html").read_text(encoding="utf-8")
    assert 'id="time"' in page
    assert "followed: " in page
    again = brainbench.ResultRecord.from_json(record.to_json())
    assert again.score.provenance.statistics["time_course"] == course


def test_one_longer_trial_does_not_stretch_features_without_a_duration(moving, tmp_path):
    shutil.copytree(moving, tmp_path, dirs_exist_ok=True)
    with h5py.File(tmp_path / "m0.h5", "r+") as file:
        file["sessions/m0-s/tables/trials/stop_time"][5] += 0.8 * BINS * BIN
    assert _latency(tmp_path) == pytest.approx(_latency(moving), abs=0.01 * BIN)


@pytest.mark.parametrize("bins", [0.7, 1.5])
def test_a_last_bin_that_the_window_cuts_does_not_stretch_them_either(moving, bins):
    assert _latency(moving, bin=bins * BIN) == pytest.approx(LAG * BIN, abs=0.2 * BIN)


def test_the_command_prints_latencies(moving, tmp_path, monkeypatch, capsys):
    arguments = ["score", str(moving / "layers.hdf5"), "-r", str(moving / "m*.h5"), "--conditions", "trials:stimulus"]
    monkeypatch.setattr("sys.argv", ["brainbench", *arguments, "--over-time", "--bin", "0.1", "--out", str(tmp_path)])
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code in (0, None)
    text = capsys.readouterr().out
    assert "5 bins of 0.1 s" in text
    assert "followed" in text


def test_without_the_option_a_score_has_no_time(moving):
    record = score_record(
        str(moving / "layers.hdf5"), recordings=str(moving / "m*.h5"), conditions="trials:stimulus", baselines=False
    )
    assert "time_course" not in record.score.provenance.statistics


@pytest.mark.parametrize("part", [slice(3, None), slice(None, None, 2)], ids=["late", "every second"])
def test_bins_that_do_not_follow_from_the_begin_of_the_window_are_refused(moving, part):
    whole = open_recordings(str(moving / "m*.h5"), conditions="trials:stimulus", bin=BIN)
    with pytest.raises(UsageError, match="begin of the window"):
        score_record(str(moving / "layers.hdf5"), recordings=whole.isel(time=part), over_time=True, baselines=False)


def test_metrics_without_rdms_and_recordings_without_time_are_refused(moving):
    with pytest.raises(UsageError, match="'ridge'"):
        _score(moving, metric="ridge")
    with pytest.raises(DataError, match="--bin"):
        _score(moving, bin=0.5)
    with pytest.raises(UsageError, match="bin of 1 s is longer"):
        _score(moving, bin=1.0)


def test_unreliable_units_are_left_out_at_each_time_too(moving):
    courses = [
        _score(moving, baselines=False, units_reliability=least).score.provenance.statistics["time_course"]
        for least in (-0.99, 0.8, 0.9999)
    ]
    every, some, none = ([point["reliability"] for point in course["points"]] for course in courses)
    assert all(np.isfinite([*every, *some]))
    assert every != some
    assert set(none) == {None}
    assert any("reliability of their tuning below" in reason for reason in courses[2]["reasons"])
