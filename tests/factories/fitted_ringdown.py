"""A plucked whisker, its readings, a table of them, and the settings with which tests fit it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import FitOptions, Trial
from tests.factories.whisker_measurements import blank_wrenches, measure_shapes, measure_wrenches, simulate_trial

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
