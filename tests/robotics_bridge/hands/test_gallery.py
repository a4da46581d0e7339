"""Hands of the kinds in public use load, get taxels on every tip, and feel what presses these."""

# ruff: noqa: E501

from __future__ import annotations

import re

import numpy as np
import pytest

from robotics_bridge import hands
from robotics_bridge.hands.gallery import check_file
from robotics_bridge.tasks.scenes import drives_of
from tests.factories.hand_gallery import CAPSULE, GALLERY, GRIP, TENDON, Model, finger, hand, jaws, mjcf, palm, urdf

SHAPES = {
    "capsule": CAPSULE,
    "cylinder": 'type="cylinder" size=".007 .015" pos="0 .015 0" euler="1.5708 0 0"',
    "ellipsoid": 'type="ellipsoid" size=".008 .015 .008" pos="0 .015 0"',
    "mesh": 'type="mesh" mesh="phalanx" pos="0 .015 0"',
    "soft": f'{CAPSULE} solref=".02 1" solimp=".6 .95 .01"',
}
MESH = '<asset><mesh name="phalanx" vertex="-.007 -.015 -.006 .007 -.015 -.006 -.007 .015 -.006 .007 .015 -.006 -.005 -.015 .006 .005 -.015 .006 -.005 .013 .006 .005 .013 .006"/></asset>'


def arm(tool: str) -> str:
    """Return an arm of three hinges that carries a tool."""
    text = ""
    for index, axis in enumerate(("0 0 1", "0 1 0", "0 1 0")):
        text += f'<body name="arm{index}" pos="0 0 .3"><joint name="arm{index}" axis="{axis}" range="-2 2"/>'
        text += '<geom type="capsule" size=".03" fromto="0 0 0 0 0 .25" mass="1"/>'
    return text + tool + "</body>" * 3


def _more() -> dict[str, Model]:
    """Return models of further kinds by name."""
    models: dict[str, Model] = {}
    for name, shape in SHAPES.items():
        fingers, tips = hand(3, shape)
        models[f"three-fingers-{name}"] = Model(
            mjcf(palm(fingers), parts=MESH if name == "mesh" else ""), tips, drives=6
        )
    for count, links in ((2, 3), (4, 3), (5, 3)):
        fingers, tips = hand(count, CAPSULE, links)
        models[f"{count}-fingers"] = Model(mjcf(palm(fingers)), tips, drives=count * links)
    models["floating"] = Model(mjcf(palm(fingers, more="<freejoint/>")), tips)
    models["hand-on-arm"] = Model(mjcf(arm(palm(fingers, place="0 0 .26"))), tips)
    fork = finger("fork", "0 .03 0", more=finger("a", "-.01 .036 0") + finger("b", ".01 .036 0"))
    models["forked-finger"] = Model(mjcf(palm(finger("f", "-.03 .03 0") + fork)), ("f_tip", "a_tip", "b_tip"))
    five = [hand(5, CAPSULE, 2, side) for side in ("l", "r")]
    arms = "".join(
        f'<body name="{side}_shoulder" pos="{x} 0 .4"><joint name="{side}_shoulder" axis="0 1 0" range="-1 1"/>'
        f'<geom type="capsule" size=".03" fromto="0 0 0 0 0 .3" mass="1"/>{palm(f[0], f"{side}_palm", "0 0 .35")}</body>'
        for side, x, f in zip("lr", (-0.3, 0.3), five, strict=True)
    )
    head = '<body name="head" pos="0 0 .5"><joint axis="0 0 1" range="-1 1"/><geom size=".08" mass="1"/></body>'
    torso = f'<body name="torso"><geom type="box" size=".1 .1 .3" mass="9"/>{head}{arms}</body>'
    models["torso"] = Model(mjcf(torso), five[0][1], ("l_palm", "r_palm"))
    models["jaws-hinge"] = Model(mjcf(palm(jaws("hinge"))), ("left", "right"), drives=2)
    split = TENDON.format("left", "right")
    models["tendon-jaws"] = Model(mjcf(palm(jaws()), parts=split + GRIP), ("left", "right"), drives=1)
    models["jaws-on-arm"] = Model(mjcf(arm(palm(jaws(), place="0 0 .26"))), ("left", "right"))
    models["urdf-jaws"] = Model(urdf(False), ("left", "right"), suffix=".urdf", drives=2)
    thumb = '<body name="thumb" pos="0 .03 0"><joint name="thumb" axis="1 0 0" range="0 1.5"/>'
    thumb += '<geom type="box" size=".01 .02 .005" pos="0 .02 0" mass=".02"/></body>'
    models["single-jaw"] = Model(mjcf(palm(thumb)), ("thumb",), drives=1)
    return models


MODELS = GALLERY | _more()


def test_the_gallery_holds_at_least_25_models() -> None:
    assert len(MODELS) >= 25


@pytest.mark.parametrize("name", list(MODELS))
def test_palms_tips_and_couplers_are_those_of_the_model(name: str, tmp_path) -> None:
    model = MODELS[name]
    found = hands.load_all(model.write(tmp_path, name))
    assert sorted(hand.palm for hand in found) == sorted(model.palms)
    first = next(hand for hand in found if hand.palm == model.palms[0])
    assert sorted(first.tips) == sorted(model.tips)
    assert len(first.couplers) == model.couplers
    layout = first.layout("low", "tips")
    assert set(layout) == set(model.tips)


@pytest.mark.parametrize("name", [name for name, model in MODELS.items() if model.drives])
def test_what_follows_is_not_driven(name: str, tmp_path) -> None:
    hand = hands.load(MODELS[name].write(tmp_path, name))
    assert len(drives_of(hand)) == MODELS[name].drives


@pytest.mark.parametrize("name", list(MODELS))
def test_a_ball_pressed_on_each_pad_is_felt(name: str, tmp_path) -> None:
    checks = check_file(MODELS[name].write(tmp_path, name))
    assert [check.errors for check in checks] == [()] * len(MODELS[name].palms)
    assert all(check.pressed >= len(check.tips) and check.worst < 0.02 for check in checks)


def test_pads_of_a_linkage_face_the_other_finger(tmp_path) -> None:
    hand = hands.load(GALLERY["four-bar-tendon"].write(tmp_path, "hand"))
    layout = hand.layout("low", "tips")
    np.testing.assert_allclose(layout["left_jaw"].normal.mean(axis=0), [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(layout["right_jaw"].normal.mean(axis=0), [-1, 0, 0], atol=1e-6)


def test_a_file_that_cannot_be_read_is_one_sentence(tmp_path) -> None:
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody><body name='a'/></worldbody></mujoco>")
    (check,) = check_file(tmp_path / "broken.xml", tmp_path)
    assert not check.passed
    assert "no joints" in check.errors[0]


def test_a_picture_of_each_hand_is_drawn(tmp_path) -> None:
    check_file(GALLERY["two-hands"].write(tmp_path, "two"), tmp_path)
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["two-left_palm-xml.png", "two-right_palm-xml.png"]


def test_a_urdf_without_links_is_one_sentence(tmp_path):
    path = tmp_path / "empty.urdf"
    path.write_text('<robot name="x"/>')
    (check,) = check_file(path, tmp_path)
    assert check.errors == (f"{str(path)!r} holds no hand: it has no links.",)


def test_a_hand_that_nothing_can_press_is_not_sound(tmp_path):
    model = GALLERY["three-fingers-box"]
    ghost = model.text.replace("<geom ", '<geom contype="0" conaffinity="0" ')
    (tmp_path / "ghost.xml").write_text(ghost)
    (check,) = check_file(tmp_path / "ghost.xml")
    assert check.errors == tuple(f"no ball can press the tip {tip!r}" for tip in model.tips)


@pytest.mark.parametrize("scale", [1e3, 1e-3])
def test_a_hand_in_another_unit_of_length_is_told(scale, tmp_path):
    def scaled(match):
        values = " ".join(f"{scale * float(word):.9g}" for word in match[2].split())
        return f'{match[1]}="{values}"'

    text = re.sub(r'\b(pos|size)="([^"]+)"', scaled, GALLERY["three-fingers-box"].text)
    (tmp_path / "large.xml").write_text(text)
    (check,) = check_file(tmp_path / "large.xml")
    assert not check.passed
    assert "lengths are in metres" in check.errors[0]
