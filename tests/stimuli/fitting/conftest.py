"""A ring-down and two fits of it, made once."""

from __future__ import annotations

import pytest

from brainbench.stimuli.fitting import Trial, fit
from tests.factories.whisker_measurements import KNOWN, QUICK, ringdown_shapes, ringdown_wrenches, simulate_ringdown


@pytest.fixture(scope="session")
def rung():
    """A plucked whisker and its simulation."""
    return simulate_ringdown()


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
