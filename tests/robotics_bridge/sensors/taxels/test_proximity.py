"""Proximity taxels against a brute-force sum in double precision."""

from __future__ import annotations

import numpy as np
import pytest

from robotics_bridge.physics import Geometry
from robotics_bridge.sensors import Noise, Probes, ProximityTaxel, SensorSuite
from robotics_bridge.sensors.queries.solids import surface_points
from tests.factories.touch_scenes import pad_scene, poses_at, random_pose, rotation_of, state_of

GRID = Probes.grid(4, 4, size=(0.02, 0.02), center=(0, 0, 0.005), radius=0.008)
OBJECTS = (
    Geometry(name="box", link="box", kind="box", size=(0.01, 0.006, 0.004), position=(0.003, 0, 0)),
    Geometry(name="ball", link="ball", kind="sphere", size=(0.006,)),
)


def _brute_force(points: list[np.ndarray], pose: np.ndarray, velocity: np.ndarray, convention: str) -> np.ndarray:
    hand = rotation_of(pose[1, 3:])
    q, a = hand.apply(np.array(GRID.position)) + pose[1, :3], hand.apply(np.array(GRID.normal))
    v_q = velocity[1, :3] + np.cross(velocity[1, 3:], q - pose[1, :3])
    total = sum(len(p) for p in points)
    f, tau = np.zeros((16, 3)), np.zeros((16, 3))
    for link, cloud in zip((2, 3), points, strict=True):
        p = rotation_of(pose[link, 3:]).apply(cloud + OBJECTS[link - 2].position) + pose[link, :3]
        v = velocity[link, :3] + np.cross(velocity[link, 3:], p - pose[link, :3])
        away = p[None] - q[:, None]
        overlap = np.maximum(0.008 - np.linalg.norm(away, axis=2), 0) * 100 / total
        slip = v[None] - v_q[:, None]
        slip -= (slip * a[:, None]).sum(2, keepdims=True) * a[:, None]
        sign = 1 if convention == "thesis" else -1
        f += sign * 300 * overlap.sum(1)[:, None] * a + 10 * (overlap[..., None] * slip).sum(1)
        tau += sign * 300 * (overlap[..., None] * np.cross(away, a[:, None])).sum(1)
    f, tau = hand.inv().apply(f), hand.inv().apply(tau)
    return np.concatenate([f, tau if convention == "thesis" else tau + np.cross(GRID.position, f)], axis=1)


@pytest.mark.parametrize("convention", ["thesis", "physical"])
def test_wrenches_are_the_sums_over_all_points(convention: str) -> None:
    rng = np.random.default_rng(2)
    scene = pad_scene(*OBJECTS)
    pose = np.stack([random_pose(rng) for _ in scene.links])
    hand = rotation_of(pose[1, 3:])
    pose[2, :3] = hand.apply([0, 0, 0.012]) + pose[1, :3]
    pose[3, :3] = hand.apply([0.008, 0.006, 0.013]) + pose[1, :3]
    velocity = rng.normal(0, 0.5, (4, 6))
    sensor = ProximityTaxel(link="hand", probes=GRID, points=700, convention=convention)  # type: ignore[arg-type]
    suite = SensorSuite(scene, {"p": sensor}, num_envs=1)
    suite.update(state_of(scene, pose[None], velocity[None], touch=False))
    runtime = suite.runtimes[0]
    shares = runtime.cloud.counts[0]  # type: ignore[attr-defined]
    areas = np.array([8 * (0.01 * 0.006 + 0.006 * 0.004 + 0.01 * 0.004), 4 * np.pi * 0.006**2])
    counts = [round(700 * areas[0] / areas.sum()), 0]
    counts[1] = int(shares - counts[0])
    points = [surface_points(g, count) for g, count in zip(OBJECTS, counts, strict=True)]
    expected = _brute_force(points, pose, velocity, convention)
    read = suite.read("p")[0].flatten(0, 1).numpy()
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(read, expected, atol=3e-5 * np.abs(expected).max())


def test_an_object_is_felt_before_it_touches_and_not_beyond_the_radius() -> None:
    scene = pad_scene(OBJECTS[1])
    suite = SensorSuite(scene, {"p": ProximityTaxel(link="hand", probes=GRID, points=2000)}, num_envs=3)
    poses = poses_at(3, {}, 3)
    # The nearest taxel sits 4.7 mm beside the ball's axis.
    poses[:, 2, 2] = 0.005 + 0.006 + np.array([0.001, 0.004, 0.02])
    suite.update(state_of(scene, poses, touch=False))
    force = -suite.read("p")[..., 2].sum((1, 2))
    assert force[0] > force[1] > 0
    assert force[2] == 0


def test_radius_noise_leaves_the_truth_alone() -> None:
    scene = pad_scene(OBJECTS[1])
    sensors = {
        "clean": ProximityTaxel(link="hand", probes=GRID, points=500),
        "noisy": ProximityTaxel(link="hand", probes=GRID, points=500, noise=Noise(radius=1e-3, gain=(0.5, 0.5))),
    }
    suite = SensorSuite(scene, sensors, num_envs=1)
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.012)}), touch=False))
    np.testing.assert_allclose(suite.read_ground_truth("noisy"), suite.read("clean"), atol=1e-7)
    ratio = (suite.read("noisy")[..., 2] / suite.read("clean")[..., 2])[suite.read("clean")[..., 2] != 0]
    assert ratio.std() > 0.01
    assert 0.3 < ratio.mean() < 0.7
