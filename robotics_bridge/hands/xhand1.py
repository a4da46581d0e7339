"""A hand of 12 joints like the RobotEra XHand1 (right).

Joint frames, axes, limits, efforts, speeds and masses are those of the maker's URDF, servo gains those identified
by neuroagents-lab/tactile-genesis (commit 3023bcd2); counts and radii of probes are those of the thesis
(table 4.11). The solids are ours. Fingers point along z, the palm faces x.
"""

from __future__ import annotations

import math

from robotics_bridge.hands.spec import BoxGeometry, CapsuleGeometry, Grid, HandSpec, Joint, Link, Pad, Vector

_NEAR, _FAR = (6.6, 8.63), (10.0, 14.38)
"""Effort [N·m] and speed [rad/s] of the drives at the base and at the tip of a finger."""


def _joint(
    name: str,
    links: tuple[str, str],
    position: Vector,
    axis: Vector,
    limits: tuple[float, float],
    drive: tuple[float, float],
    rpy: Vector = (0.0, 0.0, 0.0),
) -> Joint:
    parent, child = (f"right_hand_{link}" for link in links)
    return Joint(f"right_hand_{name}", parent, child, position, rpy, axis, limits, *drive, 100.0, 6.0, 0.05)


def _phalanges(first: str, second: str) -> tuple[Link, Link]:
    near = CapsuleGeometry((0.0015, 0.0, 0.014), (0.0015, 0.0, 0.050), 0.0092)
    far = CapsuleGeometry((0.0015, 0.0, 0.008), (0.0015, 0.0, 0.0336), 0.0088)
    cap = 0.0088 * math.pi / 2
    return (
        Link(
            f"right_hand_{first}", 0.06298, (near,), Pad((1.0, 0.0, 0.0), (0.002, 0.034), 0.8),
            {"low": Grid(2, 3, 0.004), "med": Grid(3, 4, 0.004), "high": Grid(6, 7, 0.0016)},
        ),
        Link(
            f"right_hand_{second}", 0.01582, (far,), Pad((1.0, 0.0, 0.0), (0.006, 0.0256 + 0.6 * cap), 0.9),
            {"low": Grid(3, 3, 0.004), "med": Grid(4, 5, 0.004), "high": Grid(6, 8, 0.002, 46)},
        ),
    )  # fmt: skip


def _thumb() -> tuple[Link, ...]:
    cap = 0.0112 * math.pi / 2
    return (
        Link("right_hand_thumb_bend_link", 0.01151, (CapsuleGeometry((0.0, 0.002, 0.0), (0.0, 0.024, 0.0), 0.0085),)),
        Link(
            "right_hand_thumb_rota_link1", 0.1323, (CapsuleGeometry((0.0, 0.012, 0.0), (0.0, 0.0515, 0.0), 0.0118),),
            Pad((0.0, 0.0, 1.0), (0.002, 0.036), 0.9),
            {"low": Grid(3, 3, 0.004), "med": Grid(4, 4, 0.004), "high": Grid(7, 8, 0.003)},
        ),
        Link(
            "right_hand_thumb_rota_link2", 0.03517, (CapsuleGeometry((0.0, 0.008, 0.0), (0.0, 0.040, 0.0), 0.0112),),
            Pad((0.0, 0.0, 1.0), (0.008, 0.032 + 0.6 * cap), 0.9),
            {"low": Grid(3, 3, 0.004), "med": Grid(4, 5, 0.004), "high": Grid(7, 6, 0.003, 40)},
        ),
    )  # fmt: skip


def _finger_joints(prefix: str, first: str, second: str, parent: str, position: Vector) -> tuple[Joint, Joint]:
    bend, up = (0.0, 1.919), (0.0, 1.0, 0.0)
    return (
        _joint(f"{prefix}_joint1", (parent, first), position, up, bend, _NEAR),
        _joint(f"{prefix}_joint2", (first, second), (0.0, 0.0, 0.0558), up, bend, _FAR),
    )


_FINGERS = {
    "index": ("index_rota_link1", "index_rota_link2"),
    "mid": ("mid_link1", "mid_link2"),
    "ring": ("ring_link1", "ring_link2"),
    "pinky": ("pinky_link1", "pinky_link2"),
}
_PALM = Link(
    "right_hand_link", 0.5385, (BoxGeometry((0.0, -0.0035, 0.051), (0.0225, 0.0455, 0.048)),),
    Pad((1.0, 0.0, 0.0), (0.040, 0.042)),
    {"low": Grid(4, 3, 0.004), "med": Grid(7, 5, 0.004), "high": Grid(20, 11, 0.0016, 219)},
)  # fmt: skip
_INDEX_BASE = Link(
    "right_hand_index_bend_link", 0.06872, (CapsuleGeometry((0.0, 0.0, 0.002), (0.0, 0.0, 0.012), 0.008),)
)


def xhand1() -> HandSpec:
    """Return the hand."""
    thumb = (
        _joint(
            "thumb_bend_joint", ("link", "thumb_bend_link"), (0.0095, 0.0228, 0.0305), (0, 0, -1), (0, 1.832), _NEAR
        ),
        _joint(
            "thumb_rota_joint1", ("thumb_bend_link", "thumb_rota_link1"), (0.0083177, 0.028599, -0.00178), (1, 0, 0),
            (-0.698, 1.57), _NEAR, (0.0, 0.2618, -0.0407),
        ),
        _joint(
            "thumb_rota_joint2", ("thumb_rota_link1", "thumb_rota_link2"), (0, 0.0553, 0), (1, 0, 0), (0, 1.57), _FAR
        ),
    )  # fmt: skip
    index_base = _joint(
        "index_bend_joint", ("link", "index_bend_link"), (0.0065, 0.0265, 0.0899), (-1, 0, 0), (-0.174, 0.174), _FAR
    )
    index, mid, ring, pinky = (
        _finger_joints("index", *_FINGERS["index"], "index_bend_link", (0.0, 0.0, 0.0178)),
        _finger_joints("mid", *_FINGERS["mid"], "link", (0.0065, 0.004, 0.1082)),
        _finger_joints("ring", *_FINGERS["ring"], "link", (0.0065, -0.016, 0.1052)),
        _finger_joints("pinky", *_FINGERS["pinky"], "link", (0.0065, -0.036, 0.1022)),
    )
    # The order of the actuators file: thumb and finger bases first.
    joints = (
        thumb[0], index_base, mid[0], ring[0], pinky[0], thumb[1],
        index[0], mid[1], ring[1], pinky[1], thumb[2], index[1],
    )  # fmt: skip
    fingers = {name: tuple(f"right_hand_{link}" for link in links) for name, links in _FINGERS.items()}
    fingers["thumb"] = ("right_hand_thumb_bend_link", "right_hand_thumb_rota_link1", "right_hand_thumb_rota_link2")
    fingers["index"] = ("right_hand_index_bend_link", *fingers["index"])
    return HandSpec(
        name="xhand1",
        palm="right_hand_link",
        links=(_PALM, _INDEX_BASE, *_thumb(), *(link for pair in _FINGERS.values() for link in _phalanges(*pair))),
        joints=joints,
        fingers=fingers,
        source="kinematics and limits of the XHand1 URDF; geometry of primitives by brainbench",
    )
