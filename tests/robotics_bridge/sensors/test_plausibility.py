"""What can hardly be meant is said: lengths in millimetres, probes inside their own link."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import trimesh

from brainbench.geometry import Mesh
from robotics_bridge import hands
from robotics_bridge.physics import Geometry, TouchScene
from robotics_bridge.sensors import ContactDepthProbe, Probes, SensorSuite
from tests.factories.touch_scenes import pad_scene, poses_at, state_of

BALL = Geometry(name="o", link="o", kind="sphere", size=(0.01,))
ON_TOP = Probes.grid(3, 3, size=(0.01, 0.01), center=(0, 0, 0.005), radius=0.001)


def _suite(shape: Geometry, probes: Probes) -> SensorSuite:
    return SensorSuite(pad_scene(shape), {"tip": ContactDepthProbe(link="hand", probes=probes)}, num_envs=1)


def test_lengths_in_millimetres_are_said() -> None:
    with pytest.warns(RuntimeWarning, match="'tip'.*metres"):
        _suite(BALL, Probes.grid(3, 3, size=(10, 10), center=(0, 0, 5), radius=4))
    with pytest.warns(RuntimeWarning, match="radius of 'tip': 2 m"):
        _suite(BALL, Probes.grid(3, 3, size=(0.01, 0.01), center=(0, 0, 0.005), radius=2))
    cup = trimesh.creation.icosphere(2, 40)
    with pytest.warns(RuntimeWarning, match="'cup'.*metres"):
        _suite(Geometry(name="o", link="o", kind="mesh", mesh=Mesh(cup.vertices, cup.faces, "cup")), ON_TOP)


def test_probes_far_from_the_solids_of_their_link_are_said() -> None:
    with pytest.warns(RuntimeWarning, match="'tip': 5.99. m from their own link.*metres"):
        _suite(BALL, Probes.grid(3, 3, size=(0.01, 0.01), center=(0, 0, 6), radius=0.004))
    table = Geometry(name="p", link="hand", kind="box", size=(8.0, 8.0, 0.005))
    with warnings.catch_warnings(action="error"):
        probes = {"tip": ContactDepthProbe(link="hand", probes=Probes([[7, 7, 0.005]], [[0, 0, 1.0]], 0.004))}
        SensorSuite(TouchScene(("hand", "o"), (table, BALL)), probes, num_envs=1)


@pytest.mark.parametrize(("place", "warned"), [(10.0, 0), (100.0, 1)])
def test_hands_far_from_the_origin_of_the_world_are_said_once(place: float, warned: int) -> None:
    suite, scene = _suite(BALL, ON_TOP), pad_scene(BALL)
    state = state_of(scene, poses_at(3, {1: (place, 0, 0), 2: (place, 0, 0.0145)}))
    with warnings.catch_warnings(record=True) as messages:
        warnings.simplefilter("always")
        suite.update(state)
        suite.update(state)
    assert ["to some 6 µm" in str(message.message) for message in messages] == [True] * warned


@pytest.mark.parametrize(
    "shape",
    [
        Geometry(name="p", link="hand", kind="box", size=(0.02, 0.02, 0.005)),
        Geometry(name="p", link="hand", kind="sphere", size=(0.01,)),
        Geometry(name="p", link="hand", kind="capsule", size=(0.008, 0.02), quaternion=(0.7, 0.7, 0, 0)),
        Geometry(name="p", link="hand", kind="cylinder", size=(0.008, 0.02), position=(0, 0, 0.001)),
    ],
)
def test_probes_inside_their_own_link_are_counted(shape: Geometry) -> None:
    scene = TouchScene(("hand", "o"), (shape, BALL))
    inside = Probes(
        np.array([[0, 0, 0], [0, 0, 0.001], [0.03, 0, 0.03]]), np.tile([0, 0, 1.0], (3, 1)), np.full(3, 1e-3)
    )
    with pytest.warns(RuntimeWarning, match="2 of 3 probes of 'tip'"):
        SensorSuite(scene, {"tip": ContactDepthProbe(link="hand", probes=inside)}, num_envs=1)


@pytest.mark.parametrize("hand", ["xhand1", "sharpa"])
def test_layouts_of_the_hands_are_plausible(hand: str) -> None:
    model = hands.load(hand)
    sensors = {k: ContactDepthProbe(link=k, probes=p) for k, p in model.layout("high", "hand").items()}
    with warnings.catch_warnings(action="error"):
        SensorSuite(TouchScene.from_mujoco(model.model), sensors, num_envs=1)
