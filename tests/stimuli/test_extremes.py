"""Whiskers far from the usual: each case obeys mechanics, is flagged ``unstable``, or is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad

from brainbench.core.errors import UsageError
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, Obstacle, Sphere
from brainbench.stimuli.validation import bench_tests
from brainbench.stimuli.whiskers.whisker import build_chain
from tests.factories.engine_scenes import C2

pytestmark = pytest.mark.slow

AT, PUSH, PEG = 0.007, 1e-3, 5e-4
LONG_STEPS, SHORT_STEPS = (1e-5, 1e-4, 1e-3, 5e-3), (1e-6,)


def _run(job, fidelity, *, retry=4, **options):
    return get_engine("mujoco", retry=retry).run([job], fidelity, workers=1, **options)[0]


def _moving(shape, start, end, duration, friction=0.0):
    """An obstacle that moves smoothly from one place to another and stops there."""

    def motion(times):
        u = np.clip(times / duration, 0, 1)[:, None]
        position = np.array(start) + u**3 * (10 - 15 * u + 6 * u**2) * (np.array(end) - np.array(start))
        return position, np.tile([1.0, 0, 0, 0], (len(times), 1))

    return Obstacle((shape,), motion, friction)


def _peg(at=AT, push=PUSH, duration=0.02, radius=PEG, whisker=C2):
    """A rod along z that pushes the point ``at`` sideways by ``push`` (m; towards −y when negative)."""
    gap = math.copysign(radius + float(whisker.radius(at)), push)
    rod = Capsule((0.0, 0.0, -0.02), (0.0, 0.0, 0.02), radius)
    return _moving(rod, (at, -gap, 0), (at, push - gap, 0), duration)


def _press(tip_radius, young_modulus, time_step):
    """Push a whisker aside and hold it; very short steps for a shorter time."""
    whisker = replace(C2, tip_radius=tip_radius, young_modulus=young_modulus, damping_ratio=1.0)
    duration = 0.02 if time_step < 5e-6 else 0.1
    job = Job(
        whisker, StillFollicle(), (_peg(whisker=whisker, duration=duration / 2),), np.array([duration / 2, duration])
    )
    return _run(job, Fidelity(links=10, time_step=time_step), record_shape=True)


def _imbalance(trace):
    """Distance of the last base moment from contact point × base force, over the size of the moment."""
    joints = trace.link_positions[-1]
    arcs = np.linspace(0, C2.arc_length, len(joints))
    point = np.array([np.interp(trace.contact_arc[-1], arcs, joints[:, axis]) for axis in range(3)])
    force, moment = trace.wrench[-1, :3], trace.wrench[-1, 3:]
    return float(np.linalg.norm(np.cross(point, force) - moment) / np.linalg.norm(moment))


def _sound(trace):
    """Finite and called ok, or NaN to the end and called unstable with a reason: never wrong in silence."""
    finite = np.isfinite(trace.wrench).all(axis=1)
    if trace.status == "ok":
        return bool(finite.all())
    return bool(trace.reason) and not finite[-1]


@pytest.mark.parametrize("time_step", SHORT_STEPS + LONG_STEPS)
@pytest.mark.parametrize("young_modulus", [1e6, 5e9, 1e11])
@pytest.mark.parametrize("tip_radius", [1.5e-6, 30e-6])
def test_a_held_whisker_balances_its_peg_or_is_flagged(tip_radius, young_modulus, time_step):
    trace = _press(tip_radius, young_modulus, time_step)
    assert _sound(trace)
    if trace.status == "ok" and trace.contact[-1] and young_modulus >= 1e9 and time_step <= 1e-3:
        # The soft whisker is still moving; the stiff one is at rest, where moment = contact point × force.
        assert _imbalance(trace) < 0.02


@pytest.mark.parametrize("time_step", [1e-5, 1e-4, 1e-3, 5e-3])
@pytest.mark.parametrize("speed", [0.1, 1.0, 5.0, 20.0])
@pytest.mark.parametrize("at", [0.009, 0.013])
def test_a_box_that_sweeps_past_lets_the_whisker_come_to_rest_or_is_too_fast_for_the_step(at, speed, time_step):
    box = Box((0.0, 0.0, 0.0), (2e-3, 1e-3, 5e-3))
    travel = 0.02 / speed
    sweep = _moving(box, (at, -0.01, 0.0), (at, 0.01, 0.0), 2 * travel, friction=0.48)
    times = np.linspace(travel / 20, 2 * travel + 0.1, 200)
    # Without second tries, whose steps are shorter.
    trace = _run(Job(C2, StillFollicle(), (sweep,), times), Fidelity(links=10, time_step=time_step), retry=1)
    assert _sound(trace)
    if time_step > 1.1 * 2e-3 / speed:
        # It moves on by more than its thickness of 2 mm in most steps.
        assert trace.status == "unstable"
    if trace.status == "ok":
        # At 20 m/s it is past between two readings.
        assert trace.contact.any() or trace.penetration > 0
        # Blows of some tenths of a newton at 5 m/s; 1.5 N break keratin of this thickness.
        assert np.linalg.norm(trace.wrench[:, :3], axis=1).max() < 1.0
        assert not trace.contact[-1]
        assert np.linalg.norm(trace.wrench[-1, 3:]) <= 1e-3 * np.linalg.norm(trace.wrench[:, 3:], axis=1).max()


@pytest.mark.parametrize("radius", [1e-4, 1e-3, 5e-3])
@pytest.mark.parametrize("off", [0.0, 2e-5])
def test_a_whisker_that_starts_deep_inside_an_object_says_how_deep_or_is_flagged(radius, off):
    ball = Obstacle((Sphere((0.008, off, 0.0), radius),), friction=0.0)
    trace = _run(Job(C2, StillFollicle(), (ball,), np.linspace(0.01, 0.2, 20)), Fidelity(links=10))
    assert _sound(trace)
    # Unbent, the thickness of the rod and the whole radius of the ball overlap.
    assert trace.penetration > 0.5 * radius


def test_a_whisker_that_slips_off_its_peg_forgets_it():
    at = 0.9 * C2.arc_length
    trace = _run(
        Job(C2, StillFollicle(), (_peg(at, 0.008, 0.1),), np.linspace(0.001, 0.2, 200)), Fidelity.preset("balanced")
    )
    assert trace.status == "ok"
    assert trace.contact.any()
    assert not trace.contact[-1]
    assert np.abs(trace.wrench[-1]).max() < 1e-4 * np.abs(trace.wrench).max()


def test_two_pegs_at_once_share_the_load_as_beam_theory_says():
    (a, push_a), (b, push_b) = (0.005, 5e-5), (0.010, -1e-4)
    whisker = replace(C2, damping_ratio=1.0)
    pegs = (_peg(a, push_a, 0.05), _peg(b, push_b, 0.05))
    trace = _run(Job(whisker, StillFollicle(), pegs, np.array([0.15])), Fidelity.preset("accurate"))

    def compliance(p, q):
        bend = quad(lambda s: (p - s) * (q - s) / float(C2.bending_stiffness(s)), 0, min(p, q), epsabs=0)
        return bend[0]

    forces = np.linalg.solve(
        [[compliance(a, a), compliance(a, b)], [compliance(b, a), compliance(b, b)]], [push_a, push_b]
    )
    assert trace.wrench[-1, 1] == pytest.approx(forces.sum(), rel=0.02)
    assert trace.wrench[-1, 5] == pytest.approx(forces @ [a, b], rel=0.02)


def test_sixty_links_agree_with_the_elastica():
    result = bench_tests.peg(C2, 0.6 * C2.arc_length, 0.1 * C2.arc_length, fidelity=Fidelity(links=60, time_step=2e-4))
    assert result.moment_error < 0.01
    assert result.force_error < 0.01


@pytest.mark.parametrize("values", [{"links": 1}, {"time_step": 1e-2}, {"links": 1000}])
def test_settings_that_cannot_be_right_are_refused(values):
    with pytest.raises(UsageError, match=r"at least .* and at most"):
        Fidelity(**values)


@pytest.mark.parametrize("time_step", [1e-6, 1e-4, 5e-3])
def test_an_empty_scene_is_exactly_silent(time_step):
    trace = _run(Job(C2, StillFollicle(), (), np.linspace(0.001, 0.02, 20)), Fidelity(time_step=time_step))
    assert trace.status == "ok"
    assert (trace.wrench == 0).all()


@pytest.mark.parametrize("time_step", [1e-6, 1e-5, 1e-4])
def test_a_free_whisker_without_damping_loses_no_more_energy_than_the_step_takes(time_step):
    # A backward Euler step of length h damps a mode by the ratio ω h/2: the energy falls as exp(−ω² h t).
    whisker = replace(C2, damping_ratio=0.0)
    chain = build_chain(whisker, 10)
    omega = float(chain.frequencies()[0])
    bends = chain.mode_shape(0) * 1e-4
    levers = np.triu(chain.nodes[None, 1:] - chain.nodes[:-1, None])
    forces = np.linalg.solve(levers, chain.stiffness * bends)
    loads = tuple(Load(float(s), (0.0, float(f), 0.0)) for s, f in zip(chain.nodes[1:], forces, strict=True))
    times = np.linspace(0.001, 0.04 if time_step < 5e-6 else 0.1, 1000)
    trace = _run(
        Job(whisker, StillFollicle(), (), times, loads=loads),
        Fidelity(links=10, time_step=time_step),
        record_shape=True,
    )
    # Under a constant load it swings about the static bend: from −1 to +1 times that, without loss.
    swing = trace.link_positions[:, -1, 1] / float(levers[:, -1] @ bends) - 1
    rate = omega**2 * time_step / 2
    envelope = np.exp(-rate * times)
    assert (np.abs(swing) <= envelope * 1.02 + 0.005).all()
    late = times > times[-1] - 2 * np.pi / omega
    assert np.abs(swing[late]).max() == pytest.approx(envelope[late].max(), rel=0.06, abs=2e-3)


def test_the_base_force_of_a_whisker_waved_in_air_is_its_mass_times_acceleration():
    class Shaken:
        def pose(self, times):
            position = np.zeros((len(times), 3))
            position[:, 1] = 1e-3 * np.sin(2 * np.pi * 40 * times)
            return position, np.tile([math.pi / 2, 0.0, -math.pi / 2], (len(times), 1))

    step = 2e-5
    fidelity = Fidelity(links=10, time_step=step)
    times = 0.1 + step * np.arange(1000)
    trace = _run(Job(C2, Shaken(), (), times), fidelity, record_shape=True)
    chain = build_chain(C2, 10)
    joints = trace.link_positions
    share = (chain.centres / chain.lengths)[None, :, None]
    centres = joints[:, :-1] + share * np.diff(joints, axis=1)
    momentum = np.einsum("i,nik->nk", chain.masses, centres)
    inertia = -np.diff(momentum, n=2, axis=0) / step**2
    np.testing.assert_allclose(trace.wrench[1:-1, 1], inertia[:, 1], atol=0.02 * np.abs(inertia[:, 1]).max())
