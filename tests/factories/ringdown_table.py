"""A table of base wrenches of a plucked whisker, as a laboratory would write it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import FitOptions, Trial
from tests.factories.whisker_measurements import blank_wrenches, measure_wrenches, simulate_trial


def write_ringdown(path: Path) -> Path:
    """Write the ring-down of mouse whisker C2, of 4 GPa, damping ratio .2 and 1 mm, with 1 % noise, in mN and µN·m."""
    published = WhiskerArray.of("mouse")["C2"].whisker
    period = 1 / float(references.natural_frequencies(published, 1)[0])
    truth = replace(published, young_modulus=4e9, damping_ratio=0.2)
    trial = Trial.ringdown(truth, blank_wrenches(np.arange(1, 61) * period / 15), 1e-3)
    trace = simulate_trial(trial, options=FitOptions(links=8, steps_per_period=4.0, time_step=period / 80))
    measured = measure_wrenches(trial, trace, 0.01, np.random.default_rng(0)).measured
    names = [str(name) for name in measured["channel"].values]
    head = ",".join(["time_ms", *(f"{name}_mN" if name[0] == "F" else f"{name}_uNm" for name in names)])
    factor = [1e3 if name[0] == "F" else 1e6 for name in names]
    table = np.column_stack([1e3 * measured["time"].values, measured["wrench"].values * factor])
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9g")
    return path
