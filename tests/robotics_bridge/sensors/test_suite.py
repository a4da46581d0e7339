"""The suite: what is built, what is read, and what it refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from robotics_bridge.physics import Geometry, HandState
from robotics_bridge.sensors import (
    ContactAudio,
    ContactDepthProbe,
    ContactProbe,
    KinematicTaxel,
    Noise,
    Probes,
    SensorSuite,
    SurfaceDistanceProbe,
    TemperatureGrid,
)
from robotics_bridge.sensors.audio.sensors import Modes
from tests.factories.touch_scenes import (
    BALL,
    GRID,
    move_all,
    pad_scene,
    poses_at,
    random_pose,
    state_of,
    suite_of,
    touching,
)


def _press(state: HandState, envs: int = 1) -> None:
    """Let the ball press the pad with 1 N in every environment."""
    contact = {"force": [1.0], "distance": [-5e-4], "position": [[0.001, -0.002, 0.005]], "normal": [[0, 0, 1.0]]}
    state.set_contacts(np.arange(envs), [[0, 1]] * envs, **{name: value * envs for name, value in contact.items()})


def test_readings_have_the_shapes_of_their_layouts_and_share_memory() -> None:
    line = Probes([[0, 0, 0.005]] * 7, [[0, 0, 1.0]] * 7, 0.003)
    suite = suite_of(
        {
            "grid": ContactDepthProbe(link="hand", probes=GRID),
            "line": ContactDepthProbe(link="hand", probes=line),
            "taxel": KinematicTaxel(link="hand", probes=GRID),
        },
        envs=3,
    )
    suite.update(state_of(suite.scene, touching(3)))
    assert suite.read("grid").shape == (3, 4, 5)
    assert suite.read("line").shape == (3, 7)
    assert suite.read("taxel").shape == (3, 4, 5, 6)
    assert suite.read("grid").data_ptr() == suite.read("grid").data_ptr()
    view = suite.read("grid")
    before = view.clone()
    suite.update(state_of(suite.scene, touching(3, height=0.014)))
    assert not torch.equal(view, before)


def test_only_meshes_that_a_sensor_tracks_get_a_field_and_equal_meshes_share_it() -> None:
    mesh = Mesh([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0, 0, 0.01]], [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    twins = [Geometry(name=f"m{i}", link=f"m{i}", kind="mesh", mesh=mesh) for i in range(3)]
    scene = pad_scene(*twins, BALL)
    track = {"sdf": ("m0", "m1"), "raycast": ("m2",)}
    sensors = {
        query: ContactDepthProbe(link="hand", probes=GRID, track=links, query=query)  # type: ignore[arg-type]
        for query, links in track.items()
    }
    suite = SensorSuite(scene, sensors, num_envs=1, resolution=8)
    assert _fields_and_trees(suite) == (1, 1)


def _fields_and_trees(suite: SensorSuite) -> tuple[int, int]:
    solids = suite.solids.struct.solid.numpy().ravel()
    return len({*solids["first"][solids["counts"][:, 0] > 2]}), len({*solids["mesh"]} - {0})


def test_fillers_read_zero_whatever_the_noise() -> None:
    radius = np.full(20, 0.003)
    radius[[3, 7]] = 0
    probes = Probes(GRID.position, GRID.normal, radius, (4, 5))
    noise = Noise(white=1e-3, bias=0.1, dead_probability=0.5, dead_range=(1.0, 2.0))
    suite = suite_of({"depth": ContactDepthProbe(link="hand", probes=probes, noise=noise)})
    suite.update(state_of(suite.scene, touching()))
    read = suite.read("depth").flatten()
    assert (read[[3, 7]] == 0).all()
    assert (np.delete(read.numpy(), [3, 7]) != 0).all()


def test_reset_starts_single_environments_anew() -> None:
    sensor = ContactProbe(link="hand", probes=Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 1e-6), release=1e-4)
    suite = suite_of({"bit": sensor}, envs=2)
    for depth in (6e-4, 3e-4):
        suite.update(state_of(suite.scene, poses_at(3, {2: (0, 0, 0.015 + 1e-6 - depth)}, 2)))
    assert suite.read("bit").flatten().tolist() == [1, 1]
    suite.reset([1])
    suite.update(state_of(suite.scene, poses_at(3, {2: (0, 0, 0.015 + 1e-6 - 3e-4)}, 2)))
    assert suite.read("bit").flatten().tolist() == [1, 0]


def test_a_diverged_environment_reads_nan_and_harms_no_other() -> None:
    sensors = {"depth": ContactDepthProbe(link="hand", probes=GRID), "taxel": KinematicTaxel(link="hand", probes=GRID)}
    suite, alone = suite_of(sensors, envs=3), suite_of(sensors)
    poses = touching(3)
    poses[1, 2, 0] = np.nan
    suite.update(state_of(suite.scene, poses))
    alone.update(state_of(alone.scene, touching()))
    assert suite.diverged.tolist() == [False, True, False]
    for name in sensors:
        assert suite.read(name)[1].isnan().all()
        assert torch.equal(suite.read(name)[2], alone.read(name)[0])
    suite.reset([1])
    suite.update(state_of(suite.scene, touching(3)))
    assert torch.equal(suite.read("depth")[1], alone.read("depth")[0])


def test_flags_belong_to_the_suite_that_raised_them() -> None:
    scene, far = pad_scene(BALL), replace(GRID, position=np.add(GRID.position, (0.1, 0, 0)))
    lost = suite_of({"f": KinematicTaxel(link="hand", probes=far, total="engine")}, scene=scene)
    other = suite_of({"c": ContactProbe(link="hand", probes=GRID)}, scene=scene)
    state = state_of(scene, touching())
    _press(state)
    lost.update(state)
    other.update(state)
    assert (lost.unfelt.item(), other.unfelt.item()) == (True, False)
    state.velocity_torch[0, 2, 0] = np.inf
    lost.update(state)
    state.velocity_torch[0, 2, 0] = 0.0
    other.update(state)
    assert (lost.diverged.item(), other.diverged.item()) == (True, False)
    lost.reset()
    assert not lost.diverged.item()


@pytest.mark.parametrize("delay", [0.0, 0.02])
def test_after_a_reset_nothing_of_the_old_episode_can_be_read(delay: float) -> None:
    noise = Noise(white=1e-4, read_delay=delay)
    sensors = {
        "depth": ContactDepthProbe(link="hand", probes=GRID, noise=noise, history=3),
        "near": SurfaceDistanceProbe(link="hand", probes=GRID),
        "load": KinematicTaxel(link="hand", probes=GRID, total="engine"),
        "warm": TemperatureGrid(link="hand", tau=0.1),
    }
    suite = suite_of(sensors, envs=3)
    state = state_of(suite.scene, touching(3))
    _press(state, 3)
    for _ in range(5):
        suite.update(state)

    def readings() -> list[torch.Tensor]:
        values = [read(name) for name in sensors for read in (suite.read, suite.read_ground_truth)]
        return [*values, suite.read_history("depth")]

    before = [values.clone() for values in readings()]
    assert all(values[1].any() for values in before)
    suite.reset([1])
    for values, old in zip(readings(), before, strict=True):
        assert not values[1].any()
        assert torch.equal(values[[0, 2]], old[[0, 2]])
    suite.update(state)
    assert suite.read_history("depth")[1, :2].count_nonzero() == 0
    assert suite.read_history("depth")[1, 2].any()


@pytest.mark.parametrize(
    ("settings", "advised"), [({}, True), ({"total": "engine"}, False), ({"convention": "thesis"}, False)]
)
def test_a_law_of_depths_says_once_that_it_does_not_follow_the_load(settings, advised, caplog) -> None:
    suite = suite_of({"f": KinematicTaxel(link="hand", probes=GRID, **settings)})
    state = state_of(suite.scene, poses_at(3, {2: (0.001, -0.002, 0.1)}))
    state.contact_count.zero_()
    suite.update(state)
    assert not caplog.records
    _press(state)
    for _ in range(3):
        suite.update(state)
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == advised
    assert not advised or messages[0].startswith("'f' read forces by a law of depths")


def test_history_holds_the_last_readings_oldest_first_and_is_cleared_by_reset() -> None:
    suite = suite_of({"depth": ContactDepthProbe(link="hand", probes=GRID, history=3)}, envs=2)
    read = []
    for height in (0.0145, 0.0143, 0.0141, 0.0139):
        suite.update(state_of(suite.scene, touching(2, height)))
        read.append(suite.read("depth").clone())
    assert torch.equal(suite.read_history("depth"), torch.stack(read[1:], dim=1))
    suite.reset([0])
    suite.update(state_of(suite.scene, touching(2)))
    kept = suite.read_history("depth")
    assert (kept[0, :2] == 0).all()
    assert torch.equal(kept[1, 1], read[3][1])


def test_readings_do_not_depend_on_batch_pose_or_order_of_probes() -> None:
    rng = np.random.default_rng(3)
    scene = pad_scene(BALL)
    poses = np.concatenate([touching(), touching(1, 0.0142), touching(1, 0.0148)])
    velocities = rng.normal(0, 0.1, (3, 3, 6))
    order = rng.permutation(20)
    shuffled = Probes(GRID.position[order], GRID.normal[order], GRID.radius[order])
    suite = SensorSuite(
        scene,
        {"taxel": KinematicTaxel(link="hand", probes=GRID), "shuffled": KinematicTaxel(link="hand", probes=shuffled)},
        num_envs=3,
    )
    suite.update(state_of(scene, poses, velocities))
    read = suite.read("taxel").flatten(1, 2).clone()
    assert (read != 0).any()
    assert torch.equal(suite.read("shuffled"), read[:, order])
    alone = SensorSuite(scene, {"taxel": KinematicTaxel(link="hand", probes=GRID)}, num_envs=1)
    alone.update(state_of(scene, poses[1:2], velocities[1:2]))
    assert torch.equal(alone.read("taxel").flatten(1, 2)[0], read[1])
    moved = move_all(poses, velocities, random_pose(rng, 0.2))
    suite.update(state_of(scene, *moved))
    np.testing.assert_allclose(
        suite.read("taxel").flatten(1, 2).numpy(), read.numpy(), atol=2e-4 * float(read.abs().max())
    )


def test_seeds_and_offsets_decide_the_noise_and_nothing_else() -> None:
    noise = Noise(white=1e-3)
    sensors = {"a": ContactDepthProbe(link="hand", probes=GRID, noise=noise)}
    whole, shard = suite_of(sensors, envs=4, seed=5), suite_of(sensors, envs=2, seed=5, env_offset=2)
    other = suite_of(sensors, envs=4, seed=6)
    for suite in (whole, shard, other):
        suite.update(state_of(suite.scene, touching(suite.num_envs)))
    assert torch.equal(whole.read("a")[2:], shard.read("a"))
    assert not torch.equal(whole.read("a"), other.read("a"))
    assert torch.equal(whole.read_ground_truth("a"), other.read_ground_truth("a"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: suite_of({"a": ContactProbe(link="hnad", probes=GRID)}), "did you mean 'hand'"),
        (lambda: suite_of({"a": GRID}), "The sensor .a. must be ContactProbe"),
        (lambda: suite_of({}, envs=0), "at most 1,000,000; received"),
        (
            lambda: ContactProbe(link="hand", probes=GRID, threshold=1e-4, release=2e-4),
            "release .*most 0.0001",
        ),
        (lambda: KinematicTaxel(link="hand", probes=GRID, convention="thesys"), "thesis"),  # type: ignore[arg-type]
        (lambda: ContactDepthProbe(link="hand", probes=GRID, query="ray"), "'sdf', 'raycast'"),  # type: ignore[arg-type]
        (lambda: SurfaceDistanceProbe(link="hand", probes=GRID, noise=Noise(gain=(0.5, 2.0))), "no noise knob 'gain'"),
    ],
)
def test_mistakes_are_named(make: object, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        make()  # type: ignore[operator]


def test_states_and_names_that_do_not_fit_are_refused() -> None:
    suite = suite_of({"depth": ContactDepthProbe(link="hand", probes=GRID)}, envs=2)
    with pytest.raises(UsageError, match=r"2 environments .* has 1"):
        suite.update(state_of(suite.scene, touching(1)))
    with pytest.raises(UsageError, match=r"dt .*received 0"):
        suite.update(state_of(suite.scene, touching(2)), dt=0.0)
    with pytest.raises(UsageError, match="did you mean 'depth'"):
        suite.read("dept")
    with pytest.raises(UsageError, match=r"'depth' .*history="):
        suite.read_history("depth")
    with pytest.raises(UsageError, match="are 0 to 1"):
        suite.reset([2])


def test_contacts_of_geometries_that_the_scene_lacks_are_passed_over() -> None:
    scene = pad_scene(Geometry(name="ball", link="ball", kind="sphere", size=(0.01,)))
    grid = Probes.grid(3, 3, size=(0.01, 0.01), center=(0, 0, 0.005), radius=0.002)
    sensors = {
        "law": KinematicTaxel(link="hand", probes=grid),
        "sum": KinematicTaxel(link="hand", probes=grid, total="engine"),
        "heat": TemperatureGrid(link="hand"),
        "sound": ContactAudio(link="hand", modes=Modes((500.0,), (5.0,), (1.0,)), samples=100),
    }
    read = []
    for extra in ([], [(0, 7_000_000), (-3, 1), (7_000_000, 0)]):
        suite, state = SensorSuite(scene, sensors, num_envs=1), HandState.empty(1, 3, 4)
        state.set_pose(poses_at(3, {2: (0, 0, 0.0145)}))
        pairs = [(0, 1), *extra]
        ones = np.ones(len(pairs))
        places = np.tile([0, 0, 0.005], (len(pairs), 1))
        normals = np.tile([0, 0, 1.0], (len(pairs), 1))
        for force in (0.0, 5.0, 5.0):
            state.set_contacts(0 * ones, pairs, force=force * ones, position=places, normal=normals)
            suite.update(state)
        read.append({name: suite.read(name).numpy().copy() for name in sensors})
    for name in sensors:
        assert np.abs(read[0][name]).max() > 0, name
        np.testing.assert_array_equal(read[0][name], read[1][name], err_msg=name)
