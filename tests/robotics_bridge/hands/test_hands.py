"""Hands and layouts: published counts, the maker's kinematics, any file."""

from __future__ import annotations

import os
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import DataError, UsageError
from brainbench.core.rotations import from_rpy
from robotics_bridge import hands, tasks
from robotics_bridge.hands.hand import UNKNOWN_SPEED, palmar_directions
from robotics_bridge.hands.layouts import RESOLUTIONS, active_count, fillers, read_probes, write_probes
from robotics_bridge.hands.spec import CapsuleGeometry, HandSpec, Joint, Link, build
from robotics_bridge.tasks.scenes import build as build_task

URDF = {
    "xhand1": "hands/xhand1/xhand_right_updated_effort.urdf",
    "sharpa": "hands/sharpa/sharpa_right_updated_effort.urdf",
}
JSON = {("xhand1", "low"): "probes_90_hand_xhand1", ("xhand1", "med"): "probes_199_hand_xhand1"}
COUNTS = {
    ("xhand1", "low"): (90, 45, 78, 12),
    ("xhand1", "med"): (199, 100, 164, 35),
    ("xhand1", "high"): (667, 224, 448, 219),
    ("sharpa", "low"): (98, 45, 89, 9),
    ("sharpa", "med"): (206, 70, 190, 16),
    ("sharpa", "high"): (781, 245, 660, 121),
}

# As the menagerie writes a hand: defaults, a wrist above the palm, mesh-free geometries, a tendon-free thumb.
MENAGERIE_LIKE = """
<mujoco model="claw">
  <compiler angle="radian" autolimits="true"/>
  <default><default class="claw"><joint axis="0 1 0" damping="0.1" armature="0.01"/>
    <geom type="capsule" size="0.008" density="900"/></default></default>
  <worldbody>
    <body name="forearm" childclass="claw">
      <geom type="cylinder" size="0.03 0.05"/>
      <body name="palm" pos="0 0 0.1"><joint name="wrist" range="-0.5 0.5"/>
        <geom name="palm_geom" type="box" size="0.02 0.04 0.04"/>
        <body name="f1_knuckle" pos="0 0.03 0.05"><joint name="f1_spread" axis="1 0 0" range="-0.3 0.3"/>
          <geom fromto="0 0 0 0 0 0.004"/>
          <body name="f1_near" pos="0 0 0.02"><joint name="f1_a" range="-0.1 1.6"/>
            <geom fromto="0 0 0.01 0 0 0.04"/>
            <body name="f1_far" pos="0 0 0.05"><joint name="f1_b" range="0 1.6"/>
              <geom fromto="0 0 0.01 0 0 0.03"/></body>
          </body>
        </body>
        <body name="f2_near" pos="0 -0.03 0.05"><joint name="f2_a" range="-0.1 1.6"/>
          <geom fromto="0 0 0.01 0 0 0.04"/>
          <body name="f2_far" pos="0 0 0.05"><joint name="f2_b" range="0 1.6"/><geom fromto="0 0 0.01 0 0 0.03"/></body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize(("name", "resolution"), list(COUNTS))
def test_layouts_have_exactly_the_published_counts(name, resolution):
    hand = hands.load(name)
    counts = tuple(active_count(hand.layout(resolution, place)) for place in ("hand", "tips", "fingers", "palm"))
    assert counts == COUNTS[name, resolution]


@pytest.mark.parametrize("name", hands.list_hands())
def test_every_probe_lies_on_its_link_and_looks_away_from_it(name):
    hand = hands.load(name)
    data = mujoco.MjData(hand.model)
    mujoco.mj_forward(hand.model, data)
    for link, probes in hand.layout("high").items():
        body = hand.model.body(link).id
        geom = int(hand.model.body_geomadr[body])
        place, turn = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3)
        world = data.xpos[body] + probes.position @ data.xmat[body].reshape(3, 3).T
        normal = probes.normal @ data.xmat[body].reshape(3, 3).T
        for step, inside in ((1e-6, False), (-1e-6, True)):
            local = (world + step * normal - place) @ turn
            size = hand.model.geom_size[geom]
            if hand.model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
                within = (np.abs(local) <= size).all(axis=1)
            else:
                on_axis = np.clip(local[:, 2], -size[1], size[1])
                within = np.linalg.norm(local - np.outer(on_axis, [0, 0, 1]), axis=1) <= size[0]
            assert (within == inside).all(), (link, step)


@pytest.mark.parametrize("name", hands.list_hands())
def test_the_open_hand_touches_itself_nowhere_and_its_servos_hold_it(name):
    model = hands.load(name).model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    target = np.clip(0.3, *model.jnt_range.T)
    data.ctrl[:] = target[model.actuator_trnid[:, 0]]
    for _ in range(1500):
        mujoco.mj_step(model, data)
    assert np.isfinite(data.qpos).all()
    assert data.qpos == pytest.approx(target, abs=0.03)


@pytest.mark.shared
@pytest.mark.parametrize("name", hands.list_hands())
def test_our_hands_move_like_the_makers(name, reference):
    ours, theirs = hands.load(name).model, hands.load(reference / URDF[name]).model
    assert (ours.njnt, ours.nu) == ({"xhand1": 12, "sharpa": 22}[name],) * 2
    own, other = mujoco.MjData(ours), mujoco.MjData(theirs)
    rng = np.random.default_rng(0)
    for _ in range(5):
        for index in range(ours.njnt):
            joint = ours.joint(index)
            assert joint.range == pytest.approx(theirs.joint(joint.name).range, abs=1e-4)
            angle = rng.uniform(*joint.range)
            own.qpos[joint.qposadr], other.qpos[theirs.joint(joint.name).qposadr] = angle, angle
        mujoco.mj_kinematics(ours, own)
        mujoco.mj_kinematics(theirs, other)
        for index in range(1, ours.nbody):
            body = theirs.body(ours.body(index).name).id
            assert own.xpos[index] == pytest.approx(other.xpos[body], abs=1e-6)
            assert own.xmat[index] == pytest.approx(other.xmat[body], abs=1e-4)


@pytest.mark.shared
@pytest.mark.parametrize("name", hands.list_hands())
def test_servo_gains_are_those_of_the_actuators_file(name, reference):
    text = (reference / "hands" / name / "actuators.yaml").read_text()
    model = hands.load(name).model
    names = re.search(r"dof_names:\n((?:  - [^\n]*\n)+)", text)
    assert names is not None
    order = [line.strip(" -") for line in names[1].splitlines()]
    assert [model.actuator(index).name for index in range(model.nu)] == order
    expected = {}
    for key in ("kp", "kd", "armature"):
        block = re.search(rf"^{key}:\n.*?value:\n((?:  - [^\n]*\n)+)", text, re.MULTILINE | re.DOTALL)
        assert block is not None
        expected[key] = [float(line.strip(" -")) for line in block[1].splitlines()]
    assert model.actuator_gainprm[:, 0] == pytest.approx(expected["kp"])
    assert -model.actuator_biasprm[:, 2] == pytest.approx(expected["kd"])
    dof = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    assert model.dof_armature[dof] == pytest.approx(expected["armature"])


@pytest.mark.shared
@pytest.mark.parametrize("name", hands.list_hands())
@pytest.mark.parametrize("resolution", RESOLUTIONS)
def test_published_probe_files_are_read_with_their_counts_and_links(name, resolution, reference):
    path = next((reference / "tactile" / name / resolution).glob("probes_*.json"))
    hand = hands.load(name).with_probes(path)
    counts = tuple(active_count(hand.layout("custom", place)) for place in ("hand", "tips", "fingers", "palm"))
    assert counts == COUNTS[name, resolution]
    for link, probes in hand.layout("custom").items():
        assert probes.shape == hand.layout(resolution)[link].shape or len(probes) == len(hand.layout(resolution)[link])


@pytest.mark.shared
@pytest.mark.parametrize("name", hands.list_hands())
def test_palmar_sides_of_a_hand_file_agree_with_where_its_probes_were_put(name, reference):
    hand = hands.load(reference / URDF[name])
    assert hand.palm == hands.load(name).palm
    assert len(hand.fingers) == 5
    facing = palmar_directions(hand.model, hand.palm, hand.fingers)
    path = next((reference / "tactile" / name / "low").glob("probes_*.json"))
    for link, probes in read_probes(path).items():
        assert facing[link] @ probes.normal.mean(axis=0) > 0.4, link
    layout = hand.layout("med")
    assert set(hand.tips) <= set(layout)
    assert active_count(layout) > 100


def test_a_menagerie_like_file_becomes_a_hand_with_probes_on_its_palmar_sides(tmp_path):
    path = tmp_path / "claw.xml"
    path.write_text(MENAGERIE_LIKE)
    hand = hands.load(path)
    assert (hand.palm, set(hand.fingers)) == ("palm", {"f1_far", "f2_far"})
    assert hand.joints == ("wrist", "f1_spread", "f1_a", "f1_b", "f2_a", "f2_b")
    # A joint that spreads tells no side; its link faces as the finger does.
    facing = palmar_directions(hand.model, hand.palm, hand.fingers)
    assert facing["f1_knuckle"] == pytest.approx([1, 0, 0])
    layout = hand.layout("low", "tips")
    assert set(layout) == {"f1_far", "f2_far"}
    for probes in layout.values():
        assert probes.shape == (3, 3)
        assert (probes.normal[probes.active][:, 0] > 0).all()
        on_axis = np.clip(probes.position[probes.active][:, 2], 0.01, 0.03)
        away = probes.position[probes.active] - np.outer(on_axis, [0, 0, 1])
        assert np.linalg.norm(away, axis=1) == pytest.approx(0.008, abs=1e-9)
    palm = hand.layout("low", "palm")["palm"]
    assert palm.position[:, 0] == pytest.approx(0.02)


def test_bodies_and_joints_without_a_name_are_told_apart(tmp_path):
    names, counts = re.compile(r'(<(?:body|joint)) name="(?!palm")\w+"'), {}
    for name, text in {"named": MENAGERIE_LIKE, "bare": names.sub(r"\1", MENAGERIE_LIKE)}.items():
        (tmp_path / f"{name}.xml").write_text(text)
        hand = hands.load(tmp_path / f"{name}.xml")
        assert all(hand.joints)
        counts[name] = (len(set(hand.joints)), [len(chain) for chain in hand.fingers.values()])
        counts[name] += ([active_count({"": probes}) for probes in hand.layout("low").values()],)
        assert build_task(replace(tasks.load("in_palm_rotate"), moves=()), hand).joints == hand.joints
    assert counts["bare"] == counts["named"]


def test_a_servo_behind_a_gear_drives_its_joint_as_stiffly_as_in_its_file(tmp_path):
    found = []
    for gear in (1, 3):
        servos = f'<actuator><position joint="f1_a" kp="{9 / gear**2}" gear="{gear}" forcerange="-6 6"/></actuator>'
        (tmp_path / "hand.xml").write_text(MENAGERIE_LIKE.replace("</worldbody>", f"</worldbody>{servos}"))
        made = build_task(replace(tasks.load("in_palm_rotate"), moves=()), hands.load(tmp_path / "hand.xml"))
        found.append((made.stiffness[0], made.effort[0] / gear))
    assert found[0] == pytest.approx(found[1])


def test_speeds_that_no_file_states_are_told_with_their_joints(tmp_path, caplog):
    path = tmp_path / "other.xml"
    path.write_text(MENAGERIE_LIKE)
    hand = hands.load(str(path))
    assert (hand.rated_speeds(hand.joints) == UNKNOWN_SPEED).all()
    (told,) = caplog.messages
    assert all(word in told for word in ("'other'", f"{UNKNOWN_SPEED:g} rad/s", repr(hand.joints[0])))
    caplog.clear()
    ours = hands.load("xhand1")
    assert UNKNOWN_SPEED not in ours.rated_speeds(ours.joints)
    assert not caplog.messages


def test_a_layout_survives_its_file(tmp_path):
    layout = hands.load("sharpa").layout("high")
    write_probes(tmp_path / "probes.json", layout)
    again = read_probes(tmp_path / "probes.json")
    assert list(again) == list(layout)
    for link, probes in layout.items():
        assert again[link].shape == probes.shape
        assert again[link].position == pytest.approx(probes.position)
        assert again[link].radius == pytest.approx(probes.radius)


def test_fillers_are_the_far_corners():
    assert fillers(7, 7, 2).tolist() == [6, 48]
    assert len(set(fillers(8, 8, 5).tolist())) == 5
    assert fillers(4, 4, 0).size == 0


def test_quaternions_agree_with_mujoco():
    for rpy in ((0.3, -0.7, 1.9), (np.pi, 0.0, np.pi / 2)):
        expected = np.zeros(4)
        mujoco.mju_euler2Quat(expected, np.array(rpy), "XYZ")
        assert from_rpy(rpy) == pytest.approx(expected)


def test_unknown_names_and_unusable_files_are_explained(tmp_path):
    with pytest.raises(UsageError, match=r"'xhand1'.*URDF or MJCF"):
        hands.load("xhand")
    with pytest.raises(DataError, match=r"/none\.urdf'"):
        hands.load(tmp_path / "none.urdf")
    (tmp_path / "broken.xml").write_text("<mujoco><nonsense/></mujoco>")
    with pytest.raises(DataError, match=r"/broken\.xml'"):
        hands.load(tmp_path / "broken.xml")
    (tmp_path / "still.xml").write_text('<mujoco><worldbody><geom size="1"/></worldbody></mujoco>')
    with pytest.raises(DataError, match=r"still\.xml' .*joints"):
        hands.load(tmp_path / "still.xml")
    (tmp_path / "odd.xml").write_text('<mujoco><worldbody><body pos="0 NaN 0"/></worldbody></mujoco>')
    with pytest.raises(DataError, match=r"'pos' of <body> .*odd\.xml"):
        hands.load(tmp_path / "odd.xml")
    os.mkfifo(tmp_path / "pipe.stl")
    (tmp_path / "mesh.xml").write_text('<mujoco><asset><mesh file="pipe.stl"/></asset></mujoco>')
    with pytest.raises(DataError, match=r"pipe\.stl"):
        hands.load(tmp_path / "mesh.xml")
    (tmp_path / "loop.xml").write_text('<mujoco><include file="loop.xml"/></mujoco>')
    with pytest.raises(DataError, match=r"loop\.xml"):
        hands.load(tmp_path / "loop.xml")
    with pytest.raises(UsageError, match="resolution 'hi'"):
        hands.load("xhand1").layout("hi")
    with pytest.raises(UsageError, match=r"'tip'; .* 'tips'"):
        hands.load("xhand1").layout("low", "tip")


def test_probe_files_of_another_form_or_for_another_hand_are_refused(tmp_path):
    path = tmp_path / "probes.json"
    path.write_text('{"a": 1}')
    with pytest.raises(DataError, match=r"probes\.json .*'link_name'"):
        read_probes(path)
    path.write_text('[{"link_name": "a", "probes": [[{"radius": 1}]]}]')
    with pytest.raises(DataError, match="link 1"):
        read_probes(path)
    write_probes(path, hands.load("sharpa").layout("low"))
    with pytest.raises(UsageError, match="'right_hand_C_MC'; did you mean"):
        hands.load("xhand1").with_probes(path)


def test_a_hand_that_does_not_hang_together_is_refused():
    links = (Link("a", 0.1, (CapsuleGeometry((0, 0, 0), (0, 0, 1), 0.1),)), Link("b", 0.1), Link("c", 0.1))
    joint = Joint("j", "b", "c", (0, 0, 0), (0, 0, 0), (0, 0, 1), (0, 1), 1, 1, 1, 1, 0.1)
    with pytest.raises(UsageError, match=r"'broken' .*'b'"):
        build(HandSpec("broken", "a", links, (joint,), {}))
    with pytest.raises(UsageError, match="has no link 'd'"):
        HandSpec("broken", "a", links, (joint,), {"finger": ("d",)})


@pytest.mark.parametrize(("unit", "upper", "told"), [("", 1.57, True), ("", 90, False), ("radian", 90, True)])
def test_degrees_for_radians_and_the_reverse_are_told(tmp_path, caplog, unit, upper, told) -> None:
    angle = f'<compiler angle="{unit}"/>' if unit else ""
    jaws = "".join(
        f'<body pos="0 {y} .05"><joint axis="{turn} 0 0" limited="true" range="0 {upper}"/>'
        '<geom type="capsule" size=".01" fromto="0 0 0 0 0 .05"/></body>'
        for y, turn in ((0.2, 1), (-0.2, -1))
    )
    (tmp_path / "claw.xml").write_text(
        f'<mujoco>{angle}<worldbody><body name="palm"><geom type="box" size=".05 .05 .01"/>{jaws}</body></worldbody>'
        "</mujoco>"
    )
    hands.load(str(tmp_path / "claw.xml"))
    assert ("unit of the angles" in caplog.text) == told
