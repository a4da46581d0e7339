"""Tests of residuals: their false alarms are as rare as asked for, and serial correlation is found."""

from __future__ import annotations

import numpy as np
import pytest

from brainbench.stimuli.fitting.model import Readings
from brainbench.stimuli.fitting.residual_tests import ALPHA, check_residuals, failed_words


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
