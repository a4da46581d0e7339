"""Trials: what was measured, with a pluck or a scene, and what cannot be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, UsageError
from brainbench.core.rotations import euler_matrix
from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import FitOptions, Trial, fit, new_shapes, new_wrenches
from brainbench.stimuli.fitting.model import Readings
from brainbench.stimuli.fitting.parameters import Condition
from brainbench.stimuli.fitting.trials import Pluck, to_frame
from tests.factories.fitted_ringdown import KNOWN, ringdown_wrenches
from tests.factories.whisker_measurements import blank_wrenches, measure_wrenches, simulate_trial


def test_the_direction_of_a_pluck_has_no_length():
    whisker = WhiskerArray.mouse()["C2"].whisker
    condition = Condition(whisker, {"deflection": 1e-3})
    unit, long = (
        Pluck(1e-3, 0.01, direction).loads(condition, -0.1) for direction in ((0.0, 0.6, 0.8), (0.0, 3.0, 4.0))
    )
    assert [load.force for load in long] == [pytest.approx(load.force) for load in unit]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"arc": 0.0}, "arc length"),
        ({"arc": 30.0}, "arc length"),
        ({"deflection": 0.0}, "deflection"),
        ({"deflection": np.nan}, "deflection"),
        ({"direction": (0.0, 0.0, 0.0)}, "direction"),
    ],
)
def test_a_pluck_that_holds_nothing_is_refused(changes, said):
    given = {"deflection": 1e-3, **changes}
    with pytest.raises(UsageError, match=said):
        Trial.ringdown(KNOWN, blank_wrenches(np.arange(1, 50) * 2e-4), **given)


def test_columns_of_wrenches_come_in_any_order():
    axes, values = euler_matrix((0.3, -0.2, 0.5)), np.arange(18.0).reshape(3, 6)
    levels, order = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), [0, 3, 1, 4, 2, 5]
    whole = new_wrenches(np.arange(3.0), values, noise=levels)
    mixed = new_wrenches(np.arange(3.0), values[:, order], [CHANNELS[i] for i in order], noise=levels[order])
    expected, found = (to_frame(one, axes, np.zeros(3)) for one in (whole, mixed))
    np.testing.assert_allclose(expected["wrench"].values, (values.reshape(3, 2, 3) @ axes).reshape(3, 6))
    # Turned noise of variances that differ: those of the turned components.
    np.testing.assert_allclose(expected["noise"].values[:3], np.sqrt(np.diag(axes.T @ np.diag([1, 4, 9]) @ axes)))
    xr.testing.assert_allclose(found, expected)
    with pytest.raises(UsageError, match="My is missing"):
        to_frame(new_wrenches(np.arange(3.0), values[:, :4], CHANNELS[:4]), axes, np.zeros(3))


def test_trials_agree_on_the_noise_of_a_channel(rung):
    trial = Trial.ringdown(KNOWN, ringdown_wrenches(rung).assign(noise=("channel", [1e-6, 1e-6, 1e-8])), 1e-3)
    other = replace(trial, measured=trial.measured.assign(noise=("channel", [2e-6, 1e-6, 1e-8])))
    Readings.of([trial, trial])
    with pytest.raises(DataError, match="different noise"):
        Readings.of([trial, other])


def test_too_few_frames_readings_and_long_shapes_are_refused():
    with pytest.raises(DataError, match="at least 3"):
        Trial.ringdown(KNOWN, new_wrenches([1e-3, 2e-3], np.ones((2, 1)), ["Mz"]), 1e-3)
    trial = Trial.ringdown(KNOWN, new_wrenches(np.arange(1, 4) * 1e-3, np.ones((3, 1)), ["Mz"]), 1e-3)
    with pytest.raises(DataError, match="cannot tell"):
        fit(trial, ["young_modulus", "density", "damping_ratio", "deflection"])
    shapes = np.tile(np.linspace(0, 0.02, 5)[None, :, None] * [1, 0], (4, 1, 1))
    with pytest.raises(DataError, match="20 mm long"):
        Trial.ringdown(KNOWN, new_shapes(np.arange(1, 5) * 1e-3, shapes), 1e-3)


WHISKER = replace(WhiskerArray.of("mouse")["C2"].whisker, damping_ratio=0.2)
PERIOD = 1 / float(references.natural_frequencies(WHISKER, 1)[0])
QUICK = FitOptions(links=6, steps_per_period=60.0)


@pytest.fixture(scope="module")
def measured():
    trial = Trial.ringdown(WHISKER, blank_wrenches(np.arange(1, 41) * PERIOD / 12), 1e-3)
    return measure_wrenches(trial, simulate_trial(trial, options=QUICK), 0.01, np.random.default_rng(0)).measured


@pytest.mark.parametrize(
    ("times", "told"),
    [(lambda t: 1e3 * t, "time_ms"), (lambda t: 1e-3 * t, "swings with"), (lambda t: t + 3.0, "nothing is left")],
    ids=["milliseconds", "kiloseconds", "another origin"],
)
def test_a_wrong_clock_is_refused(measured, times, told: str):
    changed = new_wrenches(times(measured["time"].values), measured["wrench"].values, measured["channel"].values)
    with pytest.raises(DataError, match=told):
        Trial.ringdown(WHISKER, changed, 1e-3)


def test_a_whisker_in_millimetres_is_refused(measured):
    with pytest.raises(DataError, match="SI units"):
        Trial.ringdown(replace(WHISKER, arc_length=1e3 * WHISKER.arc_length), measured, 1e-3)
