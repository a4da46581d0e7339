"""Distances to every kind of solid, against closed forms and exact triangles."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.optimize import minimize

from brainbench.geometry import Mesh
from robotics_bridge.physics import Geometry
from robotics_bridge.sensors import Probes, SensorSuite, SurfaceDistanceProbe
from robotics_bridge.sensors.queries.solids import tessellate
from tests.factories.touch_scenes import pad_scene, random_pose, rotation_of, state_of

TORUS = trimesh.creation.torus(0.012, 0.005, major_sections=48, minor_sections=24)
SIZES = {
    "plane": (),
    "sphere": (0.01,),
    "capsule": (0.006, 0.01),
    "ellipsoid": (0.004, 0.008, 0.013),
    "cylinder": (0.007, 0.011),
    "box": (0.005, 0.009, 0.012),
}
OBJECTS = [Geometry(name=kind, link=kind, kind=kind, size=size) for kind, size in SIZES.items()]
OBJECTS.append(Geometry(name="mesh", link="mesh", kind="mesh", mesh=Mesh(TORUS.vertices, TORUS.faces)))


def _points(count: int = 60) -> np.ndarray:
    return np.random.default_rng(0).uniform(-0.02, 0.02, (count, 3))


def _read(query: str) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    scene, rng = pad_scene(*OBJECTS), np.random.default_rng(1)
    probes = Probes(_points(), np.tile([0, 0, 1.0], (60, 1)), 0.001)
    sensors = {g.link: SurfaceDistanceProbe(link="hand", probes=probes, track=(g.link,), query=query) for g in OBJECTS}
    poses = np.stack([np.stack([random_pose(rng, 0.01) for _ in scene.links])])
    suite = SensorSuite(scene, sensors, num_envs=1, resolution=64)
    suite.update(state_of(scene, poses, touch=False))
    hand = poses[0, 1]
    world = rotation_of(hand[3:]).apply(_points()) + hand[:3]
    local = {}
    for g in OBJECTS:
        pose = poses[0, scene.link_index(g.link)]
        back = rotation_of(pose[3:]).inv()
        local[g.link] = back.apply(world - pose[:3])
    return {name: suite.read(name)[0].numpy() for name in sensors}, local


@pytest.fixture(scope="module")
def by_fields() -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    return _read("sdf")


@pytest.fixture(scope="module")
def by_triangles() -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    return _read("raycast")


def _ellipsoid(x: np.ndarray, axes: np.ndarray) -> float:
    def gap(angles: np.ndarray) -> float:
        t, p = angles
        return float(np.linalg.norm(axes * [np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)] - x))

    starts = [(t, p) for t in np.linspace(0.2, 2.9, 6) for p in np.linspace(-3, 3, 8)]
    best = min(gap(np.array(start)) for start in starts)
    nearest = sorted(starts, key=lambda s: gap(np.array(s)))[:3]
    best = min(
        [best, *(minimize(gap, s, method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-12}).fun for s in nearest)]
    )
    return best if ((x / axes) ** 2).sum() > 1 else -best


def _exact(kind: str, x: np.ndarray) -> np.ndarray:
    radial = np.hypot(x[:, 0], x[:, 1])
    if kind == "plane":
        return x[:, 2]
    if kind == "sphere":
        return np.linalg.norm(x, axis=1) - 0.01
    if kind == "capsule":
        return np.hypot(radial, x[:, 2] - np.clip(x[:, 2], -0.01, 0.01)) - 0.006
    if kind == "ellipsoid":
        return np.array([_ellipsoid(p, np.array(SIZES["ellipsoid"])) for p in x])
    if kind == "mesh":
        # A torus: the faceted one lies at most its sagitta inside.
        return np.hypot(radial - 0.012, x[:, 2]) - 0.005
    over = np.abs(x) - np.array(SIZES["box"])
    if kind == "cylinder":
        over = np.stack([radial - 0.007, np.abs(x[:, 2]) - 0.011], axis=1)
    return np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)


@pytest.mark.parametrize("kind", list(SIZES))
def test_distance_to_a_primitive_is_its_closed_form(kind: str, by_fields: tuple) -> None:
    read, local = by_fields
    np.testing.assert_allclose(read[kind], _exact(kind, local[kind]), atol=2e-7)


def test_distance_field_of_a_mesh_comes_within_a_tenth_of_a_cell_of_its_triangles(
    by_fields: tuple, by_triangles: tuple
) -> None:
    cell, exact = 0.034 / 96, by_triangles[0]["mesh"]
    # In the middle of the tube no cell is smooth, and samples reach a quarter of the mesh beyond its box.
    smooth = (exact > -0.003) & (exact < 0.008)
    assert smooth.sum() > 5
    assert np.abs(by_fields[0]["mesh"] - exact)[smooth].max() < 0.1 * cell


def test_triangles_of_a_torus_lie_within_their_sagitta(by_triangles: tuple) -> None:
    read, local = by_triangles
    sagitta = 0.005 * (1 - np.cos(np.pi / 24)) + 0.017 * (1 - np.cos(np.pi / 48))
    error = read["mesh"] - _exact("mesh", local["mesh"])
    assert error.max() < sagitta
    assert error.min() > -1e-5


@pytest.mark.parametrize("kind", ["sphere", "capsule", "cylinder", "box"])
def test_triangles_agree_with_fields(kind: str, by_fields: tuple, by_triangles: tuple) -> None:
    difference = np.abs(by_fields[0][kind] - by_triangles[0][kind]).max()
    assert difference < (1e-7 if kind == "box" else 4e-5)


def test_a_field_far_away_still_tells_the_distance_to_the_surface() -> None:
    scene = pad_scene(OBJECTS[-1])
    far = np.array([[0.2, 0.1, 0.05], [-0.3, 0.0, 0.4]])
    probes = Probes(far, np.tile([0, 0, 1.0], (2, 1)), 0.001)
    suite = SensorSuite(scene, {"far": SurfaceDistanceProbe(link="hand", probes=probes)}, num_envs=1)
    suite.update(state_of(scene, np.tile([0, 0, 0, 0, 0, 0, 1.0], (1, 3, 1)), touch=False))
    np.testing.assert_allclose(suite.read("far")[0].numpy(), _exact("mesh", far), rtol=6e-3)


@pytest.mark.parametrize("query", ["sdf", "raycast"])
def test_a_box_of_triangles_presses_like_a_box(query: str) -> None:
    from robotics_bridge.sensors import KinematicTaxel
    from tests.factories.touch_scenes import poses_at

    half = (0.006, 0.005, 0.004)
    cube = trimesh.creation.box(2 * np.array(half))
    shapes = {
        "box": Geometry(name="o", link="o", kind="box", size=half),
        "mesh": Geometry(name="o", link="o", kind="mesh", mesh=Mesh(cube.vertices, cube.faces)),
    }
    grid = Probes.grid(8, 8, size=(0.02, 0.02), center=(0, 0, 0.005), radius=0.002)
    read = {}
    for name, shape in shapes.items():
        scene = pad_scene(shape)
        taxel = KinematicTaxel(link="hand", probes=grid, query=query)  # type: ignore[arg-type]
        suite = SensorSuite(scene, {"t": taxel}, num_envs=1, resolution=64)
        suite.update(state_of(scene, poses_at(3, {2: (0.0003, -0.0004, 0.005 + 0.0035)})))
        read[name] = suite.read("t").numpy()
    error = np.linalg.norm(read["mesh"] - read["box"]) / np.linalg.norm(read["box"])
    assert np.abs(read["box"]).max() > 0.3
    # Samples round the edges off; triangles do not.
    assert error < (0.03 if query == "sdf" else 1e-5)


@pytest.mark.parametrize("radius", [1e-4, 0.0028, 0.01, 0.1])
def test_the_triangles_of_round_solids_close_at_every_size(radius: float) -> None:
    half = 1.5 * radius
    side = 4 * np.pi * radius * half
    expected = {"cylinder": side + 2 * np.pi * radius**2, "capsule": side + 4 * np.pi * radius**2}
    for kind, area in expected.items():
        mesh = tessellate(Geometry(name=kind, link="o", kind=kind, size=(radius, half)))
        found = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        assert found.is_watertight
        assert found.area == pytest.approx(area, rel=2e-3)
