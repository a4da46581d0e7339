from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import export, inspect, open_recordings, write_recordings
from brainbench.datasets.layouts.published import recorded_runs
from brainbench.datasets.layouts.registry import get_layout, list_layouts
from brainbench.datasets.sessions import Series, make_session
from tests.factories.dandi_files import make_pole_task, write_area2, write_hires, write_yu
from tests.factories.recording_files import ROWS, detection, write_rodgers
from tests.factories.recordings import LABELS


def one(index, value, other):
    return [value if row == index else other for row in range(ROWS)]


def test_the_layout_prints_every_rule():
    text = get_layout("rodgers").describe()
    for expected in (
        "conditions: trials:stimulus,servo_position",
        f"vocabulary: {', '.join(LABELS)}",
        "window: first-contact..choice",
        "window of sessions without contact tables: choice-1..+1",
        "trials: stimulus!=nothing",
        "trials: outcome!=spoil",
        "trials: direct_delivery!=true",
        "trials: stim_is_random!=false",
        "trials: optogenetic!=true",
        "trials: ignore_trial!=true",
        "starting_time is never subtracted",
        "doi:10.1038/s41597-022-01728-1",
    ):
        assert expected in text
    assert "rodgers" in list_layouts()


def test_the_layout_is_detected_and_said(tmp_path):
    path = write_rodgers(tmp_path / "a.h5")
    dataset = open_recordings(path)
    assert dataset.attrs["layout"] == "rodgers (detected from its columns)"
    assert dataset.attrs["vocabulary"] == list(LABELS)
    assert dataset.attrs["conditions"] == "trials:stimulus,servo_position"
    np.testing.assert_allclose(dataset["window_start"].values, 10.0 * np.arange(ROWS) + 2)
    np.testing.assert_allclose(dataset["duration"].values, 1.0)
    assert np.all(dataset["counts"].values == 10)
    assert open_recordings(f"rodgers:{path}").attrs["layout"] == "rodgers"


@pytest.mark.parametrize(
    ("column", "values", "rule"),
    [
        ("stimulus", one(4, "nothing", "convex"), "trials: stimulus!=nothing"),
        ("outcome", one(4, "spoil", "error"), "trials: outcome!=spoil"),
        ("direct_delivery", one(4, True, False), "trials: direct_delivery!=true"),
        ("stim_is_random", one(4, False, True), "trials: stim_is_random!=false"),
        ("optogenetic", one(4, 1, 0), "trials: optogenetic!=true"),
        ("ignore_trial", one(4, True, False), "trials: ignore_trial!=true"),
        ("choice_time", one(4, np.nan, 3.0), "trials: no event for the window first-contact..choice"),
    ],
)
def test_each_rule_removes_its_trial_and_counts_it(tmp_path, column, values, rule):
    if column == "choice_time":
        values = np.array(values) + 10.0 * np.arange(ROWS)
    dataset = open_recordings(write_rodgers(tmp_path / "a.h5", **{column: values}))
    assert {name: number for name, number in dataset.attrs["removed"].items() if number} == {rule: 1}
    assert "38" not in dataset["trial_id"].values
    assert dataset.sizes["trial"] == ROWS - 1


def test_a_position_outside_the_vocabulary_is_not_a_new_condition(tmp_path):
    dataset = open_recordings(write_rodgers(tmp_path / "a.h5", servo_position=one(2, "elsewhere", "far")))
    assert dataset.attrs["removed"]["trials: label outside the vocabulary"] == 1
    assert dataset.attrs["vocabulary"] == list(LABELS)
    assert dataset.attrs["missing"] == {"231CR": ["convex-close", "convex-medium", "concave-close", "concave-medium"]}


def test_absent_optional_columns_are_tolerated_and_said(tmp_path):
    nothing = np.array(0)
    dataset = open_recordings(write_rodgers(tmp_path / "a.h5", optogenetic=nothing, ignore_trial=nothing))
    assert dataset.sizes["trial"] == ROWS
    assert "optogenetic!=true" in "".join(dataset.attrs["notes"])


def test_a_session_without_contact_tables_is_read_before_the_choice(tmp_path):
    dataset = open_recordings(write_rodgers(tmp_path / "a.h5", contacts=False))
    np.testing.assert_allclose(dataset["window_start"].values, 10.0 * np.arange(ROWS) + 2)
    assert f"window choice-1..+1 for its {ROWS} trials" in "".join(dataset.attrs["notes"])


def test_arguments_replace_their_part_of_the_layout_only(tmp_path):
    path = write_rodgers(tmp_path / "a.h5", outcome=one(0, "spoil", "error"))
    shapes = open_recordings(path, conditions="trials:stimulus")
    assert shapes.attrs["vocabulary"] == ["convex", "concave"]
    assert shapes.attrs["removed"]["trials: outcome!=spoil"] == 1
    everything = open_recordings(path, select="none", window="start..stop")
    assert everything.sizes["trial"] == ROWS - 1
    assert everything.attrs["removed"]["trials: outside the recorded span"] == 1
    outcomes = open_recordings(path, conditions="trials:outcome", select="none")
    assert outcomes.attrs["vocabulary"] == ["error", "spoil"]


def test_a_layout_that_does_not_fit_names_what_is_missing(tmp_path):
    session = make_session("m", "1", [np.arange(5.0)], {"trials": {"start_time": [0.0, 1.0], "stim": ["a", "b"]}})
    with pytest.raises(UsageError, match="'stimulus'; did you mean 'stim'"):
        open_recordings(f"rodgers:{write_recordings(tmp_path / 'a.h5', session)}")


def test_files_of_different_layouts_are_not_mixed_silently(tmp_path):
    write_rodgers(tmp_path / "a.h5")
    session = make_session("m", "1", [np.arange(5.0)], {"trials": {"start_time": [0.0, 1.0], "stim": ["a", "b"]}})
    write_recordings(tmp_path / "b.h5", session)
    with pytest.raises(UsageError, match=r"b\.h5:m-1 .*a\.h5:231CR-1"):
        open_recordings(tmp_path)


def test_inspection_proposes_the_conditions_of_the_layout_first(tmp_path):
    report = inspect(write_rodgers(tmp_path / "a.h5"))
    assert report.layout == "rodgers"
    assert report.proposals[0].conditions == "trials:stimulus,servo_position"
    assert report.proposals[0].labels == LABELS


def test_the_two_tasks_can_be_read_apart(tmp_path):
    write_rodgers(tmp_path / "a.h5")
    write_rodgers(tmp_path / "b.h5", subject="233CR", **detection())
    both = open_recordings(tmp_path)
    assert set(both["subject"].values) == {"231CR", "233CR"}
    assert both.attrs["removed"]["trials: stimulus!=nothing"] == 2
    one = open_recordings(f"rodgers-discrimination:{tmp_path}")
    assert (set(one["subject"].values), set(one["unit_subject"].values)) == ({"231CR"}, {"231CR"})
    assert one.attrs["removed"]["trials: task=discrimination"] == ROWS
    assert "session 1 of 233CR: no trial is left, so its 1 units are left out" in one.attrs["notes"]
    assert [item["trials"] for item in one.attrs["sessions"]] == [ROWS, 0]
    other = open_recordings(f"rodgers-detection:{tmp_path}")
    assert set(other["subject"].values) == {"233CR"}
    assert open_recordings(tmp_path, select="task=detection; stimulus!=nothing").sizes["trial"] == ROWS - 2


def test_in_detection_nothing_is_a_stimulus_wherever_the_shape_would_have_been(tmp_path):
    dataset = open_recordings(f"rodgers-detection:{write_rodgers(tmp_path / 'a.h5', **detection())}")
    assert dataset.attrs["vocabulary"] == [*LABELS, "nothing"]
    assert np.sum(dataset["stimulus"].values == "nothing") == 2
    # Nothing is touched on those trials, so the window is the second before the choice for all.
    np.testing.assert_allclose(dataset["window_start"].values, 10.0 * np.arange(ROWS) + 2)
    assert dataset.attrs["window"] == "choice-1..+1"


def test_choices_do_not_label_stimuli_in_either_task(tmp_path):
    """In discrimination the shape tells the rewarded side, in detection its presence does."""
    for name, columns in (("a", {}), ("b", detection())):
        stimulus = columns.get("stimulus", np.resize(np.repeat(["convex", "concave"], 3), ROWS))
        side = np.where(stimulus == ("convex" if name == "a" else "nothing"), "left", "right")
        path = write_rodgers(tmp_path / f"{name}.h5", rewarded_side=side, choice=side, **columns)
        by_side = open_recordings(path, conditions="trials:rewarded_side", select="none")
        assert by_side.attrs["vocabulary"] == ["left", "right"]
        rights = by_side["stimulus"].values == "right"
        np.testing.assert_array_equal(rights, side == "right")


def test_a_lost_whisker_is_not_needed_for_the_first_contact_but_is_said(tmp_path):
    dataset = open_recordings(write_rodgers(tmp_path / "a.h5", lost=("C2",)))
    np.testing.assert_allclose(dataset["window_start"].values, 10.0 * np.arange(ROWS) + 2)
    assert "no contact table of 'C0', 'C2', 'C3'" in "".join(dataset.attrs["notes"])
    with pytest.raises(DataError, match=r"choice removed 14"):
        # All contacts of C2 are of zero duration, so they are no first contact.
        open_recordings(write_rodgers(tmp_path / "b.h5", lost=("C1",)))


@pytest.mark.parametrize("bin", [0.001, 0.0333, 0.25, 1.0])
def test_any_bin_width_counts_every_spike_once(tmp_path, bin):
    path = write_rodgers(tmp_path / "a.h5")
    whole, binned = open_recordings(path), open_recordings(path, bin=bin)
    np.testing.assert_array_equal(np.nansum(binned["counts"].values, axis=1), whole["counts"].values[:, 0])
    np.testing.assert_allclose(binned["duration"].values.sum(axis=1), whole["duration"].values[:, 0])
    assert binned.sizes["time"] == int(np.ceil(1.0 / bin - 1e-6))


def test_units_are_chosen_by_layer_depth_and_type(tmp_path):
    columns = {"layer": ["2/3", "4", "5b", "5b"], "depth": [200.0, 500, 700, 900], "inhibitory": [True, False] * 2}
    path = write_rodgers(tmp_path / "a.h5", units=columns)
    for select, kept in (
        ("units.layer=4|5b", [500.0, 700, 900]),
        ("units.depth=..700", [200.0, 500, 700]),
        ("units.inhibitory=false; units.layer=5b", [900.0]),
    ):
        dataset = open_recordings(path, select=select)
        assert dataset["depth"].values.tolist() == kept
        assert sum(number for rule, number in dataset.attrs["removed"].items() if "units:" in rule) == 4 - len(kept)


def test_twenty_gigabytes_of_voltage_cost_no_reading(tmp_path):
    """The bytes that were read are counted by the kernel; 20 GB are a hole in the file."""
    counter = Path("/proc/self/io")
    if not counter.exists():
        pytest.skip("no /proc/self/io on this system")
    path = write_rodgers(tmp_path / "a.h5")
    nwb = export(path, tmp_path / "a.nwb")[0]
    before = open_recordings(nwb)
    with h5py.File(nwb, "a") as file:
        series = file["acquisition"].create_group("extracellular array recording")
        series.attrs["neurodata_type"] = "ElectricalSeries"
        series.create_dataset("starting_time", data=3.5).attrs["rate"] = 30000.0
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        plist.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        space = h5py.h5s.create_simple((160_000_000, 64))
        h5py.h5d.create(series.id, b"data", h5py.h5t.NATIVE_INT16, space, plist)
    assert nwb.stat().st_size > 20e9

    def read() -> int:
        return int(counter.read_text().split("rchar: ")[1].split()[0])

    start = read()
    dataset = open_recordings(nwb)
    inspect(nwb)
    assert read() - start < 2_000_000
    # Nor is the voltage's starting_time subtracted: there is one clock.
    xr.testing.assert_identical(dataset.drop_attrs(), before.drop_attrs())


@pytest.mark.parametrize("write", [write_yu, write_hires])
def test_pole_tasks_are_counted_while_the_pole_is_there(tmp_path, write):
    spikes, _ = write(tmp_path / "a.nwb")
    spikes = spikes if write is write_yu else [spikes]
    columns, _ = make_pole_task()
    dataset = open_recordings(tmp_path / "a.nwb")
    assert dataset.attrs["vocabulary"] == ["Go", "Nogo"]
    assert dataset.attrs["removed"]["trials: stim_present!=true"] == 3
    kept = columns["stim_present"] == 0
    low, high = columns["pole_in_time"][kept], columns["pole_out_time"][kept]
    expected = [
        [np.sum((times >= begin) & (times < end)) for times in spikes] for begin, end in zip(low, high, strict=True)
    ]
    np.testing.assert_array_equal(dataset["counts"].values[:, 0], expected)


def test_a_spike_train_of_zeros_and_ones_is_a_unit_recorded_in_trials_only(tmp_path):
    spikes, touches = write_hires(tmp_path / "a.nwb")
    dataset = open_recordings(tmp_path / "a.nwb", window="first-contact..+0.1", select="none")
    assert dataset.sizes["unit"] == 1
    assert "acquisition/SpikeTrain" in "".join(dataset.attrs["notes"])
    np.testing.assert_allclose(
        dataset["window_start"].values, touches[np.searchsorted(touches, make_pole_task()[0]["start_time"])]
    )
    low = dataset["window_start"].values
    np.testing.assert_array_equal(
        dataset["counts"].values[:, 0, 0], [np.sum((spikes >= begin) & (spikes < begin + 0.1)) for begin in low]
    )
    # Between trials nothing was sampled: that is missing, not silence.
    with pytest.raises(DataError, match=r"a\.nwb: trials: .*span .*24"):
        open_recordings(tmp_path / "a.nwb", window="stop-0.2..+0.4", select="none")


def test_series_of_zeros_and_ones_say_what_is_wrong_with_them():
    flags, stamps = np.array([0, 1, 0, 1]), np.array([0.0, 0.1, 0.2, 0.3])
    np.testing.assert_allclose(Series("s", "", flags, stamps).active_times(), [0.1, 0.3])
    np.testing.assert_allclose(Series("s", "", flags, start=5.0, rate=10.0).active_times(), [5.1, 5.3])
    with pytest.raises(DataError, match="4 samples"):
        Series("s", "", flags, stamps[:3]).active_times()
    with pytest.raises(DataError, match=r"series s .*rate"):
        Series("s", "", flags).active_times()
    with pytest.raises(DataError, match="it reaches 7"):
        Series("s", "", flags * 7, stamps).active_times()
    np.testing.assert_allclose(recorded_runs(np.array([0, 0.1, 0.2, 5, 5.1])), [[0, 0.3], [5, 5.2]])


def test_every_whisker_of_the_probe_recordings_has_its_contacts(tmp_path):
    _, touches = write_yu(tmp_path / "a.nwb")
    tables = {table.name: table.rows for table in inspect(tmp_path / "a.nwb").sessions[0].tables}
    assert tables["contacts_by_whisker_C1"] == len(touches)
    assert tables["contacts_by_whisker_C2"] == len(touches[::3])


def test_bumps_and_reaches_are_told_apart_by_direction(tmp_path):
    spikes, columns = write_area2(tmp_path / "a.nwb")
    dataset = open_recordings(tmp_path / "a.nwb")
    assert len(dataset.attrs["vocabulary"]) == 16
    assert dataset.attrs["vocabulary"][:2] == ["active-0", "active-45"]
    removed = {rule: number for rule, number in dataset.attrs["removed"].items() if number}
    assert removed == {"trials: result=R": 8, "trials: no event for the window move_onset_time-0.1..+0.6": 4}
    onset = columns["move_onset_time"]
    kept = (columns["result"] == "R") & np.isfinite(onset)
    expected = [[np.sum((times >= at - 0.1) & (times < at + 0.5)) for times in spikes] for at in onset[kept]]
    np.testing.assert_array_equal(dataset["counts"].values[:, 0], expected)
    bumped = columns["ctr_hold_bump"][kept]
    np.testing.assert_array_equal(np.char.startswith(dataset["stimulus"].values.astype(str), "passive"), bumped)


def test_the_test_trials_of_the_benchmark_are_refused_in_words(tmp_path):
    write_area2(tmp_path / "a.nwb", test=True)
    with pytest.raises(DataError, match=r"a\.nwb .*interval .*'trials'"):
        open_recordings(tmp_path / "a.nwb")
    with pytest.raises(UsageError, match="column 'movement'"):
        open_recordings(f"area2-bump:{tmp_path / 'a.nwb'}")
