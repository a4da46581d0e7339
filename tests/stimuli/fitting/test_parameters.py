"""Parameters of a fit: set and read, refused where they make no sense, and their priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.fitting import FitOptions, Trial, fit
from brainbench.stimuli.fitting.gradients import JobParameters
from brainbench.stimuli.fitting.parameters import (
    PARAMETERS,
    PUBLISHED,
    FreeParameters,
    Prior,
    move_obstacle,
    with_values,
)
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle, Sphere
from tests.factories.gradients import WHISKER, Swing, gradient_errors, touching_job
from tests.factories.whisker_measurements import KNOWN, blank_wrenches

PART = Capsule((0.0, 0.0, -1e-3), (2e-3, 0.0, 3e-3), 2e-4)


class Slide:
    finest = 0.02

    def __call__(self, times):
        return np.outer(times, [0.1, 0.2, 0.0]), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))


def test_a_shifted_motion_keeps_its_turn_and_its_shortest_period():
    times, moved = np.linspace(0, 0.1, 5), move_obstacle(Obstacle((PART,), Slide()), (1e-3, 0.0, -2e-3))
    place, turn = moved.motion(times)
    np.testing.assert_array_equal(place, Slide()(times)[0] + [1e-3, 0.0, -2e-3])
    np.testing.assert_array_equal(turn, Slide()(times)[1])
    assert moved.motion.finest == Slide.finest


@pytest.mark.parametrize(
    "values",
    [{"young_modulus": 5e9}, {"base_radius": 4e-5}, {"tip_radius": 9e-6, "base_radius": 6e-5}, {"arc_length": 0.012}],
)
def test_tables_along_a_whisker_follow_its_parameters(values):
    """Tables that say what the cone says stay those of the cone."""
    arcs = np.linspace(0, WHISKER.arc_length, 4)
    radii, moduli = zip(arcs, WHISKER.radius(arcs), strict=True), [(arc, WHISKER.young_modulus) for arc in arcs]
    table, cone = with_values(replace(WHISKER, radii=(*radii,), moduli=moduli), values), with_values(WHISKER, values)
    # Between its ends a table keeps its shape, where a cone stays a cone.
    places = cone.arc_length * (np.array([0.0, 1.0]) if "base_radius" in values else np.linspace(0, 1, 9))
    np.testing.assert_allclose(table.bending_stiffness(places), cone.bending_stiffness(places), rtol=1e-12)


def test_an_obstacle_turns_about_its_middle():
    obstacle = Obstacle((PART,))
    moved = move_obstacle(obstacle, (0.0, 1e-3, 0.0), (0.0, 0.0, np.pi))
    shift = moved.bounds.mean(axis=0) - obstacle.bounds.mean(axis=0)
    assert shift == pytest.approx([0.0, 1e-3, 0.0])
    assert moved.parts[0] != obstacle.parts[0]


BALL = touching_job(Sphere((11e-3, 2.2e-3, 0.0), 1e-3))


def _build(job: Job, **given: float) -> Job:
    parameters = JobParameters([job], list(given))
    return parameters.build(np.array(list(given.values())))[0]


def test_values_are_those_of_the_jobs_and_shifts_begin_at_zero():
    parameters = JobParameters([BALL], ("young_modulus", "density", "base.theta", "object.x"))
    assert parameters.values.tolist() == [3e9, 1300.0, 0.0, 0.0]
    assert (parameters.scales > 0).all()
    same = parameters.build(parameters.values)[0]
    assert same.whisker == WHISKER
    assert same.obstacles[0].parts == BALL.obstacles[0].parts


def test_the_friction_of_an_object_is_that_of_the_whisker_where_it_states_none():
    rough = replace(BALL, whisker=replace(WHISKER, friction=0.3))
    assert rough.obstacles[0].friction is None
    assert JobParameters([rough], ["object.friction"]).values.tolist() == [0.3]
    stated = replace(rough, obstacles=(replace(BALL.obstacles[0], friction=0.1),))
    assert JobParameters([stated], ["objects.friction"]).values.tolist() == [0.1]


@pytest.mark.parametrize("name", ["object.friction", "objects.friction"])
def test_objects_that_differ_in_friction_are_refused(name):
    stated = replace(BALL, obstacles=(replace(BALL.obstacles[0], friction=0.1),))
    with pytest.raises(UsageError, match="frictions differ"):
        JobParameters([BALL, stated], [name])


def test_density_keeps_the_proportion_of_the_tip():
    job = replace(BALL, whisker=replace(WHISKER, density=(1000.0, 1500.0)))
    assert _build(job, density=1100.0).whisker.density == pytest.approx((1100.0, 1650.0))


def test_parameters_of_tables_are_differentiated():
    arcs = np.linspace(0, WHISKER.arc_length, 4)
    radii = tuple(zip(arcs, WHISKER.radius(arcs) * [1, 1.1, 0.9, 1], strict=True))
    whisker = replace(WHISKER, radii=radii, moduli=tuple(zip(arcs, (3e9, 4e9, 4e9, 5e9), strict=True)))
    job = replace(touching_job(Sphere((11e-3, 2.4e-3, 0.0), 1e-3)), whisker=whisker)
    errors, _ = gradient_errors(job, ("young_modulus", "base_radius", "tip_radius", "arc_length"))
    assert errors.max() < 1e-5


def test_an_object_is_shifted_and_turned_about_its_middle():
    moved = _build(BALL, **{"object.y": 1e-3, "object.rz": 0.5, "object.friction": 0.2}).obstacles[0]
    assert moved.parts[0].centre == pytest.approx((11e-3, 3.2e-3, 0.0))
    assert moved.friction == 0.2


def test_all_objects_are_shifted_together():
    two = replace(BALL, obstacles=BALL.obstacles * 2)
    moved = _build(two, **{"objects.y": 1e-3}).obstacles
    assert [one.parts[0].centre for one in moved] == [pytest.approx((11e-3, 3.2e-3, 0.0))] * 2
    alone = _build(two, **{"object1.y": 1e-3}).obstacles
    assert alone[0] is two.obstacles[0]
    assert alone[1].parts[0].centre == pytest.approx((11e-3, 3.2e-3, 0.0))


def test_an_object_that_moves_is_shifted_along_its_whole_way():
    def motion(times):
        return np.outer(times, [1.0, 0.0, 0.0]), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    job = replace(BALL, obstacles=(replace(BALL.obstacles[0], motion=motion),))
    moved = _build(job, **{"object.z": 2e-3, "object.rz": np.pi / 2}).obstacles[0].motion
    places, turns = moved(np.array([0.0, 0.01]))
    # The middle of the ball is 11 mm from the body's origin, about which nothing turns.
    middle = np.array([11e-3, 2.2e-3, 0.0])
    turned = np.array([-middle[1], middle[0], 0.0])
    np.testing.assert_allclose(places[0] + turned, middle + np.array([0.0, 0.0, 2e-3]), atol=1e-12)
    np.testing.assert_allclose(places[1] - places[0], [0.0, 0.01, 0.0], atol=1e-12)
    np.testing.assert_allclose(np.abs(turns[:, 3]), np.sqrt(0.5))


def test_the_base_is_shifted_at_knots_in_time_and_differentiated_there():
    job = replace(BALL, follicle=StillFollicle(), obstacles=(), times=np.linspace(1e-3, 0.03, 30))
    names = ("base.theta[1]", "base.y[2]")
    errors, run = gradient_errors(job, names, knots=(0.0, 0.01, 0.02, 0.03), change=1e-3)
    assert np.isfinite(errors[0, 1])
    assert np.isfinite(errors[1]).all()
    assert np.nanmax(errors) < 1e-3
    assert np.abs(run.traces[0].wrench).max() < 1e-12


def test_what_two_parameters_share_is_not_built_twice():
    parameters = JobParameters([replace(BALL, follicle=Swing())], ("curvature", "base.x", "object.y"))
    first = parameters.build(np.array([11.0, 0.0, 0.0]))[0]
    second = parameters.build(np.array([12.0, 0.0, 0.0]))[0]
    assert first.follicle is second.follicle
    assert first.obstacles[0] is second.obstacles[0]
    assert first.whisker.curvature == 11.0


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["young_modulas"], "young_modulus"),
        (["base.thetta"], "base.theta"),
        (["object.q"], "object.z"),
        (["object3.x"], "the jobs have 1"),
        (["base.x[0]"], "give their times as knots"),
        (["curvature", "curvature"], "once"),
        ([], "at least one"),
    ],
)
def test_unknown_parameters_are_refused(names, said):
    with pytest.raises(UsageError, match=said):
        JobParameters([BALL], names)


@pytest.mark.parametrize("knots", [[0.0], [0.0, 0.0], [0.0, np.nan, 0.1], [0.0, np.inf]])
def test_knots_increase(knots):
    with pytest.raises(UsageError, match="increasing times"):
        JobParameters([BALL], ["base.x[0]"], knots=knots)


def test_whiskers_that_differ_in_a_parameter_are_refused():
    other = replace(BALL, whisker=replace(WHISKER, curvature=20.0))
    with pytest.raises(UsageError, match="curvature"):
        JobParameters([BALL, other], ["curvature"])
    assert JobParameters([BALL, other], ["young_modulus"]).values[0] == 3e9


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
