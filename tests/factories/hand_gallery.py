"""Synthetic hand files of the kinds that are in public use: grippers, linkages, tendons, hands on arms and pairs."""

# ruff: noqa: E501

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

SHAPES = {
    "box": lambda half: f'type="box" size=".007 {half} .006" pos="0 {half} 0"',
    "capsule": lambda half: f'type="capsule" size=".007" fromto="0 .004 0 0 {2 * half} 0"',
    "cylinder": lambda half: f'type="cylinder" size=".007 {half}" pos="0 {half} 0" euler="1.5708 0 0"',
    "ellipsoid": lambda half: f'type="ellipsoid" size=".008 {half} .008" pos="0 {half} 0"',
    "mesh": lambda half: f'type="mesh" mesh="phalanx" pos="0 {half} 0"',
    "soft": lambda half: (
        f'type="capsule" size=".007" fromto="0 .004 0 0 {2 * half} 0" solref=".02 1" solimp=".6 .95 .01"'
    ),
}
MESH = '<asset><mesh name="phalanx" vertex="-.007 -.015 -.006 .007 -.015 -.006 -.007 .015 -.006 .007 .015 -.006 -.005 -.015 .006 .005 -.015 .006 -.005 .013 .006 .005 .013 .006"/></asset>'


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


def finger(name: str, place: str, shape: str = "box", links: int = 2, more: str = "") -> str:
    """Return a finger of hinges that bend up; ``more`` stands in its last link."""
    text, parts = "", [f"{name}{index}" for index in range(links - 1)] + [f"{name}_tip"]
    for index, part in enumerate(parts):
        at = place if index == 0 else "0 .036 0"
        text += f'<body name="{part}" pos="{at}"><joint name="{part}" axis="1 0 0" range="0 1.5" damping=".01"/>'
        text += f'<geom {SHAPES[shape](0.015)} mass=".02"/>'
    return text + more + "</body>" * links


def palm(fingers: str, name: str = "palm", place: str = "0 0 .2", more: str = "") -> str:
    """Return a palm with fingers."""
    return f'<body name="{name}" pos="{place}">{more}<geom type="box" size=".04 .03 .01" mass=".3"/>{fingers}</body>'


def mjcf(bodies: str, *, parts: str = "", mesh: bool = False) -> str:
    """Return a file of bodies and further parts."""
    head = '<mujoco><compiler angle="radian" autolimits="true"/>' + (MESH if mesh else "")
    return f"{head}<worldbody>{bodies}</worldbody>{parts}</mujoco>"


def hand(count: int, shape: str = "box", links: int = 2, prefix: str = "") -> tuple[str, tuple[str, ...]]:
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
JAWS = ("left_jaw", "right_jaw")


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


def arm(tool: str) -> str:
    """Return an arm of three hinges that carries a tool."""
    text = ""
    for index, axis in enumerate(("0 0 1", "0 1 0", "0 1 0")):
        text += f'<body name="arm{index}" pos="0 0 .3"><joint name="arm{index}" axis="{axis}" range="-2 2"/>'
        text += '<geom type="capsule" size=".03" fromto="0 0 0 0 0 .25" mass="1"/>'
    return text + tool + "</body>" * 3


def gallery() -> dict[str, Model]:
    """Return the models by name."""
    models: dict[str, Model] = {}
    for shape in SHAPES:
        fingers, tips = hand(3, shape)
        models[f"three-fingers-{shape}"] = Model(mjcf(palm(fingers), mesh=shape == "mesh"), tips, drives=6)
    for count, links in ((2, 3), (4, 3), (5, 3)):
        fingers, tips = hand(count, "capsule", links)
        models[f"{count}-fingers"] = Model(mjcf(palm(fingers)), tips, drives=count * links)
    fingers, tips = hand(5, "capsule", 3)
    follow = "".join(f'<joint joint1="{tip}" joint2="{tip[:-4]}1" polycoef="0 .8 0 0 0"/>' for tip in tips)
    models["mimic-hand"] = Model(mjcf(palm(fingers), parts=f"<equality>{follow}</equality>"), tips, drives=10)
    fork = finger("fork", "0 .03 0", more=finger("a", "-.01 .036 0") + finger("b", ".01 .036 0"))
    models["forked-finger"] = Model(mjcf(palm(finger("f", "-.03 .03 0") + fork)), ("f_tip", "a_tip", "b_tip"))
    models["floating"] = Model(mjcf(palm(fingers, more="<freejoint/>")), tips)
    models["hand-on-arm"] = Model(mjcf(arm(palm(fingers, place="0 0 .26"))), tips)
    pair = [hand(3, "box", 2, side) for side in ("l", "r")]
    two = palm(pair[0][0], "left_palm", "-.1 0 .2") + palm(pair[1][0], "right_palm", ".1 0 .2")
    models["two-hands"] = Model(mjcf(two), pair[0][1], ("left_palm", "right_palm"))
    five = [hand(5, "capsule", 2, side) for side in ("l", "r")]
    arms = "".join(
        f'<body name="{side}_shoulder" pos="{x} 0 .4"><joint name="{side}_shoulder" axis="0 1 0" range="-1 1"/>'
        f'<geom type="capsule" size=".03" fromto="0 0 0 0 0 .3" mass="1"/>{palm(f[0], f"{side}_palm", "0 0 .35")}</body>'
        for side, x, f in zip("lr", (-0.3, 0.3), five, strict=True)
    )
    head = '<body name="head" pos="0 0 .5"><joint axis="0 0 1" range="-1 1"/><geom size=".08" mass="1"/></body>'
    torso = f'<body name="torso"><geom type="box" size=".1 .1 .3" mass="9"/>{head}{arms}</body>'
    models["torso"] = Model(mjcf(torso), five[0][1], ("l_palm", "r_palm"))
    for joint in ("slide", "hinge"):
        models[f"jaws-{joint}"] = Model(mjcf(palm(jaws(joint))), ("left", "right"), drives=2)
    split = TENDON.format("left", "right")
    models["tendon-jaws"] = Model(mjcf(palm(jaws()), parts=split + GRIP), ("left", "right"), drives=1)
    one = '<actuator><position joint="left" kp="500" kv="10"/></actuator><equality><joint joint1="right" joint2="left"/></equality>'
    models["coupled-jaws"] = Model(mjcf(palm(jaws()), parts=one), ("left", "right"), drives=1)
    models["jaws-on-arm"] = Model(mjcf(arm(palm(jaws(), place="0 0 .26"))), ("left", "right"))
    models["urdf-jaws"] = Model(urdf(False), ("left", "right"), suffix=".urdf", drives=2)
    models["urdf-mimic"] = Model(urdf(True), ("left", "right"), suffix=".urdf")
    split = TENDON.format("left_crank", "right_crank")
    parts = f"{split}<equality>{LOOPS}{COUPLED}</equality>{GRIP}"
    models["four-bar-tendon"] = Model(mjcf(palm(four_bar()), parts=parts), JAWS, couplers=4, drives=1)
    parts = f"<equality>{LOOPS}</equality>" + "".join(
        f'<actuator><position joint="{side}_crank" kp="5" kv=".1"/></actuator>' for side in ("left", "right")
    )
    models["four-bar-servos"] = Model(mjcf(palm(four_bar()), parts=parts), JAWS, couplers=4, drives=2)
    models["four-bar-passive"] = Model(
        mjcf(palm(four_bar()), parts=f"<equality>{LOOPS}</equality>"), JAWS, couplers=4, drives=2
    )
    thumb = '<body name="thumb" pos="0 .03 0"><joint name="thumb" axis="1 0 0" range="0 1.5"/>'
    thumb += '<geom type="box" size=".01 .02 .005" pos="0 .02 0" mass=".02"/></body>'
    models["single-jaw"] = Model(mjcf(palm(thumb)), ("thumb",), drives=1)
    return models


GALLERY = gallery()
