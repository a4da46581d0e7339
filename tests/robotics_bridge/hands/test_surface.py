"""Palmar sides of hand files."""

from __future__ import annotations

import numpy as np
import pytest

from robotics_bridge import hands
from robotics_bridge.hands.hand import palmar_directions
from robotics_bridge.hands.layouts import active_count, read_probes

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
