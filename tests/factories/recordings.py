"""Small sessions with known content, for the tests of this package."""

from __future__ import annotations

import numpy as np

from brainbench.datasets.sessions import Session, make_session
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
