"""Intervals on models whose likelihood is known, and directions of known Jacobians in words."""

from __future__ import annotations

import math

import numpy as np
import pytest

from brainbench.stimuli import WhiskerArray
from brainbench.stimuli.fitting.identifiability import directions, unknown_parameters
from brainbench.stimuli.fitting.intervals import Profile, laplace_interval, quantile
from brainbench.stimuli.fitting.parameters import Condition, FreeParameters

FREE = FreeParameters(("young_modulus", "damping_ratio"), Condition(WhiskerArray.of("mouse")["C2"].whisker))
LIMITS = (np.full(2, -3.0), np.full(2, 3.0))


def _profile(residual, jacobian):
    best = np.zeros(2)
    covariance = np.linalg.inv(jacobian(best).T @ jacobian(best))
    return Profile(residual, jacobian, LIMITS, best, covariance, float(np.sum(residual(best) ** 2)), 1.0), covariance


def test_the_profile_of_a_linear_model_is_laplaces_interval():
    matrix = np.random.default_rng(0).normal(size=(40, 2)) * 10 + np.array([0, 5])
    profile, covariance = _profile(lambda u: matrix @ u, lambda u: matrix)
    t = quantile(0.95, math.inf)
    assert t == pytest.approx(1.959964, abs=1e-5)
    for index in (0, 1):
        deviation = math.sqrt(covariance[index, index])
        laplace = laplace_interval(FREE, index, np.zeros(2), deviation, 0.95, t)
        found = profile.interval(FREE, index, 0.95, t)
        assert found.low == pytest.approx(laplace.low, rel=0.02 * deviation)
        assert found.high == pytest.approx(laplace.high, rel=0.02 * deviation)


def test_the_profile_of_a_curved_model_is_lopsided_as_it_should_be():
    """S = (10 (exp(u) − 1))² falls off more slowly to the left: its ends are log(1 ± t/10)."""

    def residual(u):
        return np.array([10 * (math.exp(u[0]) - 1), 5 * u[1]])

    def jacobian(u):
        return np.array([[10 * math.exp(u[0]), 0.0], [0.0, 5.0]])

    profile, _ = _profile(residual, jacobian)
    found = profile.interval(FREE, 0, 0.95, 4.0)
    assert found.low == pytest.approx(5e9 * 0.6, rel=0.01)
    assert found.high == pytest.approx(5e9 * 1.4, rel=0.01)


def test_a_profile_that_never_falls_ends_at_the_bounds():
    profile, _ = _profile(lambda u: np.array([0.1 * u[0], 5 * u[1]]), lambda u: np.diag([0.1, 5.0]))
    found = profile.interval(FREE, 0, 0.95, 2.0)
    assert (found.low, found.high) == pytest.approx((5e9 * math.exp(-3), 5e9 * math.exp(3)))


def test_students_quantile_is_wider_for_few_readings():
    assert quantile(0.95, 5) == pytest.approx(2.5706, abs=1e-4)


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
