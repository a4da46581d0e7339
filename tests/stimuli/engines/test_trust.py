"""What the engines share: how far things move in a step, and what then cannot be trusted."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from brainbench.geometry import Mesh
from brainbench.stimuli import WhiskerArray, references
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.reach import reachable
from brainbench.stimuli.engines.trust import (
    AT_BASE,
    BENT,
    GOT_INSIDE,
    LOST,
    STARTED_INSIDE,
    force_change,
    halved,
    judge,
    passed_unseen,
    residual,
    step_travel,
    strongest_force,
    without_escape,
)
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Capsule, Obstacle, Sphere
from brainbench.stimuli.whiskers.whisker import Whisker
from tests.factories.engines import facts

WHISKER = Whisker(0.02, 50e-6, 5e-6, young_modulus=4e9, density=1260.0, damping_ratio=0.3)
TIMES = np.linspace(0.0, 0.01, 11)
STILL = StillFollicle().pose(TIMES)
CORNERS = np.array([[0.0, 0, 0], [1e-3, 0, 0], [0, 1e-3, 0], [0, 0, 1e-3]])
TETRAHEDRON = Mesh(CORNERS, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32))


def _moving(place, turn=None):
    def motion(times):
        half = np.zeros(len(times)) if turn is None else turn * times / 2
        zero = np.zeros(len(times))
        return np.outer(times, place), np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)

    return motion


def test_the_travel_of_a_step_adds_that_of_the_whisker_and_that_of_the_object():
    position, euler = np.outer(TIMES, [0.1, 0, 0]), np.outer(TIMES, [2.0, 0, 0]) + STILL[1]
    ball = Obstacle((Sphere((5e-3, 0, 0), 1e-3),), _moving((0, 0.3, 0), turn=4.0))
    travel = step_travel(WHISKER, position, euler, ball, TIMES)
    # Per millisecond: base .1 mm, tip 2 rad/s × 20 mm, object .3 mm, its far side at most 4 rad/s × |(6, 1, 1)| mm.
    np.testing.assert_allclose(travel, 1e-3 * (0.1 + 2.0 * 0.02 + 0.3 + 4.0 * 6e-3 * math.sqrt(1 + 2 / 36)), rtol=1e-5)
    still = Obstacle((Sphere((5e-3, 0, 0), 1e-3),))
    np.testing.assert_allclose(step_travel(WHISKER, position, euler, still, TIMES), 1e-4 + 4e-5, rtol=1e-9)


@pytest.mark.parametrize(
    ("obstacle", "thickness"),
    [
        (Obstacle((Capsule((0.01, -0.02, -5e-3), (0.01, -0.02, 5e-3), 2e-4),), _moving((0, 4.0, 0))), 0.5),
        (Obstacle((), _moving((0.0, 4.0, 0)), surface=TETRAHEDRON.transformed(np.eye(3), [0.01, -0.02, 0])), 1.1),
    ],
    ids=["part", "surface"],
)
def test_an_object_that_flies_farther_than_half_its_thickness_may_pass_unfelt(obstacle, thickness):
    job = Job(WHISKER, StillFollicle(), (obstacle,), TIMES[1:])
    reach = reachable(WHISKER, STILL[0], (obstacle,), TIMES, surfaces=True)
    step, reason = passed_unseen(job, reach, *STILL, TIMES)
    assert step < 5
    assert re.search(f"4 mm .* {TIMES[step]:g} s", reason)
    assert f"half of its {thickness:g} mm" in reason
    # Seen only behind its middle, an object that moves on has let go: no force is felt.
    seen_once = np.arange(0.0, 0.01, 0.75e-3 * thickness / 4)
    assert passed_unseen(job, reach, *StillFollicle().pose(seen_once), seen_once)[1]
    fine = np.linspace(0.0, 0.01, 201)
    assert passed_unseen(job, reach, *StillFollicle().pose(fine), fine) == (200, "")


def test_the_force_that_no_whisker_bears_stretches_its_base_by_a_hundredth():
    # .01 E A = .01 × 4e9 Pa × π (50 µm)²; keratin yields at some .02.
    assert strongest_force(WHISKER) == pytest.approx(0.314159, rel=1e-4)


@pytest.mark.parametrize(
    ("changed", "until", "retryable", "words"),
    [
        ({}, np.inf, False, ""),
        ({"crowded": 2}, np.inf, False, ""),
        ({"status": BENT, "failed": 0.3}, 0.3, True, "a joint bent by more than 1.5 rad"),
        ({"status": LOST, "failed": 0.3}, 0.3, True, "stopped being finite"),
        ({"status": STARTED_INSIDE, "failed": 0.0, "depth": 4e-3}, 0.0, False, "starts 4 mm deep"),
        ({"status": GOT_INSIDE, "failed": 0.3, "depth": 7e-4}, 0.3, True, "0.7 mm deep in an object at 0.3 s"),
        ({"status": AT_BASE, "failed": 0.3}, 0.3, False, "base point, where nothing is felt, at 0.3 s"),
        ({"strength": 31.0, "strong_at": 0.2}, 0.2, False, "reached 31 N, and 30 N stretch"),
        ({"strength": 31.0, "strong_at": 0.2, "status": BENT, "failed": 0.3}, 0.2, True, "stretch the whisker"),
        ({"strength": 31.0, "strong_at": 0.4, "status": BENT, "failed": 0.3}, 0.3, True, "a joint bent"),
        ({"travel": 9e-4, "fast_at": 0.1}, 0.1, False, "moves by 0.9 mm"),
        ({"travel": 9e-4, "fast_at": 0.1, "status": BENT, "failed": 0.3}, 0.1, False, "moves by 0.9 mm"),
        ({"residual": 0.06}, -np.inf, True, "missed by 6%"),
        ({"residual": np.nan}, -np.inf, True, "contact forces missed"),
        ({"crowded": 3}, -np.inf, True, "in 3 of 100 steps"),
        ({"residual": 0.06, "strength": 31.0, "strong_at": 0.2}, 0.2, False, "stretch the whisker"),
    ],
)
def test_what_goes_wrong_first_is_told_and_finer_steps_are_tried_where_they_may_mend_it(
    changed, until, retryable, words
):
    verdict = judge(facts(**changed))
    assert verdict.until.tolist() == [until]
    assert verdict.retryable.tolist() == [retryable]
    assert verdict.unstable.tolist() == [until < np.inf]
    assert words in verdict.reasons[0]
    assert bool(verdict.reasons[0]) == verdict.unstable[0]


def test_the_residual_is_what_changed_last_over_the_forces():
    np.testing.assert_allclose(residual(np.array([0.04, 0.0]), np.array([4.0, 0.0])), [0.1, 0.0])


@pytest.mark.parametrize(
    ("changed", "suspicious"),
    [
        ({}, False),
        ({"peak": 0.46, "third": 0.45}, True),
        ({"peak": 0.44, "third": 0.43}, False),
        ({"third": 4e-4}, True),
        ({"depth": 2.1e-4}, True),
        ({"residual": 0.021}, True),
        ({"residual": 0.06}, False),
        ({"status": BENT, "failed": 0.3, "depth": 3e-4}, False),
    ],
)
def test_whiskers_near_a_limit_are_suspicious_and_those_beyond_it_are_not(changed, suspicious):
    assert judge(facts(**changed)).suspicious.tolist() == [suspicious]


def test_a_force_that_changes_by_a_fifth_with_half_the_step_is_flagged_and_tried_again():
    verdict, which = judge(facts(depth=3e-4)), np.array([True])
    kept = halved(verdict, np.array([0.19]), which)
    assert (kept.unstable.tolist(), kept.suspicious.tolist(), kept.reasons[0]) == ([False], [False], "")
    for change, words in ((0.23, "by 23%"), (np.nan, "beyond what can be trusted")):
        found = halved(verdict, np.array([change]), which)
        assert (found.until.tolist(), found.retryable.tolist()) == ([-np.inf], [True])
        assert words in found.reasons[0]
    assert not halved(verdict, np.array([np.nan]), ~which).unstable.any()
    force = np.zeros((1, 4, 2, 3))
    force[..., 0] = 1.0
    np.testing.assert_allclose(force_change(force, force * [[1.25], [0.8]]), [[0.2, 0.2]])
    assert force_change(force, -force).tolist() == [[2.0, 2.0]]


def test_forces_that_do_not_matter_do_not_change_by_any_share():
    force = np.full((1, 30, 1, 3), 1e-11)
    assert force_change(force, 3 * force)[0, 0] < 0.1
    assert force_change(1e3 * force, 3e3 * force)[0, 0] > 0.5


@pytest.mark.parametrize("fidelity", ["fast", "accurate"])
@pytest.mark.parametrize("overlap", [0.0, 5e-6])
def test_a_whisker_that_touches_a_still_object_from_the_start_holds_it(overlap, fidelity):
    straight = replace(WhiskerArray.rat()["C2"].whisker, curvature=0.0, friction=0.0)
    middle = straight.arc_length / 2
    ball = Obstacle((Sphere((middle, overlap - 1e-3 - float(straight.radius(middle)), 0), 1e-3),))
    job = Job(straight, StillFollicle(), (ball,), np.arange(1, 61) * 1e-3)
    (trace,) = get_engine("rod").run([job], Fidelity.of(fidelity), workers=1)
    assert trace.status == "ok", trace.reason
    expected = overlap / references.point_load_deflection(straight, 1.0, middle)
    assert np.linalg.norm(trace.wrench[-1, :3]) == pytest.approx(expected, rel=0.1, abs=1e-9)


def test_a_blow_at_the_start_of_a_force_that_stays_is_compared():
    force = np.full((1, 30, 1, 3), 1e-4)
    half = force.copy()
    half[0, :20] *= 2
    assert force_change(force, half)[0, 0] > 0.3


@pytest.mark.parametrize("curvature", [0.0, 20.0])
def test_a_straight_whisker_that_is_pushed_along_itself_is_told_no_shorter_step(curvature):
    whisker = replace(WHISKER, curvature=curvature)
    ball = Obstacle((Sphere((whisker.arc_length + 1.2e-3, 0, 0), 1e-3),), _moving((-0.05, 0, 0)))
    job = Job(whisker, StillFollicle(), (ball,), np.arange(1, 20) * 1e-3)
    words = "the whisker was 0.5 mm deep in an object at 0.014 s; choose a smaller time step"
    told = without_escape(words, job, 0.014)
    assert (told == words) == bool(curvature)
    if not curvature:
        assert "no shorter step helps" in told
        assert "smaller time step" not in told
