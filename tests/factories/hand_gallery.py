"""Synthetic hand files of the kinds that are in public use: grippers, linkages, tendons, hands on arms and pairs."""

# ruff: noqa: E501

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

BOX = 'type="box" size=".007 .015 .006" pos="0 .015 0"'
CAPSULE = 'type="capsule" size=".007" fromto="0 .004 0 0 .03 0"'


@dataclass(frozen=True)
class Model:
    """One file and what it is."""

    text: str
    tips: tuple[str, ...]
    palms: tuple[str, ...] = ("palm",)
    suffix: str = ".xml"
    couplers: int = 0
    drives: int | None = None
    """Joints that a task drives; None where that is not the point."""

    def write(self, folder: Path, name: str) -> Path:
        """Write the file into a folder."""
        path = folder / f"{name}{self.suffix}"
        path.write_text(self.text)
        return path


def finger(name: str, place: str, shape: str = BOX, links: int = 2, more: str = "") -> str:
    """Return a finger of hinges that bend up; ``shape`` is that of its links, ``more`` stands in the last."""
    text, parts = "", [f"{name}{index}" for index in range(links - 1)] + [f"{name}_tip"]
    for index, part in enumerate(parts):
        at = place if index == 0 else "0 .036 0"
        text += f'<body name="{part}" pos="{at}"><joint name="{part}" axis="1 0 0" range="0 1.5" damping=".01"/>'
        text += f'<geom {shape} mass=".02"/>'
    return text + more + "</body>" * links


def palm(fingers: str, name: str = "palm", place: str = "0 0 .2", more: str = "") -> str:
    """Return a palm with fingers."""
    return f'<body name="{name}" pos="{place}">{more}<geom type="box" size=".04 .03 .01" mass=".3"/>{fingers}</body>'


def mjcf(bodies: str, *, parts: str = "") -> str:
    """Return a file of bodies and further parts."""
    head = '<mujoco><compiler angle="radian" autolimits="true"/>'
    return f"{head}<worldbody>{bodies}</worldbody>{parts}</mujoco>"


def hand(count: int, shape: str = BOX, links: int = 2, prefix: str = "") -> tuple[str, tuple[str, ...]]:
    """Return the fingers of a hand side by side, and their tips."""
    names = [f"{prefix}f{index}" for index in range(count)]
    spread = [f"{0.02 * (index - (count - 1) / 2):.4f} .03 0" for index in range(count)]
    fingers = "".join(finger(n, place, shape, links) for n, place in zip(names, spread, strict=True))
    return fingers, tuple(f"{name}_tip" for name in names)


def jaws(joint: str = "slide") -> str:
    """Return two jaws, on slides, or on hinges that close to the middle."""
    text = ""
    for name, sign in (("left", -1), ("right", 1)):
        way = (
            f'type="slide" axis="{-sign} 0 0" range="0 .03"' if joint == "slide" else f'axis="0 {-sign} 0" range="0 .5"'
        )
        text += f'<body name="{name}" pos="{0.035 * sign} 0 .012"><joint name="{name}" {way} damping="1"/>'
        text += '<geom type="box" size=".004 .01 .02" pos="0 0 .02" mass=".03"/></body>'
    return text


def four_bar() -> str:
    """Return two jaws, each on a crank and a lever whose ends a rod joins."""
    text = ""
    for name, s in (("left", -1), ("right", 1)):
        for part, end, x, low, high in (("crank", "rod", 0.04, -0.05, 0.5), ("lever", "jaw", 0.028, -0.05, 0.55)):
            size, at = (
                ("'.003 .007 .008'", "'0 0 .01'") if end == "rod" else ("'.004 .01 .018'", f"'{-0.008 * s} 0 .018'")
            )
            text += (
                f'<body name="{name}_{part}" pos="{x * s} 0 .015"><joint name="{name}_{part}" axis="0 {-s} 0" '
                f'range="{low} {high}"/><geom type="box" size=".003 .007 .015" pos="0 0 .015" mass=".02"/>'
                f'<body name="{name}_{end}" pos="0 0 .03"><joint name="{name}_{end}" axis="0 {-s} 0" range="-.6 .2"/>'
                f'<geom type="box" size={size} pos={at} mass=".02"/></body></body>'
            )
    return text


LOOPS = "".join(
    f'<connect body1="{side}_rod" body2="{side}_jaw" anchor="0 0 {z}"/>'
    for side in ("left", "right")
    for z in (0, 0.015)
)
COUPLED = '<joint joint1="left_crank" joint2="right_crank"/>'
TENDON = '<tendon><fixed name="split"><joint joint="{0}" coef=".5"/><joint joint="{1}" coef=".5"/></fixed></tendon>'
GRIP = '<actuator><general name="grip" tendon="split" ctrlrange="0 255" gainprm=".03" biastype="affine" biasprm="0 -16 -.6"/></actuator>'


def urdf(mimic: bool) -> str:
    """Return a gripper of two hinged jaws as URDF, one mimicking the other."""
    text = '<robot name="g"><link name="palm">' + _solid(".08 .06 .02", 0.3) + "</link>"
    for name, sign in (("left", -1), ("right", 1)):
        text += f'<link name="{name}">' + _solid(".008 .02 .04", 0.03, "0 0 .02") + "</link>"
        follow = '<mimic joint="left_joint" multiplier="1"/>' if mimic and name == "right" else ""
        text += (
            f'<joint name="{name}_joint" type="prismatic"><parent link="palm"/><child link="{name}"/>{follow}'
            f'<origin xyz="{0.035 * sign} 0 .012"/><axis xyz="{-sign} 0 0"/>'
            '<limit lower="0" upper=".03" effort="10" velocity=".1"/></joint>'
        )
    return text + "</robot>"


def _solid(size: str, mass: float, at: str = "0 0 0") -> str:
    inertia = f'<inertial><mass value="{mass}"/><inertia ixx="1e-4" iyy="1e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial>'
    return f'{inertia}<collision><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></collision>'


def _gallery() -> dict[str, Model]:
    """Return models that several tests look at, by name; ``tests/robotics_bridge/hands/test_gallery.py`` has more."""
    models: dict[str, Model] = {}
    fingers, tips = hand(3)
    models["three-fingers-box"] = Model(mjcf(palm(fingers)), tips, drives=6)
    fingers, tips = hand(5, CAPSULE, 3)
    follow = "".join(f'<joint joint1="{tip}" joint2="{tip[:-4]}1" polycoef="0 .8 0 0 0"/>' for tip in tips)
    models["mimic-hand"] = Model(mjcf(palm(fingers), parts=f"<equality>{follow}</equality>"), tips, drives=10)
    (left, tips), (right, _) = (hand(3, prefix=side) for side in ("l", "r"))
    two = palm(left, "left_palm", "-.1 0 .2") + palm(right, "right_palm", ".1 0 .2")
    models["two-hands"] = Model(mjcf(two), tips, ("left_palm", "right_palm"))
    models["jaws-slide"] = Model(mjcf(palm(jaws())), ("left", "right"), drives=2)
    one = '<actuator><position joint="left" kp="500" kv="10"/></actuator><equality><joint joint1="right" joint2="left"/></equality>'
    models["coupled-jaws"] = Model(mjcf(palm(jaws()), parts=one), ("left", "right"), drives=1)
    models["urdf-mimic"] = Model(urdf(True), ("left", "right"), suffix=".urdf")
    servos = "".join(
        f'<actuator><position joint="{side}_crank" kp="5" kv=".1"/></actuator>' for side in ("left", "right")
    )
    split = TENDON.format("left_crank", "right_crank")
    for name, parts, drives in (
        ("tendon", f"{split}<equality>{LOOPS}{COUPLED}</equality>{GRIP}", 1),
        ("servos", f"<equality>{LOOPS}</equality>{servos}", 2),
        ("passive", f"<equality>{LOOPS}</equality>", 2),
    ):
        models[f"four-bar-{name}"] = Model(
            mjcf(palm(four_bar()), parts=parts), ("left_jaw", "right_jaw"), couplers=4, drives=drives
        )
    return models


GALLERY = _gallery()
