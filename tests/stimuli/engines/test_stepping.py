"""Engines in equal steps simulate suspicious whiskers again with half the step, and flag those that change."""

from dataclasses import replace

import numpy as np
import pytest

from brainbench.stimuli import WhiskerArray
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.stepping import SteppedJob
from brainbench.stimuli.engines.trust import changes_words, roughness
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, Cylinder, Obstacle, Sphere
from brainbench.stimuli.validation.contact_scenes import contact_jobs
from tests.factories.whiskers import C2


@pytest.fixture
def halves(monkeypatch):
    """Steps (s) of the simulations that were made to compare with."""
    found, halved = [], SteppedJob.halved

    def noted(self):
        half = halved(self)
        found.append(half.step)
        return half

    monkeypatch.setattr(SteppedJob, "halved", noted)
    return found


def _swept(shape, speed, friction=0.0):
    def motion(times):
        return np.array([0.009, -0.002, 0.0]) + np.outer(times, [0, speed, 0]), np.tile([1.0, 0, 0, 0], (len(times), 1))

    duration = 0.02 / speed
    times = np.linspace(duration / 40, duration, 40)
    return Job(C2, StillFollicle(), (Obstacle((shape,), motion, friction),), times)


@pytest.mark.parametrize(
    ("force", "expected"),
    [(np.ones((50, 3)), 0.0), ([[1.0, 0, 0], [0, 0, 0]] * 50, 99 / 50), (np.zeros((9, 3)), 0.0), (np.ones((1, 3)), 0)],
    ids=["steady", "hopping", "none", "one step"],
)
def test_roughness_is_that_of_the_changes_from_step_to_step(force, expected):
    assert roughness(np.asarray(force)) == pytest.approx(expected)


@pytest.mark.parametrize("speed", [0.5, 2.0, 5.0])
def test_blows_of_a_flat_face_that_soft_contacts_throw_back_are_flagged(speed, halves):
    box = Box((0.0, 0.0, 0.0), (2e-3, 1e-3, 5e-3))
    fidelity = Fidelity(links=10, time_step=1e-4)
    (trace,) = get_engine("mujoco").run([_swept(box, speed)], fidelity, record_shape=True)
    assert trace.status == "unstable"
    assert "with half the step" in trace.reason
    assert halves == [5e-5]
    for values in (trace.wrench, trace.link_positions, trace.contact_arc):
        assert np.isnan(values).all()
    assert not trace.contact.any()
    # Both runs were computed.
    assert trace.steps > 2 * SteppedJob(_swept(box, speed), fidelity, False).where[-1]


def test_a_thin_rod_that_soft_contacts_throw_back_is_flagged_and_rod_follows_it():
    whisker = WhiskerArray.of("mouse")["C2"].whisker
    post = Cylinder((0.5 * whisker.arc_length, 3e-3, -5e-3), (0.5 * whisker.arc_length, 3e-3, 5e-3), 5e-5)

    def motion(times):
        return np.outer(times, [0, -0.1, 0]), np.tile([1.0, 0, 0, 0], (len(times), 1))

    job = Job(whisker, StillFollicle(), (Obstacle((post,), motion),), np.arange(1, 400) * 2e-4)
    (soft,) = get_engine("mujoco").run([job], Fidelity.preset("balanced"))
    (rigid,) = get_engine("rod").run([job], Fidelity.preset("balanced"))
    (fine,) = get_engine("rod").run([job], Fidelity.parse("accurate,contact_tolerance=1e-6"))
    assert soft.status == "unstable"
    assert "changes by 69% (root mean square) with half the step" in soft.reason
    assert rigid.status == "ok"
    assert np.linalg.norm(rigid.wrench - fine.wrench) < 0.1 * np.linalg.norm(fine.wrench)


def test_what_stays_at_half_the_step_keeps_its_numbers(halves):
    # A tip that is buried at the edge of a slow box: deep, and hardly different at half the step.
    job = _swept(Box((0.0, 0.0, 0.0), (2e-3, 1e-3, 5e-3)), 0.02)
    (trace,) = get_engine("mujoco").run([job], Fidelity(links=10, time_step=1e-4))
    assert trace.status == "ok"
    peg = _swept(Capsule((0, 0, -0.01), (0, 0, 0.01), 5e-4), 0.1)
    before = len(halves)
    (trace,) = get_engine("mujoco").run([peg], Fidelity(links=10, time_step=1e-4))
    assert trace.status == "ok"
    assert len(halves) == before


def test_whiskers_at_ordinary_speeds_stay_ok_at_no_cost(halves):
    # Whisks at 5 to 20 Hz onto posts, balls, edges and hollows, without friction.
    jobs = [job for job in contact_jobs(3, each=1) if job.obstacles[0].friction == 0.0]
    traces = get_engine("mujoco").run(jobs, Fidelity.preset("fast"), workers=2)
    # One errs by 22 % beside rod.
    assert sum("half the step" in trace.reason for trace in traces) == 1
    assert len(halves) <= 2
    assert sum(trace.status == "ok" for trace in traces) >= 22


@pytest.mark.parametrize(("seed", "index"), [(3, 47), (5, 11)])
def test_hopping_at_ordinary_speeds_is_flagged(seed, index):
    """With status ok the base forces of these erred by .62 and .63 of those of rod in fine steps."""
    job = contact_jobs(seed, each=1)[index]
    (trace,) = get_engine("mujoco").run([job], Fidelity.preset("fast"))
    assert "with half the step" in trace.reason


def test_friction_that_soft_contacts_let_go_is_flagged():
    """Against a post with friction .4, mujoco gave the forces of a smooth post; rod errs by less than 5 %."""
    jobs = [job for job in contact_jobs(21, each=1) if job.obstacles[0].friction == 0.4][:3]
    fidelity = Fidelity(links=10, twist=False)
    for trace in get_engine("mujoco").run(jobs, fidelity):
        assert "of the friction 0.4" in trace.reason
        assert np.isnan(trace.wrench).all()
    smooth = [replace(job, obstacles=tuple(replace(item, friction=0.0) for item in job.obstacles)) for job in jobs]
    assert [trace.status for trace in get_engine("mujoco").run(smooth, fidelity)] == ["ok"] * 3


def test_a_change_is_told_in_per_cent():
    assert "by 30% (root mean square) with half the step" in changes_words(0.3)
    assert "beyond what can be trusted" in changes_words(float("nan"))


def test_a_whisker_that_soft_friction_lets_go_at_another_time_is_flagged():
    """Beside rod the base force erred by 75 %, with status ok."""

    def motion(times):
        place = np.array([0.004089, 0.001059, 0.000236]) + times[:, None] * np.array([0.001279, -0.029795, -0.003256])
        return place, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    ball = Obstacle((Sphere((0.0, 0.0, 0.0), 0.000569),), motion, friction=0.3)
    job = Job(WhiskerArray.mouse()["C6"].whisker, StillFollicle(), (ball,), np.arange(1, 215) * 1e-3)
    (trace,) = get_engine("mujoco").run([job], Fidelity.of("balanced,twist=false"))
    assert "with half the step" in trace.reason
