"""Results of fits: combinations that the data tell, and a summary for JSON."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError
from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import FitOptions, Trial, fit, new_wrenches
from brainbench.stimuli.fitting.model import Readings
from brainbench.stimuli.fitting.result import ALPHA, check_residuals, directions, failed_words, unknown_parameters
from tests.factories.whisker_measurements import blank_wrenches, measure_wrenches, simulate_trial

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


@pytest.mark.slow
def test_a_component_that_reads_zero_though_the_whisker_acts_there_is_said(measured):
    good, bad = _fit(measured), _fit(_changed(measured, zero="Fy"))
    assert (good.status, bad.status) == ("ok", "unreliable")
    assert any("'Fy' is zero throughout" in reason for reason in bad.reasons)
    assert bad["young_modulus"].value == pytest.approx(good["young_modulus"].value, rel=0.02)


@pytest.mark.slow
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


def _readings(instants, points, noise=np.nan):
    place = np.stack(np.meshgrid(np.arange(instants), np.arange(points), [0], indexing="ij"), axis=-1).reshape(-1, 3)
    count = len(place)
    return Readings(
        np.zeros(count, dtype=int), place, np.zeros(count, dtype=int), ("shape",), np.array([noise]), np.ones(1)
    )


def _fitted(rng, readings, signal=0.0):
    """Return the residuals of a linear fit with smooth columns, and its Jacobian."""
    t = readings.place[:, 0] / readings.place[:, 0].max()
    jacobian = np.stack([np.ones_like(t), t, np.sin(6 * t), np.cos(6 * t)], axis=1)
    basis, _ = np.linalg.qr(jacobian)
    noise = rng.normal(size=len(t)) + signal * np.sin(20 * t)
    return noise - basis @ (basis.T @ noise), jacobian


@pytest.mark.slow
@pytest.mark.parametrize(("instants", "points"), [(40, 1), (30, 8)])
def test_white_noise_fails_no_more_often_than_asked_for(instants, points):
    rng, readings = np.random.default_rng(0), _readings(instants, points)
    found = [check_residuals(*_fitted(rng, readings), readings) for _ in range(1500)]
    failed = np.mean([any(not test.passed for test in tests) for tests in found])
    assert failed < 2.5 * ALPHA
    # Short series of a fit with as many parameters: without the projection the mean would be −.6.
    assert abs(np.mean([tests[0].statistic for tests in found])) < 0.15
    assert np.std([tests[0].statistic for tests in found]) == pytest.approx(1, abs=0.1)


def test_a_signal_below_the_noise_that_all_points_share_is_found():
    rng, readings = np.random.default_rng(1), _readings(60, 6)
    found = [check_residuals(*_fitted(rng, readings, 0.8), readings) for _ in range(50)]
    assert np.mean([any(not test.passed for test in tests) for tests in found]) > 0.9
    assert "same sign" in failed_words(found[0])[0]


@pytest.mark.parametrize("each", [3, 4, 8])
def test_residuals_that_swing_are_found_however_few_readings_a_swing_has(each):
    rng, readings = np.random.default_rng(3), _readings(60, 1)
    residual, jacobian = _fitted(rng, readings)
    swing = np.cos(2 * np.pi * np.arange(60) / each + 0.5)
    tests = {test.what: test.passed for test in check_residuals(residual + 1.5 * swing, jacobian, readings)}
    assert tests == {"time": True, "swing": False}


def test_residuals_beyond_repeat_noise_are_found_and_within_it_are_not():
    rng, readings = np.random.default_rng(2), _readings(100, 1, noise=1.0)
    residual, jacobian = _fitted(rng, readings)
    assert all(test.passed for test in check_residuals(residual, jacobian, readings))
    size = next(test for test in check_residuals(1.4 * residual, jacobian, readings) if test.what == "size")
    assert not size.passed


def test_a_product_that_the_data_tell_leaves_its_factors_open():
    """Data that depend on E r⁴ alone: E × 1.1 is made up for by r × 1.1^(−1/4)."""
    column = np.linspace(1, 2, 30)[:, None] * 50
    found = directions(column * np.array([[1.0, 4.0]]), ("young_modulus", "base_radius"))
    assert [one.identified for one in found] == [False, True]
    assert "young_modulus × 1.1 together with base_radius × 0.976" in found[0].words
    assert set(unknown_parameters(found)) == {"young_modulus", "base_radius"}
    assert math.isinf(found[0].deviation)


def test_a_parameter_without_effect_is_named_alone():
    jacobian = np.stack([np.full(20, 30.0), np.full(20, 1e-9), np.linspace(-30, 30, 20)], axis=1)
    found = directions(jacobian, ("young_modulus", "friction", "object_x"))
    assert found[0].words == "The data hardly depend on friction."
    assert set(unknown_parameters(found)) == {"friction"}


def test_the_summary_is_plain(traced):
    import json

    from brainbench.core.files import to_json

    data = json.loads(to_json(traced[1].summary()))
    assert data["status"] == "undefined"
    assert data["directions"][0]["deviation"] is None or data["directions"][0]["deviation"] > 1
    assert data["provenance"]["simulated_whiskers"] > 5


@pytest.mark.parametrize("kind", ["pulled", "traced"])
def test_a_fit_is_drawn(request, tmp_path, kind):
    from PIL import Image

    from brainbench.stimuli.fitting.result import draw_fit

    path = draw_fit(*request.getfixturevalue(kind), tmp_path / "fit.png")
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    # The colour of the first series is on it, and most of it is white.
    assert (np.abs(pixels.astype(int) - [0, 114, 178]).sum(axis=1) < 40).sum() > 50
    assert 0.5 < np.mean(pixels.min(axis=1) > 250) < 0.99
