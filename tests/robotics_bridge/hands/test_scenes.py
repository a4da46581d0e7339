"""A hand that holds a ball: the ball starts on the palm, and closing brings fingers to it."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge import hands, tasks
from robotics_bridge.hands.scenes import OBJECT, closing, holding
from robotics_bridge.tasks.scenes import build
from tests.factories.hand_gallery import GALLERY


@pytest.mark.parametrize("name", hands.list_hands())
def test_fingers_close_around_the_ball(name):
    hand = hands.load(name)
    model = holding(hand, radius=0.028, reach=0.9)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ball = model.geom(OBJECT).id
    assert not any(ball in contact.geom for contact in data.contact)
    target = closing(hand, 0.72)
    for step in range(400):
        data.ctrl[:] = target * min(step / 200, 1)
        mujoco.mj_step(model, data)
    touching = {
        model.body(model.geom_bodyid[geom]).name
        for contact in data.contact
        if ball in contact.geom
        for geom in contact.geom
    }
    assert len(touching - {OBJECT}) >= 2
    assert np.linalg.norm(data.xpos[model.body(OBJECT).id]) < 0.12


def test_spreading_joints_stay_in_their_middle():
    hand = hands.load("sharpa")
    target = closing(hand, 0.5)
    names = [hand.model.actuator(index).name for index in range(hand.model.nu)]
    assert target[names.index("right_index_MCP_AA")] == 0
    assert target[names.index("right_index_PIP")] == pytest.approx(0.5 * 1.7453)


def test_an_impossible_ball_is_refused():
    with pytest.raises(UsageError, match=r"radius .*received 0"):
        holding(hands.load("xhand1"), radius=0.0)
    with pytest.raises(UsageError, match=r"reach .*received nan"):
        holding(hands.load("xhand1"), reach=float("nan"))


@pytest.mark.parametrize(
    "drive",
    [
        '<motor joint="{0}"/>',
        '<position tendon="t{0}" kp="9"/>',
        '<position joint="{0}"/>',
        '<position joint="{0}" gear="2"/>',
    ],
)
def test_joints_flex_whatever_drives_the_file_has_and_in_whatever_order(tmp_path, drive):
    spans = {"a": "0 1", "b": "0 .8", "c": "-1.2 0"}
    bodies = "".join(
        f'<body pos="0 {y} 0" name="{name}"><joint name="{name}" axis="0 1 0" range="{spans[name]}"/>'
        '<geom type="capsule" size=".01" fromto="0 0 0 0 0 .05"/></body>'
        for y, name in zip((-0.05, 0, 0.05), spans, strict=True)
    )
    tendons = "".join(f'<fixed name="t{name}"><joint joint="{name}" coef="1"/></fixed>' for name in spans)
    (tmp_path / "hand.xml").write_text(
        f'<mujoco><compiler angle="radian"/><worldbody><body name="palm"><geom type="box" size=".05 .05 .01"/>{bodies}'
        f"</body></worldbody><tendon>{tendons}</tendon><actuator>"
        f"{''.join(drive.format(name) for name in reversed(spans))}</actuator></mujoco>"
    )
    hand = hands.load(tmp_path / "hand.xml")
    model = holding(hand, radius=0.02)
    driven = [model.joint(number).name for number in model.actuator_trnid[:, 0]]
    assert (model.actuator_biasprm[:, 1] < 0).all()
    assert dict(zip(driven, closing(hand, 0.5).round(9), strict=True)) == {"a": 0.5, "b": 0.4, "c": -0.6}


FOREARM = """<mujoco><compiler angle="radian"/><worldbody><body name="forearm" {}>
  <geom type="cylinder" size=".03 .05"/>
  <body name="palm" pos="0 0 .1"><joint name="wrist" axis="0 1 0" range="-.5 .5"/><geom type="box" size=".02 .05 .04"/>
    <body name="one" pos="0 .03 .05"><joint name="a" axis="0 1 0" range="0 1.6"/>
      <geom type="capsule" size=".01" fromto="0 0 0 0 0 .05"/></body>
    <body name="two" pos="0 -.03 .05"><joint name="b" axis="0 1 0" range="0 1.6"/>
      <geom type="capsule" size=".01" fromto="0 0 0 0 0 .05"/></body></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("pose", ["", 'quat="0 1 0 1" pos=".1 .2 .3"', 'euler=".3 .2 1"'])
def test_a_palm_is_up_wherever_its_forearm_lies_in_the_file_and_stays_on_it(tmp_path, pose):
    (tmp_path / "hand.xml").write_text(FOREARM.format(pose))
    hand = hands.load(tmp_path / "hand.xml")
    task = replace(tasks.load("hot_ball"), moves=())
    for model, height in ((holding(hand), -0.02), (build(task, hand).models[0], 0.4775)):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        palm, forearm = data.body("palm"), data.body("forearm")
        # Fingers bend towards x of the palm.
        assert palm.xmat.reshape(3, 3)[:, 0] == pytest.approx([0, 0, 1], abs=1e-6)
        assert palm.xpos[2] == pytest.approx(height, abs=1e-6)
        assert forearm.xmat.reshape(3, 3).T @ (palm.xpos - forearm.xpos) == pytest.approx([0, 0, 0.1], abs=1e-6)


def test_a_hand_that_floats_in_its_file_does_not_fall(tmp_path):
    fixed = FOREARM.format("").replace('<joint name="wrist" axis="0 1 0" range="-.5 .5"/>', "")
    floating = fixed.replace('<body name="forearm" >', '<body name="forearm"><freejoint/>').replace(
        "</worldbody>", '</worldbody><keyframe><key qpos="0 0 1 1 0 0 0 .1 .1"/></keyframe>'
    )
    states = []
    for name, text in {"fixed": fixed, "floating": floating}.items():
        (tmp_path / f"{name}.xml").write_text(text)
        hand = hands.load(tmp_path / f"{name}.xml")
        data = mujoco.MjData(model := holding(hand))
        mujoco.mj_step(model, data, 50)
        states.append(data.body("palm").xpos.copy())
    assert states[1] == pytest.approx(states[0], abs=1e-12)


def test_a_palm_whose_orientation_the_file_gives_in_angles_is_up_too(tmp_path):
    bodies = FOREARM[: FOREARM.index("<body")] + FOREARM[FOREARM.index('<body name="palm"') :]
    text = bodies.replace('pos="0 0 .1"><joint name="wrist" axis="0 1 0" range="-.5 .5"/>', 'euler=".3 .2 1">')
    (tmp_path / "hand.xml").write_text(text.replace("</body></body></worldbody>", "</body></worldbody>"))
    data = mujoco.MjData(model := holding(hands.load(tmp_path / "hand.xml")))
    mujoco.mj_forward(model, data)
    assert data.body("palm").xmat.reshape(3, 3)[:, 0] == pytest.approx([0, 0, 1], abs=1e-6)


@pytest.mark.parametrize("share", [float("nan"), float("inf"), -0.1, 1.1, 72, None])
def test_a_hand_closes_by_a_share_between_none_and_all(share):
    with pytest.raises(UsageError, match=f"closes .*received {share}"):
        closing(hands.load("xhand1"), share)


@pytest.mark.slow
@pytest.mark.shared
def test_a_urdf_without_drives_gets_servos_and_closes_too(reference):
    hand = hands.load(reference / "hands/sharpa/sharpa_right_updated_effort.urdf")
    model = holding(hand, radius=0.028, reach=0.9)
    assert (hand.model.nu, model.nu) == (0, 22)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert not any(model.geom(OBJECT).id in contact.geom for contact in data.contact)
    for step in range(500):
        data.ctrl[:] = closing(hand, 0.6) * min(step / 200, 1)
        mujoco.mj_step(model, data)
    assert np.isfinite(data.qpos).all()
    assert np.linalg.norm(data.xpos[model.body(OBJECT).id]) < 0.15
    bent = model.joint("right_middle_PIP").qposadr
    assert data.qpos[bent] > 0.4


@pytest.mark.parametrize("option", ['gravity="0 -9.81 0"/>', '><flag gravity="disable" contact="disable"/></option>'])
def test_scenes_have_gravity_and_contacts_whatever_the_file_of_a_hand_says(option, tmp_path) -> None:
    model = GALLERY["three-fingers-box"]
    path = tmp_path / "hand.xml"
    path.write_text(model.text.replace("<worldbody>", f"<option {option}<worldbody>", 1))
    task = tasks.load("in_hand_repose")
    for scene in (holding(hands.load(path)), build(task, hands.load(path)).models[0]):
        np.testing.assert_array_equal(scene.opt.gravity, [0, 0, -9.81])
        data = mujoco.MjData(scene)
        mujoco.mj_step(scene, data, 500)
        # The ball came to rest on the palm.
        assert data.ncon
