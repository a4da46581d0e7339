"""Contact probes latch and release."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from brainbench.geometry import Mesh
from robotics_bridge.physics import Geometry, TouchScene
from robotics_bridge.sensors import (
    ContactProbe,
    KinematicTaxel,
    Noise,
    Probes,
    SensorSuite,
)
from robotics_bridge.sensors import runtime as sensor_runtime
from robotics_bridge.sensors.kernels.readout import CLEAN, FUSED, STAGED
from robotics_bridge.sensors.runtime import probe_rows
from robotics_bridge.sensors.taxels import runtime as taxels
from tests.factories.touch_scenes import pad_scene, poses_at, random_pose, state_of

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


NOISE = Noise(radius=5e-4, gain=(0.8, 1.2), white=1e-3, walk=1e-3, hysteresis=0.3, dead_probability=0.1, bias=0.01)
TETRAHEDRON = Mesh(
    0.012 * np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]]),
    np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]),
)
OBJECTS = (
    Geometry(name="ball", link="ball", kind="sphere", size=(0.012,)),
    Geometry(name="box", link="box", kind="box", size=(0.01, 0.012, 0.009)),
    Geometry(name="mesh", link="mesh", kind="mesh", mesh=TETRAHEDRON),
)


def _gpu(envs: int) -> Any:
    return SimpleNamespace(num_envs=envs, device=SimpleNamespace(is_cuda=True, sm_count=132))


def _readings(counts: tuple[int, ...], envs: int, noise: Noise, query: Any) -> list[np.ndarray]:
    """Truth and measured readings of three updates of sensors that meet three objects, one environment lost."""
    rng = np.random.default_rng(3)
    scene = pad_scene(*OBJECTS)
    sensors = {}
    for number, count in enumerate(counts):
        radius = rng.uniform(0.001, 0.004, count) * (rng.random(count) > 0.1)
        position, normal = rng.uniform(-0.02, 0.02, (count, 3)), np.tile([0, 0, 1.0], (count, 1))
        probes = Probes(position, normal, radius, shape=(1, count))
        track = ("ball", "box", "mesh")[: number + 1]
        sensors[f"s{number}"] = KinematicTaxel(link="hand", probes=probes, track=track, noise=noise, query=query)
    suite = SensorSuite(scene, sensors, num_envs=envs, seed=5, resolution=24)
    read = []
    for _ in range(3):
        poses = np.stack([np.stack([random_pose(rng, 0.01) for _ in scene.links]) for _ in range(envs)])
        velocity = rng.normal(0, 0.3, (envs, len(scene.links), 6))
        if envs > 2:
            poses[2, 1] = np.nan
        suite.update(state_of(scene, poses, velocity))
        for name in sensors:
            read += [suite.read(name).numpy().copy(), suite.read_ground_truth(name).numpy().copy()]
    return read


@pytest.mark.slow
@pytest.mark.parametrize("counts", [(1,), (3,), (5,), (33,), (1, 3, 33, 5)])
@pytest.mark.parametrize("noise", [Noise(), NOISE, Noise(crosstalk=0.3)], ids=["clean", "noisy", "staged"])
def test_probes_that_share_a_thread_read_the_same(
    counts: tuple[int, ...], noise: Noise, monkeypatch: pytest.MonkeyPatch
) -> None:
    envs = 4
    monkeypatch.setattr(sensor_runtime, "_SHARED", 1)
    alone = _readings(counts, envs, noise, "sdf")
    assert any(np.nanmax(np.abs(read)) > 0 for read in alone)
    monkeypatch.setattr(sensor_runtime, "_SHARED", 32)
    for shared, one in zip(_readings(counts, envs, noise, "sdf"), alone, strict=True):
        np.testing.assert_array_equal(shared, one)
    # The rows of a GPU, interleaved, four and eight probes of a thread.
    for most in (4, 8):
        monkeypatch.setattr(sensor_runtime, "_SHARED_CUDA", dict.fromkeys((CLEAN, FUSED, STAGED), (most, 1e-9)))
        monkeypatch.setattr(taxels, "probe_rows", lambda slices, context, mode: probe_rows(slices, _gpu(envs), mode))
        for shared, one in zip(_readings(counts, envs, noise, "sdf"), alone, strict=True):
            np.testing.assert_array_equal(shared, one)


def test_triangles_are_asked_alike_by_probes_that_share_a_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensor_runtime, "_SHARED", 1)
    alone = _readings((5, 33), 3, Noise(), "raycast")
    monkeypatch.setattr(sensor_runtime, "_SHARED", 32)
    for shared, one in zip(_readings((5, 33), 3, Noise(), "raycast"), alone, strict=True):
        np.testing.assert_array_equal(shared, one)


@given(seed=st.integers(0, 10_000), spare=st.integers(0, 9))
@settings(max_examples=20)
def test_where_a_contact_stands_in_the_list_changes_nothing(seed: int, spare: int) -> None:
    rng, scene, envs = np.random.default_rng(seed), pad_scene(*OBJECTS), 5
    probes = Probes(rng.uniform(-0.02, 0.02, (9, 3)), np.tile([0, 0, 1.0], (9, 1)), 0.004)
    poses = np.stack([np.stack([random_pose(rng, 0.01) for _ in scene.links]) for _ in range(envs)])
    state = state_of(scene, poses)
    count = int(state.contact_count.numpy()[0])
    owner, pairs = state.contact_env.numpy()[:count], state.contact_geom.numpy()[:count]
    sensors = {"t": KinematicTaxel(link="hand", probes=probes)}

    def read(order: np.ndarray) -> np.ndarray:
        mixed = type(state).empty(envs, len(scene.links), len(order) + spare)
        mixed.set_pose(poses)
        turned = np.where(rng.random((len(order), 1)) < 0.5, pairs[order], pairs[order, ::-1])
        mixed.set_contacts(owner[order], turned)
        suite = SensorSuite(scene, sensors, num_envs=envs, resolution=16)
        suite.update(mixed)
        return suite.read("t").numpy().copy()

    kept = rng.permutation(count)[: rng.integers(1, count + 1)]
    np.testing.assert_array_equal(read(kept), read(np.sort(kept)))
