"""Pressure on an elastomer against Hertz (1882), and its sum against the engine's contact forces."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.physics import Geometry, MujocoEngine
from robotics_bridge.sensors import ContactProbe, ElastomerTaxel, Probes, SensorSuite
from robotics_bridge.sensors.taxels.elastomer import contact_pressure, gel_surface
from tests.factories.touch_scenes import pad_scene, poses_at, state_of

RADIUS, PITCH, MODULUS, POISSON = 0.01, 1e-4, 2e5, 0.45
GRID = Probes.grid(41, 45, size=(40 * PITCH, 44 * PITCH), center=(0, 0, 0.005), radius=1e-3)


@pytest.mark.parametrize("depth", [3e-5, 1e-4, 2e-4])
def test_pressure_under_a_ball_is_that_of_hertz(depth: float) -> None:
    scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(RADIUS,)))
    suite = SensorSuite(scene, {"gel": ElastomerTaxel(link="hand", probes=GRID, points=0)}, num_envs=2)
    poses = poses_at(3, {2: (0.3 * PITCH, -0.2 * PITCH, 0.005 + RADIUS - depth)}, 2)
    poses[1, 2, 2] += 0.01
    suite.update(state_of(scene, poses))
    pressure = contact_pressure(suite, "gel", modulus=MODULUS, poisson=POISSON).numpy()
    stiff = MODULUS / (1 - POISSON**2)
    load = 4 / 3 * stiff * np.sqrt(RADIUS) * depth**1.5
    assert not pressure[1].any()
    assert pressure[0].sum() * PITCH**2 == pytest.approx(load, rel=0.03)
    # p0 = 2 E* a / (π R), with a² = R δ, falling off as √(1 − r²/a²).
    a = np.sqrt(RADIUS * depth)
    far = np.linalg.norm(np.asarray(GRID.position)[:, :2] - [0.3 * PITCH, -0.2 * PITCH], axis=1).reshape(41, 45)
    hertz = 2 * stiff * a / (np.pi * RADIUS) * np.sqrt(np.maximum(1 - (far / a) ** 2, 0))
    inner = far < 0.8 * a
    np.testing.assert_allclose(pressure[0][inner], hertz[inner], rtol=0.03)
    assert pressure[0][far > a + PITCH].max() < 0.02 * hertz.max()
    # Its surface is the ball's below it, and sinks beside it too (Johnson 1985, eq. 3.42a).
    share = np.minimum(a / far.clip(1e-9), 1)
    beside = ((2 * a**2 - far**2) * np.arcsin(share) + a * np.sqrt((far**2 - a**2).clip(0))) / (np.pi * RADIUS)
    surface = gel_surface(suite, "gel").numpy()
    np.testing.assert_allclose(surface[0], np.where(far < a, depth - far**2 / (2 * RADIUS), beside), atol=0.03 * depth)
    assert not surface[1].any()


@pytest.mark.parametrize("share", [0.3, 0.6, 0.8])
def test_surface_and_load_under_a_ball_are_those_of_sneddon_however_deep(share: float) -> None:
    """A rigid ball on an elastic half-space (Sneddon 1965), to contacts of four fifths of its radius."""
    ball, pitch = 3e-3, 1e-4
    grid = Probes.grid(101, 101, size=(1e-2, 1e-2), center=(0, 0, 0.005), radius=1e-3)
    scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(ball,)))
    suite = SensorSuite(scene, {"gel": ElastomerTaxel(link="hand", probes=grid, points=0)}, num_envs=1)
    a = share * ball
    depth = a * np.arctanh(share)
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.005 + ball - depth)}, 1)))
    r = np.arange(1, 50) * pitch
    angles = np.linspace(0, 1, 2001)[:, None] * np.arcsin(np.minimum(a / r, 1))
    t = r * np.sin(angles)
    sneddon = 2 / np.pi * np.trapezoid(depth - t * np.arctanh(t / ball), angles, axis=0)
    surface = gel_surface(suite, "gel")[0, 50, 51:100].double().numpy()
    np.testing.assert_allclose(surface, sneddon, atol=0.01 * depth)
    np.testing.assert_allclose(np.diff(surface), np.diff(sneddon), atol=0.05 * np.abs(np.diff(sneddon)).max())
    load = ((a**2 + ball**2) * np.log((ball + a) / (ball - a)) - 2 * a * ball) * MODULUS / (2 * (1 - POISSON**2))
    pressure = contact_pressure(suite, "gel", modulus=MODULUS, poisson=POISSON)
    assert float(pressure.sum()) * pitch**2 == pytest.approx(load, rel=0.03)


def test_pressures_add_up_to_the_contact_forces_of_the_engine() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><option timestep="0.002"/><worldbody>
        <body name="hand"><geom name="pad" type="box" size="0.02 0.02 0.005"/></body>
        <body name="a" pos="-.008 .001 .0148"><freejoint/><geom type="sphere" size=".01" mass=".2" condim="6"/></body>
        <body name="b" pos=".009 0 .0098"><freejoint/><geom type="box" size=".004 .004 .005" mass=".1"/></body>
        </worldbody></mujoco>"""
    )
    engine = MujocoEngine(model, 1)
    engine.step(300)
    grid = Probes.grid(40, 40, size=(0.036, 0.036), center=(0, 0, 0.005), radius=1e-3)
    suite = SensorSuite(engine.scene, {"gel": ElastomerTaxel(link="hand", probes=grid, points=0)}, num_envs=1)
    suite.update(engine.state)
    pressure = contact_pressure(suite, "gel", modulus=1e5, state=engine.state)
    cell = (0.036 / 39) ** 2
    assert float(pressure.sum()) * cell == pytest.approx(0.3 * 9.81, rel=0.01)
    assert (pressure >= 0).all()


@pytest.mark.parametrize("dilation", ["separable", "fft", "direct"])
def test_the_gel_of_a_mirrored_hand_moves_as_its_mirror_image(dilation: str) -> None:
    """Its rows grow the other way about the normal; whatever the order of rows is, a marker moves alike."""
    flip = np.array([-1.0, 1.0, 1.0])
    rows = np.arange(20).reshape(4, 5)[::-1].ravel()
    grid = Probes.grid(4, 5, size=(0.018, 0.02), center=(0, 0, 0.005), radius=0.003)
    same = {"normal": grid.normal, "radius": grid.radius, "shape": grid.shape, "pitch": grid.pitch}
    grids = [grid, Probes(grid.position * flip, **same), Probes(grid.position[rows], **same)]
    readings = []
    for markers, side in zip(grids, (1.0, -1.0, 1.0), strict=True):
        scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(RADIUS,)))
        gel = ElastomerTaxel(link="hand", probes=markers, points=4000, dilation=dilation)  # type: ignore[arg-type]
        suite = SensorSuite(scene, {"gel": gel}, num_envs=1)
        for step in range(4):
            place = (side * (0.002 + 0.0003 * step), 0.003 + 0.0002 * step, 0.005 + RADIUS - 0.001)
            suite.update(state_of(scene, poses_at(3, {2: place})))
        readings.append(suite.read("gel")[0].flatten(0, 1).numpy())
    right, left, reversed_ = readings
    largest = np.abs(right).max(axis=0)
    assert (largest > 1e-3).all()
    np.testing.assert_allclose(reversed_, right[rows], atol=1e-6)
    # Points on the ball are not their own mirror image.
    assert (np.abs(left * flip - right).max(axis=0) < 0.03 * largest).all()


def test_what_has_no_pressure_is_refused() -> None:
    scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(RADIUS,)))
    line = Probes(np.tile([0.0, 0, 0.005], (3, 1)), np.tile([0.0, 0, 1], (3, 1)), np.full(3, 1e-3))
    sensors = {
        "free": ElastomerTaxel(link="hand", probes=line),
        "bit": ContactProbe(link="hand", probes=GRID),
        "gel": ElastomerTaxel(link="hand", probes=GRID),
    }
    suite = SensorSuite(scene, sensors, num_envs=1)
    with pytest.raises(UsageError, match="grid"):
        contact_pressure(suite, "free", modulus=1e5)
    with pytest.raises(UsageError, match="elastomer"):
        contact_pressure(suite, "bit", modulus=1e5)
    with pytest.raises(UsageError, match="modulus"):
        contact_pressure(suite, "gel", modulus=0)
