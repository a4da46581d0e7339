import os

import pytest

from brainbench.core.errors import DataError
from robotics_bridge.hands.references import checked_xml

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
