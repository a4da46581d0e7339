"""Gradients beside central differences in double precision: free, loaded and touching whiskers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Literal

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import euler_matrix
from brainbench.geometry import Mesh
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.engine import PackedTasks, make_task
from brainbench.stimuli.engines.rod.packing import beam_compliance
from brainbench.stimuli.fitting.gradients import (
    GradientRun,
    JobParameters,
    PackedPlaces,
    contact_events,
    packed_change,
    packed_part,
)
from brainbench.stimuli.fitting.recorded_run import RecordingSolver
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, Cylinder, Obstacle, Sphere
from tests.factories.contact_scenes import contact_jobs, held_job, meshed, sliding_job
from tests.factories.gradients import COARSE, WHISKER, Swing, gradient_errors, touching_job, traces_at

POST = Capsule((11e-3, 2.2e-3, -8e-3), (11e-3, 2.7e-3, 8e-3), 5e-4)


def _ends(job, factor):
    low, high = (replace(job, whisker=replace(WHISKER, young_modulus=factor * value)) for value in (1.0, 3.0))
    return low, high


def test_stiffness_grows_with_the_modulus_and_masses_stay():
    job = touching_job(POST)
    task = make_task(job, COARSE, {}, silent=True)
    low, high = _ends(job, 1e9)
    change = packed_change(task, low, high, 2e9, quasistatic=False)
    length, _, mass, _, _, _, stiffness, torsion, start, end, *beam = change["link"]
    np.testing.assert_allclose(stiffness, task.chain.stiffness * 1e6 / WHISKER.young_modulus, rtol=1e-9)
    # How the rod bends between joints goes with the compliance.
    softer = beam_compliance(task.chain).transpose(0, 2, 1).reshape(16, -1) * -1e-6 / 1e9
    np.testing.assert_allclose(beam[2:], softer, rtol=1e-9)
    for row in (length, mass, start, end, *beam[:2]):
        assert np.abs(row).max() < 1e-20
    assert task.twists == bool(np.abs(torsion).max() > 0)
    # What is one object in both does not change.
    assert not any(name.startswith(("shape", "base", "body")) for name in change)


def test_numbers_of_each_job_stand_in_places_of_their_own():
    tasks = [make_task(touching_job(POST), COARSE, {}, silent=True) for _ in range(2)]
    places = PackedPlaces.of(PackedTasks.of(tasks, shared=False))
    arrays = {"shape_place": np.arange(6.0).reshape(2, 3), "beta": np.arange(2.0), "link": np.zeros((10, 12, 2))}
    for job, place in enumerate(places):
        assert packed_part(arrays, "shape_place", place, job).tolist() == [[3.0 * job, 3.0 * job + 1, 3.0 * job + 2]]
        assert packed_part(arrays, "beta", place, job).tolist() == [job]
        assert packed_part(arrays, "link", place, job).shape == (10, 8)


def test_jobs_of_another_structure_are_refused():
    job = touching_job(POST)
    task = make_task(job, COARSE, {}, silent=True)
    with pytest.raises(UsageError, match="same obstacles"):
        packed_change(task, job, replace(job, obstacles=()), 1.0, quasistatic=False)


def _prism() -> Mesh:
    corners = np.array([[x, y, z] for x in (-1e-3, 1e-3) for y in (-1e-3, 1e-3) for z in (-8e-3, 8e-3)])
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4],
         [1, 5, 7], [1, 7, 3]]
    )  # fmt: skip
    turn = euler_matrix((0.1, 0.0, np.pi / 4))
    return Mesh(corners @ turn.T + [11e-3, 3e-3, 0.3e-3], faces.astype(np.int32))


def test_what_cannot_be_differentiated_is_refused():
    job = touching_job(_prism())

    def scaled(values):
        return [replace(job, obstacles=(Obstacle((), surface=_prism().scaled(values[0])),))]

    with pytest.raises(UsageError, match="deforms or scales a mesh"):
        GradientRun(scaled, [1.0], fidelity=COARSE).gradient([np.ones((30, 6))])
    with pytest.raises(UsageError, match="same number of jobs"):
        GradientRun(lambda values: [job] * (1 + (values[0] > 1)), [1.0], fidelity=COARSE)
    with pytest.raises(UsageError, match="positive scale"):
        GradientRun(lambda values: [job], [0.0], fidelity=COARSE)
    with pytest.raises(UsageError, match="finite"):
        GradientRun(lambda values: [job], [np.nan], fidelity=COARSE)


SUMMARY = {
    "first": 0, "begun": 1, "ended": 1, "slipped": 0, "jumped": 0, "degenerate": 0, "largest_force": 1.0,
    "least_force": 0.1, "fastest_slip": 1.0, "slowest_slip": 0.1, "fullest_cone": 0.5, "least_gap": 0.01,
    "least_lead": 0.01,
}  # fmt: skip


def _events(solid, friction: float, *, frames: int = 30, **changes: float):
    job = touching_job(solid, friction=friction, frames=frames)
    parameters = JobParameters([job], ["young_modulus"])
    run = GradientRun(parameters.build, parameters.values, fidelity=replace(COARSE, **changes))
    return run.gradient([np.ones((frames, 6))]).events[0]


def test_beginning_end_and_slip_of_a_contact_are_counted():
    # This whisker slips off the ball.
    ball = _events(Sphere((11e-3, 2.2e-3, 0.6e-3), 1e-3), 0.0, frames=39)
    assert (ball.begun, ball.ended, ball.slipped) == (1, 1, 0)
    assert ball.status == "smooth"
    post = _events(Capsule((11e-3, 2.2e-3, -8e-3), (11e-3, 2.7e-3, 8e-3), 5e-4), 0.4, frames=39)
    assert post.begun == 1
    assert post.slipped >= 2


@pytest.mark.parametrize(
    ("change", "close"),
    [
        ({"least_force": 1e-7}, "ending"),
        ({"least_gap": 1e-9}, "beginning"),
        ({"least_lead": 1e-9}, "passing"),
        ({"jumped": 1}, "passing"),
        ({"fullest_cone": 1 - 1e-7}, "slipping"),
        ({"slowest_slip": 1e-8}, "sticking"),
    ],
)
def test_a_contact_close_to_another_state_makes_the_gradient_one_sided(change, close):
    assert contact_events(SUMMARY, "").status == "smooth"
    found = contact_events(SUMMARY | change, "")
    assert found.status == "one-sided"
    assert found.close == (close,)


def test_a_shared_load_and_an_unstable_run_are_told():
    assert contact_events(SUMMARY | {"degenerate": 3}, "").status == "degenerate"
    assert contact_events(SUMMARY | {"degenerate": 3}, "the state stopped being finite").status == "unstable"


MATERIAL = ("young_modulus", "density", "damping_ratio", "base_radius", "tip_radius", "curvature", "arc_length")
BASE = ("base.x", "base.y", "base.theta", "base.phi", "base.zeta")
OBJECT = ("object.x", "object.y", "object.z", "object.rx", "object.ry", "object.rz")
EDGE = (np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8))


SOLIDS = {
    "sphere": Sphere((11e-3, 2.3e-3, 0.3e-3), 1e-3),
    "post": Capsule((11e-3, 2.2e-3, -8e-3), (11e-3, 2.7e-3, 8e-3), 5e-4),
    "rim": Cylinder((11e-3, 3.8e-3, 1.3e-3), (11e-3, 3.2e-3, 0.7e-3), 2e-3),
    "edge": Box((11e-3, 3e-3, 0.3e-3), (1e-3, 1e-3, 8e-3), EDGE),
    "mesh": _prism(),
}


def test_free_and_loaded_motion_has_the_gradients_of_central_differences():
    load = Load(0.0143, (0.0, 1e-5, 5e-6), stop=0.0153)
    job = Job(WHISKER, Swing(), (), np.linspace(1e-3, 0.024, 24), gravity=(0.0, 5.0, -5.0), loads=(load,))
    errors, _ = gradient_errors(job, (*MATERIAL, "poisson_ratio", *BASE), change=1e-4)
    assert np.nanmax(errors) < 1e-5


def test_quasistatic_motion_has_the_gradients_of_central_differences():
    job = touching_job(SOLIDS["post"], friction=0.4)
    errors, _ = gradient_errors(job, ("young_modulus", "curvature", "friction", "object.y"), fidelity=_quasistatic())
    assert np.nanmax(errors) < 1e-3


def _quasistatic() -> Fidelity:
    return Fidelity(links=8, time_step=1e-3, solver="quasistatic")


@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("line", ["rod", pytest.param("links", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["post", pytest.param("mesh", marks=pytest.mark.slow)])
def test_contact_has_the_gradients_of_central_differences(kind, line, friction):
    _check_contact(kind, friction, line)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.4])
@pytest.mark.parametrize("kind", ["sphere", "rim", "edge"])
def test_contact_with_every_feature_has_the_gradients_of_central_differences(kind, friction):
    _check_contact(kind, friction)


def _check_contact(kind: str, friction: float, line: Literal["links", "rod"] = "rod") -> None:
    names = (*MATERIAL, *BASE[:4], *OBJECT, *(("friction",) if friction else ()))
    # A long difference may meet another contact, a short one is rounding: one of the two is right.
    job = touching_job(SOLIDS[kind], friction=friction)
    (errors, run), (shorter, _) = (
        gradient_errors(job, names, fidelity=replace(COARSE, contact_line=line), change=change)
        for change in (1e-4, 1e-5)
    )
    assert (run.traces[0].contact > 0).sum() > 5
    assert np.nanmax(np.fmin(errors, shorter)) < 2e-4


@pytest.mark.parametrize(
    ("job", "links"),
    [
        (held_job(frames=30), 14),
        # Both posts press on one link, so that each bends the rod as its mean force does.
        (held_job(frames=30, friction=0.1), 15),
        (sliding_job(friction=0.3, frames=70), 14),
        # It lies flush: contacts begin and end at joints and between them.
        (touching_job(Box((11e-3, 3.2e-3, 0.3e-3), (3e-3, 1e-3, 8e-3)), friction=0.4), 8),
    ],
    ids=["held", "held by one link", "sliding", "flush"],
)
def test_contacts_on_the_bent_rod_have_the_gradients_of_central_differences(job, links):
    names = ("young_modulus", "tip_radius", "arc_length", "base.x", "base.theta", "object.x", "object.y")
    # Every such difference is of the same contacts; what is left is rounding, which grows as the difference shrinks.
    (errors, run), (shorter, _) = (
        gradient_errors(job, names, fidelity=Fidelity(links=links, time_step=1e-4), change=change)
        for change in (1e-5, 1e-6)
    )
    assert run._groups[0].solver.smooth
    assert (run.traces[0].contact > 0).sum() > 10
    assert np.nanmax(np.fmin(errors, shorter)) < 1e-4


MESHED = (
    "off a ball", "past the end of a post", "between posts", "along a post", "opposed posts", "post 8", "post 12",
    "post 21", "edge 0", "edge 23", "edge 30", "hollow 1", "hollow 3", "slot 8", "slot 14", "face 15", "face 21",
)  # fmt: skip


@cache
def _meshed_jobs() -> dict[str, Job]:
    """Return jobs of whiskers that touch triangles: posts of 32 sides, balls, boxes and the hollow of a trough."""
    alone = contact_jobs(29, each=1)
    around = contact_jobs(31, each=1, objects=("slot", "slip-off", "opposed", "face"))
    jobs = {
        "off a ball": touching_job(Sphere((11e-3, 2.2e-3, 0.6e-3), 1e-3), frames=42),
        "past the end of a post": touching_job(
            Capsule((11e-3, 2.2e-3, -1.2e-3), (11e-3, 2.7e-3, 8e-4), 5e-4), frames=42
        ),
        "between posts": held_job(frames=30),
        "along a post": sliding_job(friction=0.3, frames=70),
        **{f"post {k}": alone[k] for k in (8, 12, 21)},
        **{f"edge {k}": alone[k] for k in (0, 23, 30)},
        **{f"hollow {k}": alone[k] for k in (1, 3)},
        **{f"slot {k}": around[k] for k in (8, 14)},
        **{f"face {k}": around[k] for k in (15, 21)},
        "opposed posts": around[12],
    }
    return dict(zip(jobs, meshed(list(jobs.values()), "triangles"), strict=True))


@pytest.mark.parametrize(
    "name", ["off a ball", "between posts", *(pytest.param(name, marks=pytest.mark.slow) for name in MESHED)]
)
def test_contacts_with_triangles_on_the_bent_rod_have_the_gradients_of_central_differences(name):
    names = ("young_modulus", "base_radius", "tip_radius", "arc_length", "curvature", "damping_ratio", "base.theta")
    job = _meshed_jobs()[name]
    # A long difference may meet another contact, a short one is rounding: one of the three is right. Sums over
    # the joints may cancel to a ten-thousandth, and what is packed is differentiated less well than that.
    parts = [
        gradient_errors(job, (*names, "object.x"), fidelity=Fidelity(links=12, time_step=1e-4), change=change)
        for change in (1e-5, 1e-6, 1e-7)
    ]
    run = parts[0][1]
    assert run._groups[0].solver.smooth
    assert (run.traces[0].contact > 0).sum() > 5
    assert np.nanmax(np.fmin.reduce([errors for errors, _ in parts])) < 1e-3


def test_a_contact_that_jumps_between_edges_of_a_mesh_makes_the_gradient_one_sided():
    run = GradientRun(lambda values: [_meshed_jobs()["off a ball"]], [1.0], fidelity=Fidelity(links=12, time_step=1e-4))
    assert run.gradient([np.ones((42, 6))]).events[0].close == ("passing",)


def test_a_loaded_whisker_in_contact_has_the_gradients_of_central_differences():
    load = Load(0.0143, (0.0, 1e-6, 5e-7), stop=0.0153)
    job = replace(touching_job(SOLIDS["post"], friction=0.4), gravity=(0.0, 5.0, -5.0), loads=(load,))
    errors, run = gradient_errors(job, ("young_modulus", "density", "base.theta", "object.y", "friction"))
    assert run.traces[0].contact.any()
    assert np.nanmax(errors) < 1e-3


def test_quasistatic_runs_past_a_moving_object_in_several_segments_have_them_too(monkeypatch):
    monkeypatch.setattr(RecordingSolver, "room", 0)
    errors, run = gradient_errors(_moving_post(), ("young_modulus", "object.y", "object.rz"), fidelity=_quasistatic())
    assert run.traces[0].contact.any()
    assert np.nanmax(errors) < 1e-3


def _moving_post() -> Job:
    job = touching_job(SOLIDS["post"], friction=0.3)

    def motion(times):
        angle = 0.3 * np.sin(50 * times)
        turn = np.stack([np.cos(angle / 2), 0.6 * np.sin(angle / 2), 0 * angle, 0.8 * np.sin(angle / 2)], axis=1)
        return np.outer(np.sin(40 * times), [0, -1e-3, 3e-4]), turn

    return replace(job, obstacles=(replace(job.obstacles[0], motion=motion),))


def test_sizes_of_a_primitive_and_its_own_friction_have_gradients():
    job = touching_job(SOLIDS["post"])

    def build(values):
        post = replace(SOLIDS["post"], radius=values[0])
        return [replace(job, obstacles=(Obstacle((post,), friction=values[1]),))]

    run = GradientRun(build, [5e-4, 0.3], fidelity=COARSE)
    gradient = run.gradient([np.ones((30, 6)) * [0, 0, 0, 1, 1, 1]]).values
    np.testing.assert_allclose(run.tangents()[0].wrench[:, :, 3:].sum(axis=(1, 2)), gradient, rtol=1e-8)
    for p, value in enumerate((5e-4, 0.3)):
        shift = 1e-5 * value * (np.arange(2) == p)
        high, low = (traces_at(run, [5e-4, 0.3] + sign * shift)[0].wrench[:, 3:].sum() for sign in (1, -1))
        assert gradient[p] == pytest.approx((high - low) / (2 * shift[p]), rel=1e-3)


def test_an_object_that_moves_has_gradients_by_its_place_and_turn():
    errors, run = gradient_errors(_moving_post(), OBJECT)
    assert run.traces[0].contact.any()
    assert np.nanmax(errors) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("scene", range(12))
def test_random_contact_scenes_have_the_gradients_of_central_differences(scene):
    job = contact_jobs(29, each=1)[scene]
    names = ("young_modulus", "base_radius", "curvature", "base.theta", "object.x", "object.y")
    try:
        errors, run = gradient_errors(job, names, change=1e-6)
    except AssertionError as error:
        pytest.skip(f"not simulated: {error}")
    assert run.traces[0].contact.any()
    events = run.gradient([np.ones_like(run.traces[0].wrench)]).events[0]
    if events.status == "degenerate":
        pytest.skip("its contact forces have no unique solution, and the run says so")
    # A change of contact between the two differences is no error of the gradient: at most one parameter has one. Where
    # a contact jumps to and fro between triangles of a hollow mesh, all do, and the run says so.
    assert np.sort(np.nan_to_num(errors).max(axis=0))[-2] < 1e-2 or "passing" in events.close


def test_whiskers_of_different_frames_and_lengths_share_parameters():
    first = touching_job(SOLIDS["post"])
    second = Job(replace(WHISKER, arc_length=0.015), StillFollicle(), (), np.array([0.01, 0.02]), gravity=(0, 0, -9.8))
    parameters = JobParameters([first, second], ("young_modulus", "density"))
    run = GradientRun(parameters.build, parameters.values, fidelity=COARSE)
    # Frames differ, so that each has a launch of its own; the second bends in space and is short.
    assert len(run._groups) == 2
    weights = [np.ones((30, 6)), np.ones((2, 6))]
    gradient = run.gradient(weights)
    for index, job in enumerate((first, second)):
        alone = JobParameters([job], ("young_modulus", "density"))
        run = GradientRun(alone.build, alone.values, fidelity=COARSE)
        np.testing.assert_allclose(gradient.by_job[index], run.gradient([weights[index]]).values, rtol=1e-9)
    np.testing.assert_allclose(gradient.values, gradient.by_job.sum(axis=0))


def test_a_whisker_that_nothing_bends_has_the_shape_gradient_of_its_rest():
    job = Job(WHISKER, StillFollicle(), (), np.array([1e-3, 2e-3]))
    parameters = JobParameters([job], ("curvature", "base.x"))
    run = GradientRun(parameters.build, parameters.values, scales=parameters.scales, fidelity=COARSE)
    positions = np.zeros((2, 9, 3))
    positions[1, -1, 1] = 1.0
    tips = [replace(WHISKER, curvature=value).centre_line(0.02)[1] for value in (9.99, 10.01)]
    gradient = run.gradient(link_positions=[positions])
    assert gradient.values[0] == pytest.approx((tips[1] - tips[0]) / 0.02, rel=1e-5)
    positions[1, -1] = [1.0, 0.0, 0.0]
    assert run.gradient(link_positions=[positions]).values[1] == pytest.approx(1.0)


def test_an_unstable_whisker_has_no_gradient():
    job = touching_job(Sphere((11e-3, 5e-4, 0.0), 1e-3))
    parameters = JobParameters([job], ("young_modulus",))
    run = GradientRun(parameters.build, parameters.values, fidelity=COARSE)
    gradient = run.gradient([np.ones((30, 6))])
    assert np.isnan(gradient.values).all()
    assert np.isnan(run.tangents()[0].wrench).all()
    assert gradient.events[0].status == "unstable"
    assert not gradient.smooth
