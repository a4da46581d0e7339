"""The PyBullet backend against Newton's laws, the elastica, the MuJoCo backend and Bullet's own time step."""

from __future__ import annotations

import math
import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.core.errors import MissingDependencyError, UsageError
from brainbench.core.rotations import base_rotation
from brainbench.stimuli import get_recipe
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.bullet import engine
from brainbench.stimuli.engines.bullet.engine import (
    FOLLICLE,
    MOST_LINKS,
    BulletWorld,
    contact_axes,
    cross_matrix,
    solve_contacts,
)
from brainbench.stimuli.engines.fidelity import Fidelity
from brainbench.stimuli.motion.jobs import Job, Load, StillFollicle
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Obstacle, Sphere
from brainbench.stimuli.scenes.scene import Frames
from brainbench.stimuli.validation import bench_tests
from brainbench.stimuli.whiskers.whisker import Whisker, build_chain
from tests.factories.engine_scenes import C2, Swing, post

needs_bullet = pytest.mark.skipif(find_spec("pybullet") is None, reason="PyBullet is made for Python below 3.12")
COARSE = Fidelity(links=8, time_step=2e-4)


def _run(*jobs, fidelity=COARSE, backend="bullet", **options):
    return get_engine(backend).run(jobs, fidelity, **options)


def test_without_pybullet_the_error_names_the_extra_or_the_python(monkeypatch):
    monkeypatch.setitem(sys.modules, "pybullet", None)
    with pytest.raises(MissingDependencyError, match=r"\[bullet\]"):
        engine.engine()
    monkeypatch.setattr(sys, "version_info", (3, 12, 0, "final", 0))
    with pytest.raises(MissingDependencyError, match=r"'bullet' .*3\.12.*'mujoco'"):
        _run(Job(C2, StillFollicle(), (), np.array([0.01])))


@needs_bullet
@pytest.mark.parametrize(
    "part",
    [
        Capsule((0.0, 0.0, -0.002), (0.0, 0.0, 0.002), 1e-3),
        Cylinder((0.0, 0.0, 0.002), (0.0, 0.0, -0.002), 1e-3),
        Cylinder((-0.002, 0.0, 0.0), (0.002, 0.0, 0.0), 1e-3),
        Sphere((0.0, 0.0, 0.0), 1e-3),
        Box((0.0, 0.0, 0.0), (2e-3, 3e-3, 1e-3), (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)),
        ConvexPart(np.array([[x, y, z] for x in (-2e-3, 2e-3) for y in (-1e-3, 1e-3) for z in (-1e-3, 1e-3)])),
    ],
)
@pytest.mark.parametrize("gap", [0.01, -0.003])
def test_distances_to_every_shape_are_those_of_geometry(part, gap):
    cylinder = Whisker(0.01, 50e-6, 50e-6, young_modulus=5e9, density=1300.0, damping_ratio=0.3)
    with BulletWorld(build_chain(cylinder, 2), [Obstacle((part,))], 0.0, np.zeros(3)) as world:
        # The second link runs from 5 to 10 mm along x; all parts reach 1 mm from their centre along y.
        world.place([0.0] * (FOLLICLE + 4))
        world.place_obstacle(0, np.array([7.5, -1.05 - gap, 0.0]), np.array([1.0, 0, 0, 0]))
        (link, obstacle, point, normal, distance), *_ = world.closest(0.1)
    assert (link, obstacle) == (1, 0)
    assert distance == pytest.approx(gap, abs=1e-6)
    np.testing.assert_allclose(normal, [0, 1, 0], atol=1e-5)
    assert point[1] == pytest.approx(-0.05, abs=1e-6)


@needs_bullet
def test_the_joint_space_inertia_is_that_of_the_chain():
    chain = build_chain(C2, 7)
    with BulletWorld(chain, [], math.inf, np.zeros(3)) as world:
        hinges = world.mass_matrix([0.0] * (FOLLICLE + 14))[FOLLICLE:, FOLLICLE:]
    # Bullet's unit is mg·mm² = 1e-12 kg·m²; about z the chain states its own.
    np.testing.assert_allclose(hinges[1::2, 1::2] * 1e-12, chain._planar_mass(), rtol=1e-5)


@needs_bullet
def test_more_links_than_pybullet_moves_are_refused():
    job = Job(C2, StillFollicle(), (), np.array([0.01]), gravity=(0.0, 0.0, -9.81))
    assert _run(job, fidelity=Fidelity(links=MOST_LINKS, time_step=1e-3))[0].status == "ok"
    with pytest.raises(UsageError, match=r"60 links .*received 61"):
        _run(job, fidelity=Fidelity(links=MOST_LINKS + 1, time_step=1e-3))
    with pytest.raises(UsageError, match=r"workers .*received 0"):
        _run(job, workers=0)


CRITICAL = replace(C2, damping_ratio=1.0)


def _scale(wrench):
    """Largest force and largest moment, as a divisor of [n, 6] differences."""
    return np.repeat([np.abs(wrench[:, :3]).max(), np.abs(wrench[:, 3:]).max()], 3)


@needs_bullet
@pytest.mark.slow
@pytest.mark.parametrize(
    ("at", "offset"),
    [(0.3, 0.05), (0.3, 0.1), (0.5, 0.05), (0.5, 0.1), (0.5, 0.2), (0.7, 0.05), (0.7, 0.1), (0.7, 0.2)],
)
def test_at_preset_accurate_the_moment_is_within_1_and_the_force_within_2_percent(at, offset):
    result = bench_tests.peg(C2, at * C2.arc_length, offset * C2.arc_length, backend="bullet", fidelity="accurate")
    assert result.moment_error < 0.01
    assert result.force_error < 0.02


@needs_bullet
@pytest.mark.slow
@pytest.mark.parametrize("label", ["convex-close", "concave-medium"])
def test_the_rodgers_stimuli_feel_alike_on_both_engines_at_fine_steps(label):
    (scene,) = (scene for scene in get_recipe("rodgers", whiskers="C1").scenes if scene.label == label)
    scene = replace(scene, frames=Frames(0.001, 0.001, 149))
    # Contacts of bullet touch straight links.
    ours, rod = (
        _run(*scene.jobs(), backend=name, fidelity=Fidelity(links=10, time_step=2e-5, contact_line=line))[0]
        for name, line in (("bullet", None), ("rod", "links"))
    )
    moments = [np.linalg.norm(trace.wrench[:, 3:], axis=1) for trace in (ours, rod)]
    assert moments[1].max() > 1e-8
    assert moments[0].max() == pytest.approx(moments[1].max(), rel=0.03)
    assert np.sqrt(np.mean((moments[0] - moments[1]) ** 2)) < 0.04 * moments[1].max()
    assert ours.contact.any()


@needs_bullet
def test_the_twisting_moment_of_a_curved_whisker_is_that_of_mujoco():
    curved = replace(C2, curvature=25.0)
    job = Job(curved, Swing(angles=(0.3, 0.2, 0.5), rest=(0.9, 0.4, -0.6)), (), np.arange(1.0, 31.0) * 2e-3)
    (ours,), (mujoco) = _run(job), _run(job, backend="mujoco")[0]
    assert np.abs((ours.wrench - mujoco.wrench) / _scale(mujoco.wrench)).max() < 0.01
    base = base_rotation(job.follicle.pose(job.times)[1])
    twist = np.einsum("nk,nk->n", mujoco.wrench[:, 3:], base[:, :, 0])
    assert np.abs(twist).max() > 0.01 * np.abs(mujoco.wrench[:, 3:]).max()


SWEEP = Swing(angles=(0.25, 0.1, 0.2), shift=(3e-4, 0.0, 0.0))
SWEPT = np.arange(1.0, 31.0) * 2e-3


@needs_bullet
def test_a_gentle_contact_is_felt_as_in_mujoco():
    job = Job(CRITICAL, SWEEP, (post(0.010, 0.0022, friction=0.0),), SWEPT)
    ours, mujoco = _run(job)[0], _run(job, backend="mujoco")[0]
    assert ours.status == mujoco.status == "ok"
    assert ours.contact[-1]
    assert np.abs((ours.wrench[-1] - mujoco.wrench[-1]) / _scale(mujoco.wrench)).max() < 0.03
    assert np.abs((ours.wrench - mujoco.wrench) / _scale(mujoco.wrench)).max() < 0.1
    assert ours.contact_arc[-1] == pytest.approx(mujoco.contact_arc[-1], rel=5e-3)
    assert np.isnan(ours.contact_arc[~ours.contact]).all()


@pytest.mark.slow
@needs_bullet
def test_with_friction_a_resting_whisker_keeps_the_drag_and_the_step_does_not_matter():
    job = Job(CRITICAL, SWEEP, (post(0.010, 0.0022, friction=0.48),), SWEPT)
    coarse, fine = (_run(job, fidelity=Fidelity(links=8, time_step=step))[0] for step in (2e-4, 5e-5))
    assert np.abs((coarse.wrench - fine.wrench) / _scale(fine.wrench)).max() < 0.01
    # The sweep ends after 40 ms; MuJoCo's soft friction then creeps, and says so, Coulomb's does not.
    np.testing.assert_allclose(coarse.wrench[-1, :3], coarse.wrench[22, :3], rtol=2e-3)
    assert "of the friction 0.48" in _run(job, backend="mujoco")[0].reason


@needs_bullet
def test_steps_converge_on_what_bullet_itself_computes_at_a_fraction_of_a_microsecond():
    soft = replace(C2, young_modulus=5e6)
    chain, step, count = build_chain(soft, 3), 2e-6, 4000
    load = Load(C2.arc_length, (0.0, 2e-9, 1e-9))
    times = np.arange(1.0, 9.0) * 1e-3
    ours = _run(
        Job(soft, StillFollicle(), (), times, loads=(load,)), fidelity=Fidelity(links=3, time_step=1e-5),
        record_shape=True,
    )[0]  # fmt: skip
    with BulletWorld(chain, [], math.inf, np.zeros(3)) as world:
        bullet, body = world.bullet, world.whisker
        tips = _steps_of_bullet(bullet, body, chain, step, count, load)
    assert ours.link_positions is not None
    np.testing.assert_allclose(ours.link_positions[:, -1], tips, atol=0.01 * np.ptp(tips, axis=0).max())


def _steps_of_bullet(bullet, body, chain, step, count, load):
    """Tip positions [8, 3] (m) at every millisecond from Bullet's own time step with explicit spring torques."""
    bullet.setPhysicsEngineParameter(fixedTimeStep=step * 1e3, numSubSteps=0)
    joints = range(FOLLICLE, FOLLICLE + 2 * chain.links)
    for joint in range(FOLLICLE + 2 * chain.links):
        heavy = {"mass": 1e9, "localInertiaDiagonal": (1e9,) * 3} if joint < FOLLICLE else {}
        bullet.changeDynamics(body, joint, linearDamping=0, angularDamping=0, jointDamping=0, **heavy)
    everything = range(FOLLICLE + 2 * chain.links)
    bullet.setJointMotorControlArray(body, everything, bullet.VELOCITY_CONTROL, forces=[0.0] * len(everything))
    k, d = np.repeat(chain.stiffness, 2) * 1e6, np.repeat(chain.damping(0.0), 2) * 1e9
    tips, length = [], chain.lengths[-1] * 1e3
    for n in range(count):
        states = np.array([state[:2] for state in bullet.getJointStates(body, joints)])
        torque = -k * states[:, 0] - d * states[:, 1]
        bullet.setJointMotorControlArray(body, joints, bullet.TORQUE_CONTROL, forces=torque.tolist())
        frame = bullet.getLinkState(body, joints[-1], computeForwardKinematics=1)
        axis = np.array(bullet.getMatrixFromQuaternion(frame[5])).reshape(3, 3)[:, 0]
        tip = np.array(frame[4]) + length * axis
        bullet.applyExternalForce(body, joints[-1], np.multiply(load.force, 1e3), tip, bullet.WORLD_FRAME)
        bullet.stepSimulation()
        if (n + 1) % round(1e-3 / step) == 0:
            frame = bullet.getLinkState(body, joints[-1], computeForwardKinematics=1)
            axis = np.array(bullet.getMatrixFromQuaternion(frame[5])).reshape(3, 3)[:, 0]
            tips.append((np.array(frame[4]) + length * axis) / 1e3)
    return np.array(tips)


@given(seed=st.integers(0, 10**6), contacts=st.integers(1, 4))
@settings(max_examples=50)
def test_contact_forces_obey_signorini_and_coulomb(seed, contacts):
    generator = np.random.default_rng(seed)
    rows = generator.normal(size=(3 * contacts, 3 * contacts + 4))
    yielding, free = rows @ rows.T, generator.normal(size=3 * contacts)
    friction = generator.choice([0.0, 0.3], size=contacts)
    force, solved = solve_contacts(yielding, free, friction)
    assert solved
    moved = (free + yielding @ force).reshape(-1, 3)
    for f, w, limit in zip(force.reshape(-1, 3), moved, friction, strict=True):
        assert f[0] >= 0
        assert w[0] > -1e-6
        assert abs(f[0] * w[0]) < 1e-6
        drag, slip = np.hypot(*f[1:]), np.hypot(*w[1:])
        assert drag <= limit * f[0] * (1 + 1e-7) + 1e-9 * np.abs(force).max()
        if limit and f[0] > 1e-6 and slip > 1e-5:
            np.testing.assert_allclose(f[1:], -limit * f[0] * w[1:] / slip, atol=1e-4 * max(1.0, f[0]))


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_contact_axes_are_right_handed(vector):
    normal = np.array(vector) / np.linalg.norm(vector)
    axes = contact_axes(normal)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(cross_matrix(normal) @ axes[1], np.cross(axes[1], normal), atol=1e-15)
