from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

from brainbench.core.errors import DataError, UsageError
from brainbench.datasets import check, export, inspect, open_recordings, write_recordings
from brainbench.datasets.layouts.published import recorded_runs
from brainbench.datasets.layouts.registry import get_layout, list_layouts
from brainbench.datasets.sessions import Series, make_session
from tests.factories.recordings import LABELS, ROWS, detection, write_rodgers


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


# Small files with the layout of public data sets: names, types and containers as listed for the real ones.
# DANDI 000005 and 000013: ``/acquisition`` containers, ``/intervals/trials`` columns and their types (int32, float64,
# text), ``/units`` with doubly indexed electrodes and waveforms. DANDI 000127: the training file with its segments in
# ``obs_intervals`` (uint columns, NaN times), and the test file.
TEXT = h5py.string_dtype()
TRIALS = 24


def _base(file, *, subject, identifier):
    file.attrs.update({"namespace": "core", "neurodata_type": "NWBFile", "nwb_version": "2.2.1"})
    for name, value in (
        ("identifier", identifier),
        ("session_description", ""),
        ("session_start_time", "2013-02-07T00:00:00-06:00"),
        ("timestamps_reference_time", "2013-02-07T00:00:00-06:00"),
        ("general/subject/subject_id", subject),
        ("general/institution", "Janelia Research Campus"),
    ):
        file.create_dataset(name, data=value, dtype=TEXT)
    file.create_dataset("file_create_date", data=["2020-03-12T12:16:33.462573-05:00"], dtype=TEXT)
    for name in ("acquisition", "processing", "analysis", "stimulus/presentation"):
        file.require_group(name)


def _table(file, path, kind, columns, ids):
    group = file.create_group(path)
    group.attrs.update({"namespace": "core", "neurodata_type": kind, "description": kind})
    group.attrs.create("colnames", [name for name in columns if not name.endswith("_index")], dtype=TEXT)
    group.create_dataset("id", data=np.asarray(ids, dtype=np.int32))
    for name, values in columns.items():
        values = np.asarray(values)
        made = (
            group.create_dataset(name, data=values.astype(object), dtype=TEXT)
            if values.dtype.kind == "U"
            else group.create_dataset(name, data=values)
        )
        made.attrs["neurodata_type"] = "VectorIndex" if name.endswith("_index") else "VectorData"
    return group


def _units(file, spikes, spans, ids, electrodes, kinds, **columns):
    """Write a table of units: spans of observation [n, 2] of all, ``electrodes`` of each, and types of the indices."""
    count = len(spikes)
    indices = (
        np.cumsum([len(times) for times in spikes]),
        *(each * np.arange(1, count + 1) for each in (len(spans), electrodes)),
    )
    values = (np.concatenate(spikes), np.tile(spans, (count, 1)), np.arange(count * electrodes))
    table = {}
    for name, held, index, kind in zip(
        ("spike_times", "obs_intervals", "electrodes"), values, indices, kinds, strict=True
    ):
        table |= {name: held, f"{name}_index": index.astype(kind)}
    return _table(file, "units", "Units", table | columns, ids)


def _series(file, path, data, stamps, kind="TimeSeries"):
    group = file.create_group(path)
    group.attrs.update({"namespace": "core", "neurodata_type": kind})
    group.create_dataset("data", data=data).attrs.update({"unit": "a.u.", "conversion": 1.0})
    group.create_dataset("timestamps", data=stamps).attrs.update({"interval": 1, "unit": "seconds"})
    return group


def _behavior(file, name, touches, stamps, signals, random):
    """Write touches (30 ms long) as flags of their begins and ends, and signals of noise."""
    file.create_group(f"acquisition/{name}").attrs["neurodata_type"] = "BehavioralTimeSeries"
    for signal, when in (("touch_onset", touches), ("touch_offset", touches + 0.03)):
        flags = np.zeros(len(stamps))
        flags[np.searchsorted(stamps, when - 1e-6)] = 1
        _series(file, f"acquisition/{name}/{signal}", flags, stamps)
    for signal in signals:
        _series(file, f"acquisition/{name}/{signal}", random.standard_normal(len(stamps)), stamps)


def make_pole_task():
    """Times of a pole task: trials, the pole, touches (30 ms long), and one neuron that answers them after 12 ms."""
    random = np.random.default_rng(0)
    start = np.round(2.0 + np.cumsum(random.uniform(4.5, 6.5, TRIALS)), 3)
    pole_in, pole_out = start + 0.5, start + 2.5
    go = np.arange(TRIALS) % 2 == 0
    touches = np.concatenate(
        [begin + np.sort(random.uniform(0.5, 1.8, 6 if is_go else 3)) for begin, is_go in zip(pole_in, go, strict=True)]
    )
    # On the millisecond of the tracked whiskers.
    touches = np.round(np.unique(np.round(touches, 1)), 3)
    columns = {
        "start_time": start,
        "stop_time": start + 4.0,
        "type": np.where(go, "Go", "Nogo"),
        "response": np.where(go, "Hit", "CR"),
        "stim_present": (np.arange(TRIALS) % 8 == 7).astype(np.int32),
        "pole_position": np.where(go, 1.2, 5.4) + np.arange(TRIALS) % 4 * 0.1,
        "pole_in_time": pole_in,
        "pole_out_time": pole_out,
        "first_lick_time": np.where(go, pole_in + 1.9, np.nan),
    }
    return columns, touches


def answer(random, touches, end, rate=5.0):
    """Spike times: background, and several spikes about 12 ms after each touch."""
    late = (touches[:, None] + 0.012 + 0.003 * random.standard_normal((len(touches), 4))).ravel()
    spikes = np.unique(np.round(np.concatenate([late, random.uniform(0, end, int(rate * end))]), 4))
    return spikes[np.diff(spikes, prepend=-1.0) > 0.002]


def write_yu(path):
    """DANDI 000005, silicon probe in VPM: two whiskers, units with electrodes and waveforms."""
    random, units = np.random.default_rng(1), 5
    columns, touches = make_pole_task()
    end = float(columns["stop_time"][-1])
    stamps = np.arange(0, end, 0.001)
    with h5py.File(path, "w") as file:
        _base(file, subject="anm186997", identifier="anm186997_2013-03-17_ANM186997_20130317")
        _series(file, "acquisition/lick_trace/lick_trace", np.zeros(len(stamps), np.uint8), stamps)
        file["acquisition/lick_trace"].attrs["neurodata_type"] = "BehavioralTimeSeries"
        signals = ("pole_available", "whisker_angle", "whisker_curvature")
        for name, felt in (("principal_whisker_c1", touches), ("whisker_c2", touches[::3] + 0.2)):
            _behavior(file, name, felt, stamps, signals, random)
        first = np.array([np.append(touches[touches > begin], np.nan)[0] for begin in columns["pole_in_time"]])
        columns |= {
            "first_touch_time": first,
            "pole_pos_time": columns["start_time"],
            "photo_stim_mode": np.where(columns["stim_present"] == 1, "PoleInOut", "No stim"),
            "photo_stim_power": np.where(columns["stim_present"] == 1, "5.0", ""),
        }
        _table(file, "intervals/trials", "TimeIntervals", columns, np.arange(TRIALS) + 2)
        spikes = [answer(random, touches, end) for _ in range(units)]
        more = {
            "cell_desc": np.full(units, "N/A"),
            "sampling_rate": np.full(units, 19531.0),
            "waveform_mean": random.standard_normal((units, 25, 8)).astype(np.float32),
        }
        group = _units(file, spikes, [[0.0, end]], np.arange(units), 8, (np.int32,) * 3, **more)
        group["electrodes"].attrs["neurodata_type"] = "DynamicTableRegion"
    return spikes, touches


def write_hires(path):
    """DANDI 000013: one cell, spikes as a 0/1 PatchClampSeries sampled in trials only, no units table."""
    random = np.random.default_rng(2)
    columns, touches = make_pole_task()
    runs = [
        np.arange(begin, end, 0.0001) for begin, end in zip(columns["start_time"], columns["stop_time"], strict=True)
    ]
    stamps = np.concatenate(runs)
    spikes = answer(random, touches, float(columns["stop_time"][-1]))
    where = np.searchsorted(stamps, spikes - 1e-6)
    where = np.unique(where[(where < len(stamps))])
    where = where[np.abs(stamps[where][:, None] - spikes[None]).min(axis=1) < 2e-4]
    train = np.zeros(len(stamps), np.int64)
    train[where] = 1
    slow = np.concatenate([run[::10] for run in runs])
    with h5py.File(path, "w") as file:
        _base(file, subject="anm101105", identifier="anm101105_2010-06-19_Cell46")
        electrode = file.create_group("general/intracellular_ephys/AH0040_AAAA")
        electrode.attrs["neurodata_type"] = "IntracellularElectrode"
        for name, kind, data in (
            ("CurrentClampSeries", "CurrentClampSeries", random.standard_normal(len(stamps)).astype(np.float32)),
            ("SpikeTrain", "PatchClampSeries", train),
        ):
            _series(file, f"acquisition/{name}", data, stamps, kind)["electrode"] = h5py.SoftLink(electrode.name)
        signals = ("amplitude", "phase", "theta_at_base", "distance_to_pole", "pole_available")
        _behavior(file, "behavior", touches, slow, signals, random)
        _table(file, "intervals/trials", "TimeIntervals", columns, np.arange(TRIALS) + 1)
    return stamps[where], touches


def write_area2(path, *, test=False):
    """DANDI 000127: the training file (segments, directions, results) or the one of test trials."""
    random, trials, units = np.random.default_rng(3), 96, 6
    start = 5.0 + 3.0 * np.arange(trials) + 40.0 * (np.arange(trials) >= trials // 2)
    bump = np.arange(trials) % 2 == 1
    direction = (np.arange(trials) // 2 % 8 * 45).astype(np.float64)
    onset = start + 1.2
    onset[::31] = np.nan
    columns = {
        "start_time": start,
        "stop_time": start + 2.5,
        "move_onset_time": onset,
        "split": np.resize(np.array(["train", "train", "val", "none"]), trials),
    }
    if test:
        columns["split"] = np.full(trials, "test")
    else:
        columns |= {
            "bump_dir": np.where(bump, direction, np.nan),
            "bump_time": np.where(bump, start + 1.18, np.nan),
            "cond_dir": direction,
            "ctr_hold": np.full(trials, 0.5),
            "ctr_hold_bump": bump,
            "go_cue_time": np.where(bump, np.nan, start + 0.9),
            "result": np.where(np.arange(trials) % 12 == 11, "F", "R"),
            "target_dir": direction,
            "target_on_time": start + 0.3,
        }
    spans = np.array([[0.0, start[trials // 2 - 1] + 3], [start[trials // 2] - 3, start[-1] + 3]])
    events = np.where(bump, start + 1.18, onset)
    spikes = []
    for _ in range(units):
        times = answer(random, events[np.isfinite(events)], float(spans[-1, 1]), rate=12.0)
        spikes.append(times[((times[:, None] >= spans[:, 0]) & (times[:, None] < spans[:, 1])).any(axis=1)])
    with h5py.File(path, "w") as file:
        _base(file, subject="Han", identifier="c32b334c-0b8e-11ec-b9b7-0bfeb2c344ea")
        file.create_dataset("general/session_id", data="20171207", dtype=TEXT)
        _table(file, "intervals/trials", "TimeIntervals", columns, np.arange(trials))
        numbers, kinds = np.arange(units), (np.uint32, np.uint16, np.uint8)
        _units(file, spikes, spans, numbers * 10 + 1, 1, kinds, heldout=numbers % 4 == 3)
    return spikes, columns


WRITERS = {"yu": write_yu, "hires": write_hires, "area2-bump": write_area2}


@pytest.fixture(params=WRITERS)
def layout(request, tmp_path):
    path = tmp_path / "sub-x_ses-20200101.nwb"
    return request.param, path, WRITERS[request.param](path)


def test_each_layout_is_detected_read_and_declared_healthy(layout):
    name, path, _ = layout
    dataset = open_recordings(path)
    assert dataset.attrs["layout"] == f"{name} (detected from its columns)"
    checkup = check(path)
    assert checkup.count("error") == 0, str(checkup)
    assert "spikes answer touch" in str(checkup)
    assert inspect(path).layout == name
    assert inspect(path).sessions[0].units.spikes > 0
    assert get_layout(name).dandiset in get_layout(name).title


def test_copies_of_each_layout_are_small_and_equal(layout, tmp_path):
    name, path, _ = layout
    for suffix in (".nwb", ".h5"):
        (copy,) = export(path, tmp_path / f"copy{suffix}")
        one, two = open_recordings(path, bin=0.1), open_recordings(copy, bin=0.1)
        xr.testing.assert_identical(one.drop_attrs(), two.drop_attrs())
        assert two.attrs["layout"] == f"{name} (detected from its columns)"
        assert one.attrs["content_hash"] == two.attrs["content_hash"]


@pytest.mark.filterwarnings("ignore")
def test_copies_of_each_layout_are_valid_for_pynwb(layout, tmp_path):
    pynwb = pytest.importorskip("pynwb")
    (copy,) = export(layout[1], tmp_path / "copy.nwb")
    assert list(pynwb.validate(path=str(copy))) == []


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
