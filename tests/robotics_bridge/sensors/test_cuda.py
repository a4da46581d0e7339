"""On a GPU sensors read what they read on a processor, also when an update is a replayed graph."""

from __future__ import annotations

import numpy as np
import pytest

from robotics_bridge.physics import HandState, MujocoWarpEngine
from robotics_bridge.sensors import SensorSuite
from tests.factories import sensor_episode
from tests.factories.touch_scenes import falling, pyramid

TOLERANCE = {"ray": 2e-3, "gel": 1e-4, "sound": 2e-4}
"""Parts of the largest reading by which devices may differ; elsewhere rounding alone."""
TOTALS = {"sum": 1e-5, "sum and stick": 5e-3}
"""The same of sums over taxels, where how a face is shared is a choice and its force and moment are not. Noise of
single taxels is among the second."""


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_an_episode_reads_as_it_did_on_the_processor_that_kept_it(device: str) -> None:
    kept = sensor_episode.load()
    found = sensor_episode.readings(kept, device)
    assert set(found) == {name.removeprefix("reading.") for name in kept if name.startswith("reading.")}
    for name, read in found.items():
        expected = kept[f"reading.{name}"]
        if name in TOTALS:
            read, expected = (values.sum((2, 3)) for values in (read, expected))
            force = np.abs(expected[..., :3]).max()
            # Moments about the link's origin: of forces that lie up to .12 m from it.
            np.testing.assert_allclose(read, expected, rtol=0, atol=TOTALS[name] * force, err_msg=name)
            continue
        assert np.abs(expected).max() > 0, name
        atol = TOLERANCE.get(name, 1e-5) * np.abs(expected).max()
        np.testing.assert_allclose(read, expected, rtol=0, atol=atol, err_msg=name)


@pytest.mark.gpu
def test_sensors_follow_the_engine_of_the_gpu() -> None:
    sensor_episode.require_processor()
    model, sensors = pyramid(), sensor_episode.sensors()
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
        contacts = {n: getattr(engine.state, f"contact_{n}").numpy()[:count] for n in sensor_episode.CONTACT}
        mirror.set_contacts(contacts.pop("env"), contacts.pop("geom"), **contacts)
        for suite, state in zip(suites, (mirror, engine.state), strict=True):
            suite.update(state, engine.timestep)
    for name in sensors:
        here, there = (suite.read(name).cpu().numpy() for suite in suites)
        np.testing.assert_allclose(there, here, atol=2e-3 * np.abs(here).max(), err_msg=name)
