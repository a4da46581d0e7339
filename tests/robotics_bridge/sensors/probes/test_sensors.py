"""Contact probes latch and release."""

from __future__ import annotations

from robotics_bridge.physics import Geometry, TouchScene
from robotics_bridge.sensors import (
    ContactProbe,
    Noise,
    Probes,
    SensorSuite,
)
from tests.factories.touch_scenes import pad_scene, poses_at, state_of

BALL = Geometry(name="ball", link="object", kind="sphere", size=(0.01,))


def _suite(sensors: dict, envs: int = 1, scene: TouchScene | None = None, **options: object) -> SensorSuite:
    return SensorSuite(scene or pad_scene(BALL), sensors, num_envs=envs, **options)  # type: ignore[arg-type]


def test_contact_latches_and_releases_for_truth_and_measurement_apart() -> None:
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 1e-6)
    noise = Noise(bias=2e-4)
    sensor = ContactProbe(link="hand", probes=probe, threshold=5e-4, release=2e-4, noise=noise)
    suite = _suite({"bit": sensor})
    seen = []
    for depth in (0.0, 4e-4, 6e-4, 3e-4, 1e-4, 4e-4):
        suite.update(state_of(suite.scene, poses_at(3, {2: (0, 0, 0.015 + 1e-6 - depth)})))
        seen.append((int(suite.read_ground_truth("bit")[0, 0]), int(suite.read("bit")[0, 0])))
    assert seen == [(0, 0), (0, 1), (1, 1), (1, 1), (0, 1), (0, 1)]
