"""Files as ``temporaldata`` 0.1.6 writes them, without that package."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

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
