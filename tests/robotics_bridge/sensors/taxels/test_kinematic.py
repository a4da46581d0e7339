"""Kinematic taxels against the equations in double precision, and against loads they must add up to."""

from __future__ import annotations

import copy
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import dblquad

from robotics_bridge.physics import Geometry
from robotics_bridge.sensors import KinematicTaxel, Noise, Probes, SensorSuite
from tests.factories.touch_scenes import pad_scene, poses_at, random_pose, rotation_of, state_of

Convention = Literal["physical", "thesis"]
GRID = Probes.grid(5, 6, size=(0.02, 0.03), center=(0, 0, 0.005), radius=0.004)


def _by_the_equations(
    pose: np.ndarray, velocity: np.ndarray, radius: float, convention: Convention, taxel: KinematicTaxel
) -> np.ndarray:
    """Equations 4.1–4.9 for a pressed ball of one radius, channel by channel [N, 6]."""
    hand, ball = (rotation_of(pose[link, 3:]) for link in (1, 2))
    q = hand.apply(np.array(GRID.position)) + pose[1, :3]
    away = q - pose[2, :3]
    depth = np.maximum(GRID.radius - (np.linalg.norm(away, axis=1) - radius), 0)
    m = away / np.linalg.norm(away, axis=1)[:, None]
    v = [velocity[link, :3] + np.cross(velocity[link, 3:], q - pose[link, :3]) for link in (1, 2)]
    local, relative = hand.inv().apply(m), hand.inv().apply(v[1] - v[0])
    spin = hand.inv().apply(velocity[2, 3:] - velocity[1, 3:])
    s = depth**taxel.exponent
    vn = (relative * local).sum(1, keepdims=True) * local
    sign = 1 if convention == "physical" else -1
    normal = taxel.stiffness * s[:, None] * local + taxel.damping * s[:, None] * vn
    if convention == "physical":
        normal *= (normal * local).sum(1, keepdims=True) > 0
    f = normal + sign * taxel.shear * (relative - vn)
    tau = np.cross(GRID.position, f) + sign * taxel.torsion * (local @ spin)[:, None] * local
    del ball
    return np.where(depth[:, None] > 0, np.concatenate([f, tau], axis=1), 0)


@pytest.mark.parametrize("convention", ["physical", "thesis"])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=25)
def test_forces_and_torques_are_those_of_the_equations(convention: Convention, seed: int) -> None:
    rng = np.random.default_rng(seed)
    radius = rng.uniform(0.005, 0.02)
    scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(radius,)))
    poses = np.stack([np.stack([random_pose(rng) for _ in range(3)])])
    at = np.array([*rng.uniform(-0.01, 0.01, 2), 0.005 + radius - rng.uniform(-0.002, 0.004)])
    poses[0, 2, :3] = rotation_of(poses[0, 1, 3:]).apply(at) + poses[0, 1, :3]
    velocity = rng.normal(0, 0.3, (1, 3, 6))
    taxel = KinematicTaxel(link="hand", probes=GRID, convention=convention)
    suite = SensorSuite(scene, {"taxel": taxel}, num_envs=1)
    suite.update(state_of(scene, poses, velocity))
    expected = _by_the_equations(poses[0], velocity[0], radius, convention, taxel)
    read = suite.read("taxel")[0].flatten(0, 1).numpy()
    scale = max(np.abs(expected).max(), 1e-3)
    # Taxels within rounding of touching may go either way.
    np.testing.assert_allclose(read, expected, atol=3e-5 * scale + 2e-6)


def _bed(shape: str, depth: float, exponent: float) -> float:
    """Exact ∫ overlap^α dA of a pressed ball or lying cylinder on a bed of springs."""
    radius = 0.01

    def overlap(x: float, y: float) -> float:
        r = x * x + (y * y if shape == "sphere" else 0)
        return max(depth - radius + np.sqrt(max(radius**2 - r, 0)), 0) ** exponent

    half = np.sqrt(2 * radius * depth)
    width = half if shape == "sphere" else 0.007
    return 4 * dblquad(overlap, 0, width, 0, half, epsabs=1e-14, epsrel=1e-6)[0]


LYING = (0.7071067811865476, 0.7071067811865476, 0.0, 0.0)
SHAPES = {
    "sphere": Geometry(name="o", link="o", kind="sphere", size=(0.01,)),
    "cylinder": Geometry(name="o", link="o", kind="cylinder", size=(0.01, 0.007), quaternion=LYING),
}


@pytest.mark.parametrize("shape", list(SHAPES))
@pytest.mark.parametrize(("depth", "tolerance"), [(0.0001, 0.05), (0.0003, 0.05), (0.0005, 0.08)])
def test_taxel_forces_add_up_to_the_load_on_a_bed_of_springs(shape: str, depth: float, tolerance: float) -> None:
    """Stiffness calibrated once (modulus × taxel area); distances are shorter than heights, the more the deeper."""
    modulus, pitch, exponent = 1e7, 0.0002, 1.2
    grid = Probes.grid(81, 81, size=(80 * pitch, 80 * pitch), center=(0, 0, 0.005), radius=1e-9)
    taxel = KinematicTaxel(link="hand", probes=grid, stiffness=modulus * pitch**2, exponent=exponent)
    scene = pad_scene(SHAPES[shape])
    suite = SensorSuite(scene, {"taxel": taxel}, num_envs=1)
    # Off the symmetric place, so that the grid does not help.
    suite.update(state_of(scene, poses_at(3, {2: (0.00013, -0.00007, 0.015 - depth)})))
    total = suite.read("taxel")[0].sum(dim=(0, 1)).numpy()
    load = modulus * _bed(shape, depth, exponent)
    assert total[2] == pytest.approx(-load, rel=tolerance)
    assert np.abs(total[:2]).max() < 0.03 * load


def test_crosstalk_conserves_the_total_force_and_identity_changes_nothing() -> None:
    scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(0.004,)))
    grid = Probes.grid(15, 15, size=(0.014, 0.014), center=(0, 0, 0.005), radius=0.001)
    sensors = {
        "clean": KinematicTaxel(link="hand", probes=grid),
        "mixed": KinematicTaxel(link="hand", probes=grid, noise=Noise(crosstalk=0.6, crosstalk_sigma=0.7)),
        "none": KinematicTaxel(link="hand", probes=grid, noise=Noise(crosstalk=0.6, crosstalk_sigma=0.05)),
    }
    suite = SensorSuite(scene, sensors, num_envs=1)
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.0085)})))
    clean, mixed = suite.read("clean").numpy(), suite.read("mixed").numpy()
    assert np.abs(mixed - clean).max() > 0.05 * np.abs(clean).max()
    np.testing.assert_allclose(mixed.sum((1, 2)), clean.sum((1, 2)), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(suite.read("none").numpy(), clean, atol=1e-7)
    np.testing.assert_array_equal(suite.read_ground_truth("mixed").numpy(), clean)


def test_friction_follows_the_object_in_the_physical_convention_only() -> None:
    scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(0.01,)))
    sensors = {name: KinematicTaxel(link="hand", probes=GRID, convention=name) for name in ("physical", "thesis")}
    velocity = np.zeros((1, 3, 6))
    velocity[0, 2, 0] = 0.5
    suite = SensorSuite(scene, sensors, num_envs=1)
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.0148)}), velocity))
    assert suite.read("physical")[..., 0].sum() > 0.1
    assert suite.read("thesis")[..., 0].sum() < -0.1


@pytest.mark.parametrize("stiffness", [1.0, 1e7])
@pytest.mark.parametrize("depth", [1e-9, 0.009])
def test_grazing_and_deep_contact_give_finite_forces(stiffness: float, depth: float) -> None:
    scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(0.01,)))
    suite = SensorSuite(scene, {"t": KinematicTaxel(link="hand", probes=GRID, stiffness=stiffness)}, num_envs=1)
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.015 + 0.004 - depth)})))
    read = suite.read("t")
    assert read.isfinite().all()
    assert (read[..., 2] <= 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["sphere", "box", "cylinder"])
def test_fields_scaled_to_the_engine_carry_the_weight_of_what_lies_on_them(shape: str) -> None:
    """A solid of known mass at rest on a pad, under three gravities: the field adds up to its weight within 1 %."""
    import mujoco

    from robotics_bridge.physics import MujocoEngine

    sizes = {"sphere": "0.01", "box": "0.01 0.012 0.01", "cylinder": "0.01 0.01"}
    turn = 'quat="0.7071 0.7071 0 0"' if shape == "cylinder" else ""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.002"/><worldbody>
        <body name="hand"><geom name="pad" type="box" size="0.02 0.02 0.005"/></body>
        <body name="object" pos="0.0007 0.0004 0.0151"><freejoint/>
        <geom type="{shape}" size="{sizes[shape]}" {turn} mass="0.2" condim="6" friction="1 0.1 0.1"/></body>
        </worldbody></mujoco>"""
    )
    gravity = np.array([[0, 0, -5.0], [0, 0, -9.81], [0, 0, -20.0]])
    models = []
    for g in gravity:
        model.opt.gravity[:] = g
        models.append(copy.copy(model))
    engine = MujocoEngine(models, 3)
    engine.step(1500)
    grid = Probes.grid(21, 21, size=(0.03, 0.03), center=(0, 0, 0.005), radius=0.001)
    taxel = KinematicTaxel(link="hand", probes=grid, total="engine", shear=0.0)
    suite = SensorSuite(engine.scene, {"t": taxel}, num_envs=3)
    suite.update(engine.state)
    total = suite.read("t").sum((1, 2)).numpy()
    np.testing.assert_allclose(total[:, 2], 0.2 * gravity[:, 2], rtol=0.01)
    assert np.abs(total[:, :2]).max() < 0.05 * 0.2 * 20
