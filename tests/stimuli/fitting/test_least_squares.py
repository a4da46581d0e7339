"""Fits find the truth of simulated measurements, and say what they cannot tell."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, UsageError
from brainbench.core.rotations import euler_matrix
from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.fitting import FitOptions, Trial, fit, new_shapes, new_wrenches
from brainbench.stimuli.fitting.least_squares import Profile, laplace_interval, quantile
from brainbench.stimuli.fitting.model import FitModel, Readings
from brainbench.stimuli.fitting.parameters import PARAMETERS, PUBLISHED, Condition, FreeParameters, Prior
from brainbench.stimuli.fitting.result import directions, unknown_parameters
from brainbench.stimuli.fitting.trials import Pluck, to_frame
from tests.factories.whisker_measurements import blank_wrenches, measure_shapes, measure_wrenches, simulate_trial

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


KNOWN = replace(WhiskerArray.of("mouse")["C2"].whisker, damping_ratio=0.15)
TRUTH = replace(KNOWN, young_modulus=3.5e9, damping_ratio=0.2)
PERIOD = 1 / float(references.natural_frequencies(KNOWN, 1)[0])
QUICK = FitOptions(links=8, steps_per_period=80.0)
SAME = FitOptions(links=8, steps_per_period=4.0, time_step=PERIOD / 80)
"""The setting of QUICK for a truth whose period is another: the same time step."""


@pytest.fixture(scope="module")
def rung():
    """A plucked whisker and its simulation."""
    times = np.arange(1, 61) * PERIOD / 15
    trial = Trial.ringdown(TRUTH, blank_wrenches(times), 1e-3)
    return trial, simulate_trial(trial, options=SAME)


def _wrenches(rung, noise=0.01, seed=0):
    trial, trace = rung
    return measure_wrenches(trial, trace, noise, np.random.default_rng(seed)).measured


def _shapes(rung, seed=0):
    trial, trace = rung
    return measure_shapes(trial, trace, TRUTH, 20e-6, np.random.default_rng(seed)).measured


@pytest.fixture(scope="module")
def pulled(rung):
    """The measured wrenches and their fit."""
    trial = Trial.ringdown(KNOWN, _wrenches(rung), 8e-4)
    return trial, fit(trial, ["young_modulus", "damping_ratio", "deflection"], options=QUICK)


@pytest.fixture(scope="module")
def traced(rung):
    """The traced shapes and their fit."""
    trial = Trial.ringdown(KNOWN, _shapes(rung), 8e-4)
    return trial, fit(trial, ["young_modulus", "density", "damping_ratio", "deflection"], options=QUICK)


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
    trial = Trial.ringdown(KNOWN, _shapes(rung), 8e-4)
    names = ["young_modulus", "density", "damping_ratio", "deflection"]
    result = fit(trial, names, options=replace(QUICK, priors="published"))
    assert result.status == "unreliable"
    assert "prior" in result["density"].reason
    assert result["density"].value == pytest.approx(1260, rel=0.3)
    assert np.isfinite(result["density"].interval.high)


def test_a_cylinder_in_place_of_a_cone_is_noticed(rung):
    cylinder = replace(KNOWN, base_radius=3e-5, tip_radius=3e-5)
    result = fit(
        Trial.ringdown(cylinder, _shapes(rung), 8e-4), ["young_modulus", "damping_ratio", "deflection"], options=QUICK
    )
    assert result.status == "unreliable"
    assert any(not test.passed for test in result.tests)
    assert any("does not fit" in reason for reason in result.reasons)


def test_a_parameter_at_its_bound_is_unreliable(rung):
    result = fit(
        Trial.ringdown(KNOWN, _wrenches(rung), 8e-4),
        ["young_modulus", "damping_ratio"],
        bounds={"young_modulus": (4e9, 6e9)},
        options=QUICK,
    )
    assert result["young_modulus"].status == "unreliable"
    assert "lower bound" in result["young_modulus"].reason


def test_a_fit_that_is_stopped_has_not_converged(rung):
    result = fit(
        Trial.ringdown(KNOWN, _wrenches(rung), 8e-4),
        ["young_modulus", "damping_ratio", "deflection"],
        options=replace(QUICK, most_iterations=2),
    )
    assert result.status == "undefined"
    assert "did not converge" in result.reasons[0]


def test_profile_intervals_agree_with_laplace_where_the_model_is_nearly_linear(rung):
    result = fit(
        Trial.ringdown(KNOWN, _wrenches(rung), 8e-4),
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
    measured = _wrenches(rung).copy(deep=True)
    measured["wrench"].values[10:15] = np.nan
    result = fit(Trial.ringdown(KNOWN, measured, 1e-3), ["young_modulus", "damping_ratio", "deflection"], options=QUICK)
    assert result["young_modulus"].value == pytest.approx(3.5e9, rel=0.02)
    assert np.isnan(result.residuals[0][10:15]).all()


@pytest.mark.parametrize(("instants", "own"), [(3, False), (30, True)])
def test_a_channel_that_a_fit_could_follow_exactly_does_not_seem_free_of_noise(rung, instants, own):
    trial = Trial.ringdown(KNOWN, _wrenches(rung).isel(time=slice(instants)), 8e-4)
    model = FitModel([trial], FreeParameters(("young_modulus", "damping_ratio", "deflection"), trial.condition), QUICK)
    exact = model.readings.group == model.readings.groups.index("Mz")
    model.update_noise(np.where(exact, 1e-6, 0.1), model.sigma.copy())
    noise = dict(zip(model.readings.groups, model.sigma / model.readings.size, strict=True))
    assert (noise["Mz"] < 1e-4) == own


@pytest.mark.slow
def test_an_outlier_pulls_a_robust_fit_less(rung):
    measured = _wrenches(rung).copy(deep=True)
    measured["wrench"].values[::9] *= -2
    names = ["young_modulus", "damping_ratio", "deflection"]
    trial = Trial.ringdown(KNOWN, measured, 1e-3)
    fits = [fit(trial, names, options=replace(QUICK, loss=loss)) for loss in ("linear", "cauchy")]
    errors = [abs(one["damping_ratio"].value - 0.2) for one in fits]
    assert errors[1] < 0.5 * errors[0]


def test_two_trials_are_more_certain_than_one(rung, pulled):
    names, (_, one) = ["young_modulus", "damping_ratio", "deflection"], pulled
    both = fit([Trial.ringdown(KNOWN, _wrenches(rung, seed=seed), 1e-3) for seed in (0, 1)], names, options=QUICK)
    ratio = both["young_modulus"].relative_deviation / one["young_modulus"].relative_deviation
    assert ratio == pytest.approx(np.sqrt(0.5), rel=0.15)


def _pole():
    """Return a scene of a whisker that whisks against a pole, and the trial of it that is still to be simulated."""
    from brainbench.stimuli import Frames, PlacedObject, Scene, Whisking
    from brainbench.stimuli.objects.primitives import cylinder

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
        measured = measure_wrenches(trial, trace, 0.003, np.random.default_rng(seed)).measured
        result = fit(Trial.of_scene(scene, measured, "C2"), ["young_modulus", "object_y"], options=QUICK)
        one = result["young_modulus"]
        assert abs(np.log(one.value / 5e9)) > 4 * one.relative_deviation
        for name, truth in (("young_modulus", 5e9), ("object_y", 0.0)):
            assert result[name].interval.low <= truth <= result[name].interval.high, (name, seed)


def test_a_pole_is_found_by_the_forces_on_the_base():
    scene, trial = _pole()
    trace = simulate_trial(trial, options=QUICK)
    assert trace.contact.any()
    measured = measure_wrenches(trial, trace, 0.01, np.random.default_rng(0))
    start = Trial.of_scene(scene, measured.measured, "C2")
    result = fit(start, ["young_modulus", "object_y"], start={"object_y": 2e-4, "young_modulus": 4e9}, options=QUICK)
    assert abs(result["object_y"].value) < 5e-5
    assert result["young_modulus"].value == pytest.approx(5e9, rel=0.03)


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
    trial = Trial.ringdown(KNOWN, _wrenches(rung).assign(noise=("channel", [1e-6, 1e-6, 1e-8])), 1e-3)
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


@pytest.mark.parametrize("kind", ["wrench", "shape"])
def test_the_jacobian_is_that_of_differences(rung, kind):
    trial = Trial.ringdown(KNOWN, _wrenches(rung) if kind == "wrench" else _shapes(rung), 1e-3)
    names = ("young_modulus", "damping_ratio", "tip_radius", "deflection", "arc_length", "base_x", "base_angle")
    model = FitModel([trial], FreeParameters(names, trial.condition), QUICK)
    u = np.array([-0.2, 0.1, 0.05, 0.1, 0.01, 0.02, 0.03])
    jacobian = model.jacobian(u)
    for column, step in enumerate(1e-4 * np.eye(len(names))):
        fine = (model.residual(u + step) - model.residual(u - step)) / 2e-4
        # The foot of a traced point goes from sample to sample of the curve, which small differences see.
        assert np.linalg.norm(jacobian[:, column] - fine) < 5e-4 * np.linalg.norm(fine) + 1e-6


def test_an_iteration_costs_one_simulation(rung):
    trial = Trial.ringdown(KNOWN, _wrenches(rung), 1e-3)
    model = FitModel([trial], FreeParameters(("young_modulus", "damping_ratio"), trial.condition), QUICK)
    model.residual(np.zeros(2))
    model.jacobian(np.zeros(2))
    assert model.simulated == 1


@pytest.mark.parametrize("kind", ["pulled", "traced"])
def test_a_fit_is_drawn(request, tmp_path, kind):
    from PIL import Image

    from brainbench.stimuli.fitting.figure import draw_fit

    path = draw_fit(*request.getfixturevalue(kind), tmp_path / "fit.png")
    pixels = np.asarray(Image.open(path).convert("RGB")).reshape(-1, 3)
    # The colour of the first series is on it, and most of it is white.
    assert (np.abs(pixels.astype(int) - [0, 114, 178]).sum(axis=1) < 40).sum() > 50
    assert 0.5 < np.mean(pixels.min(axis=1) > 250) < 0.99


def test_the_summary_is_plain(traced):
    import json

    from brainbench.core.files import to_json

    data = json.loads(to_json(traced[1].summary()))
    assert data["status"] == "undefined"
    assert data["directions"][0]["deviation"] is None or data["directions"][0]["deviation"] > 1
    assert data["provenance"]["simulated_whiskers"] > 5
