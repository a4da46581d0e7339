"""The engine of C MuJoCo: poses, velocities and contacts are MuJoCo's own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.physics import HandState, MujocoEngine, TouchScene
from robotics_bridge.sensors import SensorSuite
from tests.factories.touch_scenes import pyramid

TWO = """<mujoco><option timestep="0.005"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
<body name="a" pos="0 0 .1"><freejoint/><geom name="a" type="box" size=".1 .1 .1"/></body>
<body name="b" pos=".03 .01 .31"><freejoint/><geom name="b" type="sphere" size=".1"/></body></worldbody></mujoco>"""


def test_state_holds_what_mujoco_computed() -> None:
    model = mujoco.MjModel.from_xml_string(TWO)
    engine = MujocoEngine(model, 3, threads=2)
    engine.set(qvel=0.3 * np.random.default_rng(0).normal(size=(3, model.nv)))
    engine.step(20)
    engine.forward()
    pose, velocity = engine.state.pose_torch.numpy(), engine.state.velocity_torch.numpy()
    total = 0
    for env, data in enumerate(engine.data):
        for body in range(model.nbody):
            np.testing.assert_allclose(pose[env, body, :3], data.xpos[body], atol=1e-6)
            np.testing.assert_allclose(pose[env, body, 3:], data.xquat[body][[1, 2, 3, 0]], atol=1e-6)
            twist = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, twist, 0)
            np.testing.assert_allclose(velocity[env, body], [*twist[3:], *twist[:3]], atol=1e-5)
        for c in range(data.ncon):
            wrench = np.zeros(6)
            mujoco.mj_contactForce(model, data, c, wrench)
            assert engine.state.contact_force.numpy()[total] == pytest.approx(wrench[0], abs=1e-4)
            slip = data.contact[c].frame.reshape(3, 3)[1:].T @ wrench[1:3]
            np.testing.assert_allclose(engine.state.contact_friction.numpy()[total], slip, atol=1e-4)
            assert engine.state.contact_geom.numpy()[total].tolist() == data.contact.geom[c].tolist()
            assert engine.state.contact_env.numpy()[total] == env
            total += 1
    assert int(engine.state.contact_count.numpy()[0]) == total > 3


def test_threads_do_not_change_the_outcome() -> None:
    model = mujoco.MjModel.from_xml_string(TWO)
    start = np.random.default_rng(1).normal(size=(5, model.nv))
    states = []
    for threads in (1, 3):
        engine = MujocoEngine(model, 5, threads=threads)
        engine.set(qvel=start)
        engine.step(10)
        states.append(engine.state.pose.numpy().copy())
    np.testing.assert_array_equal(*states)


def test_fields_vary_between_environments_and_reset_returns_to_the_start() -> None:
    model = mujoco.MjModel.from_xml_string(TWO)
    masses = np.tile(model.body_mass, (2, 1))
    masses[1, 2] *= 10
    engine = MujocoEngine(model, 2, fields={"body_mass": masses})
    engine.step(400)
    count = int(engine.state.contact_count.numpy()[0])
    force, env = engine.state.contact_force.numpy()[:count], engine.state.contact_env.numpy()[:count]
    assert force[env == 1].sum() > 1.5 * force[env == 0].sum()
    engine.reset([1])
    assert engine.state.time.numpy()[1] == 0
    assert engine.state.time.numpy()[0] > 1
    np.testing.assert_allclose(engine.qpos[1], model.qpos0)


def test_unknown_fields_and_wrong_shapes_are_refused() -> None:
    model = mujoco.MjModel.from_xml_string(TWO)
    with pytest.raises(UsageError, match="'body_mass'"):
        MujocoEngine(model, 2, fields={"body_mas": np.zeros((2, 3))})
    with pytest.raises(UsageError, match=r"\(2, 3\); .* \(3,\)"):
        MujocoEngine(model, 2, fields={"body_mass": np.zeros(3)})
    with pytest.raises(UsageError, match=r"environments of an engine .*received 0"):
        MujocoEngine(model, 0)
    with pytest.raises(UsageError, match=r"qvel .*received \(5,\)"):
        MujocoEngine(model, 2).set(qvel=np.zeros(5))
    for wrong in ("qvell", "time", "contact"):
        with pytest.raises(UsageError, match=f"array of the simulation '{wrong}'"):
            MujocoEngine(model, 2).set(**{wrong: 0.0})


@pytest.mark.parametrize("wrong", [0, -1, 2.5, np.nan, True, "2"])
def test_threads_and_steps_are_whole_and_positive(wrong) -> None:
    model = mujoco.MjModel.from_xml_string(TWO)
    with pytest.raises(UsageError, match=f"threads .*{wrong}"):
        MujocoEngine(model, 2, threads=wrong)
    with pytest.raises(UsageError, match=f"steps .*{wrong}"):
        MujocoEngine(model, 2, threads=1).step(wrong)


def test_values_of_fields_that_are_no_numbers_are_refused() -> None:
    model = mujoco.MjModel.from_xml_string(TWO)
    with pytest.raises(UsageError, match=r"'body_mass' .*NaN"):
        MujocoEngine(model, 1, fields={"body_mass": np.full((1, 3), np.nan)})


def test_a_mask_puts_back_the_environments_that_it_names() -> None:
    engine = MujocoEngine(mujoco.MjModel.from_xml_string(TWO), 3, threads=1)
    engine.step(2)
    engine.reset(np.array([False, False, True]))
    assert (engine.state.time.numpy() > 0).tolist() == [True, True, False]
    for wrong in ([3], [-1], [0.5]):
        with pytest.raises(UsageError, match=rf"reset .*received {wrong[0]}"):
            engine.reset(wrong)


def test_an_environment_that_diverges_is_not_put_back_in_silence() -> None:
    engine = MujocoEngine(mujoco.MjModel.from_xml_string(TWO), 2, threads=1)
    engine.step(5)
    engine.data[1].qpos[0] = np.nan
    engine.step(5)
    assert np.isfinite(engine.qpos[0]).all()
    assert not np.isfinite(engine.qpos[1]).all()
    assert engine.data[1].time == pytest.approx(engine.data[0].time)


def test_a_suite_tells_which_environments_diverged_and_when_contacts_were_lost() -> None:
    state = HandState.empty(3, 2, contacts=2)
    velocity = np.zeros((3, 2, 6))
    velocity[1, 1, 4] = np.inf
    state.set_velocity(velocity)
    suite = SensorSuite(TouchScene(("a", "b")), {}, num_envs=3)
    suite.update(state)
    assert suite.diverged.tolist() == [False, True, False]
    assert not suite.crowded.any()
    state.contact_count.fill_(3)
    suite.update(state)
    assert suite.diverged.tolist() == [False, True, False]
    assert suite.crowded.all()


def test_an_engine_leaves_the_model_that_it_is_given_as_it_is() -> None:
    model = pyramid()
    flags = model.opt.disableflags
    engine = MujocoEngine(model, 1, contacts=128)
    assert model.opt.disableflags == flags
    assert engine.model.opt.disableflags != flags
