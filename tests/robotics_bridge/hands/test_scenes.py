"""A hand that holds a ball: the ball starts on the palm, and closing brings fingers to it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.hands.scenes import OBJECT, closing, holding


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


@pytest.mark.parametrize("share", [float("nan"), float("inf"), -0.1, 1.1, 72, None])
def test_a_hand_closes_by_a_share_between_none_and_all(share):
    with pytest.raises(UsageError, match=f"closes .*received {share}"):
        closing(hands.load("xhand1"), share)


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
