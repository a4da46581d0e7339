"""Grippers: jaws that slide, mimic, are fixed or swing; facing surfaces get taxels, and a file without says why."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
import trimesh

from brainbench.core.errors import UsageError
from robotics_bridge import hands, tasks
from robotics_bridge.deploy.driver import HandReading
from robotics_bridge.deploy.safety import SafetyLimits
from robotics_bridge.hands import Hand
from robotics_bridge.hands.hand import LEVER
from robotics_bridge.hands.scenes import closing
from robotics_bridge.physics import MujocoEngine
from robotics_bridge.sensors import ContactDepthProbe, SensorSuite
from robotics_bridge.tasks.scenes import palm_up
from robotics_bridge.tasks.task import Placement

PANDA_LIKE = """<mujoco model="gripper"><compiler angle="radian" autolimits="true"/><asset>{asset}</asset><worldbody>
<body name="base"><geom type="box" size=".03 .06 .02"/>
  <body name="left" pos="0 0 .06"><joint name="l" type="slide" axis="0 1 0" range="{range}"/>
    <geom type="box" size=".01 .005 .02" pos="0 .01 0"/>{tip}</body>
  <body name="right" pos="0 0 .06" quat="0 0 0 1"><joint name="r" type="slide" axis="0 1 0" range="{range}"/>
    <geom type="box" size=".01 .005 .02" pos="0 .01 0"/></body>
</body></worldbody><equality><joint joint1="l" joint2="r"/></equality></mujoco>"""
URDF = """<robot name="jaws">{links}
<joint name="l" type="prismatic"><parent link="base"/><child link="left"/><origin xyz="0 .02 .06"/><axis xyz="0 1 0"/>
<limit lower="0" upper=".03" effort="10" velocity="1"/></joint>
<joint name="r" type="prismatic"><parent link="base"/><child link="right"/><origin xyz="0 -.02 .06"/>
<axis xyz="0 -1 0"/><limit lower="0" upper=".03" effort="10" velocity="1"/><mimic joint="l" multiplier="1"/></joint>
</robot>"""
JAWS = (("base", ".06 .12 .04"), ("left", ".02 .01 .04"), ("right", ".02 .01 .04"))
LINK = """<link name="{}"><inertial><mass value=".1"/>
<inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/>
</inertial><collision><geometry><box size="{}"/></geometry></collision></link>"""
FOUR_BAR = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="base">
<geom type="box" size=".03 .03 .02"/>
<body name="right" pos="0 .03 .03"><joint axis="1 0 0" range="-.6 .6"/>
  <geom type="capsule" fromto="0 0 0 0 0 .04" size=".006"/>
  <body name="right_pad" pos="0 -.004 .04"><geom type="box" size=".01 .003 .01"/></body></body>
<body name="left" pos="0 -.03 .03"><joint axis="1 0 0" range="-.6 .6"/>
  <geom type="capsule" fromto="0 0 0 0 0 .04" size=".006"/>
  <body name="left_pad" pos="0 .004 .04"><geom type="box" size=".01 .003 .01"/></body></body>
</body></worldbody></mujoco>"""
ONE_JAW = """<mujoco><compiler angle="radian" autolimits="true"/><worldbody>
<body name="arm"><joint axis="0 0 1" range="-3 3"/><geom type="capsule" fromto="0 0 0 0 0 .2" size=".02"/>
<body name="fixed_jaw" pos="0 0 .25"><joint axis="0 1 0" range="-1 2"/><geom type="box" size=".01 .005 .03"/>
<body name="moving_jaw" pos="0 .03 0"><joint type="slide" axis="0 1 0" range="-.02 .02"/>
<geom type="box" size=".01 .005 .03"/></body></body></body></worldbody></mujoco>"""


def _load(folder: Path, text: str, name: str = "gripper.xml") -> Hand:
    (folder / name).write_text(text)
    return hands.load(folder / name)


def _normals(hand: Hand, placement: str = "tips") -> dict[str, np.ndarray]:
    """Mean outward normal of every link's taxels in the world, at rest."""
    data = mujoco.MjData(hand.model)
    mujoco.mj_kinematics(hand.model, data)
    found = {}
    for link, probes in hand.layout("med", placement).items():
        turn = data.xmat[hand.model.body(link).id].reshape(3, 3)
        found[link] = turn @ probes.normal[probes.active].mean(axis=0)
    return found


def _soft_tip(folder: Path) -> dict[str, Any]:
    mesh = trimesh.creation.icosphere(3, 0.006)
    mesh.apply_scale([1.5, 0.5, 2.0])
    mesh.export(folder / "tip.stl")
    tip = '<body name="soft" pos="0 .004 .025"><geom type="mesh" mesh="tip" contype="0" conaffinity="0"/></body>'
    return {"asset": '<mesh name="tip" file="tip.stl"/>', "tip": tip}


@pytest.mark.parametrize("span", ["0 .04", "-.04 0", "-.02 .02"])
def test_sliding_jaws_face_each_other_and_the_palm_faces_between_them(tmp_path: Path, span: str) -> None:
    hand = _load(tmp_path, PANDA_LIKE.format(asset="", tip="", range=span))
    assert hand.palm == "base"
    normals = _normals(hand, "hand")
    sign = 1 if span != "-.04 0" else -1
    np.testing.assert_allclose(normals["base"], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(normals["left"], [0, -sign, 0], atol=1e-6)
    np.testing.assert_allclose(normals["right"], [0, sign, 0], atol=1e-6)


def test_soft_tips_of_mesh_get_taxels_beside_the_jaw_that_carries_them(tmp_path: Path) -> None:
    hand = _load(tmp_path, PANDA_LIKE.format(range="0 .04", **_soft_tip(tmp_path)))
    normals = _normals(hand, "fingers")
    assert set(normals) == {"left", "soft", "right"}
    assert normals["soft"][1] < -0.7
    assert normals["left"][1] < -0.9


def test_jaws_of_a_urdf_file_with_a_mimic_joint_face_each_other(tmp_path: Path) -> None:
    links = "".join(LINK.format(n, s) for n, s in JAWS)
    hand = _load(tmp_path, URDF.format(links=links), "jaws.urdf")
    assert (hand.palm, set(hand.tips), hand.joints) == ("base", {"left", "right"}, ("l", "r"))
    normals = _normals(hand)
    np.testing.assert_allclose(normals["left"], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(normals["right"], [0, 1, 0], atol=1e-6)
    # What mimics moves with what it mimics.
    data = mujoco.MjData(hand.model)
    data.qpos[0] = 0.02
    for _ in range(2000):
        data.qfrc_applied[0] = 1.0
        mujoco.mj_step(hand.model, data)
    assert data.qpos[0] > 0.02
    assert data.qpos[1] == pytest.approx(data.qpos[0], abs=2e-3)


def test_a_task_drives_the_leading_jaw_of_a_urdf_file_at_its_own_speed_from_open_jaws(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    text = URDF.format(links="".join(LINK.format(n, s) for n, s in JAWS)).replace('velocity="1"', 'velocity=".2"')
    (tmp_path / "jaws.urdf").write_text(text)
    task = replace(tasks.load("in_hand_repose"), placement=Placement(height=0.5))
    env = tasks.make(task, hand=tmp_path / "jaws.urdf", num_envs=4)
    # What mimics takes no commands; jaws that are closed at 0 would begin inside the object.
    assert env.action_names == env.joint_names == ("l",)
    qpos, noise = env.simulation.qpos, env.task.actuators
    np.testing.assert_allclose(qpos[:, :2].numpy(), 0.03, atol=1e-6)
    assert env.state.target_step is not None
    assert noise is not None
    np.testing.assert_allclose(env.state.target_step.numpy(), 0.2 * env.step_dt, rtol=1e-6)
    assert "speed" not in caplog.text
    # Imperfections in radians are those of the tip of a finger of 5 cm.
    assert float(env.state.actuators.values["backlash"].max()) <= LEVER * noise.backlash[1]
    for _ in range(60):
        env.step(-torch.ones(4, 1))
    # As far as it was told, half of the way, but for play, noise and the bias of its sensor.
    np.testing.assert_allclose(qpos[:, :2].numpy(), 0.015, atol=3e-3)


def test_a_jaw_that_is_reported_far_beyond_its_way_stops_the_hand(tmp_path: Path) -> None:
    (tmp_path / "jaws.urdf").write_text(URDF.format(links="".join(LINK.format(n, s) for n, s in JAWS)))
    limits = SafetyLimits.of_hand(hands.load(tmp_path / "jaws.urdf"), ("l", "r"))
    for place, stops in ((0.036, False), (0.045, True)):
        reading = HandReading(0, 0.0, 0.0, np.array([place, 0.0]), np.zeros(2), np.zeros((2, 3)))
        assert (limits.fault(reading, 0.0) is not None) is stops


@pytest.mark.parametrize("scale", [1, 4, 16])
def test_a_gripper_whose_jaws_stand_around_its_middle_is_placed_palm_up_at_any_size(tmp_path: Path, scale: int) -> None:
    """The middle of the palm is that of its jaws but for rounding, so that no direction leads to them."""
    sizes = {"size": (0.03, 0.06, 0.02), "jaw": (0.01, 0.005, 0.02), "root": (0.02, 0.06), "way": (0.03,)}
    words = {name: " ".join(f"{scale * one:g}" for one in numbers) for name, numbers in sizes.items()}
    jaw = (
        '<body name="{0}" pos="0 {1}{2}"><joint type="slide" axis="0 {1}1 0" range="0 {3}"/>'
        '<geom type="box" size="{4}"/></body>'
    )
    jaws = "".join(
        jaw.format(name, sign, words["root"], words["way"], words["jaw"]) for name, sign in (("a", ""), ("b", "-"))
    )
    text = f'<body name="base"><geom type="box" size="{words["size"]}"/>{jaws}</body>'
    hand = _load(tmp_path, f'<mujoco><compiler autolimits="true"/><worldbody>{text}</worldbody></mujoco>')
    place, quaternion = palm_up(hand)
    np.testing.assert_allclose(quaternion, [1, 0, 0, 0], atol=1e-9)
    np.testing.assert_allclose(place, [0, 0, 0.4975 - scale * 0.02], atol=1e-9)


def test_a_task_tells_where_its_object_begins_inside_the_hand(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    text = PANDA_LIKE.format(asset="", tip='<geom type="box" size=".06 .06 .004"/>', range="0 .04")
    (tmp_path / "gripper.xml").write_text(text)
    tasks.make("in_hand_repose", hand=tmp_path / "gripper.xml")
    assert "inside 'left' of hand 'gripper'" in caplog.text


def test_joints_that_follow_others_start_where_their_law_has_them(tmp_path: Path) -> None:
    text = PANDA_LIKE.format(asset="", tip="", range="0 .04").replace(
        '<joint joint1="l" joint2="r"/>', '<joint joint1="l" joint2="r" polycoef=".01 .5 0 0 0"/>'
    )
    (tmp_path / "gripper.xml").write_text(text)
    env = tasks.make("in_hand_repose", hand=tmp_path / "gripper.xml")
    assert env.joint_names == ("r",)
    np.testing.assert_allclose(env.simulation.qpos[0, :2].numpy(), [0.03, 0.04], atol=1e-6)


def test_pads_of_a_four_bar_gripper_face_each_other(tmp_path: Path) -> None:
    normals = _normals(_load(tmp_path, FOUR_BAR))
    np.testing.assert_allclose(normals["right_pad"], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(normals["left_pad"], [0, 1, 0], atol=1e-6)


@pytest.mark.parametrize("side", [1, -1])
def test_jaws_that_their_joints_open_face_each_other_and_close_to_zero(tmp_path: Path, side: int) -> None:
    """As of the PR2: closed at 0, and open at the other end of the range."""
    span, edge = ("0 .5", 1) if side == 1 else ("-.5 0", -1)
    jaw = (
        '<body name="{0}" pos="0 {1} .03"><joint axis="{2} 0 0" range="{3}"/>'
        '<geom type="box" size=".01 .004 .03" pos="0 {1} .04"/></body>'
    )
    jaws = jaw.format("left", ".006", -edge, span) + jaw.format("right", "-.006", edge, span)
    base = '<body name="base"><geom type="box" size=".03 .03 .02"/>'
    text = f'<mujoco><compiler angle="radian" autolimits="true"/><worldbody>{base}{jaws}</body></worldbody></mujoco>'
    hand = _load(tmp_path, text)
    normals = _normals(hand, "hand")
    np.testing.assert_allclose(normals["base"], [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(normals["left"], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(normals["right"], [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose([closing(hand, share) for share in (0, 0.5, 1)], np.outer([0.5, 0.25, 0], [side, side]))


def test_the_palm_of_jaws_that_lean_faces_what_lies_between_them(tmp_path: Path) -> None:
    """As of a Robotiq 2F-85: where its pads go leads a little back to the base."""
    leaning = FOUR_BAR.replace("-.6 .6", "-.1 .6").replace('"0 -.004 .04"', '"0 -.014 .04"')
    leaning = leaning.replace('"0 .004 .04"', '"0 .014 .04"')
    leaning = leaning.replace('pos="0 -.03 .03"><joint axis="1', 'pos="0 -.03 .03"><joint axis="-1')
    np.testing.assert_allclose(_normals(_load(tmp_path, leaning), "palm")["base"], [0, 0, 1], atol=1e-6)


def test_a_single_jaw_and_the_fixed_one_face_each_other(tmp_path: Path) -> None:
    hand = _load(tmp_path, ONE_JAW)
    assert (hand.palm, hand.tips) == ("fixed_jaw", ("moving_jaw",))
    normals = _normals(hand, "hand")
    np.testing.assert_allclose(normals["moving_jaw"], [0, -1, 0], atol=1e-6)
    np.testing.assert_allclose(normals["fixed_jaw"], [0, 1, 0], atol=1e-6)


def test_a_hand_without_surfaces_says_why_it_gets_no_taxels(tmp_path: Path) -> None:
    bare = PANDA_LIKE.format(asset="", tip="", range="0 .04").replace(
        '<geom type="box" size=".01 .005 .02" pos="0 .01 0"/>', ""
    )
    bare = bare.replace("</body>\n  <body", '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>\n  <body')
    bare = bare.replace("</body>\n</body>", '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>\n</body>')
    with pytest.raises(UsageError, match=r"'left' has no geometry.*with_probes"):
        _load(tmp_path, bare).layout("low", "tips")


def test_links_without_collision_feel_all_pairs_but_not_contacts(tmp_path: Path) -> None:
    """A block between jaws that the engine lets pass: no contact, but an overlap."""
    text = PANDA_LIKE.format(asset="", tip="", range="0 .04").replace(
        'type="box"', 'type="box" contype="0" conaffinity="0"'
    )
    block = '<body name="block" pos="0 0 .06"><geom type="box" size=".01 .006 .01"/></body></worldbody>'
    hand = _load(tmp_path, text.replace("</worldbody>", block))
    engine = MujocoEngine(hand.model, 1)
    left = hand.layout("low", "tips")["left"]
    sensors = {pairs: ContactDepthProbe(link="left", probes=left, pairs=pairs) for pairs in ("contact", "all")}
    suite = SensorSuite(engine.scene, sensors, num_envs=1)
    suite.update(engine.state)
    assert not suite.read("contact").any()
    # Jaws at rest stand 5 mm from the middle; the block reaches 6 mm.
    inside = 0.006 - 0.005 + float(left.radius.max())
    assert float(suite.read("all").max()) == pytest.approx(inside, abs=1e-6)
    assert math.isfinite(float(suite.read("all").sum()))


@pytest.mark.parametrize("span", ["0 .04", "-.04 0", "-.02 .02"])
def test_the_scene_of_the_demo_holds_a_ball_between_sliding_jaws(tmp_path: Path, span: str) -> None:
    from brainbench.cli.tactile.scenes import Grip

    (tmp_path / "gripper.xml").write_text(PANDA_LIKE.format(asset="", tip="", range=span))
    grip = Grip(str(tmp_path / "gripper.xml"))
    grip.run(400)
    state, names = grip.engine.state, [g.link for g in grip.engine.scene.geometries]
    felt = {}
    for pair, force in zip(state.contact_geom.numpy(), state.contact_force.numpy(), strict=True):
        for geometry in pair:
            felt[names[geometry]] = felt.get(names[geometry], 0.0) + float(force)
    assert min(felt["left"], felt["right"]) > 1.0
    ball = state.pose_torch[0, grip.engine.scene.link_index("object"), :3]
    assert abs(float(ball[1])) < 2e-3
