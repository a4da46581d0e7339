"""A log that the simulated hand wrote is replayed without error; logs that do not fit are refused in one sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from pyarrow import parquet

from brainbench.core.errors import DataError, UsageError
from robotics_bridge import hands
from robotics_bridge.deploy.controller import PressureCalibration
from robotics_bridge.deploy.driver import HandReading
from robotics_bridge.deploy.links.replay import (
    PARTS,
    TIME,
    Replay,
    SessionFacts,
    SessionRecorder,
    TactilePoints,
    TouchLog,
    read_touch_log,
    replay,
    taxel_names,
    total_wrench,
    write_lerobot,
)
from robotics_bridge.deploy.links.simulated_hand import SimulatedHand
from robotics_bridge.hands.observations import observe
from robotics_bridge.policies.contract import PolicyContract
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid, finger_axes_of
from tests.factories.paper_hands import still_map
from tests.robotics_bridge.hands.test_grippers import JAWS, LINK, URDF

HAND = hands.load("xhand1")
TIPS = HAND.tips
PROBES = HAND.layout("low", "tips")
PLACES = [[getattr(probes, name)[probes.active] for probes in PROBES.values()] for name in ("position", "normal")]
LINKS = tuple(np.repeat(list(PROBES), list(map(len, PLACES[0]))).tolist())
POINTS = TactilePoints(LINKS, *map(np.concatenate, PLACES))
SESSION = SessionFacts(task="turn the ball", fps=40, joints=HAND.joints, points=POINTS, robot="xhand1", unit="N")
CONTRACT = PolicyContract({}, 40.0, "xhand1", HAND.joints, HAND.joints, still_map(HAND.joints), {})


def _frames(length: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    shapes = dict(zip(PARTS, ((12,), (12,), (12,), (45, 6), (6,)), strict=True))
    return {name: rng.normal(size=(length, *shape)) for name, shape in shapes.items()}


@pytest.fixture
def folder(tmp_path):
    return write_lerobot(tmp_path / "set", _frames(4), SESSION)


def test_frames_are_those_that_were_recorded(folder) -> None:
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["total_frames"], info["fps"]) == ("v3.0", 4, 40)
    found = pd.read_parquet(folder / info["data_path"].format(chunk_index=0, file_index=0))
    assert set(found.columns) == set(info["features"])
    given = _frames(4)
    np.testing.assert_allclose(np.stack(found["action"]), given["action"], rtol=1e-6)
    tactile = np.array([np.stack(row) for row in found["observation.tactile"]])
    np.testing.assert_allclose(tactile, given["observation.tactile"], rtol=1e-6)
    assert found["frame_index"].tolist() == found["index"].tolist() == [0, 1, 2, 3]
    np.testing.assert_allclose(found["timestamp"], np.arange(4) / 40)
    for name, feature in info["features"].items():
        if name.startswith(("observation", "action")):
            assert list(np.stack(found[name].iloc[0]).shape) == feature["shape"]
        else:
            assert str(found[name].dtype) == feature["dtype"]


def test_columns_have_the_types_that_lerobot_stores(folder) -> None:
    kinds = parquet.read_schema(folder / "data" / "chunk-000" / "file-000.parquet")
    told = {name: str(kinds.field(name).type) for name in kinds.names}
    assert told["action"] == "fixed_size_list<element: float>[12]"
    assert told["observation.tactile"] == "list<element: list<element: float>>"
    assert (told["timestamp"], told["index"]) == ("float", "int64")


def test_episodes_and_tasks_are_found_as_lerobot_looks_for_them(folder) -> None:
    tasks = pd.read_parquet(folder / "meta" / "tasks.parquet")
    assert tasks.loc["turn the ball", "task_index"] == 0
    (episode,) = pd.read_parquet(folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_dict("records")
    assert (episode["dataset_from_index"], episode["dataset_to_index"], *episode["tasks"]) == (0, 4, "turn the ball")
    stats = json.loads((folder / "meta" / "stats.json").read_text())
    given = _frames(4)
    np.testing.assert_allclose(stats["observation.wrench"]["mean"], given["observation.wrench"].mean(axis=0), rtol=1e-5)
    np.testing.assert_allclose(episode["stats/action/max"], given["action"].max(axis=0), rtol=1e-6)
    points = json.loads((folder / "meta" / "tactile.json").read_text())
    assert len(points["position"]) == len(points["link"]) == 45
    assert set(points["links"]) == set(HAND.tips)
    assert points["units"] == ["N", "N·m"]


def test_a_session_states_forces_in_the_unit_of_the_hand(tmp_path) -> None:
    recorder = SessionRecorder(CONTRACT, tmp_path / "set").begin(HAND.joints, HAND.fingers)
    assert recorder.write() is None
    pressure = np.zeros((5, 3))
    pressure[0] = 0.2
    # A loop may miss ticks, and two may use one report.
    for number, time in enumerate((7.0, 7.025, 7.025, 7.075)):
        reading = HandReading(number, time, time, np.zeros(12), np.zeros(12), pressure)
        recorder(reading, None, None, np.full(12, 0.01 * number))
    # What was recorded is read again: when it was measured, of the middle of a round tip, along one normal.
    log = read_touch_log(recorder.write(), HAND, PROBES)
    np.testing.assert_allclose(log.time, [0, 0.025, 0.075], atol=1e-6)
    assert log.target[:, 0].tolist() == pytest.approx([0, 0, 0.02])
    assert "pressure" in log.unit
    np.testing.assert_allclose(np.linalg.norm(log.points.normal, axis=1), 1)
    assert {*log.points.links} == {*TIPS}
    assert [log.points.links[row] for row in np.flatnonzero(log.force[0])] == [TIPS[0]]


def test_the_clock_of_a_session_of_hours_keeps_its_microseconds(tmp_path) -> None:
    clock = 36_000.0 + np.arange(4) * 0.025 + 1e-4
    still = {name: 0 * values for name, values in _frames(4).items()} | {TIME: clock[:, None]}
    log = read_touch_log(write_lerobot(tmp_path / "set", still, SESSION), HAND, PROBES)
    np.testing.assert_allclose(log.time, clock, rtol=0, atol=1e-7)


@pytest.mark.parametrize("fingers", [None, ("thumb", "pinky", "index"), ()])
def test_recorded_forces_are_those_of_pressed_skin(tmp_path, fingers) -> None:
    """Pressed along its normal, each tip is pushed inward, whatever the order of the fingers in the reports."""
    layout, order = HAND.layout("med", "tips"), tuple(HAND.fingers) if fingers is None else fingers
    recorder = SessionRecorder(CONTRACT, tmp_path / "set").begin(HAND.joints, order)
    depth = {link: torch.rand(1, *layout[link].shape) for link in TIPS}
    felt = observe("agg_force", depth, {link: layout[link] for link in TIPS})
    pressure = PressureCalibration().pressure(tuple(HAND.fingers), felt.reshape(-1, 3).numpy())
    rows = [list(HAND.fingers).index(finger) for finger in order]
    recorder(HandReading(1, 0.0, 0.0, np.zeros(12), np.zeros(12), pressure[rows]), None, None, np.zeros(12))
    weighed = {link: d.numpy().reshape(-1, 1) * layout[link].normal for link, d in depth.items()}
    inward = {link: -10.0 * each[layout[link].active].sum(0) for link, each in weighed.items()}
    assert {*recorder.points.links} == {TIPS[row] for row in rows}
    for link, point in zip(recorder.points.links, recorder.frames[0][3], strict=True):
        np.testing.assert_allclose(point[:3], inward[link], atol=1e-5 * np.linalg.norm(inward[link]))


def test_the_wrench_is_the_sum_of_the_points() -> None:
    axes = finger_axes_of(HAND, HAND.layout("med", "hand"))
    rng = np.random.default_rng(2)
    points = rng.normal(size=(45, 6))
    total = total_wrench(points, POINTS.links, axes)
    grid = TaxelGrid("xhand1", placement="tips", resolution="low")
    image = grid(torch.from_numpy(points).float()[None, None])[0].numpy().astype(float)
    force = image[:3].sum((1, 2))
    moment = (image[3:] + np.cross(grid.axes.centers.transpose(2, 0, 1), image[:3], axis=0)).sum((1, 2))
    np.testing.assert_allclose(total, [*force, *moment], atol=1e-4)


def test_sessions_that_do_not_fit_are_refused(tmp_path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "x").write_text("")
    with pytest.raises(UsageError, match=r"/full' .*empty"):
        write_lerobot(tmp_path / "full", _frames(2), SESSION)
    with pytest.raises(UsageError, match=r"whole number.* 33\.3"):
        write_lerobot(tmp_path / "a", _frames(2), replace(SESSION, fps=33.3))
    with pytest.raises(UsageError, match=r"observation.state .*\(0, 12\)"):
        write_lerobot(tmp_path / "b", _frames(0), SESSION)
    spoiled = _frames(2)
    spoiled["observation.wrench"][1][0] = np.nan
    with pytest.raises(DataError, match=r"observation.wrench .* no numbers"):
        write_lerobot(tmp_path / "c", spoiled, SESSION)


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


@pytest.mark.parametrize(
    ("factor", "words"), [(1.0, ""), (3.0, ""), (1e3, "reads 1e+03 times"), (1e-3, "another unit"), (-1.0, "log falls")]
)
def test_a_log_of_another_sign_or_unit_is_doubted(recorded, factor, words) -> None:
    log = replace(recorded.log, force=factor * recorded.log.force + 0.2)
    doubts = Replay(log, recorded.simulated, recorded.position).doubts
    assert len(doubts) == bool(words)
    assert words in "".join(doubts)
    # Touch of something else tells neither.
    other = replace(log, force=np.random.default_rng(0).normal(size=log.force.shape))
    assert not Replay(other, recorded.simulated, recorded.position).doubts


@pytest.mark.parametrize("missing", [(), (5, 6, 7)])
def test_an_action_moves_the_hand_after_the_state_of_its_frame(recorded, jaws, tmp_path, missing) -> None:
    """A hand that is driven here, reported before each command as LeRobot does, goes the same way in the replay."""
    log = recorded.log
    body = SimulatedHand(str(jaws), 200.0)
    steps, states = np.linspace(0.03, 0.0, FRAMES // 4).repeat(4), []
    start = body.engine.data[0].qpos.copy()
    start[[int(body.engine.model.joint(joint).qposadr[0]) for joint in log.joints]] = 0.03
    body.engine.set(qpos=start)
    for target in steps:
        states.append(body.position)
        body.drive(np.full(len(log.joints), target))
        for _ in range(4):
            body.step()
    actions = steps[:, None].repeat(len(log.joints), axis=1)
    folder = _episode(tmp_path / "v3", replace(log, position=np.array(states), target=actions))
    if missing:
        file = folder / "data" / "chunk-000" / "file-000.parquet"
        pd.read_parquet(file).drop(index=[*missing]).to_parquet(file)
    hand = hands.load(jaws)
    result = replay(read_touch_log(folder, hand, hand.layout("low", "tips")), str(jaws))
    assert np.ptp(result.position) > 0.01
    assert result.tracking < 1e-6


@pytest.mark.parametrize("fps", [20, 50])
def test_joints_of_a_log_without_actions_are_followed_in_time(fps) -> None:
    """The damped drives of a hand would stay .1 s behind what moves."""
    time = np.arange(fps) / fps
    position = np.zeros((fps, len(HAND.joints)))
    moving = HAND.joints.index("right_hand_index_joint1")
    position[:, moving] = 0.3 + 0.2 * np.sin(2 * np.pi * time)
    log = TouchLog("wave", time, HAND.joints, position, None, POINTS, np.zeros((fps, len(LINKS))))
    behind = replay(log, "xhand1").position[:, moving] - position[:, moving]
    assert np.abs(behind[fps // 4 :]).max() < 0.01


def test_a_joint_that_stands_in_a_log_twice_is_refused(recorded) -> None:
    with pytest.raises(DataError, match="the joint l stands in it 2 times"):
        replace(recorded.log, joints=("l", "l"))


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
    with pytest.raises(UsageError, match="below 1; received 1"):
        read_touch_log(folder, hand, layout, 1)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"l": "wrist"}, "another hand than .*'wrist'"),
        ({"left:0": "elbow:0"}, "another hand than .*'elbow'"),
        ({"left:0": "left:9999"}, "has .* taxels on 'left'"),
        ({"left:0": "left:x"}, "LINK:NUMBER"),
        ({"time": "t"}, "'time'"),
        ({"left:1": "left:00"}, "left:0 stands in it 2 times"),
    ],
)
def test_tables_of_another_hand_are_refused(change, sentence, recorded, jaws, tmp_path) -> None:
    hand, path = hands.load(jaws), _table(tmp_path / "log.csv", recorded.log)
    pd.read_csv(path).rename(columns=change).to_csv(path, index=False)
    with pytest.raises(DataError, match=sentence):
        read_touch_log(path, hand, hand.layout("low", "tips"))


@pytest.mark.parametrize(
    ("key", "change"), [("position", lambda rows: rows + rows[:1]), ("link", lambda rows: [-1, *rows[1:]])]
)
def test_points_without_a_place_each_are_refused(key, change, recorded, jaws, tmp_path) -> None:
    hand, folder = hands.load(jaws), _episode(tmp_path / "v3", recorded.log)
    described = folder / "meta" / "tactile.json"
    places = json.loads(described.read_text())
    described.write_text(json.dumps({**places, key: change(places[key])}))
    with pytest.raises(DataError, match="gives each point a link"):
        read_touch_log(folder, hand, hand.layout("low", "tips"))


def test_numbers_that_are_none_repeated_times_and_millimetres_are_refused(recorded) -> None:
    log = recorded.log
    spoilt, late = log.force.copy(), log.time.copy()
    spoilt[7, 0], late[5] = np.nan, late[4]
    far, nowhere = (replace(log.points, position=scale * log.points.position) for scale in (1e3, np.nan))
    for change, sentence in (
        ({"force": spoilt}, "force of frame 7 is no finite number"),
        ({"time": late}, "frame 5 does not come after"),
        ({"time": 1e3 * log.time}, "every 20 s .* give time in seconds"),
        ({"time": np.arange(FRAMES) * 1e-9}, "every 1e-09 s"),
        ({"time": log.time + 3600 * (log.time > 0.1)}, "longest gap is 3600.02 s .*cut the log"),
        ({"points": far}, "scale millimetres"),
        ({"points": nowhere}, "lies nan m"),
        ({"points": replace(log.points, normal=2 * log.points.normal)}, "normals are 2 to 2 long"),
    ):
        with pytest.raises(DataError, match=sentence):
            replace(log, **change)


def test_joints_far_out_of_their_range_are_in_another_unit(recorded, jaws, tmp_path) -> None:
    for name, unit in ((jaws, "millimetres"), ("xhand1", "degrees")):
        hand = hands.load(name)
        layout = hand.layout("low", "tips")
        table = {
            "time": np.arange(3) / 50,
            hand.joints[0]: np.linspace(0, 40.0, 3),
            f"{next(iter(layout))}:0": np.ones(3),
        }
        pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
        with pytest.raises(DataError, match=f"are these {unit}"):
            read_touch_log(tmp_path / "log.csv", hand, layout)


def test_an_episode_in_two_files_is_read_whole(recorded, jaws, tmp_path) -> None:
    hand, folder = hands.load(jaws), _episode(tmp_path / "v3", recorded.log)
    first = folder / "data" / "chunk-000" / "file-000.parquet"
    frames = pd.read_parquet(first)
    frames[12:].to_parquet(first.with_name("file-001.parquet"))
    frames[:12].to_parquet(first)
    log = read_touch_log(folder, hand, hand.layout("low", "tips"))
    np.testing.assert_allclose(log.force, recorded.log.force, atol=1e-6)


@pytest.mark.parametrize("channels", [1, 2, 4, 5])
def test_touch_of_other_channels_than_a_force_is_refused(channels, recorded, jaws, tmp_path) -> None:
    folder, hand = _episode(tmp_path / "v3", recorded.log), hands.load(jaws)
    path = folder / "data" / "chunk-000" / "file-000.parquet"
    table = pd.read_parquet(path)
    table["observation.tactile"] = [[row[:channels] for row in frame] for frame in table["observation.tactile"]]
    table.to_parquet(path)
    with pytest.raises(DataError, match=rf"received \[\d+, {channels}\]"):
        read_touch_log(folder, hand, hand.layout("low", "tips"))


def test_taxels_that_a_layout_places_have_its_sensing_radius(tmp_path) -> None:
    layout = HAND.layout("high", "tips")
    index, thumb = (next(link for link in TIPS if name in link) for name in ("index", "thumb"))
    path = tmp_path / "log.csv"
    names = ["time", HAND.joints[0], f"{index}:0", f"{thumb}:3"]
    pd.DataFrame([[0.0, 0, 0, 0], [0.02, 0, 0, 0]], columns=names).to_csv(path, index=False)
    log = read_touch_log(path, HAND, layout)
    np.testing.assert_array_equal(log.points.radius, [layout[link].radius.max() for link in (index, thumb)])


def test_the_radius_of_a_log_is_that_of_the_simulated_taxels(recorded, jaws) -> None:
    narrow = replace(recorded.log.points, radius=np.full(len(recorded.log.taxels), 1.5e-3))
    result = replay(replace(recorded.log, points=narrow), str(jaws))
    # The same load lies on fewer taxels.
    assert (result.simulated[-1] > 1e-3).sum() < (recorded.simulated[-1] > 1e-3).sum()
    assert result.simulated[-1].max() > 1.2 * recorded.simulated[-1].max()
