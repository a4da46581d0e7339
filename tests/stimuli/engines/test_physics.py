"""What Newton, Euler and Coulomb say, for every engine. A new engine joins with one line in ``ENGINES``."""

import math
from dataclasses import dataclass, replace
from importlib.util import find_spec
from types import SimpleNamespace

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli.engines import get_engine, list_engines
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere
from brainbench.stimuli.validation import bench_tests
from brainbench.stimuli.validation.bench_tests import ringdown
from brainbench.stimuli.whiskers.whisker import build_chain
from tests.factories.engine_scenes import C2, Swing, post

CRITICAL = replace(C2, damping_ratio=1.0)


@dataclass(frozen=True)
class Engine:
    """A backend, the step that suits it, and what its contact promises (relative to the largest value)."""

    name: str
    step: float
    turned: float
    """Difference between a scene and the same scene turned and moved."""
    path: float
    """Difference between an obstacle that turns and one that goes the same way without turning, during the motion."""
    coulomb: float
    """Error of Coulomb's law in full slip."""
    creep: float
    """Drag that is left where nothing drags."""

    @property
    def coarse(self) -> Fidelity:
        return Fidelity(links=8, time_step=self.step)


ENGINES = (
    Engine("mujoco", 1e-4, turned=2e-4, path=0.03, coulomb=0.15, creep=0.02),
    Engine("rod", 1e-4, turned=2e-4, path=0.03, coulomb=0.02, creep=0.01),
    Engine("bullet", 2e-4, turned=1e-6, path=1e-5, coulomb=0.02, creep=1e-3),
)
"""MuJoCo's friction cone is convex and soft, and its contact sees the chord of a step where something turns."""


def _param(engine):
    missing = engine.name == "bullet" and find_spec("pybullet") is None
    marks = pytest.mark.skipif(missing, reason="PyBullet is made for Python below 3.12")
    return pytest.param(engine, id=engine.name, marks=marks)


@pytest.fixture(params=[_param(engine) for engine in ENGINES])
def engine(request):
    return request.param


def _run(engine, *jobs, fidelity=None, **options):
    return get_engine(engine.name).run(jobs, fidelity or engine.coarse, **options)


def _scale(wrench):
    """Largest force and largest moment, as a divisor of [n, 6] differences."""
    return np.repeat([np.abs(wrench[:, :3]).max(), np.abs(wrench[:, 3:]).max()], 3)


def test_the_engine_is_listed_and_found_by_name(engine):
    assert engine.name in list_engines()
    assert get_engine(engine.name).name == engine.name


@pytest.mark.parametrize(
    "follicle",
    [
        Swing(angles=(0.4, 0.2, 0.3)),
        Swing(angles=(0.3, -0.2, 0.4), rest=(0.7, 0.3, 1.1)),
        Swing(shift=(1e-3, 2e-3, -1e-3)),
        Swing(angles=(0.4, 0.2, 0.3), shift=(1e-3, 2e-3, -1e-3), rest=(2.0, -0.4, -2.0)),
    ],
)
def test_a_stiff_whisker_in_free_air_shows_its_centripetal_and_euler_wrench(engine, follicle):
    stiff = replace(C2, young_modulus=5e13, damping_ratio=6.0)
    times = np.arange(1.0, 21.0) * 2e-3
    trace = _run(engine, Job(stiff, follicle, (), times), fidelity=Fidelity(links=6, time_step=2e-5))[0]
    s = np.linspace(0, stiff.arc_length, 2001)
    density = stiff.linear_density(s)[None, :, None]

    def points(at):
        position, euler = follicle.pose(at)
        return position[:, None, :] + base_rotation(euler)[:, None, :, 0] * s[:, None]

    acceleration = (points(times + 1e-5) - 2 * points(times) + points(times - 1e-5)) / 1e-10
    arm = points(times) - follicle.pose(times)[0][:, None, :]
    force = -np.trapezoid(density * acceleration, s, axis=1)
    moment = -np.trapezoid(np.cross(arm, density * acceleration), s, axis=1)
    for found, expected in ((trace.wrench[:, :3], force), (trace.wrench[:, 3:], moment)):
        assert np.linalg.norm(found - expected) < 3e-3 * np.linalg.norm(expected)
    assert not trace.contact.any()


def test_the_base_wrench_is_the_applied_force_less_the_growth_of_momentum(engine):
    force, step = np.array([0.0, 2e-6, 1e-6]), 2e-5
    times = np.arange(1.0, 400.0) * step
    job = Job(C2, StillFollicle(), (), times, loads=(Load(0.011, tuple(force)),))
    trace = _run(engine, job, fidelity=Fidelity(links=12, time_step=step), record_shape=True)[0]
    chain = build_chain(C2, 12)
    along = np.diff(trace.link_positions, axis=1)
    centres = trace.link_positions[:, :-1] + along * (chain.centres / chain.lengths)[:, None]
    momentum = np.gradient(np.einsum("l,nlk->nk", chain.masses, centres), times, axis=0)
    impulse = np.cumsum(force - trace.wrench[:, :3], axis=0) * step
    # Momentum between samples: compare growth since the first interior one.
    gained = (momentum - momentum[1])[2:-1]
    given = (impulse - impulse[1] + (force - trace.wrench[1, :3]) * step / 2)[2:-1]
    given -= (force - trace.wrench[2:-1, :3]) * step / 2
    assert np.abs(gained).max() > 1e-11
    assert np.abs(gained - given).max() < 0.02 * np.abs(gained).max()


def test_gravity_pulls_the_base_with_the_weight_of_the_whisker_when_asked(engine):
    trace = _run(engine, Job(CRITICAL, StillFollicle(), (), np.array([0.1]), gravity=(0.0, 0.0, -9.81)))[0]
    assert trace.wrench[0, 2] == pytest.approx(-9.81 * C2.mass, rel=1e-6)
    s = np.linspace(0, C2.arc_length, 4001)
    # M = r × F: a weight along −z at +x turns the base about +y.
    assert trace.wrench[0, 4] == pytest.approx(9.81 * np.trapezoid(C2.linear_density(s) * s, s), rel=1e-3)


@pytest.mark.parametrize("share", [0.3, 0.65, 1.0])
def test_a_point_load_bends_the_cantilever_by_the_closed_form(engine, share):
    at = share * C2.arc_length
    weak = 1e-3 * at / bench_tests.references.point_load_deflection(C2, 1.0, at)
    result = bench_tests.point_load(C2, weak, at, backend=engine.name)
    assert result.wrench[1] == pytest.approx(weak, rel=1e-8)
    assert result.moment_error < 1e-5
    assert result.deflection == pytest.approx(result.reference_deflection, rel=0.01)


def test_a_ringdown_shows_the_first_frequency_and_the_damping_ratio(engine):
    light = replace(C2, damping_ratio=0.15)
    result = ringdown(light, modes=1, backend=engine.name, fidelity=Fidelity(links=10, time_step=4e-5))
    assert result.frequency_error == pytest.approx(0, abs=0.01)
    assert result.damping_ratio == pytest.approx(0.15, rel=0.02)
    assert abs(result.wrench[-1, 5]) < 1e-4 * np.abs(result.wrench[:, 5]).max()


@pytest.mark.parametrize(("at", "offset", "radius"), [(0.3, 0.05, 2.5e-4), (0.5, 0.2, 1e-3), (0.7, 0.2, 2.5e-4)])
def test_a_peg_reproduces_the_elastica(engine, at, offset, radius):
    length = C2.arc_length
    result = bench_tests.peg(C2, at * length, offset * length, peg_radius=radius, backend=engine.name)
    assert result.moment_error < 0.02
    assert result.force_error < 0.02
    assert result.wrench[1] > 0
    assert result.wrench[5] > 0
    expected = bench_tests.references.elastica(C2, at * length, offset * length).arc
    assert result.contact_arc == pytest.approx(expected, rel=3e-3)


@pytest.mark.parametrize(
    "part",
    [
        Capsule((0.009, -5e-4, -0.01), (0.009, -5e-4, 0.01), 1e-3),
        Cylinder((0.009, -5e-4, -0.01), (0.009, -5e-4, 0.01), 1e-3),
        Sphere((0.009, -5e-4, 0.0), 1e-3),
        Box((0.009, -5e-4, 0.0), (1e-3, 1e-3, 1e-2)),
        ConvexPart(np.array([[x, y, z] for x in (0.008, 0.010) for y in (-1.5e-3, 5e-4) for z in (-0.01, 0.01)])),
    ],
    ids=lambda part: type(part).__name__,
)
def test_an_object_on_one_side_pushes_the_base_to_the_other_whatever_its_shape(engine, part):
    # The whisker swings down onto the object from above and rests on it.
    follicle = Swing(angles=(-0.3, 0, 0), rest=(math.pi / 2 + 0.3, 0.0, -math.pi / 2))
    times = np.arange(1.0, 26.0) * 2e-3
    trace = _run(engine, Job(CRITICAL, follicle, (Obstacle((part,), friction=0.0),), times))[0]
    assert trace.status == "ok"
    assert trace.contact[-1]
    assert not trace.contact[0]
    assert trace.wrench[-1, 1] > 0
    assert trace.wrench[-1, 5] > 0
    assert 0.007 < trace.contact_arc[-1] < 0.0115
    assert np.isnan(trace.contact_arc[~trace.contact]).all()


def test_friction_drags_the_base_along_with_a_moving_object_and_is_bounded_by_coulombs_law(engine):
    def belt(times):
        position = np.zeros((len(times), 3))
        ramp = np.clip(times / 0.05, 0, 1)
        position[:, 1] = -1.2e-3 + 6e-4 * ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
        position[:, 2] = 0.05 * np.maximum(times - 0.06, 0)
        return position, np.tile([1.0, 0, 0, 0], (len(times), 1))

    obstacle = Obstacle((Box((0.01, 0, 0), (1e-3, 1e-3, 2e-2)),), belt, friction=0.3)
    trace = _run(engine, Job(CRITICAL, StillFollicle(), (obstacle,), np.array([0.059, 0.16, 0.2])))[0]
    normal, drag = trace.wrench[:, 1], trace.wrench[:, 2]
    assert abs(drag[0]) < engine.creep * normal[0]
    assert drag[1] > 0.1 * normal[1]
    assert drag[2] == pytest.approx(0.3 * normal[2], rel=engine.coulomb)


def test_a_turning_arm_that_carries_a_ball_does_what_the_ball_on_its_circle_does(engine):
    arm, centre = 6e-3, np.array([0.010, -7.5e-3, 0.0])

    def angle(times):
        u = np.clip(times / 0.04, 0, 1)
        return np.pi / 2 - 1.2 + 1.2 * u**3 * (10 - 15 * u + 6 * u**2)

    def turning(times):
        half = angle(times) / 2
        zero = np.zeros_like(half)
        return np.tile(centre, (len(times), 1)), np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)

    def circling(times):
        around = np.stack([np.cos(angle(times)), np.sin(angle(times)), np.zeros(len(times))], axis=1)
        return centre + arm * around, np.tile([1.0, 0, 0, 0], (len(times), 1))

    times = np.arange(1.0, 36.0) * 2e-3
    a, b = _run(
        engine,
        Job(C2, StillFollicle(), (Obstacle((Sphere((arm, 0, 0), 2e-3),), turning, friction=0.0),), times),
        Job(C2, StillFollicle(), (Obstacle((Sphere((0, 0, 0), 2e-3),), circling, friction=0.0),), times),
    )
    assert a.contact[-1]
    np.testing.assert_allclose(a.wrench[-1], b.wrench[-1], atol=min(engine.path, 1e-3) * np.abs(b.wrench[-1]).max())
    assert np.linalg.norm(a.wrench - b.wrench) < engine.path * np.linalg.norm(b.wrench)


def test_moving_the_object_to_the_whisker_is_moving_the_whisker_to_the_object(engine):
    lowered = Swing(shift=(0.0, -1.5e-3, 0.0))

    def lifted(times):
        return -lowered.pose(times)[0], np.tile([1.0, 0, 0, 0], (len(times), 1))

    times = np.array([0.08, 0.1])
    part = Capsule((0.009, -1.5e-3, -0.01), (0.009, -1.5e-3, 0.01), 1e-3)
    a, b = _run(
        engine,
        Job(CRITICAL, StillFollicle(), (Obstacle((part,), lifted, friction=0.0),), times),
        Job(CRITICAL, lowered, (Obstacle((part,), friction=0.0),), times),
    )
    assert a.contact.all()
    # The search for the nearest points starts differently in the two; it ends within some 1e-5.
    np.testing.assert_allclose(a.wrench, b.wrench, atol=5e-5 * np.abs(a.wrench).max())


def test_mirrored_scenes_give_mirrored_wrenches(engine):
    times = np.arange(1.0, 51.0) * 1e-3
    curved = replace(C2, curvature=12.0)
    a, b = _run(
        engine,
        Job(curved, Swing(angles=(0.3, 0.1, 0.2)), (post(0.010, 3e-3, friction=0.0),), times),
        Job(
            replace(curved, curvature=-12.0),
            Swing(angles=(-0.3, 0.1, -0.2)),
            (post(0.010, -3e-3, friction=0.0),),
            times,
        ),
    )
    assert a.contact.any()
    # Forces mirror in y, moments as pseudo-vectors.
    np.testing.assert_allclose(b.wrench, a.wrench * [1, -1, 1, -1, 1, -1], atol=1e-5 * np.abs(a.wrench).max())
    np.testing.assert_array_equal(a.contact, b.contact)


@pytest.mark.parametrize(("turn", "shift"), [(1.1, (0.003, -0.002, 0.0)), (-2.7, (0.03, 0.01, 0.0))])
def test_a_scene_turned_about_z_and_moved_gives_turned_wrenches(engine, turn, shift):
    rotation = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    here = Swing(angles=(0.3, 0.1, 0.2))

    class There:
        def pose(self, times):
            position, euler = here.pose(times)
            return position + np.array(shift), euler + np.array([turn, 0, 0])

    place = np.array([0.010, 2e-3, 0.0])
    moved = rotation @ place + shift
    times = np.arange(1.0, 26.0) * 2e-3
    a, b = _run(
        engine,
        Job(C2, here, (post(*place[:2], friction=0.0),), times),
        Job(C2, There(), (post(*moved[:2], friction=0.0),), times),
    )
    assert a.contact.any()
    vectors = (a.wrench.reshape(-1, 2, 3) @ rotation.T).reshape(-1, 6)
    assert np.abs((b.wrench - vectors) / _scale(vectors)).max() < engine.turned


def test_a_whisker_that_cannot_be_touched_or_moved_is_not_simulated(engine):
    times = np.arange(1.0, 6.0) * 1e-2
    trace = _run(engine, Job(C2, StillFollicle(), (post(0.05, 0.0),), times), record_shape=True)[0]
    assert (trace.steps, trace.status) == (0, "ok")
    np.testing.assert_array_equal(trace.wrench, 0)
    np.testing.assert_allclose(trace.link_positions[-1, -1], [C2.arc_length, 0, 0], atol=1e-12)


@pytest.mark.parametrize("touched", [False, True])
def test_objects_out_of_reach_change_nothing(engine, touched):
    times, swing = np.arange(1.0, 31.0) * 1e-3, Swing(angles=(0.3, 0, 0))
    near = (post(0.012, 0.0025, friction=0.0),) if touched else ()
    far = (post(0.03, 0.0), Obstacle((Box((0.05, 0.0, 0.0), (1e-3, 1e-3, 1e-3)),)))
    without, with_far = _run(engine, Job(C2, swing, near, times), Job(C2, swing, (*near, *far), times))
    assert without.contact.any() == touched
    np.testing.assert_array_equal(without.wrench, with_far.wrench)


@pytest.mark.parametrize("finest", [math.inf, None])
def test_forces_are_those_of_a_frame_that_moves_along(engine, finest):
    # Galilei: a whisker that drifts onto a post feels what one at rest feels of a post that drifts onto it.
    rest = StillFollicle()
    drift = SimpleNamespace(pose=lambda t: (np.outer(t, (0.0, 0.04, 0.0)), rest.pose(t)[1]), finest=finest)
    times = np.arange(1.0, 41.0) * 1e-3
    post = Capsule((0.012, 0.001, -0.01), (0.012, 0.001, 0.01), 4e-4)
    comes = _flying(post, (0.0, 0.0, 0.0), (0.0, -0.04, 0.0))
    there, here = _run(engine, Job(C2, rest, (comes,), times), Job(C2, drift, (replace(comes, motion=None),), times))
    assert here.contact.any()
    assert np.linalg.norm(here.wrench - there.wrench) < engine.path * np.linalg.norm(there.wrench)


def test_the_recorded_shape_at_rest_is_the_rest_curve(engine):
    curved = replace(C2, curvature=20.0)
    still = StillFollicle(position=(0.001, 0.002, 0.003), euler=(0.4, 0.2, 0.9))
    trace = _run(engine, Job(curved, still, (), np.array([0.01])), record_shape=True)[0]
    chain = build_chain(curved, engine.coarse.links)
    expected = chain.points @ base_rotation(still.euler).T
    np.testing.assert_allclose(trace.link_positions[0], expected + still.position, atol=1e-9)


def test_progress_counts_the_jobs_and_impossible_workers_are_refused(engine):
    calls = []
    jobs = [Job(C2, StillFollicle(), (), np.array([0.01]))] * 3
    _run(engine, *jobs, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(1, 3), (2, 3), (3, 3)]
    with pytest.raises(UsageError, match=r"workers .*received 0"):
        _run(engine, *jobs, workers=0)


def _flying(part, start, velocity):
    """An obstacle that flies at a constant velocity (m/s) from the first instant."""

    def motion(times):
        return np.array(start) + times[:, None] * np.array(velocity), np.tile([1.0, 0, 0, 0], (len(times), 1))

    return Obstacle((part,), motion, friction=0.3)


def _assert_unstable(trace, words):
    """Flagged with a reason in words, and unknown from then on."""
    assert trace.status == "unstable"
    assert words in trace.reason
    assert np.isnan(trace.wrench[-1]).all()
    assert not trace.contact[-1]
    assert np.isnan(trace.contact_arc[-1])


def test_a_load_beyond_all_reason_is_reported_as_unstable_and_never_as_a_number(engine, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    load = Load(C2.arc_length, (0.0, 1.0, 0.0))
    _assert_unstable(_run(engine, Job(C2, StillFollicle(), (), np.array([2e-4, 0.05]), loads=(load,)))[0], "")
    assert not list(tmp_path.iterdir()), "the engine wrote a log into the user's folder"


def test_an_object_that_can_fly_through_the_whisker_within_one_step_is_unstable_and_not_missed(engine):
    flying = _flying(Box((0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3)), (0.01, -0.021, 0.0), (0.0, 20.0, 0.0))
    times = np.array([1e-3, 5e-3, 2e-2])
    trace = _run(engine, Job(C2, StillFollicle(), (flying,), times), fidelity=Fidelity(links=8, time_step=1e-3))[0]
    _assert_unstable(trace, "choose a smaller time step")
    # At 10 µs it meets the whisker and nothing is wrong.
    fine = _run(engine, Job(C2, StillFollicle(), (flying,), times), fidelity=Fidelity(links=8, time_step=1e-5))[0]
    assert "thick" not in fine.reason
    # What flies by beyond reach is not in the way.
    aside = _flying(Box((0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3)), (0.05, -0.021, 0.0), (0.0, 20.0, 0.0))
    trace = _run(engine, Job(C2, StillFollicle(), (aside,), times), fidelity=Fidelity(links=8, time_step=1e-3))[0]
    assert trace.status == "ok"


def test_a_force_along_the_whisker_that_none_bears_is_unstable_and_not_a_number(engine):
    # A chain cannot stretch and would hold any force; overlaps that can only be resolved along it make such forces.
    force = 1e3 * C2.young_modulus * math.pi * C2.base_radius**2
    pulled = Load(0.5 * C2.arc_length, (force, 0.0, 0.0))
    trace = _run(engine, Job(C2, StillFollicle(), (), np.array([1e-3, 0.02]), loads=(pulled,)))[0]
    _assert_unstable(trace, "0.367 N stretch the whisker by 1%")
