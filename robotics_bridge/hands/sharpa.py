"""A hand of 22 joints like the Sharpa Wave (right).

Joint frames, axes, limits, efforts, speeds and masses are those of the maker's URDF, servo gains those identified
by neuroagents-lab/tactile-genesis (commit 3023bcd2); counts and radii of probes are those of the thesis
(table 4.11). The solids are ours; elastomer and finger tip are part of the distal link. The palm faces x.
"""

from __future__ import annotations

import math

from robotics_bridge.hands.spec import (
    BoxGeometry,
    CapsuleGeometry,
    Grid,
    HandSpec,
    Joint,
    Link,
    Pad,
    SphereGeometry,
    Vector,
)

_HALF = math.pi / 2
_AXIS = (0.0, 0.0, 1.0)
_TURN, _BACK, _NONE = (_HALF, 0.0, 0.0), (-_HALF, 0.0, 0.0), (0.0, 0.0, 0.0)
_CMC, _MCP, _PIP, _DIP = (33.0, 11.84), (18.64, 16.077), (6.38, 11.618), (1.894, 14.666)
"""Effort [N·m] and speed [rad/s] of the drives."""
_SIDE = (-0.3491, 0.3491)


def _joint(
    name: str,
    links: tuple[str, str],
    position: Vector,
    rpy: Vector,
    limits: tuple[float, float],
    drive: tuple[float, float],
    servo: tuple[float, float, float],
) -> Joint:
    parent, child = (f"right_{link}" for link in links)
    return Joint(f"right_{name}", parent, child, position, rpy, _AXIS, limits, *drive, *servo)


_SOFT = (90.0, 4.0, 0.015)


def _finger(name: str, parent: str, position: Vector, rpy: Vector) -> tuple[Joint, ...]:
    base, near, mid, tip = (f"{name}_{part}" for part in ("MCP_VL", "PP", "MP", "DP"))
    return (
        _joint(f"{name}_MCP_FE", (parent, base), position, rpy, (-0.1745, 1.5708), _MCP, (100.0, 5.0, 0.05)),
        _joint(f"{name}_MCP_AA", (base, near), _NONE, _BACK, _SIDE, _MCP, (100.0, 6.0, 0.05)),
        _joint(f"{name}_PIP", (near, mid), (0.047, 0.0, 0.0), _TURN, (0.0, 1.7453), _PIP, _SOFT),
        _joint(f"{name}_DIP", (mid, tip), (0.0315, 0.0, 0.0), _NONE, (0.0, 1.3963), _DIP, _SOFT),
    )


def _finger_links(name: str, tip: int) -> tuple[Link, ...]:
    """Return the four links; ``tip`` is the number of active probes of the finger tip at high resolution."""
    cap = 0.0075 * _HALF
    return (
        Link(f"right_{name}_MCP_VL", 1e-6, (SphereGeometry(_NONE, 0.008),)),
        Link(
            f"right_{name}_PP", 0.04138, (CapsuleGeometry((0.014, 0.0, 0.0), (0.0445, 0.0, 0.0), 0.0095),),
            Pad((0.0, 0.0, 1.0), (0.002, 0.028), 0.9),
            {"low": Grid(2, 2, 0.004), "med": Grid(3, 4, 0.004), "high": Grid(6, 7, 0.003)},
        ),
        Link(
            f"right_{name}_MP", 0.02509, (CapsuleGeometry((0.008, 0.0, 0.0), (0.0275, 0.0, 0.0), 0.0087),),
            Pad((0.0, 1.0, 0.0), (0.002, 0.018), 0.9),
            {"low": Grid(2, 2, 0.004), "med": Grid(4, 3, 0.004), "high": Grid(6, 6, 0.003)},
        ),
        Link(
            f"right_{name}_DP", 0.0041, (CapsuleGeometry((0.0065, -0.001, 0.0), (0.0182, -0.001, 0.0), 0.0075),),
            Pad((0.0, 1.0, 0.0), (0.001, 0.0117 + 0.6 * cap), 0.9),
            {"low": Grid(3, 3, 0.004), "med": Grid(4, 4, 0.004, 14), "high": Grid(7, 7, 0.003, tip)},
        ),
    )  # fmt: skip


def _thumb() -> tuple[tuple[Link, ...], tuple[Joint, ...]]:
    cap = 0.0083 * _HALF
    links = (
        Link("right_thumb_CMC_VL", 1e-6),
        Link(
            "right_thumb_MC", 0.116, (CapsuleGeometry((0.014, -0.004, 0.008), (0.056, -0.005, 0.010), 0.0125),),
            Pad((0.0, 0.85, 0.53), (0.012, 0.034), 0.7),
            {"low": Grid(2, 2, 0.004), "med": Grid(3, 3, 0.004), "high": Grid(5, 6, 0.003)},
        ),
        Link("right_thumb_MCP_VL", 1e-6, (SphereGeometry(_NONE, 0.009),)),
        Link(
            "right_thumb_PP", 0.04955, (CapsuleGeometry((0.0125, 0.0, 0.0), (0.035, 0.0, 0.0), 0.0098),),
            Pad((0.0, 0.0, 1.0), (0.002, 0.020), 0.8),
            {"low": Grid(2, 2, 0.004), "med": Grid(3, 3, 0.004), "high": Grid(5, 4, 0.003)},
        ),
        Link(
            "right_thumb_DP", 0.00599, (CapsuleGeometry((0.0075, -0.001, 0.0), (0.0206, -0.001, 0.0), 0.0083),),
            Pad((0.0, 1.0, 0.0), (0.001, 0.0131 + 0.6 * cap), 0.9),
            {"low": Grid(3, 3, 0.004), "med": Grid(4, 4, 0.004, 14), "high": Grid(8, 8, 0.003, 59)},
        ),
    )  # fmt: skip
    stiff = (100.0, 6.0, 0.1)
    joints = (
        _joint(
            "thumb_CMC_FE", ("hand_C_MC", "thumb_CMC_VL"), (0.01, 0.026, 0.0212), (math.pi, 0.0, _HALF),
            (-0.1745, 1.9199), _CMC, stiff,
        ),
        _joint(
            "thumb_CMC_AA", ("thumb_CMC_VL", "thumb_MC"), (0.0, -0.005, 0.0), (-_HALF, math.pi / 4, 0.0), _SIDE,
            _CMC, stiff,
        ),
        _joint(
            "thumb_MCP_FE", ("thumb_MC", "thumb_MCP_VL"), (0.065, -0.006, 0.010392), (0.5236, 0.0, 0.0),
            (-0.5236, 1.3963), _MCP, (100.0, 5.0, 0.05),
        ),
        _joint("thumb_MCP_AA", ("thumb_MCP_VL", "thumb_PP"), _NONE, _BACK, _SIDE, _MCP, (100.0, 6.0, 0.05)),
        _joint("thumb_IP", ("thumb_PP", "thumb_DP"), (0.039, 0.0, 0.0), _TURN, (0.0, 1.7453), _PIP, _SOFT),
    )  # fmt: skip
    return links, joints


_PALM = Link(
    "right_hand_C_MC", 0.72045,
    (
        BoxGeometry((0.0, 0.0115, 0.044), (0.0215, 0.0315, 0.042)),
        BoxGeometry((0.0, -0.031, 0.013), (0.019, 0.011, 0.013)),
    ),
    Pad((1.0, 0.0, 0.0), (0.026, 0.033)),
    {"low": Grid(3, 3, 0.004), "med": Grid(4, 4, 0.004), "high": Grid(11, 11, 0.003)},
)  # fmt: skip
_PINKY_PALM = Link(
    "right_pinky_MC", 0.12541, (BoxGeometry((0.010, 0.0085, -0.033), (0.019, 0.0105, 0.021)),),
    Pad((-1.0, 0.0, 0.0), (0.008, 0.017)),
    {"low": Grid(2, 2, 0.004), "med": Grid(2, 3, 0.004), "high": Grid(7, 8, 0.003, 53)},
)  # fmt: skip


def sharpa() -> HandSpec:
    """Return the hand."""
    upright = (0.0, -_HALF, -_HALF)
    thumb_links, thumb_joints = _thumb()
    pinky_base = _joint(
        "pinky_CMC", ("hand_C_MC", "pinky_MC"), (0.01136, -0.0263, 0.0867), (0.0, 0.0, math.pi), (0.0, 0.2618),
        (5.285, 35.074), (100.0, 6.0, 0.1),
    )  # fmt: skip
    joints = (
        *thumb_joints,
        *_finger("index", "hand_C_MC", (0.001, 0.0303, 0.0957), upright),
        *_finger("middle", "hand_C_MC", (0.0, 0.01, 0.0987), upright),
        *_finger("ring", "hand_C_MC", (0.0015, -0.0103, 0.0927), upright),
        pinky_base,
        *_finger("pinky", "pinky_MC", (0.00836, 0.0048, 0.0), (_HALF, -_HALF, 0.0)),
    )
    tips = {"index": 47, "middle": 46, "ring": 46, "pinky": 47}
    chains = {name: tuple(link.name for link in _finger_links(name, count)) for name, count in tips.items()}
    chains["pinky"] = ("right_pinky_MC", *chains["pinky"])
    chains["thumb"] = tuple(link.name for link in thumb_links)
    return HandSpec(
        name="sharpa",
        palm="right_hand_C_MC",
        links=(
            _PALM, _PINKY_PALM, *thumb_links,
            *(link for name, count in tips.items() for link in _finger_links(name, count)),
        ),
        joints=joints,
        fingers=chains,
        apart=(
            ("right_hand_C_MC", "right_thumb_MC"), ("right_hand_C_MC", "right_pinky_MCP_VL"),
            ("right_thumb_MC", "right_thumb_PP"), ("right_pinky_MC", "right_ring_MCP_VL"),
        ),
        source="kinematics and limits of the Sharpa Wave URDF; geometry of primitives by brainbench",
    )  # fmt: skip
