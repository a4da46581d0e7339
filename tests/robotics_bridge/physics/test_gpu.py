"""MuJoCo Warp against C MuJoCo."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from robotics_bridge.physics import MujocoEngine, MujocoWarpEngine
from robotics_bridge.physics.kernels.state import fill_contacts
from robotics_bridge.sensors import SensorSuite
from tests.factories.touch_scenes import falling, pyramid

TWO = """<mujoco><option timestep="0.005"/><worldbody><geom name="floor" type="plane" size="0 0 1"/>
<body name="a" pos="0 0 .1"><freejoint/><geom name="a" type="box" size=".1 .1 .1"/></body>
<body name="b" pos=".03 .01 .31"><freejoint/><geom name="b" type="sphere" size=".1"/></body></worldbody></mujoco>"""


@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_the_kernel_of_the_gpu_engine_reads_forces_as_mujoco_does(cone: str) -> None:
    """Constraint forces of C MuJoCo in the arrays of MuJoCo Warp, whose own type of five numbers is derived."""
    import warp as wp

    class Five(wp.types.vector(length=5, dtype=wp.float32)):
        pass

    model = mujoco.MjModel.from_xml_string(TWO.replace("<option", f'<option cone="{cone}"', 1))
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
    normal, friction = (wp.zeros(count, dtype=wp.vec3f) for _ in range(2))
    force = wp.zeros(count, dtype=float)
    inputs = [
        wp.array([count], dtype=int), wp.zeros(count, dtype=int),
        wp.array(contact.frame.reshape(-1, 3, 3), dtype=wp.mat33f),
        wp.array(contact.dim, dtype=int), wp.array(address, dtype=int), wp.array(data.efc_force[None], dtype=float),
        wp.array(contact.friction, dtype=Five), int(model.opt.cone == 0), normal, force, friction,
    ]  # fmt: skip
    wp.launch(fill_contacts, dim=count, inputs=inputs)
    state = engine.state
    for found, known in ((normal, state.contact_normal), (force, state.contact_force)):
        np.testing.assert_allclose(found.numpy(), known.numpy()[:count], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(friction.numpy(), state.contact_friction.numpy()[:count], rtol=1e-5, atol=1e-4)
    assert np.abs(friction.numpy()).max() > 0.1


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
