"""Recording files with known content: a small NWB file, and sessions in the layout of Rodgers 2022."""

from __future__ import annotations

import h5py
import numpy as np

from brainbench.datasets import write_recordings
from brainbench.datasets.nwb_writer import NwbWriter
from brainbench.datasets.sessions import make_session

HUMAN = "pynapple_sub-4_ses-4_ecephys+image.nwb"
"""A file of human recordings among the private reference data."""
ROWS = 14
"""Trials of :func:`write_rodgers`."""


def write_nwb(path, *, subject="m1", session="s1", keywords=("touch",), units=True, identifier=None, description="d"):
    """A small NWB file: six trials of two textures, one unit, and a table inside a processing module."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        writer = NwbWriter(
            file,
            identifier=identifier or path.name,
            description=description,
            start="2020-01-01T00:00:00+00:00",
            general={"session_id": session, "keywords": list(keywords)} if session else {"keywords": list(keywords)},
            subject={"subject_id": subject} if subject else {"species": "Mus musculus"},
        )
        start = np.arange(6.0)
        columns = {
            "start_time": ("s", start),
            "stop_time": ("s", start + 0.5),
            "texture": ("P", np.resize(np.array(["P100", "P20"]), 6)),
            "tags": ("list", [np.array([1.0, 2.0])] * 6),
        }
        writer.table("intervals/trials", "TimeIntervals", "trials", np.arange(6) * 2, columns)
        side = {**columns, "side": ("s", np.resize(np.array([1, 2]), 6))}
        writer.table("processing/behavior/pokes", "TimeIntervals", "pokes", np.arange(6), side)
        if units:
            spikes = [np.arange(0.0, 6.0, 0.05)]
            writer.table("units", "Units", "units", np.array([17]), {"spike_times": ("s", spikes)})
    return path


def write_rodgers(path, *, contacts=True, lost=(), subject="231CR", units=None, **columns):
    """Fourteen trials of 10 s in the layout of Rodgers 2022; contact after 2 s, choice after 3 s."""
    start = 10.0 * np.arange(ROWS)
    trials = {
        "id": np.arange(ROWS) * 2 + 30,
        "start_time": start,
        "stop_time": start + 10,
        "stimulus": np.resize(np.repeat(["convex", "concave"], 3), ROWS),
        "servo_position": np.resize(np.array(["far", "medium", "close"]), ROWS),
        "outcome": np.full(ROWS, "correct"),
        "choice_time": start + 3,
        "direct_delivery": np.zeros(ROWS, dtype=bool),
        "stim_is_random": np.ones(ROWS, dtype=bool),
        "optogenetic": np.zeros(ROWS, dtype=bool),
        "ignore_trial": np.zeros(ROWS, dtype=bool),
    } | {name: np.asarray(values) for name, values in columns.items()}
    tables = {"trials": {name: values for name, values in trials.items() if values.ndim}}
    if contacts:
        tables["contacts_by_whisker_C1"] = {"start_time": start + 2.0, "stop_time": start + 2.1}
        tables["contacts_by_whisker_C2"] = {"start_time": start + 2.5, "stop_time": start + 2.5}
    tables = {name: table for name, table in tables.items() if name[-2:] not in lost}
    spikes = [np.arange(0.0, 10.0 * ROWS, 0.1) - 0.01] * (len(units["layer"]) if units else 1)
    return write_recordings(path, make_session(subject, "1", spikes, tables, unit_columns=units))


def detection(**columns):
    """Every seventh trial without a shape: its position means nothing."""
    stimulus = np.resize(np.array([*["convex"] * 3, *["concave"] * 3, "nothing"]), ROWS)
    return {"stimulus": stimulus, "servo_position": np.resize(np.array(["far", "medium", "close"]), ROWS), **columns}
