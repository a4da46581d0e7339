"""Episodes in LeRobot's layout, read back by pandas and pyarrow."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from pyarrow import parquet

from brainbench.core.errors import DataError, UsageError
from robotics_bridge import hands
from robotics_bridge.deploy.driver import HandReading
from robotics_bridge.deploy.episodes import Episode, SessionRecorder, TactilePoints, total_wrench, write_lerobot
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.encoders.finger_axes import finger_axes_of
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid

HAND = hands.load("xhand1")
PROBES = HAND.layout("low", "tips")
PLACES = [[getattr(probes, name)[probes.active] for probes in PROBES.values()] for name in ("position", "normal")]
POINTS = TactilePoints(
    tuple(PROBES), np.repeat(range(5), list(map(len, PLACES[0]))), np.concatenate(PLACES[0]), np.concatenate(PLACES[1])
)


def _episode(length: int, task: str = "turn the ball", seed: int = 0) -> Episode:
    rng = np.random.default_rng(seed)
    shapes = ((12,), (12,), (12,), (45, 6), (6,))
    frames = [[rng.normal(size=shape) for shape in shapes] for _ in range(length)]
    return Episode(task, *(np.array([frame[part] for frame in frames]) for part in range(5)))


@pytest.fixture
def folder(tmp_path):
    episodes = [_episode(4), _episode(3, "hold it", 1)]
    return write_lerobot(tmp_path / "set", episodes, fps=40, joints=HAND.joints, points=POINTS)


def test_frames_are_those_that_were_recorded(folder) -> None:
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["total_frames"], info["fps"]) == ("v3.0", 7, 40)
    path = folder / info["data_path"].format(chunk_index=0, file_index=0)
    frames = pd.read_parquet(path)
    assert set(frames.columns) == set(info["features"])
    second = _episode(3, seed=1)
    np.testing.assert_allclose(np.stack(frames["action"])[4:], second.action, rtol=1e-6)
    tactile = np.array([np.stack(row) for row in frames["observation.tactile"]])
    assert tactile.shape == (7, 45, 6)
    np.testing.assert_allclose(tactile[4:], second.tactile, rtol=1e-6)
    assert frames["frame_index"].tolist() == [0, 1, 2, 3, 0, 1, 2]
    assert frames["index"].tolist() == list(range(7))
    np.testing.assert_allclose(frames["timestamp"], np.array([0, 1, 2, 3, 0, 1, 2]) / 40)
    for name, feature in info["features"].items():
        if name.startswith(("observation", "action")):
            shape = np.stack(frames[name].iloc[0]).shape
            assert list(shape) == feature["shape"]
    # One row group per episode, so that an episode can be read alone.
    assert parquet.read_metadata(path).num_row_groups == 2


def test_episodes_and_tasks_are_found_as_lerobot_looks_for_them(folder) -> None:
    tasks = pd.read_parquet(folder / "meta" / "tasks.parquet")
    assert tasks.index.tolist() == ["turn the ball", "hold it"]
    assert tasks.loc["hold it", "task_index"] == 1
    episodes = pd.read_parquet(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet")
    assert episodes["dataset_from_index"].tolist() == [0, 4]
    assert episodes["dataset_to_index"].tolist() == [4, 7]
    assert [list(row) for row in episodes["tasks"]] == [["turn the ball"], ["hold it"]]
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    both = np.concatenate([_episode(4).wrench, _episode(3, seed=1).wrench])
    np.testing.assert_allclose(stats["observation.wrench"]["mean"], both.mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(episodes["stats/action/max"][1], np.max(_episode(3, seed=1).action, axis=0), rtol=1e-6)
    points = json.loads((folder / "meta" / "tactile.json").read_text())
    assert len(points["position"]) == len(points["link"]) == 45
    assert set(points["links"]) == set(HAND.tips)
    assert points["units"] == ["N", "N·m"]


def test_a_session_states_forces_in_the_unit_of_the_hand(tmp_path) -> None:
    recorder = SessionRecorder(PolicyContract({}, 40.0, "xhand1", HAND.joints, HAND.joints, {}, {}))
    pressure = np.zeros((5, 3))
    pressure[0] = 0.2
    reading = HandReading(1, 0.0, 0.0, np.zeros(12), np.zeros(12), pressure)
    recorder(reading, None, None, np.zeros(12))
    folder = recorder.write(tmp_path / "set", HAND.joints)
    points = json.loads((folder / "meta" / "tactile.json").read_text())
    assert all("pressure" in unit for unit in points["units"])


def test_the_wrench_is_the_sum_of_the_points() -> None:
    axes = finger_axes_of(HAND, HAND.layout("med", "hand"))
    rng = np.random.default_rng(2)
    points = rng.normal(size=(45, 6))
    total = total_wrench(points, POINTS.links, POINTS.link, axes)
    import torch

    grid = TaxelGrid("xhand1", placement="tips", resolution="low")
    image = grid(torch.from_numpy(points).float()[None, None])[0].numpy().astype(float)
    force = image[:3].sum((1, 2))
    moment = (image[3:] + np.cross(grid.axes.centers.transpose(2, 0, 1), image[:3], axis=0)).sum((1, 2))
    np.testing.assert_allclose(total, [*force, *moment], atol=1e-4)


def test_episodes_that_do_not_fit_are_refused(tmp_path) -> None:
    settings = {"joints": HAND.joints, "points": POINTS}
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("")
    with pytest.raises(UsageError, match=r"/full' .*empty"):
        write_lerobot(tmp_path / "full", [_episode(2)], fps=40, **settings)
    with pytest.raises(UsageError, match=r"whole number.* 33\.3"):
        write_lerobot(tmp_path / "a", [_episode(2)], fps=33.3, **settings)
    with pytest.raises(UsageError, match=r"observation.state .*\(0,\)"):
        write_lerobot(tmp_path / "b", [_episode(0)], fps=40, **settings)
    spoiled = _episode(2)
    spoiled.wrench[1][0] = np.nan
    with pytest.raises(DataError, match=r"observation.wrench .* no numbers"):
        write_lerobot(tmp_path / "c", [spoiled], fps=40, **settings)
