"""Thin walls against closed forms of thick ones, however they are pressed and stored; meshes that are no solids."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from robotics_bridge.physics import Geometry, TouchScene
from robotics_bridge.sensors import (
    ContactDepthProbe,
    ElastomerTaxel,
    KinematicTaxel,
    Noise,
    Probes,
    ProximityTaxel,
    SensorSuite,
)
from robotics_bridge.sensors.queries.solids import list_by_cells, surface_points
from tests.factories.touch_scenes import PAD, pad_scene, poses_at, state_of

WALLS = (0.0002, 0.0005, 0.001, 0.003)
RADIUS = 0.03


def _revolved(profile: list[tuple[float, float]]) -> trimesh.Trimesh:
    return trimesh.creation.revolve(np.array([*profile, profile[0]]), sections=256)


def _cup(t: float) -> trimesh.Trimesh:
    """A cup of outer radius 30 mm, 60 mm high, open above."""
    inner = RADIUS - t
    return _revolved([(0, -0.03), (RADIUS, -0.03), (RADIUS, 0.03), (inner, 0.03), (inner, -0.03 + t), (0, -0.03 + t)])


def _tray(t: float) -> trimesh.Trimesh:
    """A box of 60 × 60 × 40 mm without a lid, its floor in the plane z = −20 mm."""
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    rings = [(0.03, -0.02), (0.03, 0.02), (0.03 - t, 0.02), (0.03 - t, -0.02 + t)]
    vertices = np.concatenate([np.c_[half * square, np.full(4, z)] for half, z in rings])
    faces = [(0, 2, 1), (0, 3, 2), (12, 13, 14), (12, 14, 15)]
    for ring in range(3):
        for k in range(4):
            a, b = 4 * ring + k, 4 * ring + (k + 1) % 4
            faces += [(a, b, b + 4), (a, b + 4, a + 4)]
    return trimesh.Trimesh(vertices, faces, process=False)


def _plate(t: float) -> trimesh.Trimesh:
    return trimesh.creation.box((0.1, 0.08, t))


def _depths(solid: Mesh, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Depths at places in the frame of the solid."""
    probes = Probes(points, normals, 0.002)
    scene = TouchScene(
        ("hand", "o"),
        (Geometry(name="h", link="hand", kind="sphere", size=(0.001,)),
         Geometry(name="o", link="o", kind="mesh", mesh=solid)),
    )  # fmt: skip
    suite = SensorSuite(scene, {"d": ContactDepthProbe(link="hand", probes=probes)}, num_envs=1)
    suite.update(state_of(scene, poses_at(2, {})))
    return suite.read("d")[0].numpy()


@pytest.mark.parametrize("thickness", WALLS)
@pytest.mark.parametrize("side", [-1, 1])
def test_a_plate_presses_like_a_thick_one_from_either_side_however_deep(thickness: float, side: int) -> None:
    grid = Probes.grid(5, 5, size=(0.01, 0.01), center=(0, 0, 0.005), radius=0.002)
    plate = _plate(thickness)
    depths, read = (2e-5, 1e-4, 1.5e-4, 2e-4, 5e-4, 1.2e-3), []
    for shape, half in (
        (Geometry(name="o", link="o", kind="mesh", mesh=Mesh(plate.vertices, plate.faces)), thickness / 2),
        (Geometry(name="o", link="o", kind="box", size=(0.05, 0.04, 0.03)), 0.03),
    ):
        scene = pad_scene(shape)
        suite = SensorSuite(scene, {"f": KinematicTaxel(link="hand", probes=grid)}, num_envs=len(depths))
        poses = poses_at(3, {2: (0.002, 0.001, 0.005 + half)}, len(depths))
        poses[:, 2, 2] -= depths
        poses[:, 2, 3:] = (1, 0, 0, 0) if side > 0 else (0, 1, 0, 0)
        suite.update(state_of(scene, poses))
        read.append(suite.read("f").numpy())
    np.testing.assert_allclose(read[0], read[1], atol=1e-3 * np.abs(read[1]).max())


@pytest.mark.parametrize("thickness", WALLS)
@pytest.mark.parametrize("inside", [False, True])
def test_the_wall_of_a_cup_is_felt_from_outside_and_inside(thickness: float, inside: bool) -> None:
    rng = np.random.default_rng(0)
    angle, depth = rng.uniform(0, 2 * np.pi, 200), rng.uniform(-0.0015, 0.0015, 200)
    way = np.c_[np.cos(angle), np.sin(angle), np.zeros(200)]
    surface, sign = (RADIUS - thickness, 1) if inside else (RADIUS, -1)
    points = way * (surface + sign * depth)[:, None] + [0, 0, 1] * rng.uniform(-0.015, 0.015, (200, 1))
    cup = _cup(thickness)
    read = _depths(Mesh(cup.vertices, cup.faces), points, sign * way)
    np.testing.assert_allclose(read, 0.002 + depth, rtol=0.02)


@pytest.mark.parametrize("thickness", WALLS[:2])
@pytest.mark.parametrize("stored", ["arrays", "soup", "inverted", "stl", "obj", "mujoco"])
@pytest.mark.filterwarnings("ignore:The mesh .* is not a sound solid:RuntimeWarning")
def test_a_box_without_a_lid_is_felt_however_it_is_stored(thickness: float, stored: str, tmp_path: Path) -> None:
    from brainbench.geometry import load_mesh

    tray = _tray(thickness)
    solid = Mesh(tray.vertices, tray.faces, "tray")
    if stored == "soup":
        solid = Mesh(tray.triangles.reshape(-1, 3), np.arange(3 * len(tray.faces)), "tray")
    elif stored == "inverted":
        solid = Mesh(tray.vertices, tray.faces[:, ::-1], "tray")
    elif stored != "arrays":
        path = tmp_path / f"tray.{'obj' if stored == 'obj' else 'stl'}"
        tray.export(path)
        solid = load_mesh(path, unit="m")
        if stored == "mujoco":
            model = mujoco.MjModel.from_xml_string(
                f'<mujoco><asset><mesh name="m" file="{path}"/></asset><worldbody><body name="o">'
                '<geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
            )
            shape = TouchScene.from_mujoco(model).geometries[0]
            assert shape.mesh is not None
            turn = trimesh.transformations.quaternion_matrix(shape.quaternion)[:3, :3]
            solid = shape.mesh.transformed(turn, shape.position)
    rng = np.random.default_rng(1)
    depth = rng.uniform(-0.0015, 0.0015, 60)
    across = rng.uniform(-0.02, 0.02, 60)
    walls = {
        "below": ((across, 0 * across, -0.02 + depth), (0, 0, 1)),
        "floor": ((across, 0 * across, -0.02 + thickness - depth), (0, 0, -1)),
        "side": ((0.03 - depth, across / 2, 0 * across), (-1, 0, 0)),
        "side from within": ((0.03 - thickness + depth, across / 2, 0 * across), (1, 0, 0)),
    }
    for place, normal in walls.values():
        read = _depths(solid, np.stack(place, axis=1), np.tile(normal, (60, 1)).astype(float))
        np.testing.assert_allclose(read, 0.002 + depth, rtol=0.02)


def test_a_thin_wall_that_does_not_face_a_taxel_is_only_near() -> None:
    """A plate behind a finger: taxels on the other side of it are not pressed through."""
    plate = _plate(0.0002)
    points = np.array([[0, 0, 0.0001 + 0.003], [0, 0, 0.0001 + 0.0015]])
    read = _depths(Mesh(plate.vertices, plate.faces), points, np.array([[0, 0, 1.0], [0, 0, -1.0]]))
    np.testing.assert_allclose(read, [0, 0.0005], atol=1e-7)


def test_an_elastomer_is_indented_by_a_thin_wall_as_by_a_thick_one() -> None:
    grid = Probes.grid(7, 7, size=(0.012, 0.012), center=(0, 0, 0.005), radius=0.002)
    plate, read = _plate(0.0002), []
    for shape, half in (
        (Geometry(name="o", link="o", kind="mesh", mesh=Mesh(plate.vertices, plate.faces)), 0.0001),
        (Geometry(name="o", link="o", kind="box", size=(0.05, 0.04, 0.03)), 0.03),
    ):
        scene = pad_scene(shape)
        suite = SensorSuite(scene, {"e": ElastomerTaxel(link="hand", probes=grid, points=0)}, num_envs=1)
        suite.update(state_of(scene, poses_at(3, {2: (0.04, 0, 0.005 + half - 4e-4)})))
        read.append(suite.read("e").numpy())
    np.testing.assert_allclose(read[0], read[1], atol=0.02 * np.abs(read[1]).max())


def test_meshes_that_are_no_solids_are_refused_or_said() -> None:
    box = trimesh.creation.box((0.02, 0.02, 0.01))
    sheet = Mesh([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0)], [(0, 1, 2)], "sheet")
    double = Mesh(sheet.vertices, [(0, 1, 2), (0, 2, 1)], "double")
    for mesh in (sheet, double):
        scene = pad_scene(Geometry(name="o", link="o", kind="mesh", mesh=mesh))
        with pytest.raises(UsageError, match=f"{mesh.name!r} has no thickness"):
            SensorSuite(
                scene,
                {"d": ContactDepthProbe(link="hand", probes=Probes.grid(2, 2, size=(1e-2, 1e-2), center=(0, 0, 5e-3)))},
                num_envs=1,
            )
    for mesh, word in (
        (Mesh(box.vertices, box.faces[2:], "lidless"), "open edges"),
        (Mesh(box.vertices, box.faces[:, ::-1], "inverted"), "inside out"),
    ):
        scene = pad_scene(Geometry(name="o", link="o", kind="mesh", mesh=mesh), pad=PAD)
        with pytest.warns(RuntimeWarning, match=f"{mesh.name!r}.*{word}"):
            suite = SensorSuite(
                scene,
                {"d": ContactDepthProbe(link="hand", probes=Probes([[0, 0, 0.005]], [[0, 0, 1.0]], 1e-3))},
                num_envs=1,
            )
        suite.update(state_of(scene, poses_at(3, {2: (0, 0, 0.0099)})))
        if word == "inside out":
            assert suite.read("d").item() == pytest.approx(0.0011, rel=0.02)


OBJECTS = (
    Geometry(name="box", link="box", kind="box", size=(0.01, 0.006, 0.004), position=(0.003, 0, 0)),
    Geometry(name="ball", link="ball", kind="sphere", size=(0.006,)),
)


def test_points_cover_a_surface_evenly() -> None:
    box = Geometry(name="b", link="b", kind="box", size=(1.0, 1.0, 0.5))
    points = surface_points(box, 2000)
    assert (np.abs(np.abs(points) / [1.0, 1.0, 0.5]).max(axis=1) > 1 - 1e-9).all()
    top = points[points[:, 2] > 0.5 - 1e-9]
    assert len(top) == pytest.approx(2000 * 4 / 16, rel=0.02)
    # Random points would leave one cell of 100 without any in half of all draws, and 15 % of scatter in quarters.
    cells = np.histogram2d(top[:, 0], top[:, 1], bins=10, range=[[-1, 1], [-1, 1]])[0]
    assert cells.min() >= 2
    quarters = cells.reshape(2, 5, 2, 5).sum(axis=(1, 3))
    assert quarters.max() / quarters.min() < 1.1


def test_cells_hold_every_point_within_reach_in_order() -> None:
    noise = Noise(radius=1e-3, gain=(0.5, 1.5))
    free = Probes(np.random.default_rng(0).normal(0, 0.01, (75, 3)), [[0, 0, 1.0]] * 75, [0.0, *np.full(74, 0.006)])
    sensors = {
        "grid": ProximityTaxel(link="hand", probes=Probes.grid(7, 11, size=(0.03, 0.02), center=(0, 0, 0.005))),
        "free": ProximityTaxel(link="hand", probes=free, noise=noise),
    }
    scene = pad_scene(*OBJECTS)
    suites = [SensorSuite(scene, sensors, num_envs=3) for _ in range(2)]
    # With a reach of 10 m every cell lists all points.
    runtime = suites[1].runtimes[0]
    runtime._cells = list_by_cells(runtime.cloud, 10.0, "cpu")  # type: ignore[attr-defined]
    poses = poses_at(len(scene.links), {}, 3)
    poses[:, 2, :3] = (0.002, 0.001, 0.011)
    poses[:, 3, :3] = (-0.006, 0.002, 0.012)
    poses[1, 3, 2] = 0.5
    poses[2, 2, 0] = np.nan
    velocity = np.random.default_rng(1).normal(0, 0.5, (3, len(scene.links), 6))
    for suite in suites:
        suite.update(state_of(scene, poses, velocity, touch=False))
    for name in sensors:
        assert np.isnan(suites[0].read(name)[2].flatten(0, -2).numpy()[5]).all()
        for read in ("read", "read_ground_truth"):
            found, expected = (getattr(suite, read)(name).numpy() for suite in suites)
            assert (np.abs(expected[:2]).max(axis=(1, 2) if name == "free" else (1, 2, 3)) > 0.05).all()
            np.testing.assert_array_equal(found, expected)
