"""Points on surfaces and the cells that list them."""

from __future__ import annotations

import numpy as np
import pytest

from robotics_bridge.physics import Geometry
from robotics_bridge.sensors import Noise, Probes, ProximityTaxel, SensorSuite
from robotics_bridge.sensors.queries.surface_points import list_by_cells, surface_points
from tests.factories.touch_scenes import pad_scene, poses_at, state_of

OBJECTS = (
    Geometry(name="box", link="box", kind="box", size=(0.01, 0.006, 0.004), position=(0.003, 0, 0)),
    Geometry(name="ball", link="ball", kind="sphere", size=(0.006,)),
)


def test_points_cover_a_surface_evenly() -> None:
    box = Geometry(name="b", link="b", kind="box", size=(1.0, 1.0, 0.5))
    points = surface_points(box, 2000)
    assert (np.abs(np.abs(points) / [1.0, 1.0, 0.5]).max(axis=1) > 1 - 1e-9).all()
    top = points[points[:, 2] > 0.5 - 1e-9]
    assert len(top) == pytest.approx(2000 * 4 / 16, rel=0.02)
    # Random points would leave one cell of 100 without any in half of all draws, and 15 % of scatter in quarters.
    cells = np.histogram2d(top[:, 0], top[:, 1], bins=10, range=[[-1, 1], [-1, 1]])[0]
    assert cells.min() >= 2
    quarters = cells.reshape(2, 5, 2, 5).sum(axis=(1, 3))
    assert quarters.max() / quarters.min() < 1.1


def test_cells_hold_every_point_within_reach_in_order() -> None:
    noise = Noise(radius=1e-3, gain=(0.5, 1.5))
    free = Probes(np.random.default_rng(0).normal(0, 0.01, (75, 3)), [[0, 0, 1.0]] * 75, [0.0, *np.full(74, 0.006)])
    sensors = {
        "grid": ProximityTaxel(link="hand", probes=Probes.grid(7, 11, size=(0.03, 0.02), center=(0, 0, 0.005))),
        "free": ProximityTaxel(link="hand", probes=free, noise=noise),
    }
    scene = pad_scene(*OBJECTS)
    suites = [SensorSuite(scene, sensors, num_envs=3) for _ in range(2)]
    # With a reach of 10 m every cell lists all points.
    runtime = suites[1].runtimes[0]
    runtime._cells = list_by_cells(runtime.cloud, 10.0, "cpu")  # type: ignore[attr-defined]
    poses = poses_at(len(scene.links), {}, 3)
    poses[:, 2, :3] = (0.002, 0.001, 0.011)
    poses[:, 3, :3] = (-0.006, 0.002, 0.012)
    poses[1, 3, 2] = 0.5
    poses[2, 2, 0] = np.nan
    velocity = np.random.default_rng(1).normal(0, 0.5, (3, len(scene.links), 6))
    for suite in suites:
        suite.update(state_of(scene, poses, velocity, touch=False))
    for name in sensors:
        assert np.isnan(suites[0].read(name)[2].flatten(0, -2).numpy()[5]).all()
        for read in ("read", "read_ground_truth"):
            found, expected = (getattr(suite, read)(name).numpy() for suite in suites)
            assert (np.abs(expected[:2]).max(axis=(1, 2) if name == "free" else (1, 2, 3)) > 0.05).all()
            np.testing.assert_array_equal(found, expected)
