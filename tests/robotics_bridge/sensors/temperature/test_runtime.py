"""Temperature grids over environments, contacts and devices."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robotics_bridge.physics.scene import Geometry, TouchScene
from robotics_bridge.physics.state import HandState
from robotics_bridge.sensors.noise.model import Noise
from robotics_bridge.sensors.suite import SensorSuite
from robotics_bridge.sensors.temperature.grid import TemperatureGrid
from robotics_bridge.sensors.temperature.materials import ThermalBody
from robotics_bridge.sensors.temperature.runtime import diffusion, link_temperature, lost_contacts
from tests.factories.touch_scenes import make_grid, require_processor, touch_face


@settings(max_examples=25)
@given(st.integers(1, 40), st.floats(1e-4, 1e-1), st.floats(1e-12, 1e2))
def test_diffusion_keeps_heat_makes_no_new_extremes_and_forgets_at_last(cells, edge, spread):
    matrix = diffusion(cells, edge, spread)
    assert matrix.min() >= 0
    assert matrix.sum(axis=0) == pytest.approx(np.ones(cells), abs=1e-9)
    assert matrix.sum(axis=1) == pytest.approx(np.ones(cells), abs=1e-9)
    assert diffusion(cells, edge, 1e9) == pytest.approx(np.full((cells, cells), 1 / cells), abs=1e-6)


@pytest.mark.parametrize("bodies", [{}, {"world": ThermalBody("steel", 30.0)}])
def test_a_grid_that_touches_another_feels_its_material_and_temperature(bodies):
    boxes = [Geometry(name=name, link=name, kind="box", size=(0.01, 0.01, 0.01)) for name in ("hot", "cold")]
    still = {"convection": 0.0, "radiates": False}
    grids = {
        "hot": TemperatureGrid(link="hot", material="steel", base_temperature=40.0, **still),
        "cold": TemperatureGrid(link="cold", material="silicone", base_temperature=20.0, bodies=bodies, **still),
    }
    suite = SensorSuite(TouchScene(("world", "hot", "cold"), boxes), grids, num_envs=1)
    state = HandState.empty(1, 3, 4)
    touch_face(state, 0.01, height=0.01)
    for _ in range(200):
        suite.update(state, 0.05)
    means = [float(suite.read(name).mean()) for name in grids]
    assert means == pytest.approx([39.43, 21.42], abs=0.01)


def test_environments_are_reset_and_break_alone():
    suite, state = make_grid(envs=3, contacts=12, cells=(2, 2, 2), bodies={"object": ThermalBody("steel", 60.0)})
    touch_face(state, 0.008, envs=(0, 1, 2), depth=1e-3)
    warm = link_temperature(suite, "grid")
    warm[2] = 22.0
    for _ in range(50):
        suite.update(state, 0.02)
    read = suite.read("grid").clone()
    assert read[0, ..., 1].mean() > 22.03
    assert np.array_equal(read[0], read[1])
    assert np.all(np.abs(read[2].numpy() - 22) < 1e-4)
    suite.reset([1])
    pose = state.pose_torch
    pose[0, 1, 0] = math.nan
    suite.update(state, 0.02)
    after = suite.read("grid")
    assert after[0].isnan().all()
    assert after[1].max() < read[1].max()
    assert np.all(np.abs(after[2].numpy() - 22) < 1e-4)
    pose[0, 1, 0] = 0.0
    suite.update(state, 0.02)
    assert suite.read("grid")[0].isnan().all()
    suite.reset([0])
    suite.update(state, 0.02)
    assert suite.read("grid")[0].isfinite().all()


def test_noise_touches_the_measured_branch_alone():
    suite, state = make_grid(envs=200, cells=(2, 2, 2), noise=Noise(white=0.1, quantum=0.05))
    suite.update(state, 0.01)
    assert np.all(suite.read_ground_truth("grid").numpy() == 22)
    error = suite.read("grid").numpy() - 22
    assert error.std() == pytest.approx(0.1, rel=0.1)
    assert error / 0.05 == pytest.approx(np.round(error / 0.05), abs=1e-3)


def test_contacts_without_room_are_counted_and_warned_of_once():
    suite, state = make_grid(contacts=60, bodies={"object": ThermalBody("steel", 60.0)})
    state.set_contacts(
        np.zeros(60), np.tile([[0, 1]], (60, 1)), distance=np.full(60, -1e-4),
        position=np.random.default_rng(0).normal(size=(60, 3)) * 0.01, normal=np.tile([0.0, 0, 1], (60, 1)),
    )  # fmt: skip
    with pytest.warns(RuntimeWarning, match="60 contacts touched one temperature grid"):
        suite.update(state, 0.01)
    suite.update(state, 0.01)
    assert lost_contacts(suite, "grid").tolist() == [12]
    assert float(suite.read("grid").max()) > 22


@pytest.mark.gpu
def test_cpu_and_cuda_agree():
    require_processor()
    read = {}
    for device in ("cpu", "cuda"):
        geometries = (
            Geometry(name="pad", link="pad", kind="box", size=(0.01, 0.02, 0.03)),
            Geometry(name="object", link="object", kind="sphere", size=(0.04,)),
        )
        grid = TemperatureGrid(link="pad", cells=(4, 5, 6), bodies={"object": ThermalBody("steel", 60.0)}, tau=0.1)
        suite = SensorSuite(
            TouchScene(("world", "pad", "object"), geometries), {"grid": grid}, num_envs=8, device=device
        )
        state = HandState.empty(8, 3, 32, device)
        touch_face(state, 0.008, envs=tuple(range(8)), depth=1e-3)
        for _ in range(100):
            suite.update(state, 0.01)
        read[device] = suite.read("grid").cpu().numpy()
    assert read["cuda"] == pytest.approx(read["cpu"], abs=1e-3)
    assert read["cpu"].max() > 22.05
