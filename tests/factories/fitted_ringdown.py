"""A plucked whisker, its readings, and the settings with which tests fit it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import FitOptions
from tests.factories.whisker_measurements import measure_shapes, measure_wrenches

KNOWN = replace(WhiskerArray.of("mouse")["C2"].whisker, damping_ratio=0.15)
TRUTH = replace(KNOWN, young_modulus=3.5e9, damping_ratio=0.2)
PERIOD = 1 / float(references.natural_frequencies(KNOWN, 1)[0])
QUICK = FitOptions(links=8, steps_per_period=80.0)
SAME = FitOptions(links=8, steps_per_period=4.0, time_step=PERIOD / 80)
"""The setting of QUICK for a truth whose period is another: the same time step."""


def ringdown_wrenches(rung, noise=0.01, seed=0):
    trial, trace = rung
    return measure_wrenches(trial, trace, noise, np.random.default_rng(seed)).measured


def ringdown_shapes(rung, seed=0):
    trial, trace = rung
    return measure_shapes(trial, trace, TRUTH, 20e-6, np.random.default_rng(seed)).measured
