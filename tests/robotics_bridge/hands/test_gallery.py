"""Hands of the kinds in public use load, get taxels on every tip, and feel what presses these."""

from __future__ import annotations

import re

import numpy as np
import pytest

from robotics_bridge import hands
from robotics_bridge.hands.gallery import check_file
from tests.factories.hand_gallery import GALLERY


def test_the_gallery_holds_at_least_25_models() -> None:
    assert len(GALLERY) >= 25


@pytest.mark.parametrize("name", list(GALLERY))
def test_palms_tips_and_couplers_are_those_of_the_model(name: str, tmp_path) -> None:
    model = GALLERY[name]
    found = hands.load_all(model.write(tmp_path, name))
    assert sorted(hand.palm for hand in found) == sorted(model.palms)
    first = next(hand for hand in found if hand.palm == model.palms[0])
    assert sorted(first.tips) == sorted(model.tips)
    assert len(first.couplers) == model.couplers
    layout = first.layout("low", "tips")
    assert set(layout) == set(model.tips)


@pytest.mark.parametrize("name", list(GALLERY))
def test_a_ball_pressed_on_each_pad_is_felt(name: str, tmp_path) -> None:
    checks = check_file(GALLERY[name].write(tmp_path, name))
    assert [check.errors for check in checks] == [()] * len(GALLERY[name].palms)
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
