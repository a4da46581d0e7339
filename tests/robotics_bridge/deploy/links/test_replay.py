"""A log that the simulated hand wrote is replayed without error; logs that do not fit are refused in one sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from brainbench.core.errors import DataError, UsageError
from robotics_bridge import hands
from robotics_bridge.deploy.links.episodes import PARTS, SessionFacts, TactilePoints, write_lerobot
from robotics_bridge.deploy.links.replay import Replay, TouchLog, read_touch_log, replay, taxel_names
from tests.robotics_bridge.hands.test_grippers import JAWS, LINK, URDF

FRAMES = 20


@pytest.fixture(scope="module")
def jaws(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("hand") / "jaws.urdf"
    path.write_text(URDF.format(links="".join(LINK.format(*jaw) for jaw in JAWS)))
    return path


@pytest.fixture(scope="module")
def recorded(jaws) -> Replay:
    """Return what the simulated jaws do and feel while they close, as the log of a real hand."""
    hand = hands.load(jaws)
    layout = hand.layout("low", "tips")
    places = [[getattr(probes, name)[probes.active] for probes in layout.values()] for name in ("position", "normal")]
    links = np.repeat(list(layout), list(map(len, places[0])))
    points = TactilePoints(tuple(links.tolist()), *map(np.concatenate, places))
    target = np.linspace(0.03, 0.0, FRAMES)[:, None].repeat(len(hand.joints), axis=1)
    nothing = np.zeros((FRAMES, len(links)))
    log = TouchLog("jaws", np.arange(FRAMES) / 50, hand.joints, target, target, points, nothing)
    result = replay(log, str(jaws))
    assert result.simulated.max() > 0.1
    return Replay(replace(log, position=result.position, force=result.simulated), result.simulated, result.position)


def _episode(folder: Path, log: TouchLog) -> Path:
    touch = np.zeros((FRAMES, len(log.points.links), 6))
    touch[..., :3] = -log.force[..., None] * log.points.normal
    frames = dict(zip(PARTS, (log.position, 0 * log.position, log.target, touch, np.zeros((FRAMES, 6))), strict=True))
    facts = SessionFacts(task="close", fps=50, joints=log.joints, points=log.points, robot="jaws", unit="N")
    return write_lerobot(folder, frames, facts)


def _table(path: Path, log: TouchLog) -> Path:
    names = ["time", *log.joints, *taxel_names(log.points.links)]
    pd.DataFrame(np.c_[log.time, log.position, log.force], columns=names).to_csv(path, index=False)
    return path


def test_a_reading_that_no_hand_feels_is_refused(recorded) -> None:
    force = recorded.log.force.copy()
    force[3, 0] = 1e308
    with pytest.raises(DataError, match="more than any hand feels"):
        replace(recorded.log, force=force)


def test_what_the_simulated_hand_recorded_is_replayed_to_the_last_newton(recorded, jaws) -> None:
    result = replay(recorded.log, str(jaws))
    peaks = recorded.simulated.max(axis=0)
    assert max(row["error"] for row in result.rows()) < 0.02 * peaks.max()
    assert result.tracking < 1e-4
    # Twice the force in the log is an error of once the force, and of no correlation.
    louder = replace(recorded.log, force=2 * recorded.log.force)
    rows = Replay(louder, recorded.simulated, recorded.position).rows()
    felt = max(rows, key=lambda row: row["simulated_peak"])
    assert felt["error"] == pytest.approx(np.sqrt(np.mean(recorded.simulated**2, axis=0)).max(), rel=0.5)
    assert felt["correlation"] == pytest.approx(1.0)


def test_episodes_of_both_layouts_and_tables_are_read_alike(recorded, jaws, tmp_path) -> None:
    hand = hands.load(jaws)
    layout, log = hand.layout("low", "tips"), recorded.log
    folder = _episode(tmp_path / "v3", log)
    logs = [read_touch_log(folder, hand, layout), read_touch_log(_table(tmp_path / "log.csv", log), hand, layout)]
    # Layout v2: a file for each episode, names of joints below "motors", and places as the hand's own layout has them.
    info = json.loads((folder / "meta" / "info.json").read_text())
    info["codebase_version"] = "v2.1"
    for name in ("observation.state", "action"):
        info["features"][name]["names"] = {"motors": [f"{joint}.pos" for joint in log.joints]}
    (folder / "meta" / "info.json").write_text(json.dumps(info))
    (folder / "meta" / "tactile.json").unlink()
    data = folder / "data" / "chunk-000"
    (data / "file-000.parquet").rename(data / "episode_000000.parquet")
    logs.append(read_touch_log(folder, hand, layout))
    for read in logs:
        assert (read.joints, read.points.links) == (log.joints, log.points.links)
        for name in ("time", "position", "force"):
            np.testing.assert_allclose(getattr(read, name), getattr(log, name), atol=1e-6)
        np.testing.assert_allclose(read.points.position, log.points.position)
    with pytest.raises(UsageError, match="1 episodes"):
        read_touch_log(folder, hand, layout, 1)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"l": "wrist"}, "another hand than .*'wrist'"),
        ({"left:0": "elbow:0"}, "another hand than .*'elbow'"),
        ({"left:0": "left:9999"}, "has .* taxels on 'left'"),
        ({"left:0": "left:x"}, "LINK:NUMBER"),
        ({"time": "t"}, "'time'"),
    ],
)
def test_tables_of_another_hand_are_refused(change, sentence, recorded, jaws, tmp_path) -> None:
    hand, path = hands.load(jaws), _table(tmp_path / "log.csv", recorded.log)
    pd.read_csv(path).rename(columns=change).to_csv(path, index=False)
    with pytest.raises(DataError, match=sentence):
        read_touch_log(path, hand, hand.layout("low", "tips"))


def test_numbers_that_are_none_repeated_times_and_millimetres_are_refused(recorded) -> None:
    log = recorded.log
    spoilt, late = log.force.copy(), log.time.copy()
    spoilt[7, 0], late[5] = np.nan, late[4]
    far = replace(log.points, position=1e3 * log.points.position)
    for change, sentence in (
        ({"force": spoilt}, "force of frame 7 is no finite number"),
        ({"time": late}, "frame 5 does not come after"),
        ({"points": far}, "scale millimetres"),
    ):
        with pytest.raises(DataError, match=sentence):
            replace(log, **change)
