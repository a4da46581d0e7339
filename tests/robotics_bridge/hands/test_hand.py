"""Hands: the maker's kinematics, any file."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from brainbench.core.errors import DataError, UsageError
from brainbench.core.rotations import from_rpy
from robotics_bridge import hands, tasks
from robotics_bridge.hands.gallery import check_file
from robotics_bridge.hands.hand import UNKNOWN_SPEED, palmar_directions
from robotics_bridge.hands.layouts import active_count
from robotics_bridge.hands.scenes import holding
from robotics_bridge.physics import MujocoEngine
from robotics_bridge.sensors import KinematicTaxel, SensorSuite
from robotics_bridge.tasks.scenes import build as build_task

URDF = {
    "xhand1": "hands/xhand1/xhand_right_updated_effort.urdf",
    "sharpa": "hands/sharpa/sharpa_right_updated_effort.urdf",
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


def _box_hand(
    folder: Path, unit: float = 1.0, *, inertia: float = 1e-5, mass: float = 0.1, mesh: bool = False,
    root: float = 0.045, apart: float = 0.06,
) -> Path:  # fmt: skip
    """Write a palm with two fingers as URDF: lengths times ``unit``, as boxes, or as a box that is inside out.

    The fingers begin at ``root`` (m, the palm ends at .04), ``apart`` from one another.
    """
    box = trimesh.creation.box((2, 2, 2))
    box.invert()
    box.export(folder / "box.stl")

    def link(name: str, size: tuple[float, ...], at: float) -> str:
        sides = " ".join(str(unit * side / (2 if mesh else 1)) for side in size)
        solid = f'<mesh filename="box.stl" scale="{sides}"/>' if mesh else f'<box size="{sides}"/>'
        moments = " ".join(
            f'i{axes}="{inertia if axes[0] == axes[1] else 0}"' for axes in ("xx", "yy", "zz", "xy", "xz", "yz")
        )
        return (
            f'<link name="{name}"><inertial><origin xyz="{unit * at} 0 0"/><mass value="{mass}"/><inertia {moments}/>'
            f'</inertial><collision><origin xyz="{unit * at} 0 0"/><geometry>{solid}</geometry></collision></link>'
        )

    text = '<robot name="h">' + link("palm", (0.08, 0.08, 0.02), 0)
    for name, y in (("index", -apart / 2), ("thumb", apart / 2)):
        text += link(name, (0.04, 0.016, 0.014), 0.022)
        text += (
            f'<joint name="{name}" type="revolute"><origin xyz="{root * unit} {y * unit} 0"/><parent link="palm"/>'
            f'<child link="{name}"/><axis xyz="0 -1 0"/><limit lower="0" upper="1.5" effort="1" velocity="3"/></joint>'
        )
    path = folder / "box.urdf"
    path.write_text(text + "</robot>")
    return path


@pytest.mark.parametrize("unit", [100.0, 1 / 0.0254, 1e-3])
def test_a_hand_whose_lengths_are_no_metres_is_refused(unit, tmp_path):
    with pytest.raises(DataError, match="lengths are in metres"):
        hands.load(_box_hand(tmp_path, unit))


@pytest.mark.parametrize(("settings", "words"), [({"inertia": 10.0}, "kg·m²"), ({"mass": 100.0}, "masses are in kg")])
def test_masses_and_inertias_in_other_units_are_named(settings, words, tmp_path, caplog):
    path = _box_hand(tmp_path, **settings)
    hands.load(path)
    assert words in caplog.text
    (check,) = check_file(path)
    assert words in check.errors[0]


def test_a_sound_hand_raises_no_doubt_about_units(tmp_path, caplog):
    hands.load(_box_hand(tmp_path))
    assert not caplog.text


def test_taxels_of_a_mesh_that_is_inside_out_face_outward(tmp_path):
    layout, plain = (hands.load(_box_hand(tmp_path, mesh=mesh)).layout("low") for mesh in (True, False))
    for link, probes in plain.items():
        np.testing.assert_allclose(layout[link].normal, probes.normal, atol=1e-6)


def test_a_hand_whose_frame_lies_far_from_its_solids_gets_all_taxels(tmp_path):
    far = tmp_path / "far.xml"
    text = MENAGERIE_LIKE.replace('name="palm" pos="0 0 0.1"', 'name="palm" pos="-12 0 0.1"')
    text = text.replace('<geom name="palm_geom"', '<geom name="palm_geom" pos="12 0 0"')
    far.write_text(text.replace('pos="0 0.03 0.05"', 'pos="12 0.03 0.05"').replace('pos="0 -0.03', 'pos="12 -0.03'))
    near = tmp_path / "near.xml"
    near.write_text(MENAGERIE_LIKE)
    layout, plain = (hands.load(path).layout("low") for path in (far, near))
    assert list(layout) == list(plain)
    np.testing.assert_allclose(layout["palm"].position - [12, 0, 0], plain["palm"].position, atol=1e-9)


def test_fingers_that_begin_inside_the_palm_move_and_feel_nothing_of_it(tmp_path):
    hand = hands.load(_box_hand(tmp_path, root=0.03))
    assert hand.nested == {("palm", "index"), ("palm", "thumb")}
    engine = MujocoEngine(holding(hand, radius=0.02), 1)
    sensors = {link: KinematicTaxel(link=link, probes=probes) for link, probes in hand.layout("low").items()}
    suite = SensorSuite(engine.scene, sensors, num_envs=1)
    ball = engine.model.joint(engine.model.body("object").jntadr[0]).qposadr[0]
    engine.data[0].qpos[ball + 2] += 1.0
    engine.set(ctrl=[[0.5, 0.5]])
    for _ in range(150):
        engine.step()
        suite.update(engine.state, engine.timestep)
    np.testing.assert_allclose([engine.data[0].joint(name).qpos[0] for name in hand.joints], 0.5, atol=0.05)
    assert all(not suite.read(link).any() for link in sensors)


def test_fingers_that_lie_in_each_other_at_rest_are_named(tmp_path, caplog):
    path = _box_hand(tmp_path, apart=0.01)
    hands.load(path)
    assert "'index and thumb' lie more than 1 mm in each other" in caplog.text
    (check,) = check_file(path)
    assert not check.passed
