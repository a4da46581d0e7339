"""On a GPU sensors read what they read on a processor, also when an update is a replayed graph."""

from __future__ import annotations

import numpy as np
import pytest

from robotics_bridge.physics import HandState, MujocoWarpEngine
from robotics_bridge.sensors import (
    ContactDepthProbe,
    ContactProbe,
    ElastomerTaxel,
    KinematicTaxel,
    Noise,
    Probes,
    ProximityTaxel,
    SensorSuite,
    SurfaceDistanceProbe,
)
from tests.factories.touch_scenes import falling, pyramid

pytestmark = pytest.mark.gpu
GRID = Probes.grid(10, 10, size=(0.2, 0.2), center=(0, 0, 0.125), radius=0.01)


def test_devices_agree_over_many_updates() -> None:
    common = {"link": "box0", "probes": GRID, "track": ("box1",)}
    noise = Noise(white=1e-3, walk=1e-3, hysteresis=0.5, gain=(0.9, 1.1))
    sensors = {
        "distance": SurfaceDistanceProbe(**common),
        "bit": ContactProbe(**common),
        "depth": ContactDepthProbe(**common, history=3),
        "ray": ContactDepthProbe(**common, query="raycast"),
        "taxel": KinematicTaxel(**common),
        "noisy": KinematicTaxel(**common, noise=noise),
        "near": ProximityTaxel(**common, points=400),
        "gel": ElastomerTaxel(**common, points=400),
    }
    model = pyramid()
    engine = MujocoWarpEngine(model, 8, device="cuda", contacts=128)
    engine.set(qvel=falling(8, model.nv))
    engine.step(50)
    suites = [SensorSuite(engine.scene, sensors, num_envs=8, device=device) for device in ("cpu", "cuda")]
    mirror = HandState.empty(8, engine.state.num_links, engine.state.contact_env.shape[0])
    for _ in range(6):
        engine.step()
        count = int(engine.state.contact_count.numpy()[0])
        mirror.set_pose(engine.state.pose_torch[..., [0, 1, 2, 6, 3, 4, 5]])
        mirror.set_velocity(engine.state.velocity.numpy())
        mirror.set_contacts(engine.state.contact_env.numpy()[:count], engine.state.contact_geom.numpy()[:count])
        for suite, state in zip(suites, (mirror, engine.state), strict=True):
            suite.update(state, engine.timestep)
    for name in sensors:
        here, there = (suite.read(name).cpu().numpy() for suite in suites)
        np.testing.assert_allclose(there, here, atol=2e-3 * np.abs(here).max(), err_msg=name)
    history = [suite.read_history("depth").cpu().numpy() for suite in suites]
    np.testing.assert_allclose(history[1], history[0], atol=1e-5)
