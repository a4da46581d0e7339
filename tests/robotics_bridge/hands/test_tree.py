"""Several hands of a file, and which joints of linkages and tendons lead."""

from __future__ import annotations

import logging

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from robotics_bridge import hands
from robotics_bridge.hands.hand import palmar_directions
from robotics_bridge.hands.layouts import active_count, read_probes
from robotics_bridge.hands.observations import sensors_for
from robotics_bridge.hands.scenes import closing, holding, replace_drives
from robotics_bridge.hands.tree import Tree, driven, pulled
from robotics_bridge.physics import MujocoEngine
from robotics_bridge.sensors import SensorSuite
from robotics_bridge.tasks.scenes import drives_of
from tests.factories.hand_gallery import GALLERY

URDF = {
    "xhand1": "hands/xhand1/xhand_right_updated_effort.urdf",
    "sharpa": "hands/sharpa/sharpa_right_updated_effort.urdf",
}


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


def test_a_tendon_drive_is_the_servo_of_its_first_joint(tmp_path) -> None:
    """Coefficients ½ and a gain of 16: 16 · ½ · 1 N·m/rad at the crank, as the tendon makes when both cranks turn."""
    hand = hands.load(GALLERY["four-bar-tendon"].write(tmp_path, "hand"))
    assert {joint: values[:2] for joint, values in drives_of(hand).items()} == {"left_crank": (8.0, pytest.approx(0.3))}
    assert [hand.model.joint(joint).name for joint in pulled(hand.model)] == ["right_crank"]
    assert [hand.model.joint(joint).name for joint in driven(hand.model)] == ["left_crank"]


def test_a_hand_that_holds_a_ball_has_a_servo_on_each_leading_joint_alone(tmp_path) -> None:
    for name, count in (("four-bar-servos", 2), ("four-bar-passive", 2), ("three-fingers-box", 6)):
        hand = hands.load(GALLERY[name].write(tmp_path, name))
        assert holding(hand).nu == len(closing(hand, 0.5)) == count


def test_the_other_hand_of_a_file_is_named_and_can_be_chosen(tmp_path, caplog) -> None:
    path = GALLERY["two-hands"].write(tmp_path, "pair")
    with caplog.at_level(logging.WARNING):
        assert hands.load(path).palm == "left_palm"
    assert "'right_palm' get no taxels" in caplog.text
    assert hands.load(path, palm="right_palm").tips == ("rf0_tip", "rf1_tip", "rf2_tip")
    with pytest.raises(UsageError, match="right_palm"):
        hands.load(path, palm="right_plam")
    assert len(hands.load_all(path)) == 2


def test_both_hands_of_a_file_carry_a_board_in_one_scene(tmp_path) -> None:
    both = hands.load_all(GALLERY["two-hands"].write(tmp_path, "pair"))
    spec = both[0].mjspec()
    replace_drives(spec)
    model = both[0].model
    places = [model.body(hand.palm).pos for hand in both]
    top = max(place[2] + model.geom_size[model.body_geomadr[model.body(hand.palm).id]][2]
              for hand, place in zip(both, places, strict=True))  # fmt: skip
    middle, span = sum(places) / 2, abs(places[1] - places[0]).max() / 2
    board = spec.worldbody.add_body(name="board", pos=[middle[0], middle[1], top + 0.0051])
    board.add_freejoint()
    board.add_geom(type=6, size=[span + 0.02, 0.02, 0.005], mass=1.0)
    engine = MujocoEngine(spec.compile(), 1)
    engine.step(300)
    layout = {link: probes for hand in both for link, probes in hand.layout("low").items()}
    suite = SensorSuite(engine.scene, sensors_for("force", layout), num_envs=1)
    suite.update(engine.state)
    for hand in both:
        assert float(suite.read(hand.palm)[0, ..., 2].sum()) == pytest.approx(-9.81 / 2, rel=0.01)
    assert float(suite.missing.max()) < 1e-3


def test_followers_of_a_model_without_loops_are_those_that_mimic(tmp_path) -> None:
    hand = hands.load(GALLERY["mimic-hand"].write(tmp_path, "hand"))
    assert {hand.model.joint(joint).name for joint in Tree(hand.model).followers} == set(hand.tips)


_ASKEW = """<robot name="askew"><link name="base"/>
<joint name="mount" type="fixed"><parent link="base"/><child link="palm"/><origin rpy="{turn} 0 0"/></joint>
<link name="palm"><inertial><mass value=".3"/><inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/>
</inertial><collision><geometry><box size=".08 .1 .024"/></geometry></collision></link>{fingers}</robot>"""
_PHALANX = """<link name="{name}"><inertial><mass value=".05"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0"
iyz="0"/></inertial><collision><origin xyz="0 .02 0"/><geometry><box size=".016 .04 .016"/></geometry></collision>
</link>
<joint name="to_{name}" type="revolute"><parent link="{parent}"/><child link="{name}"/><origin xyz="{x} .05 0"/>
<axis xyz="1 0 0"/><limit lower="0" upper="1.5" effort="1" velocity="3"/></joint>"""


@pytest.mark.parametrize("turn", [0.4, 0.7, 0.9, 2.0])
def test_taxels_of_a_palm_that_is_mounted_askew_turn_with_it(turn: float, tmp_path) -> None:
    fingers = "".join(
        _PHALANX.format(name=f"{name}{part}", parent="palm" if part == "a" else f"{name}a", x=x if part == "a" else 0)
        for name, x in (("index", -0.03), ("middle", 0.0), ("ring", 0.03))
        for part in "ab"
    )
    palms = []
    for number, angle in enumerate((0.0, turn)):
        file = tmp_path / f"hand{number}.urdf"
        file.write_text(_ASKEW.format(turn=angle, fingers=fingers))
        hand = hands.load(file)
        palms.append(hand.layout("low", "palm")[hand.palm])
    straight, askew = palms
    c, s = np.cos(turn), np.sin(turn)
    about_x = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    assert straight.active.sum() == askew.active.sum() > 10
    np.testing.assert_allclose(askew.normal[askew.active], straight.normal[straight.active] @ about_x.T, atol=1e-6)
    # The grid may count its rows from the other side.
    there = straight.position[straight.active] @ about_x.T
    apart = np.linalg.norm(askew.position[askew.active][:, None] - there, axis=2).min(axis=1)
    assert apart.max() < 0.012
