"""Who meets whom."""

from __future__ import annotations

import numpy as np
import torch

from robotics_bridge.physics import Geometry, TouchScene
from robotics_bridge.sensors import (
    ContactDepthProbe,
    Probes,
    SensorSuite,
    SurfaceDistanceProbe,
)
from tests.factories.touch_scenes import PAD, pad_scene, poses_at, state_of

BALL = Geometry(name="ball", link="object", kind="sphere", size=(0.01,))


GRID = Probes.grid(4, 5, size=(0.02, 0.03), center=(0, 0, 0.005), radius=0.003)


def _suite(sensors: dict, envs: int = 1, scene: TouchScene | None = None, **options: object) -> SensorSuite:
    return SensorSuite(scene or pad_scene(BALL), sensors, num_envs=envs, **options)  # type: ignore[arg-type]


def _touching(envs: int = 1, height: float = 0.0145) -> np.ndarray:
    return poses_at(3, {2: (0.001, -0.002, height)}, envs)


def test_an_empty_scene_touches_nothing() -> None:
    scene = TouchScene(("world", "hand"), (PAD,))
    suite = _suite(
        {
            "depth": ContactDepthProbe(link="hand", probes=GRID),
            "far": SurfaceDistanceProbe(link="hand", probes=GRID),
            "near": SurfaceDistanceProbe(link="hand", probes=GRID, max_range=0.3),
        },
        scene=scene,
    )
    suite.update(state_of(scene, poses_at(2, {})))
    assert (suite.read("depth") == 0).all()
    assert torch.isinf(suite.read("far")).all()
    assert (suite.read("near") == np.float32(0.3)).all()


def test_depth_needs_a_contact_pair_unless_all_pairs_are_asked_for() -> None:
    suite = _suite(
        {
            "contact": ContactDepthProbe(link="hand", probes=GRID),
            "all": ContactDepthProbe(link="hand", probes=GRID, pairs="all"),
        }
    )
    suite.update(state_of(suite.scene, _touching(), touch=False))
    assert (suite.read("contact") == 0).all()
    assert (suite.read("all") > 0).any()
    suite.update(state_of(suite.scene, _touching()))
    assert torch.equal(suite.read("contact"), suite.read("all"))
