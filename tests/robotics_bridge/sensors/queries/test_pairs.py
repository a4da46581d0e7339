"""Who meets whom."""

from __future__ import annotations

import numpy as np
import torch

from robotics_bridge.physics import TouchScene
from robotics_bridge.sensors import (
    ContactDepthProbe,
    SurfaceDistanceProbe,
)
from tests.factories.touch_scenes import GRID, PAD, poses_at, state_of, suite_of, touching


def test_an_empty_scene_touches_nothing() -> None:
    scene = TouchScene(("world", "hand"), (PAD,))
    suite = suite_of(
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
    suite = suite_of(
        {
            "contact": ContactDepthProbe(link="hand", probes=GRID),
            "all": ContactDepthProbe(link="hand", probes=GRID, pairs="all"),
        }
    )
    suite.update(state_of(suite.scene, touching(), touch=False))
    assert (suite.read("contact") == 0).all()
    assert (suite.read("all") > 0).any()
    suite.update(state_of(suite.scene, touching()))
    assert torch.equal(suite.read("contact"), suite.read("all"))
