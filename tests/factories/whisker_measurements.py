"""Synthetic measurements: what sensors and trackers would have written of a simulated whisker, with noise.

A trial is simulated at a finer setting than a fit uses, and read with white noise. Tests fit that of a plucked whisker.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError
from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting.model import FitModel
from brainbench.stimuli.fitting.parameters import FitOptions, FreeParameters
from brainbench.stimuli.fitting.trials import Trial
from brainbench.stimuli.tracks.contract import new_shapes, new_wrenches
from brainbench.stimuli.whiskers.whisker import Whisker, build_chain

if TYPE_CHECKING:
    import xarray as xr

    from brainbench.stimuli.motion.jobs import Trace

FINE = FitOptions(links=40, steps_per_period=1000.0)
"""Setting of the simulated truth."""


def blank_wrenches(times: ArrayLike) -> xr.Dataset:
    """Return wrenches of ones at times [n] (s): the place of a measurement in a trial that is still to be simulated."""
    times = np.asarray(times, dtype=float)
    return new_wrenches(times, np.ones((len(times), 6)))


def simulate_trial(trial: Trial, *, options: FitOptions = FINE) -> Trace:
    """Simulate a trial as it stands, with its shapes."""
    model = FitModel([trial], FreeParameters(("young_modulus",), trial.condition), options)
    (trace,) = model.run(np.zeros(1)).traces
    if trace.status != "ok":
        raise DataError(f"The simulated trial is unstable: {trace.reason}.")
    return trace


def measure_wrenches(trial: Trial, trace: Trace, relative_noise: float, rng: np.random.Generator) -> Trial:
    """Return a trial with the base wrenches of a simulation, read with white noise.

    ``relative_noise`` is the standard deviation over the largest force, or moment, of the whole trace; components that
    stay below a thousandth of it are not measured.
    """
    wrench = trace.wrench
    sizes = np.abs(wrench).max(axis=0)
    scale = np.repeat([sizes[:3].max(), sizes[3:].max()], 3)
    kept = np.flatnonzero(sizes > 1e-3 * scale)
    values = wrench[:, kept] + rng.normal(size=(len(wrench), len(kept))) * relative_noise * scale[kept]
    channels = [CHANNELS[index] for index in kept]
    return replace(trial, measured=new_wrenches(trial.job.times, values, channels))


def measure_shapes(
    trial: Trial,
    trace: Trace,
    whisker: Whisker,
    noise: float,
    rng: np.random.Generator,
    *,
    points: int = 12,
) -> Trial:
    """Return a trial with traced shapes of a simulation: points evenly spaced on 95 % of it, with noise (m)."""
    places = sample_shape(trace, whisker, np.linspace(0.0, 0.95 * whisker.arc_length, points))[..., :2]
    return replace(trial, measured=new_shapes(trial.job.times, places + rng.normal(size=places.shape) * noise))


def sample_shape(trace: Trace, whisker: Whisker, arcs: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the points [n, k, 3] (m) of a simulated shape at arc lengths [k] (m)."""
    from scipy.interpolate import CubicSpline

    assert trace.link_positions is not None
    nodes = build_chain(whisker, trace.link_positions.shape[1] - 1).nodes
    return CubicSpline(nodes, trace.link_positions, axis=1)(arcs)


KNOWN = replace(WhiskerArray.of("mouse")["C2"].whisker, damping_ratio=0.15)
TRUTH = replace(KNOWN, young_modulus=3.5e9, damping_ratio=0.2)
PERIOD = 1 / float(references.natural_frequencies(KNOWN, 1)[0])
QUICK = FitOptions(links=8, steps_per_period=80.0)
SAME = FitOptions(links=8, steps_per_period=4.0, time_step=PERIOD / 80)
"""The setting of QUICK for a truth whose period is another: the same time step."""


def simulate_ringdown():
    """Return the trial of a pluck by 1 mm that is read sixty times in four periods, and its simulation."""
    trial = Trial.ringdown(TRUTH, blank_wrenches(np.arange(1, 61) * PERIOD / 15), 1e-3)
    return trial, simulate_trial(trial, options=SAME)


def ringdown_wrenches(rung, noise=0.01, seed=0):
    trial, trace = rung
    return measure_wrenches(trial, trace, noise, np.random.default_rng(seed)).measured


def ringdown_shapes(rung, seed=0):
    trial, trace = rung
    return measure_shapes(trial, trace, TRUTH, 20e-6, np.random.default_rng(seed)).measured


def write_ringdown(path):
    """Write its wrenches, with 1 % noise, as a laboratory would: in mN and µN·m."""
    measured = ringdown_wrenches(simulate_ringdown())
    names = [str(name) for name in measured["channel"].values]
    head = ",".join(["time_ms", *(f"{name}_mN" if name[0] == "F" else f"{name}_uNm" for name in names)])
    factor = [1e3 if name[0] == "F" else 1e6 for name in names]
    table = np.column_stack([1e3 * measured["time"].values, measured["wrench"].values * factor])
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")
    return path
