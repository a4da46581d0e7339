"""Parameters of a fit: set and read, refused where they make no sense, and their priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.fitting import FitOptions, Trial, fit
from brainbench.stimuli.fitting.parameters import PARAMETERS, PUBLISHED, FreeParameters, Prior
from tests.factories.fitted_ringdown import KNOWN
from tests.factories.whisker_measurements import blank_wrenches


def test_profiles_follow_squares_alone():
    with pytest.raises(UsageError, match=r"'huber'.*intervals = 'laplace'"):
        FitOptions(intervals="profile", loss="huber")


@pytest.mark.parametrize("name", [name for name in PARAMETERS if name != "deflection"])
def test_every_parameter_is_set_and_read(name):
    trial = Trial.ringdown(KNOWN, blank_wrenches(np.arange(1, 9) * 1e-3), 1e-3)
    value = trial.condition[name] * 1.1 + (0.0 if PARAMETERS[name].kind == "log" else 1e-4)
    assert trial.condition.changed({name: value})[name] == pytest.approx(value)
    free = FreeParameters((name,), trial.condition)
    assert free.condition([0.3])[name] == pytest.approx(free.values([0.3])[0])
    low, high = free.limits()
    assert low[0] < 0 < high[0]


def test_unknown_names_and_bad_starts_are_refused():
    trial = Trial.ringdown(KNOWN, blank_wrenches(np.arange(1, 9) * 1e-3), 1e-3)
    with pytest.raises(UsageError, match="young_modulus"):
        fit(trial, ["young_moduls"])
    with pytest.raises(UsageError, match="between its bounds"):
        FreeParameters(("young_modulus",), trial.condition, {"young_modulus": (6e9, 9e9)}).limits()
    with pytest.raises(UsageError, match="laplace"):
        FitOptions(intervals="laplac")
    with pytest.raises(UsageError, match="with bounds 'density'"):
        fit(trial, ["young_modulus"], bounds={"density": (1000.0, 2000.0)})
    with pytest.raises(UsageError, match="with a prior 'density'"):
        fit(trial, ["young_modulus"], priors={"density": PUBLISHED["density"]})
    with pytest.raises(UsageError, match="time_step"):
        FitOptions(time_step=-1e-4)
    with pytest.raises(UsageError, match="the loss 'huber'"):
        FitOptions(loss="huber", intervals="profile")
    with pytest.raises(DataError, match="noise"):
        Trial.ringdown(KNOWN, trial.measured.assign(noise=-1e-6), 1e-3)
    still = Trial(replace(trial.job, loads=()), trial.measured)
    with pytest.raises(UsageError, match="ring-down"):
        FreeParameters(("deflection",), still.condition)


@pytest.mark.parametrize(("mean", "spread"), [(np.nan, 0.1), (-3e9, 0.1), (3e9, 0.0), (3e9, -0.1), (3e9, np.nan)])
def test_priors_are_normal_laws(mean, spread):
    with pytest.raises(UsageError, match=r"of (a|the) prior"):
        Prior(mean, spread, "the test").row("young_modulus", 3e9, KNOWN)
