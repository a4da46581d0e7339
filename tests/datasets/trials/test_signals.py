import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.datasets import open_recordings, write_recordings
from brainbench.datasets.trials.signals import fading
from tests.factories.recording_files import write_nwb

SERIES = "processing/ophys/DfOverF/dff"


def imaged(path, data, *, rate=10.0, stamps=None, place=SERIES):
    """Six trials of half a second every second, and a signal of cells in place of units."""
    if not path.exists():
        write_nwb(path, units=False)
    with h5py.File(path, "a") as file:
        group = file.create_group(place)
        group.attrs["neurodata_type"] = "RoiResponseSeries"
        group["data"] = data
        if stamps is not None:
            group["timestamps"] = stamps
        elif rate:
            group["starting_time"] = 0.0
            group["starting_time"].attrs["rate"] = rate
    return path


def means(path, **options):
    opened = open_recordings(path, conditions="trials:texture", **options)
    return opened, (opened["counts"] / opened["duration"]).values


def test_responses_are_means_over_the_window_and_may_be_negative(tmp_path):
    data = np.random.default_rng(0).normal(size=(70, 3))
    opened, values = means(imaged(tmp_path / "a.nwb", data))
    expected = [data[10 * trial : 10 * trial + 5].mean(axis=0) for trial in range(6)]
    np.testing.assert_allclose(values[:, 0], expected, rtol=1e-5)
    assert values.min() < 0
    assert any(f"means over the window of {SERIES}" in doubt for doubt in opened.attrs["doubts"])
    again = open_recordings(write_recordings(tmp_path / "b.h5", opened))
    np.testing.assert_array_equal(again["counts"], opened["counts"])


def test_bins_timestamps_and_chosen_cells(tmp_path):
    data = np.random.default_rng(0).normal(size=(70, 3))
    path = imaged(tmp_path / "a.nwb", data, stamps=0.001 + np.arange(70) / 10)
    _, values = means(path, window="start..+0.4", bin=0.2, select="units.id=1")
    assert values.shape == (6, 2, 1)
    np.testing.assert_allclose(values[2, :, 0], [data[20:22, 1].mean(), data[22:24, 1].mean()], rtol=1e-5)


def test_frames_that_are_nan_are_left_out(tmp_path):
    data = np.random.default_rng(0).normal(size=(70, 3))
    data[11:14, 0], data[:, 2], data[20:25, 1] = np.nan, np.nan, np.nan
    opened, values = means(imaged(tmp_path / "a.nwb", data))
    np.testing.assert_allclose(values[1, 0, 0], data[[10, 14], 0].mean(), rtol=1e-5)
    assert np.isnan(values[2, 0, 1])
    assert opened.attrs["ledger"]["units"]["read"] == 2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate": None}, "neither timestamps nor a rate"),
        ({"rate": 1.0}, r"a frame every 1 s, and windows or bins are as short as 0\.5 s"),
        ({"stamps": np.zeros(70)}, "not finite and increasing"),
        ({"stamps": np.arange(5.0)}, "5 timestamps for 70 frames"),
    ],
)
def test_frames_without_a_time_base_are_refused(tmp_path, options, words):
    with pytest.raises(DataError, match=words):
        means(imaged(tmp_path / "a.nwb", np.ones((70, 3)), **options))


def test_of_several_signals_the_only_dff_is_read_and_others_are_asked_for(tmp_path):
    path = imaged(tmp_path / "a.nwb", np.random.default_rng(0).normal(size=(70, 3)))
    imaged(path, np.ones((70, 3)), place="processing/ophys/Fluorescence/raw")
    assert means(path)[0].attrs["measure"].startswith(SERIES)
    imaged(path, np.ones((70, 3)), place="processing/ophys/DfOverF/second")
    with pytest.raises(DataError, match="several signals"):
        means(path)


def segmented(path, iscell):
    with h5py.File(path, "a") as file:
        plane = file.create_group("processing/ophys/ImageSegmentation/plane")
        plane["id"], plane["iscell"] = np.arange(len(iscell)), iscell
        file["general/optophysiology/plane/location"] = "S1 barrel field"
        plane["imaging_plane"] = h5py.SoftLink("/general/optophysiology/plane")
        rois = file[SERIES].create_dataset("rois", data=np.array([2, 1, 0]))
        rois.attrs["table"] = plane.ref
    return path


def test_what_is_no_cell_is_left_out_and_cells_have_the_area_of_their_plane(tmp_path):
    data = np.random.default_rng(0).normal(size=(70, 3))
    path = segmented(imaged(tmp_path / "a.nwb", data), [[1.0, 0.9], [1.0, 0.8], [0.0, 0.1]])
    opened, values = means(path)
    assert opened["unit_id"].values.tolist() == ["1", "2"]
    assert set(opened["area"].values.tolist()) == {"S1 barrel field"}
    assert opened.attrs["removed"]["units: no cell (iscell)"] == 1
    np.testing.assert_allclose(values[0, 0], data[:5, 1:].mean(axis=0), rtol=1e-5)


def test_responses_that_fade_over_the_session_are_doubted():
    random = np.random.default_rng(0)
    steady = random.normal(size=(40, 1, 20)).astype(np.float32)
    assert fading(steady) == ""
    assert fading(steady[:8]) == ""
    steady[3] = np.nan
    assert "falls over the session" in fading(steady - 0.05 * np.arange(40, dtype=np.float32)[:, None, None])
