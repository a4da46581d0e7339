"""Readings at the edges: no overflow, nothing hidden, one environment never harms another."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge.physics import Geometry, HandState, MujocoEngine, TouchScene
from robotics_bridge.sensors import (
    ContactDepthProbe,
    ElastomerTaxel,
    KinematicTaxel,
    Probes,
    ProximityTaxel,
    SensorSuite,
    SurfaceDistanceProbe,
)
from tests.factories.touch_scenes import PAD, pad_scene, poses_at, state_of

BALL = Geometry(name="ball", link="ball", kind="sphere", size=(0.01,))


def test_one_taxel_and_a_hundred_thousand_read_the_same_depth() -> None:
    many = Probes.grid(250, 400, size=(0.03, 0.03), center=(0, 0, 0.005), radius=0.002)
    one = Probes(many.position[60_215], many.normal[60_215], 0.002)
    scene = pad_scene(BALL)
    suite = SensorSuite(
        scene,
        {"many": ContactDepthProbe(link="hand", probes=many), "one": ContactDepthProbe(link="hand", probes=one)},
        num_envs=1,
    )
    suite.update(state_of(scene, poses_at(3, {2: (0.001, 0.002, 0.014)})))
    many_read = suite.read("many").flatten()
    assert many_read.shape == (100_000,)
    assert suite.read("one").item() == many_read[60_215].item()
    gap = np.linalg.norm(np.array(many.position) - [0.001, 0.002, 0.014], axis=1) - 0.01
    np.testing.assert_allclose(many_read.numpy(), np.maximum(0.002 - gap, 0), atol=1e-7)


@pytest.mark.parametrize("query", ["sdf", "raycast"])
def test_a_probe_at_the_heart_of_a_solid_reads_its_whole_depth(query: str) -> None:
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    scene = pad_scene(Geometry(name="box", link="box", kind="box", size=(0.05, 0.04, 0.03)))
    suite = SensorSuite(scene, {"d": ContactDepthProbe(link="hand", probes=probe, query=query)}, num_envs=1)  # type: ignore[arg-type]
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.006)})))
    assert suite.read("d").item() == pytest.approx(0.001 + 0.029, abs=1e-6)


def test_a_surface_that_touches_in_one_point_reads_zero_or_next_to_it() -> None:
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    scene = pad_scene(BALL)
    sensors = {
        "d": ContactDepthProbe(link="hand", probes=probe),
        "k": KinematicTaxel(link="hand", probes=probe),
        "p": ProximityTaxel(link="hand", probes=probe, points=100),
        "e": ElastomerTaxel(link="hand", probes=probe, points=100),
    }
    suite = SensorSuite(scene, sensors, num_envs=1)
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.016)})))
    for name in sensors:
        assert suite.read(name).abs().max() < 1e-6


def test_a_sensor_of_fillers_only_reads_zero() -> None:
    fillers = Probes(np.zeros((4, 3)), np.zeros((4, 3)), 0.0, (2, 2))
    scene = pad_scene(BALL)
    sensors = {
        "d": ContactDepthProbe(link="hand", probes=fillers),
        "s": SurfaceDistanceProbe(link="hand", probes=fillers),
        "k": KinematicTaxel(link="hand", probes=fillers),
        "p": ProximityTaxel(link="hand", probes=fillers, points=50),
    }
    suite = SensorSuite(scene, sensors, num_envs=1)
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.012)})))
    for name in sensors:
        assert (suite.read(name) == 0).all()


def test_three_thousand_objects_are_all_looked_at() -> None:
    rng = np.random.default_rng(0)
    balls = [Geometry(name=f"b{i}", link=f"b{i}", kind="sphere", size=(0.002,)) for i in range(3000)]
    scene = pad_scene(*balls)
    places = rng.uniform(-0.3, 0.3, (3000, 3))
    grid = Probes.grid(3, 3, size=(0.02, 0.02), center=(0, 0, 0.005), radius=0.01)
    sensors = {
        "far": SurfaceDistanceProbe(link="hand", probes=grid),
        "near": ContactDepthProbe(link="hand", probes=grid, pairs="all"),
        "touch": ContactDepthProbe(link="hand", probes=grid),
    }
    suite = SensorSuite(scene, sensors, num_envs=1)
    state = state_of(scene, poses_at(3002, dict(enumerate(places, start=2))), touch=False)
    suite.update(state)
    gaps = np.linalg.norm(np.array(grid.position)[:, None] - places[None], axis=2) - 0.002
    nearest = gaps.min(axis=1)
    np.testing.assert_allclose(suite.read("far").flatten(), nearest, atol=1e-6)
    np.testing.assert_allclose(suite.read("near").flatten(), np.maximum(0.01 - nearest, 0), atol=1e-6)
    chosen = int(np.argsort(gaps.min(axis=0))[0])
    state = HandState.empty(1, 3002, 8)
    state.set_pose(poses_at(3002, dict(enumerate(places, start=2))))
    # The same pair twice, in both orders, and a pair that is none of the sensor's.
    state.set_contacts([0, 0, 0], [(0, chosen + 1), (chosen + 1, 0), (5, 6)])
    suite.update(state)
    np.testing.assert_allclose(suite.read("touch").flatten(), np.maximum(0.01 - gaps[:, chosen], 0), atol=1e-6)
    assert not suite.crowded.any()


def test_more_touching_geometries_than_are_listed_are_said() -> None:
    balls = [Geometry(name=f"b{i}", link=f"b{i}", kind="sphere", size=(0.002,)) for i in range(40)]
    scene = pad_scene(*balls)
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    state = state_of(scene, poses_at(42, {}, 2), touch=False)
    state.set_contacts([0] * 40 + [1] * 3, [(0, i + 1) for i in [*range(40), 0, 1, 2]])
    short = SensorSuite(scene, {"d": ContactDepthProbe(link="hand", probes=probe)}, num_envs=2, listed=16)
    with pytest.warns(RuntimeWarning, match="listed=40"):
        short.update(state)
    assert short.crowded.tolist() == [True, False]
    with warnings.catch_warnings(action="error"):
        short.update(state)
    # Unless it is told otherwise, a suite looks at all of them.
    suite = SensorSuite(scene, {"d": ContactDepthProbe(link="hand", probes=probe)}, num_envs=2)
    suite.update(state)
    assert not suite.crowded.any()


def test_an_engine_that_runs_out_of_room_says_once_how_much_it_needs() -> None:
    import mujoco

    balls = "".join(
        f'<body pos="{0.03 * i} 0 .0099"><freejoint/><geom type="sphere" size=".01"/></body>' for i in range(9)
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><geom type="plane" size="1 1 1"/>{balls}</worldbody></mujoco>'
    )
    with pytest.warns(RuntimeWarning, match="contacts=9"):
        engine = MujocoEngine(model, 2, contacts=4)
    with warnings.catch_warnings(action="error"):
        engine.forward()
        MujocoEngine(model, 2, contacts=9)


def test_an_environment_that_was_lost_reads_nan_until_its_reset() -> None:
    ball = Geometry(name="ball", link="ball", kind="sphere", size=(0.01,))
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    scene = pad_scene(ball)
    suite = SensorSuite(scene, {"d": SurfaceDistanceProbe(link="hand", probes=probe)}, num_envs=2)
    good = poses_at(3, {2: (0, 0, 0.02)}, 2)
    bad = good.copy()
    bad[0, 2, 0] = np.nan
    state = state_of(scene, bad)
    suite.update(state)
    state.set_pose(good)
    for _ in range(2):
        suite.update(state)
        assert suite.read("d").isnan().flatten().tolist() == [True, False]
    suite.reset([1])
    suite.update(state)
    assert suite.diverged.tolist() == [True, False]
    suite.reset([0])
    suite.update(state)
    np.testing.assert_allclose(suite.read("d").flatten(), 0.005, atol=1e-7)


def test_poses_are_normalised_and_contacts_start_afresh() -> None:
    ball = Geometry(name="ball", link="ball", kind="sphere", size=(0.01,))
    state = state_of(pad_scene(ball), poses_at(3, {}), touch=False)
    pose = poses_at(3, {})
    pose[..., 3:] = [2, 0, 0, 2]
    state.set_pose(pose)
    np.testing.assert_allclose(state.pose_torch[0, 1], [0, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-7)
    pose[0, 2, 3:] = 0
    with pytest.raises(UsageError, match=r"\(0, 2\)"):
        state.set_pose(pose)
    state.set_contacts([0], [(0, 1)], force=[3.0], distance=[-1.0], position=[(1, 2, 3)], normal=[(0, 0, 1)])
    state.set_contacts([0], [(0, 1)])
    blank = HandState.empty(1, 3, 1)
    for name in ("force", "distance", "position", "normal", "friction"):
        kept, empty = (getattr(s, f"contact_{name}").numpy()[:1] for s in (state, blank))
        np.testing.assert_array_equal(kept, empty)
    with pytest.raises(UsageError, match=r"environment of a contact .*below 1; received 7"):
        state.set_contacts([7], [(0, 1)])


def test_objects_that_differ_between_environments_are_each_their_own() -> None:
    small = Geometry(name="o", link="o", kind="sphere", size=(0.004,))
    large = Geometry(name="o", link="o", kind="sphere", size=(0.010,), position=(0, 0, 0.001))
    box = Geometry(name="o", link="o", kind="box", size=(0.004, 0.004, 0.004))
    scene = TouchScene(("world", "hand", "o"), (PAD, small), variants={1: (box, large, small)})
    probe = Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.001)
    sensors = {
        "s": SurfaceDistanceProbe(link="hand", probes=probe),
        "p": ProximityTaxel(link="hand", probes=Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 0.02), points=300),
    }
    suite = SensorSuite(scene, sensors, num_envs=4)
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.02)}, 4), touch=False))
    np.testing.assert_allclose(suite.read("s").flatten(), [0.011, 0.006, 0.011, 0.011], atol=1e-7)
    force = -suite.read("p")[:, 0, 2]
    assert force[0] == force[3] > 0
    # The smaller ball shows more of its surface to the taxel, in parts of the whole.
    assert force[2] > force[1] > 0


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e2])
def test_distances_scale_with_the_scene(scale: float) -> None:
    ball = Geometry(name="ball", link="ball", kind="sphere", size=(0.01 * scale,))
    pad = Geometry(name="pad", link="hand", kind="box", size=(0.02 * scale, 0.02 * scale, 0.005 * scale))
    grid = Probes.grid(3, 3, size=(0.02 * scale, 0.02 * scale), center=(0, 0, 0.005 * scale), radius=0.004 * scale)
    scene = pad_scene(ball, pad=pad)
    suite = SensorSuite(scene, {"d": ContactDepthProbe(link="hand", probes=grid)}, num_envs=1)
    suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.014 * scale)})))
    gap = np.linalg.norm(np.array(grid.position) / scale - [0, 0, 0.014], axis=1) - 0.01
    np.testing.assert_allclose(suite.read("d").flatten() / scale, np.maximum(0.004 - gap, 0), atol=2e-8)
