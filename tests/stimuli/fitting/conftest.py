"""A ring-down and two fits of it, made once."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.stimuli.fitting import Trial, fit
from tests.factories.fitted_ringdown import KNOWN, PERIOD, QUICK, SAME, TRUTH, ringdown_shapes, ringdown_wrenches
from tests.factories.whisker_measurements import blank_wrenches, simulate_trial


@pytest.fixture(scope="session")
def rung():
    """A plucked whisker and its simulation."""
    times = np.arange(1, 61) * PERIOD / 15
    trial = Trial.ringdown(TRUTH, blank_wrenches(times), 1e-3)
    return trial, simulate_trial(trial, options=SAME)


@pytest.fixture(scope="session")
def pulled(rung):
    """The measured wrenches and their fit."""
    trial = Trial.ringdown(KNOWN, ringdown_wrenches(rung), 8e-4)
    return trial, fit(trial, ["young_modulus", "damping_ratio", "deflection"], options=QUICK)


@pytest.fixture(scope="session")
def traced(rung):
    """The traced shapes and their fit."""
    trial = Trial.ringdown(KNOWN, ringdown_shapes(rung), 8e-4)
    return trial, fit(trial, ["young_modulus", "density", "damping_ratio", "deflection"], options=QUICK)
