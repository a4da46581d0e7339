"""Wrenches of a wrong clock, unit or sign are refused or make a fit unreliable, as a dead channel does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import FitOptions, Trial, fit, new_wrenches
from brainbench.stimuli.fitting.synthetic import blank_wrenches, measure_wrenches, simulate_trial

WHISKER = replace(WhiskerArray.of("mouse")["C2"].whisker, damping_ratio=0.2)
PERIOD = 1 / float(references.natural_frequencies(WHISKER, 1)[0])
QUICK = FitOptions(links=6, steps_per_period=60.0)
FREE = ("young_modulus", "damping_ratio")


@pytest.fixture(scope="module")
def measured():
    trial = Trial.ringdown(WHISKER, blank_wrenches(np.arange(1, 41) * PERIOD / 12), 1e-3)
    return measure_wrenches(trial, simulate_trial(trial, options=QUICK), 0.01, np.random.default_rng(0)).measured


def _changed(measured, factor: float = 1.0, *, zero: str = ""):
    values = factor * measured["wrench"].values
    channels = measured["channel"].values.tolist()
    if zero:
        values[:, channels.index(zero)] = 0.0
    return new_wrenches(measured["time"].values, values, channels)


def _fit(changed):
    return fit(Trial.ringdown(WHISKER, changed, 1e-3), FREE, options=QUICK)


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_wrong_unit_is_refused(measured, factor: float):
    with pytest.raises(DataError, match="Fy_mN"):
        _fit(_changed(measured, factor))


def test_a_wrong_sign_is_refused(measured):
    with pytest.raises(DataError, match="opposite"):
        _fit(_changed(measured, -1.0))


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


def test_a_component_that_reads_zero_though_the_whisker_acts_there_is_said(measured):
    good, bad = _fit(measured), _fit(_changed(measured, zero="Fy"))
    assert (good.status, bad.status) == ("ok", "unreliable")
    assert any("'Fy' is zero throughout" in reason for reason in bad.reasons)
    assert bad["young_modulus"].value == pytest.approx(good["young_modulus"].value, rel=0.02)


def test_moments_of_another_unit_than_the_forces_are_said(measured):
    """Of 20 readings the forces tell the parameters, and the moments were taken for noise, with status ok."""
    few = measured.isel(time=slice(1, None, 2)).copy(deep=True)
    few["wrench"].values[:, [name[0] == "M" for name in few["channel"].values]] *= 10
    result = _fit(few)
    assert result.status == "unreliable"
    assert any("moments are" in reason and "units" in reason for reason in result.reasons)


@pytest.mark.parametrize(
    ("forces", "clock", "names", "told"),
    [
        (1 / 9.81, 1.0, (*FREE, "deflection"), "deflection"),
        (1.0, 0.5, (*FREE, "deflection"), "young_modulus"),
        (1.0, 2.0, ("density", "deflection"), "density"),
    ],
    ids=["kilograms", "half the frame rate", "twice the frame rate"],
)
def test_parameters_of_no_whisker_are_said(measured, forces, clock, names, told):
    changed = new_wrenches(
        clock * measured["time"].values, forces * measured["wrench"].values, measured["channel"].values
    )
    result = fit(Trial.ringdown(WHISKER, changed, 1e-3), names, options=QUICK)
    assert result.status == result[told].status == "unreliable"
    assert told in result[told].reason


def test_a_wire_whose_stiffness_is_beyond_whiskers_is_fitted(measured):
    wire = replace(WHISKER, young_modulus=4 * WHISKER.young_modulus)
    blank = Trial.ringdown(wire, blank_wrenches(measured["time"].values / 2), 1e-3)
    trial = measure_wrenches(blank, simulate_trial(blank, options=QUICK), 0.01, np.random.default_rng(0))
    assert fit(trial, FREE, options=QUICK).status == "ok"
