"""Small sessions with known content, and files of recordings: NWB, and the layout of Rodgers 2022."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np

from brainbench.datasets import write_recordings
from brainbench.datasets.nwb import write_nwb as save_nwb
from brainbench.datasets.sessions import SPIKES, Session, SessionTable, make_session, ragged
from brainbench.datasets.synthetic import PopulationDesign
from brainbench.datasets.synthetic.populations import draw_sessions, spike_session
from brainbench.datasets.trials.counting import ReadingOptions, count_session
from brainbench.datasets.trials.selection import EVERYTHING, Conditions, Window
from brainbench.datasets.trials.session_trials import join_sessions

LABELS = ("convex-close", "convex-medium", "convex-far", "concave-close", "concave-medium", "concave-far")


def make_simple_session(
    *, subject: str = "mouse", session: str = "1", trials: int = 12, units: int = 3, seed: int = 0, **options
) -> Session:
    """Regular trials of 1 s every 2 s, stimulus by turns, Poisson spikes of its own over the whole session."""
    random = np.random.default_rng(
        [seed, *f"{subject}/{session}".encode()] if (subject, session) != ("mouse", "1") else seed
    )
    start = 1.0 + 2.0 * np.arange(trials)
    table = {
        "start_time": start,
        "stop_time": start + 1.0,
        "stimulus": np.resize(np.array(["a", "b", "c"]), trials),
        "id": np.arange(trials) * 3 + 5,
    }
    spikes = [np.sort(random.uniform(0, 2.0 * trials + 2, 40 * trials)) for _ in range(units)]
    for times in spikes:
        times[0], times[-1] = 0.0, 2.0 * trials + 2
    tables = {"trials": table | options.pop("columns", {})} | options.pop("tables", {})
    return make_session(subject, session, spikes, tables, **options)


def quiet_design(**changes):
    """A design without any noise but Poisson's and without individual differences, apart from ``changes``."""
    quiet = {"animals": 11, "units": 40, "trials": 20, "rate": 8.0, "window": 1.0, "modulation": 0.3}
    return PopulationDesign(**{**quiet, "emphasis": 0.0, "dispersion": 0.0, "shared_gain": 0.0, **changes})


def make_sessions(geometry, design=None, *, seed=0):
    """Synthetic animals as sessions of spike times."""
    return [spike_session(geometry, drawn) for drawn in draw_sessions(geometry, design, seed)]


def as_recordings(geometry, design=None, *, seed=0):
    """Synthetic animals as a recordings data set, counted as files of the same seed are."""
    length = (design or PopulationDesign()).window
    window = Window("choice", offset=-length, length=length)
    options = ReadingOptions(Conditions("trials", ("stimulus",)), geometry.labels, EVERYTHING, window)
    counted = [count_session(session, options) for session in make_sessions(geometry, design, seed=seed)]
    return join_sessions(counted, options, source="synthetic", layout="", notes=[])


HUMAN = "pynapple_sub-4_ses-4_ecephys+image.nwb"
"""A file of human recordings among the private reference data."""
ROWS = 14
"""Trials of :func:`write_rodgers`."""


def write_nwb(path, *, subject="m1", session="s1", keywords=("touch",), units=True, identifier=None, description="d"):
    """A small NWB file: six trials of two textures, one unit, and a table inside a processing module."""
    start = np.arange(6.0)
    columns = {
        "start_time": start,
        "stop_time": start + 0.5,
        "texture": np.resize(np.array(["P100", "P20"]), 6),
        **ragged("tags", [np.array([1.0, 2.0])] * 6),
    }
    pokes = {**columns, "id": np.arange(6), "side": np.resize(np.array([1, 2]), 6)}
    tables = {
        name: SessionTable(name, data)
        for name, data in (("trials", {"id": np.arange(6) * 2, **columns}), ("behavior/pokes", pokes))
    }
    spikes = SessionTable("units", {"id": np.array([17]), **ragged(SPIKES, [np.arange(0.0, 6.0, 0.05)])})
    made = Session(subject or "", session or "", spikes, tables, identifier=identifier or path.name)
    made = replace(made, start="2020-01-01T00:00:00+00:00")
    stated = {"keywords": list(keywords)}
    save_nwb(path, made, description=description, general=stated, subject={"species": "Mus musculus"})
    with h5py.File(path, "a") as file:
        for name, there in (("general/subject/subject_id", subject), ("general/session_id", session), ("units", units)):
            if not there:
                del file[name]
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
