"""Compiled scenes of tasks: what a task adds to the file of a hand is as the task says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from brainbench.core.errors import UsageError
from brainbench.core.rotations import angle_of, multiply
from robotics_bridge import hands, tasks
from robotics_bridge.tasks.scenes import TaskModel, build, drives_of, palm_up
from tests.factories.hand_gallery import GALLERY

LEAKS = (
    '<general ctrllimited="true"/>', '<general gear="3" dyntype="filter"/>', '<geom contype="0" conaffinity="0"/>',
    '<geom mass="2" margin=".01"/>', '<joint damping="3" stiffness="2"/>', '<geom friction=".1 .1 .1" solref=".1 1"/>',
)  # fmt: skip
OWN = '<geom class="hand" type="box" size=".006 .013 .005" pos="0 .014 0" mass=".015"/>'
ADDED = (
    "body_mass", "body_inertia", "geom_contype", "geom_conaffinity", "geom_friction", "geom_solref", "geom_margin",
    "actuator_gear", "actuator_dyntype", "actuator_ctrllimited", "actuator_forcerange", "dof_damping", "jnt_stiffness",
)  # fmt: skip


def _model(path: Path, default: str, task: str) -> TaskModel:
    """The model of a task for a hand whose file states a main default that no part of the hand has."""
    undone = '<geom contype="1" conaffinity="1" friction="1 .005 .0001" solref=".02 1" margin="0"/>'
    hinge = 'class="hand" axis="1 0 0" range="0 1.5"'
    fingers = "".join(
        f'<body name="{name}_base" pos="{x} .03 0"><joint name="{name}_bend" {hinge}/>{OWN}'
        f'<body name="{name}_tip" pos="0 .033 0"><joint name="{name}_curl" {hinge}/>{OWN}'
        "</body></body>"
        for name, x in (("near", -0.02), ("mid", 0.0), ("far", 0.02))
    )
    drives = "".join(
        f'<position class="hand" joint="{name}_{part}" kp="2" kv=".1" ctrlrange="0 1.5"/>'
        for name in ("near", "mid", "far")
        for part in ("bend", "curl")
    )
    path.write_text(
        f'<mujoco model="hand"><compiler angle="radian" autolimits="true"/><default>{default}'
        f'<default class="hand">{undone}'
        '<joint damping="0" stiffness="0"/><general gear="1" dyntype="none"/></default></default><worldbody>'
        f'<body name="palm" pos="0 0 .2"><geom class="hand" type="box" size=".03 .03 .01" mass=".2"/>{fingers}</body>'
        f"</worldbody><actuator>{drives}</actuator></mujoco>"
    )
    return build(tasks.load(task), hands.load(path))


@pytest.mark.parametrize("task", ["in_hand_repose", "hot_ball"])
def test_defaults_of_a_hand_file_do_not_reach_what_a_task_adds(tmp_path, task) -> None:
    plain = _model(tmp_path / "plain.xml", "", task).models[0]
    for number, default in enumerate(LEAKS):
        model = _model(tmp_path / f"{number}.xml", default, task).models[0]
        for name in ADDED:
            np.testing.assert_array_equal(getattr(model, name), getattr(plain, name), err_msg=f"{name} under {default}")


@pytest.mark.parametrize(("hand", "published"), [("xhand1", (0.07, 0.0, 0.475)), ("sharpa", (0.07, -0.015, 0.48))])
def test_palms_of_other_hands_are_turned_up_where_the_published_ones_are(hand: str, published: Any) -> None:
    position, quaternion = palm_up(hands.load(hand))
    assert position == pytest.approx(published, abs=0.015)
    turn = multiply(torch.tensor([quaternion]), torch.tensor([[0.70710678, 0.0, 0.70710678, 0.0]]))
    assert float(angle_of(turn)) < 0.2


def test_only_links_that_can_meet_collide() -> None:
    model = build(tasks.load("in_hand_repose"), hands.load("xhand1")).models[0]
    left_out = {tuple(sorted((int(s) >> 16, int(s) & 0xFFFF))) for s in model.exclude_signature}
    thumb, index = (model.body(f"right_hand_{name}").id for name in ("thumb_rota_link2", "index_rota_link2"))
    assert tuple(sorted((thumb, index))) not in left_out
    palm, base = model.body("right_hand_link").id, model.body("right_hand_mid_link1").id
    assert tuple(sorted((palm, base))) in left_out


def test_links_of_a_file_collide_unless_the_file_excludes_them(tmp_path: Path) -> None:
    """Whether slender links ever meet shows in no few thousand random poses."""
    hand = hands.load(GALLERY["three-fingers-box"].write(tmp_path, "hand"))
    assert build(tasks.load("in_hand_repose"), hand).models[0].nexclude == hand.model.nexclude == len(hand.nested)


def test_a_finger_that_the_hand_lacks_is_named() -> None:
    task = replace(tasks.load("in_palm_rotate"), moves=("tentacle",))
    with pytest.raises(UsageError, match=r"tentacle; .*'xhand1' .*index"):
        build(task, hands.load("xhand1"))
    with pytest.raises(UsageError, match=r"'xhand1': 'elbow'.*thumb"):
        build(replace(tasks.load("in_palm_rotate"), joints={"xhand1": {"elbow": 1.0}}), hands.load("xhand1"))


def test_a_word_of_every_fingers_links_names_no_finger(tmp_path: Path) -> None:
    """Middle phalanges, as of the Shadow hand, are no middle fingers; a part that is missing is not passed over."""
    finger = (
        '<body name="{0}proximal" pos="0 {1} .05"><joint name="{0}1" axis="0 1 0" range="0 1.6"/><geom type="capsule" '
        'size=".01" fromto="0 0 0 0 0 .04"/><body name="{0}middle" pos="0 0 .05"><joint name="{0}2" axis="0 1 0" '
        'range="0 1.6"/><geom type="capsule" size=".01" fromto="0 0 0 0 0 .04"/><body name="{0}distal" pos="0 0 .05">'
        '<geom type="sphere" size=".01"/></body></body></body>'
    )
    fingers = "".join(finger.format(name, y) for name, y in (("th", -0.05), ("mf", 0.0), ("ff", 0.05)))
    text = f'<body name="palm"><geom type="box" size=".02 .06 .04"/>{fingers}</body>'
    (tmp_path / "hand.xml").write_text(
        f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{text}</worldbody></mujoco>'
    )
    hand, task = hands.load(tmp_path / "hand.xml"), tasks.load("in_palm_rotate")
    assert build(replace(task, moves=("th", "mf")), hand).moved == ("th1", "th2", "mf1", "mf2")
    for moves in (("thumb", "mid"), ("th", "mid")):
        with pytest.raises(UsageError, match=r"thdistal, mfdistal, ffdistal.*moves="):
            build(replace(task, moves=moves), hand)


@pytest.mark.parametrize(("joint", "servo", "effort"), [
    ("", "", 1.57), ("", 'forcerange="-.7 .7"', 0.7), ('actuatorfrcrange="-.5 .5"', "", 0.5),
    ('actuatorfrcrange="-.5 .5"', 'forcerange="-.7 .7"', 0.5),
])  # fmt: skip
def test_drives_are_no_stronger_than_a_file_says_and_noise_is_in_units_of_that(tmp_path, joint, servo, effort) -> None:
    jaws = "".join(
        f'<body pos="0 {y} .05"><joint name="{name}" axis="1 0 0" range="0 1.57" {joint}/>'
        '<geom type="capsule" size=".01" fromto="0 0 0 0 0 .05"/></body>'
        for name, y in (("a", 0.2), ("b", -0.2))
    )
    servos = "".join(f'<position joint="{name}" kp="1" kv=".1" {servo}/>' for name in "ab")
    (tmp_path / "hand.xml").write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="palm">'
        f'<geom type="box" size=".05 .05 .01"/>{jaws}</body></worldbody><actuator>{servos}</actuator></mujoco>'
    )
    found = drives_of(hands.load(str(tmp_path / "hand.xml")))
    assert found == {name: pytest.approx((1.0, 0.1, effort)) for name in "ab"}


def _changed(**changes: Any) -> tasks.Task:
    return replace(tasks.load("in_palm_rotate"), **changes)


def test_joints_rest_within_their_limits() -> None:
    hand = hands.load("xhand1")
    joint = hand.joints[0]
    with pytest.raises(UsageError, match=f"{joint}.*received 45"):
        build(_changed(joints={"xhand1": {joint: 45.0}}), hand)
    with pytest.raises(UsageError, match=joint):
        _changed(joints={"xhand1": {joint: np.nan}})
