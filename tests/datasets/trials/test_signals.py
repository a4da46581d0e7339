import h5py
import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import check, export, inspect, open_recordings, write_recordings
from brainbench.datasets.sessions import make_session
from brainbench.datasets.trials.signals import fading, time_lost
from tests.factories.recordings import make_simple_session, write_nwb

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


def test_signals_of_other_than_frames_and_units_are_refused(tmp_path):
    path = imaged(tmp_path / "a.nwb", np.zeros((70, 2, 3)))
    with pytest.raises(DataError, match=r"has the shape \(70, 2, 3\), not \[frame, unit\]"):
        open_recordings(path, conditions="trials:texture")


@pytest.mark.parametrize("data", [np.zeros((70, 2), "c8"), np.full((70, 2), b"x"), np.zeros((70, 0)), np.zeros((0, 2))])
def test_samples_are_real_numbers_and_there_are_some(tmp_path, data):
    """Of complex numbers the real part was read."""
    with pytest.raises(DataError, match="samples are real numbers, one each"):
        open_recordings(imaged(tmp_path / "a.nwb", data), conditions="trials:texture")


def test_numbers_of_frames_in_place_of_seconds_are_doubted(tmp_path):
    """An unknown rate is written as 1, so the first frames, one a second, pass for those of all trials."""
    data = np.random.default_rng(0).normal(size=(700, 3))
    for rate, doubted in ((1.0, True), (100.0, False)):
        path = imaged(tmp_path / f"{rate}.nwb", data, rate=rate)
        opened = open_recordings(path, conditions="trials:texture", window="start..+1")
        doubts = opened.attrs["doubts"]
        assert any("runs for 699 s and its trials for 6, so its times" in doubt for doubt in doubts) is doubted


def test_bins_timestamps_and_chosen_cells(tmp_path):
    data = np.random.default_rng(0).normal(size=(70, 3))
    path = imaged(tmp_path / "a.nwb", data, stamps=0.001 + np.arange(70) / 10)
    _, values = means(path, window="start..+0.4", bin=0.2, select="units.id=1")
    assert values.shape == (6, 2, 1)
    np.testing.assert_allclose(values[2, :, 0], [data[20:22, 1].mean(), data[22:24, 1].mean()], rtol=1e-5)


def test_frames_on_the_bounds_of_bins_are_in_the_later_bin_however_sums_are_rounded(tmp_path):
    """Bins of one frame: 7 % had none and as many two, since 1 + 7 · (1/30) is not (30 + 7)/30."""
    data = np.random.default_rng(0).normal(size=(1900, 3))
    path = write_nwb(tmp_path / "a.nwb", units=False)
    with h5py.File(path, "a") as file:
        file["intervals/trials/start_time"][...] = starts = np.array([1, 7, 13, 29, 41, 58])
        file["intervals/trials/stop_time"][...] = starts + 1
    _, values = means(imaged(path, data, rate=30.0), window="start..+1", bin=1 / 30)
    expected = data[30 * starts[:, None] + np.arange(30)]
    np.testing.assert_allclose(values, expected, rtol=1e-5)


@pytest.mark.parametrize("rates", [(20, 20), (20, 60)])
def test_windows_without_a_tenth_of_their_frames_are_left_out(tmp_path, rates):
    """Trials of .5 s each second; frames are missing from 2.06 to 4.02 s, and one of ten in the first trial."""
    stamps = np.concatenate([np.arange(0, 3, 1 / rates[0]), 3 + np.arange(0, 4, 1 / rates[1])])
    stamps = stamps[(np.abs(stamps - 0.25) > 1e-9) & ~((stamps > 2.06) & (stamps < 4.02))]
    data = np.random.default_rng(0).normal(size=(len(stamps), 3))
    opened, values = means(imaged(tmp_path / "a.nwb", data, stamps=stamps))
    assert opened["trial_id"].values.tolist() == ["0", "2", "8", "10"]
    trials = opened.attrs["ledger"]["trials"]
    assert {"reason": "outside the recorded span", "number": 2, "lost": False} in trials["left_out"]
    np.testing.assert_allclose(values[0, 0], data[stamps < 0.5].mean(axis=0), rtol=1e-5)


def test_the_time_that_frames_do_not_cover_is_that_of_a_fine_grid():
    random = np.random.default_rng(1)
    for _ in range(50):
        steps = np.where(random.random(200) < 0.03, random.uniform(1, 9, 200), random.uniform(0.9, 1.1, 200))
        times, most = np.cumsum(steps), np.quantile(steps[1:], 0.9)
        begin, end = np.sort(random.uniform(times[0], times[-1], 2))
        grid = np.linspace(begin, end, 20001)
        place = np.searchsorted(times, grid, side="right") - 1
        gap = np.append(steps[1:], 0)[place] > 1.5 * most
        share = np.mean(gap & (grid - times[place] > most))
        assert time_lost(times, np.array([[begin, end]]))[0] == pytest.approx(
            (end - begin) * share, abs=1e-3 * (end - begin)
        )


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
        ({"stamps": np.arange(5.0)}, "5 timestamps for 70 samples"),
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


def test_stored_numbers_are_scaled_to_the_unit_of_the_file(tmp_path):
    data = np.random.default_rng(0).normal(size=(70, 3))
    path = imaged(tmp_path / "a.nwb", np.round((data + 8) * 1000).astype(np.uint16))
    with h5py.File(path, "a") as file:
        file[f"{SERIES}/data"].attrs.update({"conversion": 0.001, "offset": -8.0})
    _, values = means(path)
    expected = [data[10 * trial : 10 * trial + 5].mean(axis=0) for trial in range(6)]
    np.testing.assert_allclose(values[:, 0], expected, atol=1e-3)
    (copy,) = export(path, tmp_path / "copy", format="temporaldata")
    np.testing.assert_allclose(means(copy)[1], values, atol=1e-6)


def test_a_copy_of_some_channels_keeps_the_conversion_of_each(tmp_path):
    path = voltages(tmp_path / "a.nwb", tones([1.0, 2.0, 4.0], 100.0))
    with h5py.File(path, "a") as file:
        file["processing/ecephys/LFP/lfp/channel_conversion"] = [1.0, 10.0, 100.0]
    (copy,) = export(path, tmp_path / "copy", format="temporaldata", select="units.id=2")
    _, values = means(copy, window="start..stop of @70..150")
    np.testing.assert_allclose(values[:, 0], 80_000.0, rtol=0.02)


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


@pytest.mark.parametrize(
    ("rois", "flags", "units"),
    [
        ([3, 1, 0], [1, 1, 0], ["1", "2"]),
        ([-1, 1, 0], [1, 1, 1], ["1", "2"]),
        ([0.5, 1, 2], [1, 1, 1], ["1", "2"]),
        ([2, 1, 0], [1, 1], ["1", "2"]),
    ],
)
def test_cells_without_a_row_in_the_table_of_their_plane_are_left_out_and_counted(tmp_path, rois, flags, units):
    path = segmented(imaged(tmp_path / "a.nwb", np.random.default_rng(0).normal(size=(70, 3))), flags)
    with h5py.File(path, "a") as file:
        table = file[SERIES]["rois"].attrs["table"]
        del file[SERIES]["rois"]
        file[SERIES].create_dataset("rois", data=np.array(rois)).attrs["table"] = table
    opened, _ = means(path)
    assert opened["unit_id"].values.tolist() == units
    assert opened.attrs["removed"]["units: not known whether a cell (no row has its iscell)"] == 1


@pytest.mark.parametrize("flags", [[b"yes", b"no", b"yes"], []])
def test_where_no_column_is_known_to_be_a_cell_none_is_scored(tmp_path, flags):
    path = segmented(imaged(tmp_path / "a.nwb", np.random.default_rng(0).normal(size=(70, 3))), flags)
    with pytest.raises(DataError, match=r"not known whether a cell .* removed 3"):
        means(path)


def test_responses_that_fade_over_the_session_are_doubted():
    random = np.random.default_rng(0)
    steady = random.normal(size=(40, 1, 20)).astype(np.float32)
    assert fading(steady) == ""
    assert fading(steady[:8]) == ""
    steady[3] = np.nan
    assert "falls over the session" in fading(steady - 0.05 * np.arange(40, dtype=np.float32)[:, None, None])


@pytest.mark.parametrize(("unit", "cause"), [("dF/F", "bleaches"), ("mV", "bleaches"), ("spikes", "electrodes")])
def test_drift_is_told_of_responses_of_any_unit_by_every_command(tmp_path, unit, cause):
    table = {"start_time": np.arange(30.0), "stop_time": np.arange(30.0) + 0.5, "stimulus": list("abc") * 10}
    values = np.random.default_rng(0).poisson(5, (30, 1, 4)) + np.arange(30)[:, None, None]
    path = write_recordings(
        tmp_path / "a.h5", make_session("m", "1", None, {"trials": table}, response=values, unit=unit)
    )
    (doubt,) = (
        doubt for doubt in open_recordings(path, conditions="trials:stimulus").attrs["doubts"] if "rises" in doubt
    )
    assert cause in doubt
    checkup = check(path, conditions="trials:stimulus")
    assert (checkup.verdict, doubt in {finding.message for finding in checkup.findings}) == ("warning", True)


def test_the_mean_of_a_baseline_is_taken_away_from_signals_and_rates(tmp_path):
    data = np.random.default_rng(0).normal(size=(70, 3))
    opened, values = means(imaged(tmp_path / "a.nwb", data), window="start+0.5..+0.4 minus start..+0.5")
    expected = [data[10 * n + 5 : 10 * n + 9].mean(axis=0) - data[10 * n : 10 * n + 5].mean(axis=0) for n in range(6)]
    np.testing.assert_allclose(values[:, 0], expected, rtol=1e-4, atol=1e-6)
    assert opened.attrs["window"] == "start+0.5..+0.4 minus start..+0.5"
    path = write_recordings(tmp_path / "b.h5", make_simple_session())
    window, before = (
        open_recordings(path, conditions="trials:stimulus", window=text) for text in ("start..+0.5", "start-0.5..start")
    )
    both = open_recordings(path, conditions="trials:stimulus", window="start..+0.5 minus start-0.5..start")
    rows = np.isin(window["trial_id"].values, both["trial_id"].values)
    rates = (both["counts"] / both["duration"]).values
    np.testing.assert_allclose(rates, 2 * (window["counts"].values[rows] - before["counts"].values), rtol=1e-5)
    assert rates.min() < 0
    assert "spikes minus their mean in start-0.5..start" in both.attrs["measure"]
    again = open_recordings(write_recordings(tmp_path / "c.h5", both))
    np.testing.assert_array_equal(again["counts"], both["counts"])


def test_trials_without_their_baseline_are_left_out(tmp_path):
    path = imaged(tmp_path / "a.nwb", np.random.default_rng(0).normal(size=(70, 3)))
    opened, _ = means(path, window="start..stop minus start-0.5..start")
    assert opened.attrs["removed"]["trials: outside the recorded span"] == 1
    with pytest.raises(DataError, match=r"baseline start\.\.start of no length removed 6"):
        means(path, window="start..stop minus start..start")


def voltages(path, data, *, rate=1000.0, place="processing/ecephys/LFP/lfp", **attributes):
    """A signal of voltages over six trials of half a second."""
    imaged(path, data, rate=rate, place=place)
    with h5py.File(path, "a") as file:
        file[place].attrs["neurodata_type"] = "ElectricalSeries"
        file[f"{place}/data"].attrs.update({"conversion": 1e-6, **attributes})
    return path


def tones(amplitudes, hertz, *, seconds=7.0, rate=1000.0):
    """Voltages (µV) of channels with a tone each, beside a slow one that is larger."""
    time = np.arange(int(seconds * rate)) / rate
    slow = 50 * np.sin(2 * np.pi * 5 * time)[:, None]
    return (np.array(amplitudes) * np.sin(2 * np.pi * hertz * time)[:, None] + slow).astype(np.float32)


def test_voltages_are_read_as_power_in_a_band(tmp_path):
    path = voltages(tmp_path / "a.nwb", tones([1.0, 2.0, 4.0], 100.0))
    opened, values = means(path, window="start..stop of LFP@70..150")
    # A sine of amplitude A has the power A² / 2.
    np.testing.assert_allclose(values[:, 0], np.tile([0.5, 2.0, 8.0], (6, 1)), rtol=0.02)
    assert opened.attrs["measure"] == "power at 70..150 Hz of processing/ecephys/LFP/lfp (ElectricalSeries)"
    assert opened.attrs["window"] == "start..stop of LFP@70..150"
    _, slow = means(path, window="start..stop of @2..10")
    np.testing.assert_allclose(slow[2:5], 1250.0, rtol=0.05)


def test_power_of_a_window_is_that_of_the_whole_recording(tmp_path):
    from scipy.signal import butter, sosfiltfilt

    data = np.random.default_rng(0).normal(size=(7000, 2)).astype(np.float32)
    _, values = means(voltages(tmp_path / "a.nwb", data), window="start..stop of @70..150")
    whole = sosfiltfilt(butter(4, (70, 150), "bandpass", fs=1000, output="sos"), data, axis=0) ** 2
    expected = [whole[1000 * trial : 1000 * trial + 500].mean(axis=0) for trial in range(6)]
    np.testing.assert_allclose(values[1:, 0], expected[1:], rtol=1e-3)


def test_channels_have_the_area_of_their_electrode_and_gaps_are_missing(tmp_path):
    data = tones([1.0, 2.0], 100.0)
    data[2100:2110, 1] = np.nan
    path = voltages(tmp_path / "a.nwb", data)
    with h5py.File(path, "a") as file:
        table = file.create_group("general/extracellular_ephys/electrodes")
        table["id"], table["location"] = np.arange(3), np.array([b"S1", b"S1", b"S2"])
        rows = file["processing/ecephys/LFP/lfp"].create_dataset("electrodes", data=np.array([2, 0]))
        rows.attrs["table"] = table.ref
    opened, values = means(path, window="start..stop of @70..150")
    assert opened["area"].values.tolist() == ["S2", "S1"]
    assert np.isnan(values[:, 0, 1]).tolist() == [False, False, True, False, False, False]


@pytest.mark.parametrize(
    ("window", "words"),
    [
        ("start..stop of @300..600", r"1000 samples/s.* ends below half of that; received 300\.\.600 Hz"),
        ("start..+0.1 of @4..8", r"a cycle of 4 Hz every 0\.25 s, and windows or bins are as short as 0\.1 s"),
        ("start..stop of LPF@70..150", "did you mean"),
        ("start..stop of LFP", "needs a band in Hz, such as LFP@70..150"),
        ("start..stop of @", "'DfOverF', 'LFP@70..150'"),
        ("start..stop of ", "cannot be read"),
        ("start..stop of @150..70", "the lower first"),
        ("start..stop minus start..+1 minus start..+1", "a plain window"),
        (None, "read as power in a band"),
    ],
)
def test_bands_that_cannot_be_read_are_refused(tmp_path, window, words):
    path = voltages(tmp_path / "a.nwb", tones([1.0, 2.0], 100.0))
    with pytest.raises((DataError, UsageError), match=words):
        means(path, window=window)


def test_voltages_without_a_time_base_are_refused(tmp_path):
    path = voltages(tmp_path / "a.nwb", tones([1.0], 100.0), rate=None)
    with pytest.raises(DataError, match="neither timestamps nor a rate"):
        means(path, window="start..stop of @70..150")


def sampled(path, response, *, time=None, unit="dF/F", **columns):
    """Responses [trial, time, unit] to six trials of a second every two seconds."""
    start = 2.0 * np.arange(len(response))
    labels = np.resize(["a", "b", "c"], len(response))
    table = {"start_time": start, "stop_time": start + 1.0, "texture": labels}
    session = make_session(
        path.stem, "1", None, {"trials": table}, response=response, time=time, unit=unit, unit_columns=columns
    )
    return write_recordings(path, session)


def test_responses_by_trial_are_averaged_over_windows(tmp_path):
    response = np.random.default_rng(0).normal(size=(6, 20, 3))
    time = -0.5 + np.arange(20) / 10
    path = sampled(tmp_path / "m1.h5", response, time=time, layer=["4", "5", "5"])
    opened, values = means(path, window="start..+0.5 minus start-0.5..start", select="units.layer=5")
    expected = response[:, 5:10, 1:].mean(axis=1) - response[:, :5, 1:].mean(axis=1)
    np.testing.assert_allclose(values[:, 0], expected, rtol=1e-4, atol=1e-6)
    assert opened.attrs["measure"].startswith("response (dF/F)")
    sampled(tmp_path / "m2.h5", response, time=time)
    assert set(means(tmp_path)[0]["subject"].values.tolist()) == {"m1", "m2"}


def test_counts_by_trial_add_up_and_one_sample_needs_no_time(tmp_path):
    counts = np.random.default_rng(0).poisson(2.0, size=(6, 10, 3))
    path = sampled(tmp_path / "a.h5", counts, time=np.arange(10) / 10, unit="spikes")
    opened, _ = means(path)
    np.testing.assert_allclose(opened["counts"].values[:, 0], counts.sum(axis=1), rtol=1e-6)
    assert opened.attrs["measure"] == "spikes"
    whole = sampled(tmp_path / "b.h5", counts[:, :1], unit="spikes")
    np.testing.assert_allclose(means(whole)[0]["counts"].values, counts[:, :1], rtol=1e-6)
    with pytest.raises(UsageError, match="says no time of its 1 samples"):
        means(whole, window="start..+0.5")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda session: session["response"].attrs.pop("unit"), "no attribute 'unit'"),
        (lambda session: session.pop("time"), "says no time of its 20 samples"),
        (lambda session: session["response"].attrs.update(table="licks"), r"with the rows of 'licks'"),
        (lambda session: session["units"].pop("id"), None),
    ],
)
def test_responses_that_are_incomplete_are_refused(tmp_path, change, words):
    path = sampled(tmp_path / "m1.h5", np.ones((6, 20, 3)), time=np.arange(20) / 10)
    with h5py.File(path, "a") as file:
        change(file["sessions/m1-1"])
    if words is None:
        assert means(path)[0].sizes["unit"] == 3
        return
    with pytest.raises((DataError, UsageError), match=words):
        means(path)


def test_signals_are_inspected_and_checked_without_an_error(tmp_path):
    path = imaged(tmp_path / "a.nwb", np.ones((70, 3)))
    imaged(path, np.ones((70, 3)), place="processing/ophys/DfOverF/second")
    assert "several signals" in str(inspect(path))
    assert check(path).count("error") == 0
    assert "holds signals and no spikes" in str(check(path))
