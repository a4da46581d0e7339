"""Small sessions and stimuli with known content, for the tests of this package."""

from __future__ import annotations

import numpy as np

from brainbench.core.contracts import CHANNELS
from brainbench.datasets.sessions import Session, make_session
from brainbench.datasets.synthetic import PopulationDesign
from brainbench.datasets.synthetic.populations import draw_sessions, spike_session
from brainbench.datasets.trials.counting import ReadingOptions, count_session
from brainbench.datasets.trials.selection import EVERYTHING, Conditions, Window
from brainbench.datasets.trials.session_trials import join_sessions

LABELS = ("convex-close", "convex-medium", "convex-far", "concave-close", "concave-medium", "concave-far")


def make_stimuli(seed: int = 0, whiskers: int = 30):
    """Whisking-like bursts of contact: six stimuli × 110 frames of 9 ms on the mouse's 30 whiskers."""
    import xarray as xr

    random = np.random.default_rng(seed)
    cells = [(row, col) for row, number in enumerate((5, 5, 7, 7, 6)) for col in range(number)][:whiskers]
    row, col = np.array(cells).T
    time = np.arange(110) * 0.009
    phase = np.sin(2 * np.pi * 20 * time)[None, :, None]
    shape, place = np.repeat([0, 1], 3)[:, None, None], np.tile([0.0, 1.0, 2.0], 2)[:, None, None]
    bulge = np.where(shape == 0, -((col - 1.5) ** 2), (col - 1.5) ** 2) * 0.12
    depth = np.maximum(phase * np.minimum(time / 0.2, 1.0)[None, :, None] - 0.1 - 0.2 * place - bulge - 0.05 * row, 0.0)
    direction = random.normal(size=(6, len(cells), 6)) + 2.0 * random.normal(size=(1, len(cells), 6))
    scale = np.array([1e-4] * 3 + [1e-6] * 3)
    wrench = depth[..., None] * direction[:, None] * scale + 1e-7 * scale * phase[..., None]
    return xr.Dataset(
        {
            "wrench": (("stimulus", "time", "whisker", "channel"), wrench.astype(np.float32)),
            "contact": (("stimulus", "time", "whisker"), depth > 0),
        },
        {
            "stimulus": list(LABELS),
            "time": time,
            "whisker": [f"{'ABCDE'[r]}{c}" for r, c in cells],
            "row": ("whisker", row),
            "col": ("whisker", col),
            "channel": list(CHANNELS),
        },
        dict.fromkeys(("array", "scene", "fidelity", "seed", "backend", "version"), "test")
        | {"content_hash": f"fake-{seed}-{whiskers}"},
    )


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
