"""Fits find the truth of simulated measurements, and say what they cannot tell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from brainbench.stimuli import WhiskerArray
from brainbench.stimuli.fitting import Trial, fit
from brainbench.stimuli.fitting.least_squares import Profile, laplace_interval, quantile
from brainbench.stimuli.fitting.model import FitModel
from brainbench.stimuli.fitting.parameters import Condition, FreeParameters
from tests.factories.whisker_measurements import (
    KNOWN,
    QUICK,
    TRUTH,
    blank_wrenches,
    measure_wrenches,
    ringdown_shapes,
    ringdown_wrenches,
    simulate_trial,
)

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


def test_stiffness_and_damping_of_a_ring_down_come_back(rung, pulled):
    _, result = pulled
    assert result.status == "ok"
    assert result["young_modulus"].value == pytest.approx(3.5e9, rel=0.02)
    assert result["damping_ratio"].value == pytest.approx(0.2, rel=0.02)
    assert result["deflection"].value == pytest.approx(1e-3, rel=0.05)
    assert result["young_modulus"].interval.low < 3.5e9 < result["young_modulus"].interval.high
    assert "forward" in result.provenance["jacobian"]
    assert result.noise["Mz"] == pytest.approx(0.01 * np.abs(rung[1].wrench[:, 5]).max(), rel=0.2)


def test_traced_shapes_tell_stiffness_over_density_and_not_both(traced):
    _, result = traced
    assert result.status == "undefined"
    assert {result[name].status for name in ("young_modulus", "density")} == {"undefined"}
    assert result["damping_ratio"].status == "ok"
    assert any("young_modulus" in reason and "density" in reason for reason in result.reasons)
    ratio = result["young_modulus"].value / result["density"].value
    assert ratio == pytest.approx(TRUTH.young_modulus / 1260, rel=0.03)


def test_a_prior_makes_an_estimate_of_what_the_data_do_not_tell_and_says_so(rung):
    trial = Trial.ringdown(KNOWN, ringdown_shapes(rung), 8e-4)
    names = ["young_modulus", "density", "damping_ratio", "deflection"]
    result = fit(trial, names, options=replace(QUICK, priors="published"))
    assert result.status == "unreliable"
    assert "prior" in result["density"].reason
    assert result["density"].value == pytest.approx(1260, rel=0.3)
    assert np.isfinite(result["density"].interval.high)


def test_a_cylinder_in_place_of_a_cone_is_noticed(rung):
    cylinder = replace(KNOWN, base_radius=3e-5, tip_radius=3e-5)
    result = fit(
        Trial.ringdown(cylinder, ringdown_shapes(rung), 8e-4),
        ["young_modulus", "damping_ratio", "deflection"],
        options=QUICK,
    )
    assert result.status == "unreliable"
    assert any(not test.passed for test in result.tests)
    assert any("does not fit" in reason for reason in result.reasons)


def test_a_parameter_at_its_bound_is_unreliable(rung):
    result = fit(
        Trial.ringdown(KNOWN, ringdown_wrenches(rung), 8e-4),
        ["young_modulus", "damping_ratio"],
        bounds={"young_modulus": (4e9, 6e9)},
        options=QUICK,
    )
    assert result["young_modulus"].status == "unreliable"
    assert "lower bound" in result["young_modulus"].reason


def test_a_fit_that_is_stopped_has_not_converged(rung):
    result = fit(
        Trial.ringdown(KNOWN, ringdown_wrenches(rung), 8e-4),
        ["young_modulus", "damping_ratio", "deflection"],
        options=replace(QUICK, most_iterations=2),
    )
    assert result.status == "undefined"
    assert "did not converge" in result.reasons[0]


def test_profile_intervals_agree_with_laplace_where_the_model_is_nearly_linear(rung):
    result = fit(
        Trial.ringdown(KNOWN, ringdown_wrenches(rung), 8e-4),
        ["young_modulus", "damping_ratio"],
        start={"deflection": 1e-3},
        options=replace(QUICK, intervals="profile"),
    )
    # The deflection that is not fitted is the given one, not that of the trial.
    assert result["damping_ratio"].value == pytest.approx(0.2, rel=0.02)
    assert result["young_modulus"].value == pytest.approx(3.5e9, rel=0.02)
    for one in result.estimates:
        assert one.profile is not None
        width = one.laplace.high - one.laplace.low
        assert one.profile.low == pytest.approx(one.laplace.low, abs=0.1 * width)
        assert one.profile.high == pytest.approx(one.laplace.high, abs=0.1 * width)


def test_gaps_are_left_out(rung):
    measured = ringdown_wrenches(rung).copy(deep=True)
    measured["wrench"].values[10:15] = np.nan
    result = fit(Trial.ringdown(KNOWN, measured, 1e-3), ["young_modulus", "damping_ratio", "deflection"], options=QUICK)
    assert result["young_modulus"].value == pytest.approx(3.5e9, rel=0.02)
    assert np.isnan(result.residuals[0][10:15]).all()


@pytest.mark.parametrize(("instants", "own"), [(3, False), (30, True)])
def test_a_channel_that_a_fit_could_follow_exactly_does_not_seem_free_of_noise(rung, instants, own):
    trial = Trial.ringdown(KNOWN, ringdown_wrenches(rung).isel(time=slice(instants)), 8e-4)
    model = FitModel([trial], FreeParameters(("young_modulus", "damping_ratio", "deflection"), trial.condition), QUICK)
    exact = model.readings.group == model.readings.groups.index("Mz")
    model.update_noise(np.where(exact, 1e-6, 0.1), model.sigma.copy())
    noise = dict(zip(model.readings.groups, model.sigma / model.readings.size, strict=True))
    assert (noise["Mz"] < 1e-4) == own


@pytest.mark.slow
def test_an_outlier_pulls_a_robust_fit_less(rung):
    measured = ringdown_wrenches(rung).copy(deep=True)
    measured["wrench"].values[::9] *= -2
    names = ["young_modulus", "damping_ratio", "deflection"]
    trial = Trial.ringdown(KNOWN, measured, 1e-3)
    fits = [fit(trial, names, options=replace(QUICK, loss=loss)) for loss in ("linear", "cauchy")]
    errors = [abs(one["damping_ratio"].value - 0.2) for one in fits]
    assert errors[1] < 0.5 * errors[0]


def test_two_trials_are_more_certain_than_one(rung, pulled):
    names, (_, one) = ["young_modulus", "damping_ratio", "deflection"], pulled
    both = fit(
        [Trial.ringdown(KNOWN, ringdown_wrenches(rung, seed=seed), 1e-3) for seed in (0, 1)], names, options=QUICK
    )
    ratio = both["young_modulus"].relative_deviation / one["young_modulus"].relative_deviation
    assert ratio == pytest.approx(np.sqrt(0.5), rel=0.15)


def _pole():
    """Return a scene of a whisker that whisks against a pole, and the trial of it that is still to be simulated."""
    from brainbench.stimuli import Frames, PlacedObject, Scene, Whisking
    from brainbench.stimuli.objects.solid import cylinder

    array = WhiskerArray.of("mouse", whiskers="C2")
    pole = PlacedObject(cylinder(0.0005, 0.02), position=(0.0115, -0.0005, 0.003))
    scene = Scene(
        "pole", array, (pole,), whisking=Whisking(frequency=10, onset=0.05), frames=Frames(count=30, interval=2e-3)
    )
    times = 0.01 + np.arange(30) * 2e-3
    return scene, Trial.of_scene(scene, blank_wrenches(times), "C2")


@pytest.mark.slow
def test_intervals_contain_the_error_of_links_and_steps():
    scene, trial = _pole()
    trace = simulate_trial(trial)
    for seed in range(2):
        measured = measure_wrenches(trial, trace, 0.0002, np.random.default_rng(seed)).measured
        result = fit(Trial.of_scene(scene, measured, "C2"), ["young_modulus", "object_y"], options=QUICK)
        one = result["young_modulus"]
        # The interval of noise alone (1.96 deviations) misses the truth.
        assert abs(np.log(one.value / 5e9)) > 2 * one.relative_deviation
        for name, truth in (("young_modulus", 5e9), ("object_y", 0.0)):
            assert result[name].interval.low <= truth <= result[name].interval.high, (name, seed)


@pytest.mark.slow
def test_a_pole_is_found_by_the_forces_on_the_base():
    scene, trial = _pole()
    trace = simulate_trial(trial, options=QUICK)
    assert trace.contact.any()
    measured = measure_wrenches(trial, trace, 0.01, np.random.default_rng(0))
    start = Trial.of_scene(scene, measured.measured, "C2")
    result = fit(start, ["young_modulus", "object_y"], start={"object_y": 2e-4, "young_modulus": 4e9}, options=QUICK)
    assert abs(result["object_y"].value) < 5e-5
    assert result["young_modulus"].value == pytest.approx(5e9, rel=0.03)
