"""The engine of C MuJoCo: poses, velocities and contacts are MuJoCo's own."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.physics import HandState, MujocoEngine, MujocoWarpEngine, TouchScene
from robotics_bridge.physics.kernels.state import fill_contacts
from robotics_bridge.sensors import SensorSuite
from tests.factories.touch_scenes import falling, pyramid

TWO = """<mujoco><option timestep="0.005"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
<body name="a" pos="0 0 .1"><freejoint/><geom name="a" type="box" size=".1 .1 .1"/></body>
<body name="b" pos=".03 .01 .31"><freejoint/><geom name="b" type="sphere" size=".1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("condim", [3, 4, 6])
def test_state_holds_what_mujoco_computed(condim: int) -> None:
    model = mujoco.MjModel.from_xml_string(TWO.replace("<geom", f'<geom condim="{condim}"'))
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
            couple = data.contact[c].frame.reshape(3, 3).T @ wrench[3:]
            np.testing.assert_allclose(engine.state.contact_couple.numpy()[total], couple, atol=1e-5)
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


@pytest.mark.parametrize("condim", [3, 4, 6])
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_the_kernel_of_the_gpu_engine_reads_forces_as_mujoco_does(cone: str, condim: int) -> None:
    """Constraint forces of C MuJoCo in the arrays of MuJoCo Warp, whose own type of five numbers is derived."""
    import warp as wp

    class Five(wp.types.vector(length=5, dtype=wp.float32)):
        pass

    text = TWO.replace("<option", f'<option cone="{cone}"', 1)
    model = mujoco.MjModel.from_xml_string(text.replace("<geom", f'<geom condim="{condim}"'))
    assert model.opt.cone == (cone == "elliptic")
    engine = MujocoEngine(model, 1)
    engine.set(qvel=np.random.default_rng(0).normal(size=(1, model.nv)))
    engine.step(20)
    engine.forward()
    data, count = engine.data[0], engine.data[0].ncon
    assert count >= 3
    contact, many = data.contact, 10
    rows = np.where(np.arange(many) < np.where(contact.dim > 1, 2 * (contact.dim - 1), 1)[:, None], np.arange(many), -1)
    address = np.where((rows >= 0) & (contact.efc_address[:, None] >= 0), contact.efc_address[:, None] + rows, -1)
    found, state = HandState.empty(1, model.nbody, count), engine.state
    found.contact_count.fill_(count)
    inputs = [
        wp.array(contact.frame.reshape(-1, 3, 3), dtype=wp.mat33f), wp.array(contact.dim, dtype=int),
        wp.array(address, dtype=int), wp.array(data.efc_force[None], dtype=float),
        wp.array(contact.friction, dtype=Five), int(model.opt.cone == 0), found.arrays,
    ]  # fmt: skip
    wp.launch(fill_contacts, dim=count, inputs=inputs)
    for name, atol in {"normal": 1e-4, "force": 1e-4, "friction": 1e-4, "couple": 1e-6}.items():
        read, known = (getattr(each, f"contact_{name}").numpy()[:count] for each in (found, state))
        np.testing.assert_allclose(read, known, rtol=1e-5, atol=atol, err_msg=name)
    assert np.abs(found.contact_friction.numpy()).max() > 0.1
    assert (np.abs(found.contact_couple.numpy()).max() > 1e-4) == (condim > 3)


@pytest.mark.slow
def test_mujoco_warp_agrees_with_c_mujoco() -> None:
    """The published pyramid, 20 steps; MuJoCo Warp runs on the processor here, in single precision."""
    pytest.importorskip("mujoco_warp")
    model = pyramid()
    start = falling(4, model.nv)
    cpu, gpu = MujocoEngine(model, 4, contacts=128), MujocoWarpEngine(model, 4, device="cpu")
    for engine in (cpu, gpu):
        engine.set(qvel=start)
        engine.step(20)
    np.testing.assert_allclose(gpu.state.pose.numpy(), cpu.state.pose.numpy(), atol=5e-4)
    np.testing.assert_allclose(gpu.state.velocity.numpy(), cpu.state.velocity.numpy(), atol=2e-2)
    np.testing.assert_allclose(gpu.state.time.numpy(), cpu.state.time.numpy(), atol=1e-5)
    counts = [int(engine.state.contact_count.numpy()[0]) for engine in (cpu, gpu)]
    assert abs(counts[0] - counts[1]) < 0.05 * counts[0]
    weight = float(model.body_mass.sum()) * 9.81
    for engine in (cpu, gpu):
        engine.step(300)
    forces = []
    for engine in (cpu, gpu):
        n = int(engine.state.contact_count.numpy()[0])
        pair = engine.state.contact_geom.numpy()[:n]
        floor = (pair == 0).any(axis=1)
        forces.append(engine.state.contact_force.numpy()[:n][floor].sum() / 4)
    np.testing.assert_allclose(forces, weight, rtol=0.02)


@pytest.mark.slow
def test_sensors_read_the_same_from_both_engines_with_objects_that_differ() -> None:
    pytest.importorskip("mujoco_warp")
    from robotics_bridge.physics import Geometry, compile_variants
    from robotics_bridge.sensors import ContactDepthProbe, KinematicTaxel, Probes

    spec = mujoco.MjSpec.from_string(TWO)
    shapes = [Geometry(name="b", link="b", kind="sphere", size=(radius,)) for radius in (0.1, 0.09)]
    models = compile_variants(spec, "b", shapes)
    grid = Probes.grid(6, 6, size=(0.1, 0.1), center=(0.03, 0.01, 0.1), radius=0.02)
    sensors = {
        "depth": ContactDepthProbe(link="a", probes=grid, track=("b",)),
        "taxel": KinematicTaxel(link="a", probes=grid, track=("b",)),
    }
    read = []
    for engine in (MujocoEngine(models, 4), MujocoWarpEngine(models, 4, device="cpu")):
        engine.step(12)
        suite = SensorSuite(engine.scene, sensors, num_envs=4)
        suite.update(engine.state, engine.timestep)
        read.append({name: suite.read(name).numpy().copy() for name in sensors})
    assert read[0]["depth"].max() > 1e-3
    np.testing.assert_allclose(read[1]["depth"], read[0]["depth"], atol=2e-4)
    scale = np.abs(read[0]["taxel"]).max()
    np.testing.assert_allclose(read[1]["taxel"], read[0]["taxel"], atol=0.03 * scale)
    assert np.abs(read[0]["depth"][0] - read[0]["depth"][1]).max() > 1e-4
