import json
import math

import numpy as np
import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError
from brainbench.stimuli import read_stimulus_set, to_grid, write_stimulus_set
from brainbench.stimuli.external import FRAME_STATUSES
from brainbench.stimuli.whiskit import save_run
from brainbench.stimuli.whiskit_runs import find_runs, published_cleaning, read_run, read_runs
from tests.factories.published_sweeps import write_run

NAMES = ("RC1", "RC2")


def _dynamics(rows=110, seed=0, whiskers=2):
    return np.round(np.random.default_rng(seed).normal(size=(rows, whiskers, 6)), 4)


@pytest.mark.shared
def test_the_cleaned_reference_run_is_the_published_sweep_to_the_bit(reference):
    (folder,) = find_runs(reference / "published" / "whiskit_run")
    data = np.load(reference / "published" / "sweep_example_110hz.npz")["data"]
    expected = np.delete(data, [5, 6, 12, 13, 34], axis=1)
    np.testing.assert_array_equal(published_cleaning(read_run(folder).dynamics), expected)
    found = read_runs([folder], cleaning="published")
    np.testing.assert_allclose(found["wrench"].values[0], expected * np.repeat([1e-3, 1e-6], 3), rtol=1e-7)
    # The input of a network, by the layout of the reference: channel 6 · sub-step + component.
    grid = (data * np.repeat([1e-3, 1e-6], 3)).reshape(22, 5, 5, 7, 6).transpose(0, 1, 4, 2, 3)
    np.testing.assert_allclose(to_grid(found)[0], grid.reshape(22, 30, 5, 7), rtol=1e-6)


@pytest.mark.shared
def test_faults_of_the_reference_run_stand_where_its_manifest_says(reference):
    found = read_runs(find_runs(reference / "published" / "whiskit_run"))
    status = found["frame_status"].values[0]
    expected = np.zeros((110, 30), dtype=int)
    expected[0] = FRAME_STATUSES.index("unwritten")
    expected[40:43, 7] = expected[:2, 20] = FRAME_STATUSES.index("missing")
    expected[60, 12] = expected[0, 3] = expected[70, 25] = FRAME_STATUSES.index("too large")
    np.testing.assert_array_equal(status, expected)
    assert json.loads(found.attrs["faults"]) == {"h-3-to12-t90-v30-s40": {"missing": 30, "too large": 13}}
    assert np.isnan(found["wrench"].values).sum() == 43
    bad = [str(name) for name in found["whisker"].values[found["status"].values[0] != "ok"]]
    assert bad == ["A3", "B2", "C2", "D3", "E1"]
    with pytest.raises(DataError, match="A3 in h-3-to12-t90-v30-s40"):
        to_grid(found)


def test_a_run_is_read_in_newtons_and_seconds(tmp_path):
    raw = _dynamics()
    raw[0] = 0.0
    found = read_runs([write_run(tmp_path / "a", raw, ("RE0", "LC2"))])
    np.testing.assert_allclose(found["wrench"].values[0], raw * np.repeat([1e-3, 1e-6], 3), rtol=1e-7)
    np.testing.assert_allclose(found["time"].values, np.arange(110) / 110)
    assert [str(found[name].values[0]) for name in ("whisker", "row", "col", "side")] == ["E0", "4", "0", "right"]
    assert [str(found[name].values[1]) for name in ("whisker", "row", "col", "side")] == ["C2", "2", "2", "left"]
    assert (found["status"].values == "ok").all()
    assert "contact" not in found


def test_bad_values_are_missing_and_their_frames_marked(tmp_path):
    raw = _dynamics()
    raw[4, 0, 2], raw[5, 1, 0], raw[6, 1, 3], raw[0, 0, 0] = -math.nan, math.inf, -1000.5, 0.5
    found = read_runs([write_run(tmp_path / "a", raw)])
    missing = np.argwhere(np.isnan(found["wrench"].values[0])).tolist()
    assert missing == [[4, 0, 2], [5, 1, 0], [6, 1, 3]]
    marked = [[FRAME_STATUSES[code] for code in row] for row in found["frame_status"].values[0, [0, 4, 5, 6, 7]]]
    assert marked == [["unwritten"] * 2, ["missing", "ok"], ["ok", "too large"], ["ok", "too large"], ["ok", "ok"]]
    assert json.loads(found.attrs["faults"])["a"] == {"missing": 1, "too large": 2, "unwritten": 12}
    assert "missing: 1" in str(found["reason"].values[0, 0])


def test_the_published_cleaning_keeps_every_ninth_of_1000_rows_and_fills_from_the_last_good_one():
    raw = _dynamics(1000)
    raw[1, 0, 0], raw[10, 0, 0], raw[19, 0, 1], raw[28, 0, 1], raw[37, 0, 1], raw[46, 1, 5] = (
        2e3, math.inf, math.nan, 1e4, -1e4, math.nan,
    )  # fmt: skip
    expected = raw[1:983:9].copy()
    expected[[0, 1], 0, 0] = 0.0  # nothing good before
    expected[[2, 3, 4], 0, 1] = 0.0  # a missing value becomes 0, which is then the last good one
    expected[5, 1, 5] = 0.0
    np.testing.assert_array_equal(published_cleaning(raw), expected)
    with pytest.raises(UsageError, match="900"):
        published_cleaning(raw[:900])


def test_runs_of_1000_rows_are_milliseconds_and_cleaned_ones_9_ms_apart(tmp_path):
    folder = write_run(tmp_path / "a", _dynamics(1000))
    np.testing.assert_allclose(read_runs([folder])["time"].values, np.arange(1000) / 1000)
    cleaned = read_runs([folder], cleaning="published")
    np.testing.assert_allclose(cleaned["time"].values, 0.001 + 0.009 * np.arange(110))
    np.testing.assert_allclose(cleaned["wrench"].values[0, 3, 1, 4], _dynamics(1000)[28, 1, 4] * 1e-6)
    assert not cleaned["frame_status"].values.any()


def test_many_runs_make_one_set_and_a_set_becomes_runs_again(tmp_path):
    for index in range(3):
        write_run(tmp_path / "runs" / f"run-{index}", _dynamics(seed=index))
    (tmp_path / "runs" / "notes").mkdir()
    found = read_runs(find_runs(tmp_path / "runs"))
    assert [str(label) for label in found["stimulus"].values] == ["run-0", "run-1", "run-2"]
    again = read_stimulus_set(write_stimulus_set(found, tmp_path / "set.h5"))
    back = save_run(again, tmp_path / "back" / "run-1", stimulus="run-1", dialect="thesis")
    np.testing.assert_allclose(read_run(back).dynamics, _dynamics(seed=1), rtol=2e-7)
    assert read_run(back).names == NAMES


def test_runs_of_several_objects_are_called_by_their_paths(tmp_path):
    for name in ("mug/1/h0", "mug/2/h0"):
        write_run(tmp_path / name, _dynamics())
    labels = read_runs(find_runs(tmp_path))["stimulus"].values
    assert [str(label) for label in labels] == ["1/h0", "2/h0"]


def test_contacts_of_the_kinematics_are_kept(tmp_path):
    folder = write_run(tmp_path / "a", _dynamics())
    (folder / "kinematics" / "c").mkdir(parents=True)
    flags = np.zeros((110, 5), dtype=int)
    flags[30:40, 2] = 1
    for name in NAMES:
        np.savetxt(folder / "kinematics" / "c" / f"{name}.csv", flags, delimiter=",", fmt="%d")
    touched = read_runs([folder])["contact"].values[0]
    np.testing.assert_array_equal(touched, np.repeat(flags.any(axis=1)[:, None], 2, axis=1))
    np.savetxt(folder / "kinematics" / "c" / "RC2.csv", flags[:50], delimiter=",", fmt="%d")
    with pytest.raises(DataError, match=r"RC2\.csv"):
        read_runs([folder])


def _shorten(folder):
    path = folder / "dynamics" / "Fz.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:50]))


def _narrow(folder):
    np.savetxt(folder / "dynamics" / "My.csv", _dynamics()[:, :1, 0], delimiter=",")


@pytest.mark.parametrize(
    ("spoil", "culprit"),
    [
        (_shorten, r"Fz\.csv.* has 50 rows; it needs 110"),
        (_narrow, r"My\.csv.* has 1 columns; it needs 2"),
        (lambda folder: (folder / "dynamics" / "Mx.csv").unlink(), r"Mx\.csv"),
        (lambda folder: (folder / "dynamics" / "Mx.csv").write_text("1,x\n"), r"Mx\.csv"),
        (lambda folder: (folder / "whisker_ID.csv").unlink(), r"whisker_ID\.csv"),
        (lambda folder: (folder / "whisker_ID.csv").write_bytes(b"\xff\xfe"), r"whisker_ID\.csv"),
        (lambda folder: (folder / "whisker_ID.csv").write_text("RC1\nRF2\n"), "'RF2'.* did you mean 'R.2'"),
        (lambda folder: (folder / "whisker_ID.csv").write_text("RC1\nRC1\n"), "once"),
    ],
)
def test_a_run_that_does_not_fit_together_names_its_file(tmp_path, spoil, culprit):
    spoil(folder := write_run(tmp_path / "run", _dynamics()))
    with pytest.raises(DataError, match=culprit):
        read_run(folder)


def test_runs_that_do_not_fit_one_another_are_refused(tmp_path):
    first = write_run(tmp_path / "a", _dynamics())
    with pytest.raises(DataError, match=r"'a' and 'b' .*110 and 100 rows"):
        read_runs([first, write_run(tmp_path / "b", _dynamics(100))])
    with pytest.raises(DataError, match="whisker_ID"):
        read_runs(find_runs(tmp_path / "b" / "dynamics"))
    with pytest.raises(UsageError, match="100 rows"):
        read_runs([tmp_path / "b"])
    assert read_runs([tmp_path / "b"], rate=200.0)["time"].values[-1] == pytest.approx(99 / 200)
    with pytest.raises(UsageError, match="-1"):
        read_runs([first], rate=-1.0)
    with pytest.raises(UsageError, match="did you mean 'published'"):
        read_runs([first], cleaning="publish")
    (tmp_path / "c" / "dynamics").mkdir(parents=True)
    (tmp_path / "c" / "whisker_ID.csv").write_text("RC1\n")
    with pytest.raises(DataFileNotFoundError, match=r"Fx\.csv"):
        read_runs(find_runs(tmp_path / "c"))
