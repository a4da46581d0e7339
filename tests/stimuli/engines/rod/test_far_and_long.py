"""Where a scene stands, how long it lasts, and what else stands in it: none of it changes what is felt."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.engines.rod.engine import RodEngine
from brainbench.stimuli.motion.jobs import Job, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, Obstacle, Sphere
from tests.factories.engine_scenes import C2, Oscillation, post

pytest.importorskip("warp")

BALANCED = Fidelity.preset("balanced")
WHISKING = Oscillation(angles=(0.35, 0.0, 0.0), frequency=20.0)
TIMES = np.arange(1, 151) * 1e-3


@dataclass(frozen=True)
class _Elsewhere:
    """A motion, displaced (m) and then moving on (m/s)."""

    motion: Oscillation
    by: tuple[float, float, float]
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def pose(self, times):
        position, euler = self.motion.pose(times)
        return position + np.array(self.by) + times[:, None] * np.array(self.velocity), euler


def _felt(follicle, obstacles, times=TIMES, fidelity=BALANCED):
    trace = RodEngine().run([Job(C2, follicle, tuple(obstacles), times)], fidelity)[0]
    assert trace.status == "ok"
    assert trace.contact.any()
    return trace


def _far(found, expected):
    """Largest difference of force and of moment, of the largest of each."""
    return [
        np.abs(found - expected)[:, some].max() / np.abs(expected[:, some]).max() for some in (slice(3), slice(3, 6))
    ]


def _bodies(by):
    """A post, a box and a ball around the whisker, displaced."""
    stick = Capsule(*(tuple(np.add(end, by)) for end in ((0.01, 0.003, -0.02), (0.01, 0.003, 0.02))), 1e-3)
    cube = Box(tuple(np.add((0.006, -0.0045, 0.0), by)), (1e-3, 2e-3, 2e-3))
    return Obstacle((stick,)), Obstacle((cube,)), Obstacle((Sphere(tuple(np.add((0.012, -0.004, 1e-3), by)), 1e-3),))


@pytest.mark.parametrize("distance", [1.0, 10.0, 100.0])
def test_a_scene_far_from_the_origin_feels_the_same(distance):
    by = (distance, 0.5003 * distance, -0.3331 * distance)
    here = _felt(WHISKING, _bodies((0.0, 0.0, 0.0)))
    there = _felt(_Elsewhere(WHISKING, by), _bodies(by))
    assert max(_far(there.wrench, here.wrench)) < 1e-3


@pytest.mark.slow
def test_a_scene_that_travels_ten_metres_feels_the_same():
    """Whisker and post move on together at 1 m/s, for .25 s and for 10.25 s."""
    velocity = (0.8, -0.5, 0.33)

    def motion(times):
        return times[:, None] * np.array(velocity), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    follicle = _Elsewhere(WHISKING, (0.0, 0.0, 0.0), velocity)
    times = 0.2 + np.arange(1, 51) * 1e-3
    soon, late = (_felt(follicle, [replace(post(0.01, 0.003), motion=motion)], times + end) for end in (0.0, 10.0))
    assert max(_far(late.wrench, soon.wrench)) < 1e-3


@pytest.mark.parametrize("end", [10.0, pytest.param(100.0, marks=pytest.mark.slow)])
def test_whisking_feels_at_the_end_of_a_long_run_what_it_felt_at_the_beginning(end):
    whisk = np.arange(1, 51) * 1e-3
    trace = _felt(WHISKING, [post(0.01, 0.003)], np.concatenate([0.2 + whisk, end + whisk]))
    assert max(_far(trace.wrench[50:], trace.wrench[:50])) < 1e-3


def _balls(count, low, high, seed=0):
    """Small balls at distances between ``low`` and ``high`` (m), none near the plane of whisking."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        place = rng.uniform(-high, high, 3)
        if low < np.linalg.norm(place) < high and abs(place[2]) > 2e-3:
            found.append(Obstacle((Sphere(tuple(place), 2e-4),)))
    return found


@pytest.mark.parametrize(("low", "high", "count"), [(0.0, 0.014, 500), (0.03, 0.3, 10_000)])
def test_objects_that_are_not_touched_change_no_digit(low, high, count):
    touched = _bodies((0.0, 0.0, 0.0))
    alone = _felt(WHISKING, touched)
    among = _felt(WHISKING, [*_balls(count, low, high), *touched])
    np.testing.assert_array_equal(among.wrench, alone.wrench)
    assert among.steps == alone.steps


def test_a_step_is_split_only_for_what_is_about_to_be_touched():
    """Balls beside the plane of a fast whisker, .6 mm off and never approached, and one that flies past far away."""
    fidelity = Fidelity(links=10, time_step=1e-3)
    beside = [Obstacle((Sphere((x, 0.0, z), 4e-4),)) for x in (0.006, 0.009, 0.012) for z in (-1.1e-3, 1.1e-3)]

    def motion(times):
        return times[:, None] * np.array([0.0, 0.14, 0.0]), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

    flying = Obstacle((Sphere((0.012, -0.02, 0.006), 1e-3),), motion)
    touched = [post(0.01, 0.003)]
    alone = _felt(WHISKING, touched, fidelity=fidelity)
    among = _felt(WHISKING, [*touched, *beside, flying], fidelity=fidelity)
    assert among.steps == alone.steps
    np.testing.assert_array_equal(among.wrench, alone.wrench)


@pytest.mark.slow
def test_a_still_whisker_touched_after_a_long_rest_feels_it_as_at_once():
    def ball(delay):
        def motion(times):
            place = np.zeros((len(times), 3))
            place[:, 1] = 0.05 * np.clip(times - delay, 0.0, 0.06)
            return place, np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1))

        return Obstacle((Sphere((0.01, -0.002, 0.0), 1e-3),), motion)

    soon = _felt(StillFollicle(), [ball(0.0)])
    late = _felt(StillFollicle(), [ball(20.0)], 20.0 + TIMES)
    assert max(_far(late.wrench, soon.wrench)) < 1e-3


@pytest.mark.slow
def test_an_object_that_takes_minutes_follows_its_way_as_a_faster_one_does():
    """Its velocity changes by less from one millisecond to the next than that of a straight motion may."""
    felt = []
    for duration in (2.0, 100.0):

        def motion(times, duration=duration):
            u = np.clip(times / duration, 0.0, 1.0)[:, None]
            return 1e-3 * u * u * (3 - 2 * u) * np.array([0.0, 1.0, 0.0]), np.tile(
                [1.0, 0.0, 0.0, 0.0], (len(times), 1)
            )

        motion.finest = duration
        bar = Obstacle((Capsule((0.008, -0.6e-3, -8e-3), (0.008, -0.6e-3, 8e-3), 0.5e-3),), motion, 0.0)
        felt.append(
            _felt(
                StillFollicle(), [bar], duration * np.linspace(0.1, 1.0, 10), Fidelity(links=8, time_step=1e-3)
            ).wrench
        )
    assert max(_far(felt[1], felt[0])) < 5e-3
