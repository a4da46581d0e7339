"""Hands that explore objects."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from brainbench import load_model
from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli import load_stimuli
from brainbench.stimuli.stimulus_set import hash_stimulus_set
from robotics_bridge import hands
from robotics_bridge.exploration.record import PROCEDURES, Explored, record_exploration
from robotics_bridge.hands.scenes import closing
from robotics_bridge.physics import Geometry, MujocoEngine
from robotics_bridge.policies.encoders.taxel_grid import TaxelGrid


def _box(label: str = "box", **changes) -> Explored:
    return Explored(label, Geometry(name="o", link="o", kind="box", size=(0.02, 0.03, 0.015)), **changes)


@pytest.fixture(scope="module")
def rubbed():
    return record_exploration([_box(), _box("far", retreat=0.0015)], ["lateral_motion"], resolution="low", frames=40)


def test_nothing_is_felt_before_the_touch_and_the_object_pushes_into_the_palm(rubbed) -> None:
    total = rubbed.wrench[:, :, :, :3].sum(axis=2)
    assert not total[:, 0].any()
    assert (total[:, -1, 0] < -0.5).all()  # the palm of this hand faces x


def test_rubbing_drags_the_skin_along(rubbed) -> None:
    times = np.arange(40) / 40
    there = times > 0.45
    sideways = np.array([PROCEDURES["lateral_motion"](t).y for t in times])
    velocity = np.gradient(sideways, times)
    force = rubbed.wrench[0, :, :, :3].sum(axis=1)
    # Across the fingers is the palm's y, up to its sign in the world.
    assert abs(np.corrcoef(force[there, 1], velocity[there])[0, 1]) > 0.8


def test_what_is_held_further_away_is_felt_more_softly(rubbed) -> None:
    strength = np.linalg.norm(rubbed.wrench[..., :3].sum(axis=2), axis=-1).max(axis=1)
    assert strength[1] < strength[0]


def test_a_held_object_does_not_give_way() -> None:
    ball = Explored("ball", Geometry(name="o", link="o", kind="sphere", size=(0.03,)))
    found = record_exploration([ball], ["enclosure"], resolution="low", frames=40)
    # One of 100 g, which fingers throw about within a step, reads 5.1 N on a site.
    assert np.linalg.norm(found.wrench[..., :3], axis=-1).max() < 3


def test_the_recording_is_a_stimulus_set_that_models_read(rubbed) -> None:
    dataset = rubbed.dataset()
    dataset.attrs["content_hash"] = hash_stimulus_set(dataset)
    stimuli = load_stimuli(dataset)
    assert stimuli.labels == ("box", "far")
    assert stimuli.input.shape == (2, 8, 30, 5, 7)
    gains = torch.tensor(rubbed.calibration().gains(5)).view(30, 1, 1)
    np.testing.assert_allclose(stimuli.input, (rubbed.grid() * gains).numpy(), rtol=1e-5, atol=1e-12)
    model = load_model("zhuang-small")
    values = model.normaliser(torch.from_numpy(stimuli.input))  # type: ignore[operator]
    touched = values.abs().amax((0, 1, 2)) > 0
    assert 0.05 < float(values[..., touched].pow(2).mean().sqrt()) < 1.5
    assert torch.isfinite(model(torch.from_numpy(stimuli.input))).all()


@pytest.mark.parametrize("hand", ["xhand1", "sharpa"])
@pytest.mark.parametrize("name", list(PROCEDURES))
def test_every_procedure_touches_on_both_hands(hand, name) -> None:
    ball = Explored("ball", Geometry(name="o", link="o", kind="sphere", size=(0.03,)))
    found = record_exploration([ball], [name], hand=hand, frames=60)
    assert np.isfinite(found.wrench).all()
    assert np.linalg.norm(found.wrench[0, -1, :, :3], axis=-1).max() > 0.02
    assert found.labels == ("ball",)
    occupied = TaxelGrid(hand).occupied.flatten().numpy()
    assert not found.wrench[0, :, ~occupied].any()


@pytest.mark.parametrize("name", hands.list_hands())
def test_each_joint_is_flexed_by_a_share_of_its_own_range(monkeypatch, name) -> None:
    step, asked = MujocoEngine.step, {}

    def note(engine: MujocoEngine) -> None:
        asked.update({drive: engine.data[0].ctrl[index] for index, drive in enumerate(drives)})
        step(engine)

    hand = hands.load(name)
    drives = [hand.model.actuator(index).name for index in range(hand.model.nu)]
    monkeypatch.setattr(MujocoEngine, "step", note)
    record_exploration([_box()], ["lateral_motion"], hand=name, resolution="low", frames=5)
    assert asked == dict(zip(drives, closing(hand, 0.3), strict=True))


def test_requests_that_make_no_sense_are_refused() -> None:
    with pytest.raises(UsageError, match="'enclosure'"):
        record_exploration([_box()], ["enclosur"])
    with pytest.raises(UsageError, match="different labels"):
        record_exploration([_box(), _box()], ["enclosure"])
    with pytest.raises(UsageError, match="'enclosure' more than once"):
        record_exploration([_box()], ["enclosure", "enclosure"])
    for frames in (0, 1.5, True, np.nan):
        with pytest.raises(UsageError, match=rf"frames .*{frames}"):
            record_exploration([_box()], ["enclosure"], frames=frames)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_objects_are_held_in_some_way(value) -> None:
    for place in range(4):
        turned = [0.0] * 4
        turned[place] = value
        with pytest.raises(UsageError, match="quaternion of an explored object"):
            _box(quaternion=tuple(turned))
    with pytest.raises(UsageError, match="quaternion of 'box'"):
        _box(quaternion=(0, 0, 0, 0))
    with pytest.raises(UsageError, match=rf"retreat .*received {value}"):
        _box(retreat=value)
    assert _box(quaternion=(2.0, 0, 0, 0), retreat=-1e-3).retreat < 0


def test_millimetres_in_place_of_metres_are_refused() -> None:
    with pytest.raises(UsageError, match=r"extent of 'ball' .*received 25"):
        Explored("ball", Geometry(name="o", link="o", kind="sphere", size=(25,)))
    with pytest.raises(UsageError, match=r"retreat .*received 1\.5"):
        _box(retreat=1.5)


@pytest.mark.parametrize("name", PROCEDURES)
def test_a_procedure_has_no_pose_before_it_begins_or_after_its_end(name) -> None:
    assert PROCEDURES[name](0.0).z > PROCEDURES[name](1.0).z
    for time in (np.nan, -0.01, 1.01, np.inf):
        with pytest.raises(UsageError, match=rf"time .*received {time}"):
            PROCEDURES[name](time)


def test_a_hand_that_diverges_gives_no_recording(monkeypatch) -> None:
    step = MujocoEngine.step

    def burst(engine: MujocoEngine) -> None:
        engine.data[1].qvel[0] = np.nan
        step(engine)

    monkeypatch.setattr(MujocoEngine, "step", burst)
    with pytest.raises(DataError, match=r"unstable .*'far'"):
        record_exploration([_box(), _box("far")], ["enclosure"], resolution="low", frames=5)


GRIPPER = """<mujoco model="jaws"><worldbody><body name="base"><geom type="box" size=".05 .03 .015"/>
  <body name="left" pos="-.03 0 .05"><joint name="slide_left" type="slide" axis="1 0 0" range="0 .028"/>
    <geom type="box" size=".005 .012 .035" mass=".05"/></body>
  <body name="right" pos=".03 0 .05"><joint name="slide_right" type="slide" axis="-1 0 0" range="0 .028"/>
    <geom type="box" size=".005 .012 .035" mass=".05"/></body></body></worldbody>
<equality><joint joint1="slide_left" joint2="slide_right"/></equality>
<actuator>{}</actuator></mujoco>"""


@pytest.mark.parametrize(
    "drive",
    ['<position name="grip" joint="slide_left" kp="200"/>', '<motor name="slide_left" joint="slide_left"/>'],
    ids=["one servo for two jaws", "motor"],
)
def test_a_gripper_explores_whatever_drives_its_file_has(tmp_path, drive: str) -> None:
    path = tmp_path / "jaws.xml"
    path.write_text(GRIPPER.format(drive))
    found = record_exploration([_box()], ["static_pressure"], hand=str(path), resolution="low", frames=20)
    assert np.isfinite(found.wrench).all()
    assert np.abs(found.wrench[..., :3]).max() > 0.1


def test_jaws_that_are_open_away_from_zero_open_before_they_close(tmp_path) -> None:
    servos = "".join(f'<position name="slide_{side}" joint="slide_{side}" kp="200"/>' for side in ("left", "right"))
    text, felt = GRIPPER.format(servos), []
    shut_at_zero = text.replace("-.03 0", "-.002 0").replace(".03 0 .05", ".002 0 .05")
    shut_at_zero = shut_at_zero.replace('axis="1', 'axis="?').replace('axis="-1', 'axis="1').replace("?", "-1")
    for name, file in {"open.xml": text, "shut.xml": shut_at_zero}.items():
        (tmp_path / name).write_text(file)
        options = {"hand": str(tmp_path / name), "resolution": "low", "frames": 60}
        felt.append(np.abs(record_exploration([_box()], ["enclosure"], **options).wrench[0, :, :, :3]).max((1, 2)))
    # The one file starts with its jaws shut; a tenth of the procedure later both are open.
    assert not felt[0][6]
    assert not felt[1][6]
    np.testing.assert_allclose(felt[0][12:], felt[1][12:], rtol=1e-3)
