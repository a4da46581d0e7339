"""Thin solids are felt from the side of the sensor, like thick ones whose touching face is the same."""

import numpy as np
import pytest
import trimesh

from brainbench.geometry import Mesh
from robotics_bridge.physics.scene import Geometry, TouchScene
from robotics_bridge.sensors import ContactDepthProbe, ElastomerTaxel, KinematicTaxel, Probes, SensorSuite
from robotics_bridge.sensors.queries.solids import THINNEST, least_width
from tests.factories.touch_scenes import poses_at, state_of

HALF, PRESSED = 0.15e-3, 0.24e-3
PAD = Geometry(name="pad", link="pad", kind="box", size=(0.04, 0.04, 0.01))
GRID = Probes.grid(16, 16, size=(0.08, 0.08), center=(0, 0, 0.01), radius=0.004)
FLAT = (2**-0.5, 0.0, 2**-0.5, 0.0)


def _ball(*scale: float) -> Mesh:
    solid = trimesh.creation.icosphere(3, 1.0)
    return Mesh(solid.vertices * scale, solid.faces, "ball")


def _wire(radius: float, half: float) -> Mesh:
    solid = trimesh.creation.cylinder(1e3 * radius, 2e3 * half, sections=24)
    return Mesh(1e-3 * solid.vertices, solid.faces, "wire")


def _press(half: float, pressed: float, sensors: dict, turn: tuple = (1.0, 0, 0, 0), **shape: object) -> SensorSuite:
    """Return a suite that read an object whose lower side lies ``pressed`` below the top of a pad."""
    body = Geometry(name="o", link="o", quaternion=turn, **shape)
    scene = TouchScene(("world", "pad", "o"), (PAD, body))
    suite = SensorSuite(scene, sensors, num_envs=1)
    state = state_of(scene, poses_at(3, {2: (0, 0, 0.01 - pressed + half)}))
    for _ in range(2):
        suite.update(state, 0.002)
    return suite


def _read(half: float, pressed: float = PRESSED, turn: tuple = (1.0, 0, 0, 0), **shape: object) -> tuple:
    sensors = {"law": KinematicTaxel(link="pad", probes=GRID), "gel": ElastomerTaxel(link="pad", probes=GRID, points=0)}
    suite = _press(half, pressed, sensors, turn, **shape)
    return suite.read("law")[..., 2].sum().item(), suite.read("gel").abs().max().item()


@pytest.mark.parametrize("half", [0.15e-3, 0.45e-3])
def test_a_sheet_reads_like_a_thick_block(half: float) -> None:
    thin = _read(half, 1.6 * half, kind="box", size=(0.02, 0.02, half))
    np.testing.assert_allclose(thin, _read(0.01, 1.6 * half, kind="box", size=(0.02, 0.02, 0.01)), rtol=1e-4)
    assert thin[0] < -40


@pytest.mark.slow
def test_a_disc_reads_like_a_thick_cylinder_and_a_lens_like_its_mesh() -> None:
    thick = _read(0.01, kind="cylinder", size=(0.02, 0.01))
    np.testing.assert_allclose(_read(HALF, kind="cylinder", size=(0.02, HALF)), thick, rtol=1e-4)
    lens = _read(HALF, kind="ellipsoid", size=(0.02, 0.02, HALF))
    assert lens[0] < -25
    assert _read(HALF, kind="mesh", mesh=_ball(0.02, 0.02, HALF))[0] == pytest.approx(lens[0], rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("radius", [0.15e-3, 0.4e-3, 1e-3])
def test_wires_and_beads_push_whatever_they_are_made_of(radius: float) -> None:
    """Taxels 2.7 mm beside what is pressed past its middle, and taxels under it."""
    for turn, shape in (
        ((1, 0, 0, 0), {"kind": "sphere", "size": (radius,)}),
        ((1, 0, 0, 0), {"kind": "mesh", "mesh": _ball(radius, radius, radius)}),
        (FLAT, {"kind": "capsule", "size": (radius, 0.02)}),
        (FLAT, {"kind": "mesh", "mesh": _wire(radius, 0.02)}),
    ):
        assert _read(radius, 1.6 * radius, turn, **shape)[0] < 0
    under = Probes.grid(1, 5, size=(0, 0.004), center=(0, 0, 0.01), radius=0.002)
    suite = _press(
        radius, 1.6 * radius, {"d": ContactDepthProbe(link="pad", probes=under)}, kind="sphere", size=(radius,)
    )
    assert suite.read("d").max().item() == pytest.approx(0.002 + 1.6 * radius, rel=0.01)


def test_the_back_of_a_thin_link_does_not_read_what_lies_on_its_front_as_passed() -> None:
    """A sheet on a plate of 3 mm: probes on its other side are 3 mm away, not 3 mm deep."""
    back = Probes.grid(3, 3, size=(0.01, 0.01), center=(0, 0, 0.007), normal=(0, 0, -1), radius=0.004)
    sensors = {"d": ContactDepthProbe(link="pad", probes=back)}
    suite = _press(HALF, 0.0, sensors, kind="box", size=(0.02, 0.02, HALF))
    np.testing.assert_allclose(suite.read("d").numpy(), 0.001, atol=1e-6)


def _told(shape: dict, pad: float, under: float, back: bool) -> tuple[float, float]:
    """Return depth and force of taxels on a plate, where a contact tells that the object pushes it from above."""
    link = Geometry(name="p", link="p", kind="box", size=(0.04, 0.04, pad))
    scene = TouchScene(("p", "o"), (link, Geometry(name="o", link="o", **shape)))
    side = -1 if back else 1
    probes = Probes.grid(3, 3, size=(0.004, 0.004), center=(0, 0, side * pad), normal=(0, 0, side), radius=0.004)
    sensors = {"d": ContactDepthProbe(link="p", probes=probes), "f": KinematicTaxel(link="p", probes=probes)}
    suite = SensorSuite(scene, sensors, num_envs=1)
    state = state_of(scene, poses_at(2, {1: (0, 0, pad + under)}))
    where = {"position": [[0, 0, pad]], "normal": [[0, 0, 1]], "force": [1.0], "friction": [[0, 0, 0]]}
    state.set_contacts([0], [(0, 1)], distance=[-0.001], **where)
    suite.update(state)
    return suite.read("d").max().item(), suite.read("f")[..., 2].sum().item()


@pytest.mark.parametrize("pressed", [0.5, 6.0])
@pytest.mark.parametrize("kind", ["box", "cylinder", "plate", "lens"])
def test_the_side_of_the_reported_contact_is_felt_however_deep(kind: str, pressed: float) -> None:
    """Six times as deep as a sheet is thick: what lies wholly below the surface still pushes it from above."""
    half = 0.2e-3
    plate = trimesh.creation.box((0.04, 0.04, 2 * half))
    shape = {
        "box": {"kind": "box", "size": (0.02, 0.02, half)}, "cylinder": {"kind": "cylinder", "size": (0.02, half)},
        "plate": {"kind": "mesh", "mesh": Mesh(plate.vertices, plate.faces)},
        "lens": {"kind": "mesh", "mesh": _ball(0.02, 0.02, half)},
    }[kind]  # fmt: skip
    depth, force = _told(shape, 0.01, half - 2 * half * pressed, back=False)
    assert depth == pytest.approx(0.004 + 2 * half * pressed, rel=0.01)
    assert force < -0.5


@pytest.mark.parametrize("mesh", [False, True])
def test_the_back_of_a_link_thinner_than_the_solid_is_not_pressed_through(mesh: bool) -> None:
    """A plate of 2 mm on a shell of .8 mm: probes on the back lie .8 mm from it."""
    plate = trimesh.creation.box((0.04, 0.04, 0.002))
    shape = {"kind": "box", "size": (0.02, 0.02, 0.001)}
    if mesh:
        shape = {"kind": "mesh", "mesh": Mesh(plate.vertices, plate.faces)}
    assert _told(shape, 0.0004, 0.001, back=True)[0] == pytest.approx(0.0032, abs=1e-6)


def test_a_solid_is_thin_by_its_least_width() -> None:
    assert least_width(Geometry(name="a", link="a", kind="cylinder", size=(0.02, 0.001))) == 0.002 < THINNEST
    assert least_width(Geometry(name="a", link="a", kind="capsule", size=(0.002, 0.0001))) == 0.004
