"""Small files with the layout of public data sets: names, types and containers as listed for the real ones.

DANDI 000005 and 000013: ``/acquisition`` containers, ``/intervals/trials`` columns and their types
(int32, float64, text), ``/units`` with doubly indexed electrodes and waveforms. DANDI 000127: the
training file with its segments in ``obs_intervals`` (uint columns, NaN times), and the test file.
"""

from __future__ import annotations

import h5py
import numpy as np

TEXT = h5py.string_dtype()


def _base(file, *, subject, identifier, description=""):
    file.attrs.update({"namespace": "core", "neurodata_type": "NWBFile", "nwb_version": "2.2.1"})
    for name, value in (
        ("identifier", identifier),
        ("session_description", description),
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


def make_pole_task(trials=24, seed=0):
    """Times of a pole task: trials, the pole, touches (30 ms long), and one neuron that answers them after 12 ms."""
    random = np.random.default_rng(seed)
    start = np.round(2.0 + np.cumsum(random.uniform(4.5, 6.5, trials)), 3)
    pole_in, pole_out = start + 0.5, start + 2.5
    go = np.arange(trials) % 2 == 0
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
        "stim_present": (np.arange(trials) % 8 == 7).astype(np.int32),
        "pole_position": np.where(go, 1.2, 5.4) + np.arange(trials) % 4 * 0.1,
        "pole_in_time": pole_in,
        "pole_out_time": pole_out,
        "first_lick_time": np.where(go, pole_in + 1.9, np.nan),
    }
    return columns, touches


def answer(random, touches, end, rate=5.0, times=4):
    """Spike times: background, and several spikes about 12 ms after each touch."""
    late = (touches[:, None] + 0.012 + 0.003 * random.standard_normal((len(touches), times))).ravel()
    spikes = np.unique(np.round(np.concatenate([late, random.uniform(0, end, int(rate * end))]), 4))
    return spikes[np.diff(spikes, prepend=-1.0) > 0.002]


def write_yu(path, *, trials=24, units=5):
    """DANDI 000005, silicon probe in VPM: two whiskers, units with electrodes and waveforms."""
    random = np.random.default_rng(1)
    columns, touches = make_pole_task(trials)
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
        _table(file, "intervals/trials", "TimeIntervals", columns, np.arange(trials) + 2)
        spikes = [answer(random, touches, end) for _ in range(units)]
        more = {
            "cell_desc": np.full(units, "N/A"),
            "sampling_rate": np.full(units, 19531.0),
            "waveform_mean": random.standard_normal((units, 25, 8)).astype(np.float32),
        }
        group = _units(file, spikes, [[0.0, end]], np.arange(units), 8, (np.int32,) * 3, **more)
        group["electrodes"].attrs["neurodata_type"] = "DynamicTableRegion"
    return spikes, touches


def write_hires(path, *, trials=24, cell="AH0040_AAAA"):
    """DANDI 000013: one cell, spikes as a 0/1 PatchClampSeries sampled in trials only, no units table."""
    random = np.random.default_rng(2)
    columns, touches = make_pole_task(trials)
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
        electrode = file.create_group(f"general/intracellular_ephys/{cell}")
        electrode.attrs["neurodata_type"] = "IntracellularElectrode"
        for name, kind, data in (
            ("CurrentClampSeries", "CurrentClampSeries", random.standard_normal(len(stamps)).astype(np.float32)),
            ("SpikeTrain", "PatchClampSeries", train),
        ):
            _series(file, f"acquisition/{name}", data, stamps, kind)["electrode"] = h5py.SoftLink(electrode.name)
        signals = ("amplitude", "phase", "theta_at_base", "distance_to_pole", "pole_available")
        _behavior(file, "behavior", touches, slow, signals, random)
        _table(file, "intervals/trials", "TimeIntervals", columns, np.arange(trials) + 1)
    return stamps[where], touches


def write_area2(path, *, trials=96, units=6, test=False):
    """DANDI 000127: the training file (segments, directions, results) or the one of test trials."""
    random = np.random.default_rng(3)
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
