"""Files of hands: endings, included files, inertias and defaults as their authors leave them."""

from __future__ import annotations

import os

import mujoco
import numpy as np
import pytest

from brainbench.core.errors import DataError
from robotics_bridge import hands
from robotics_bridge.hands.files import checked_xml, clear_defaults
from robotics_bridge.hands.scenes import holding, replace_drives

HAND = """<mujoco><compiler angle="radian"/>{}<worldbody>{}
<body name="palm"><geom type="box" size=".02 .03 .01" mass=".3"/>
<body name="tip" pos="0 .03 0"><joint name="a" axis="1 0 0" range="0 1.5"/><geom type="sphere" size=".01" mass=".05"/>
</body></body></worldbody></mujoco>"""


def _asset(text):
    return HAND.format(f"<asset>{text}</asset>", "")


NAMED = {
    "a picture": '<texture name="t" type="2d" file="{}"/>',
    "a height field": '<hfield name="t" size="1 1 1 1" file="{}"/>',
    "a mesh": '<mesh name="t" file="{}"/>',
    "a skin": '<skin name="t" file="{}"/>',
    "a side of a cube": '<texture name="t" type="cube" fileright="{}"/>',
    "a model": '<model name="t" file="{}"/>',
}
SIZES = {
    "a height field": _asset('<hfield name="h" nrow="30000" ncol="30000" size="1 1 1 1"/>'),
    "a picture": _asset('<texture name="t" type="2d" builtin="flat" width="100000" height="100000"/>'),
    "copies": HAND.format("", '<replicate count="100000000"><geom size=".01"/></replicate>'),
    "copies of copies": HAND.format(
        "", '<replicate count="200"><replicate count="200"><geom size=".01"/></replicate></replicate>'
    ),
    "a flexible body": HAND.format("", '<flexcomp name="f" type="grid" count="900 900 900" spacing="1 1 1"/>'),
    "a composite": HAND.format("", '<composite type="cable" count="1000000 1 1"/>'),
    "memory": HAND.format('<size memory="900G"/>', ""),
    "tables": HAND.format('<size nuserdata="2000000000"/>', ""),
    "a deep tree": HAND.format("", "<body>" * 5000 + "</body>" * 5000),
}


@pytest.mark.parametrize("place", ["pipe", "device", "outside", "link"])
@pytest.mark.parametrize("kind", NAMED)
def test_what_a_hand_names_is_a_regular_file_of_its_folder(tmp_path, kind, place):
    folder = tmp_path / "above" / "hand"
    folder.mkdir(parents=True)
    os.mkfifo(folder / "pipe")
    (tmp_path / "outside").write_text("PRIVATE")
    (folder / "link").symlink_to(tmp_path / "outside")
    name = {"pipe": "pipe", "device": "/dev/zero", "outside": "../../outside", "link": "link"}[place]
    path = folder / "hand.xml"
    path.write_text(_asset(NAMED[kind].format(name)))
    with pytest.raises(DataError) as caught:
        checked_xml(path)
    assert name in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize("case", SIZES)
def test_declared_sizes_have_bounds(tmp_path, case):
    path = tmp_path / "hand.xml"
    path.write_text(SIZES[case])
    with pytest.raises(DataError, match=r"hand\.xml"):
        checked_xml(path)


def test_a_file_that_includes_itself_is_refused(tmp_path):
    (tmp_path / "a.xml").write_text('<mujoco><include file="b.xml"/></mujoco>')
    (tmp_path / "b.xml").write_text('<mujoco><include file="a.xml"/></mujoco>')
    with pytest.raises(DataError, match="includes itself"):
        checked_xml(tmp_path / "a.xml")


def test_meshes_of_the_folder_and_of_the_one_beside_it_are_read(tmp_path):
    (tmp_path / "urdf" / "meshes").mkdir(parents=True)
    (tmp_path / "meshes").mkdir()
    for folder in ("urdf/meshes", "meshes"):
        (tmp_path / folder / "a.stl").write_bytes(b"solid")
    path = tmp_path / "urdf" / "hand.urdf"
    names = ("meshes/a.stl", "../meshes/a.stl", "package://robot/meshes/a.stl", "gone.stl")
    meshes = "".join(f"<mesh filename='{name}'/>" for name in names)
    path.write_text(f"<robot>{meshes}</robot>")
    assert len(list(checked_xml(path))) == len(names)


def _fingers(geom: str = "") -> str:
    return "".join(
        f"""<body name="{name}_base" pos="{x} .03 0"><joint name="{name}_bend" axis="1 0 0" range="0 1.5"/>
        <geom {geom} type="box" size=".007 .015 .006" pos="0 .016 0" mass=".02"/>
        <body name="{name}_tip" pos="0 .033 0"><joint name="{name}_curl" axis="1 0 0" range="0 1.5"/>
        <geom {geom} type="box" size=".006 .013 .005" pos="0 .014 0" mass=".015"/></body></body>"""
        for name, x in (("near", 0), ("mid", 0.02), ("far", -0.02))
    )


def _write_hand(path, defaults="", geom="", drives=""):
    path.write_text(
        f"""<mujoco><compiler angle="radian" autolimits="true"/><default>{defaults}</default><worldbody>
        <body name="palm"><geom {geom} type="box" size=".03 .03 .01" mass=".2"/>{_fingers(geom)}</body></worldbody>
        <actuator>{drives}</actuator></mujoco>"""
    )
    return path


_DRIVES = "".join(f'<position joint="{f}_{j}" kp="2"/>' for f in ("near", "mid", "far") for j in ("bend", "curl"))
_LEAKS = {
    "collision": '<geom contype="0" conaffinity="0"/>'
    '<default class="hand"><geom contype="1" conaffinity="1"/></default>',
    "mass": '<geom mass="2" margin=".01"/>',
    "joints": '<joint damping="5" stiffness="2"/><default class="hand"><joint damping="0" stiffness="0"/></default>',
    "drives": '<general gear="3" ctrllimited="true" ctrlrange="0 1" dyntype="filter" forcelimited="true"'
    ' forcerange="-1 1"/>',
}


@pytest.mark.parametrize("leak", _LEAKS)
def test_defaults_of_a_hand_file_change_nothing_that_a_scene_adds(tmp_path, leak):
    plain = holding(hands.load(_write_hand(tmp_path / "plain.xml")))
    geom = 'class="hand"' if leak == "collision" else ""
    model = holding(hands.load(_write_hand(tmp_path / "hand.xml", _LEAKS[leak], geom)))
    for name in ("actuator_gear", "actuator_ctrllimited", "actuator_forcerange", "actuator_dyntype", "body_mass"):
        assert np.array_equal(getattr(model, name), getattr(plain, name)), name
    for name in ("contype", "conaffinity", "margin", "friction"):
        assert np.array_equal(getattr(model.geom("object"), name), getattr(plain.geom("object"), name)), name


def test_the_elements_of_a_hand_file_keep_their_defaults(tmp_path):
    defaults = '<geom friction=".3 .1 .1" margin=".002"/><joint damping=".4"/><general gear="3" ctrllimited="true"/>'
    drives = _DRIVES.replace("/>", ' ctrlrange="0 1.5"/>')
    spec = mujoco.MjSpec.from_file(str(_write_hand(tmp_path / "hand.xml", defaults, drives=drives)))
    before = spec.copy().compile()
    clear_defaults(spec)
    for after in (spec.copy().compile(), mujoco.MjSpec.from_string(spec.to_xml()).compile()):
        for name in ("geom_friction", "geom_margin", "dof_damping", "actuator_gear", "actuator_ctrllimited"):
            assert np.array_equal(getattr(after, name), getattr(before, name)), name
    replace_drives(spec)
    assert (spec.compile().actuator_gear[:, 0] == 1).all()


def test_a_file_that_ends_in_mjcf_loads_like_one_that_ends_in_xml(tmp_path):
    (tmp_path / "parts" / "meshes").mkdir(parents=True)
    corners = "v 0 0 0\nv .01 0 0\nv 0 .01 0\nv 0 0 .01\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "tip.obj").write_text(corners)
    (tmp_path / "parts" / "outer.xml").write_text('<mujoco><include file="parts/inner.xml"/></mujoco>')
    (tmp_path / "parts" / "inner.xml").write_text(
        f'<mujoco><asset><mesh name="tip" file="tip.obj"/></asset><worldbody><body name="palm">{_fingers()}'
        '<geom type="mesh" mesh="tip"/></body></worldbody></mujoco>'
    )
    text = '<mujoco><compiler angle="radian"/><include file="parts/outer.xml"/></mujoco>'
    for ending in ("xml", "mjcf"):
        (tmp_path / f"hand.{ending}").write_text(text)
    xml, mjcf = (hands.load(tmp_path / f"hand.{ending}") for ending in ("xml", "mjcf"))
    assert (mjcf.palm, mjcf.fingers, mjcf.physics) == (xml.palm, xml.fingers, xml.physics)
    assert np.array_equal(mjcf.model.mesh_vert, xml.model.mesh_vert)
    (tmp_path / "parts" / "inner.xml").write_text('<mujoco><worldbody><body pos="0 inf 0"/></worldbody></mujoco>')
    with pytest.raises(DataError, match=r"'pos' of <body> .*inner\.xml"):
        hands.load(tmp_path / "hand.mjcf")


def _urdf(path, inertia):
    links, joints = "", ""
    for name, parent in (("palm", ""), ("base", "palm"), ("tip", "base"), ("thumb", "palm")):
        xx, yy, zz = inertia if name == "tip" else (3e-6, 2e-6, 3e-6)
        links += (
            f'<link name="{name}"><inertial><mass value=".03"/><inertia ixx="{xx}" iyy="{yy}" izz="{zz}" ixy="0"'
            ' ixz="0" iyz="0"/></inertial>'
            '<collision><geometry><box size=".014 .03 .012"/></geometry></collision></link>'
        )
        if parent:
            joints += (
                f'<joint name="{name}_joint" type="revolute"><parent link="{parent}"/><child link="{name}"/>'
                '<origin xyz="0 .03 0"/><axis xyz="1 0 0"/>'
                '<limit lower="0" upper="1.5" effort="2" velocity="4"/></joint>'
            )
    path.write_text(f'<robot name="r">{links}{joints}</robot>')
    return path


def test_an_inertia_that_no_body_can_have_is_balanced_and_its_link_named(tmp_path, caplog):
    hand = hands.load(_urdf(tmp_path / "hand.urdf", (1e-6, 1e-6, 4e-6)))
    assert hand.model.body("tip").inertia == pytest.approx([2e-6] * 3)
    assert hand.model.body("base").inertia == pytest.approx([3e-6, 3e-6, 2e-6])
    assert "'tip'" in caplog.text
    assert "'base'" not in caplog.text
    caplog.clear()
    assert hands.load(_urdf(tmp_path / "flat.urdf", (1e-6, 1e-6, 2e-6))).model.body("tip").inertia[0] == 2e-6
    assert "inertia" not in caplog.text
    with pytest.raises(DataError, match=r"inertia of link 'tip' .*negative\.urdf.* below 0"):
        hands.load(_urdf(tmp_path / "negative.urdf", (-1e-6, 2e-6, 2e-6)))
