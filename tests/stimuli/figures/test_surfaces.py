import math

import numpy as np
import pytest

from brainbench.geometry import Mesh
from brainbench.stimuli.figures.surfaces import ball, corner_normals, object_surface, part_mesh, smoothed, tube
from brainbench.stimuli.motion.trajectories import Spin, Translation
from brainbench.stimuli.objects import procedural
from brainbench.stimuli.objects.mesh_solids import mesh_solid, shape_solid
from brainbench.stimuli.objects.obstacle import Box, Capsule, Cylinder, Sphere
from brainbench.stimuli.objects.placed_object import PlacedObject
from brainbench.stimuli.objects.primitives import box, rodgers_solid, sphere

START, END, R = (1e-3, 2e-3, -1e-3), (3e-3, -1e-3, 5e-3), 1.5e-3
LENGTH = math.dist(START, END)
TURNED = (math.cos(0.4), 0.0, math.sin(0.4), 0.0)


@pytest.mark.parametrize(
    ("part", "volume"),
    [
        (Sphere(START, R), 4 / 3 * math.pi * R**3),
        (Cylinder(START, END, R), math.pi * R**2 * LENGTH),
        (Capsule(START, END, R), math.pi * R**2 * LENGTH + 4 / 3 * math.pi * R**3),
        (Box(START, (1e-3, 2e-3, 3e-3), TURNED), 8 * 6e-9),
    ],
    ids=lambda item: type(item).__name__,
)
def test_a_drawn_part_is_the_part_that_is_touched(part, volume):
    mesh = part_mesh(part)
    solid = mesh.scaled(1e3).to_trimesh()
    assert solid.is_watertight
    assert solid.volume == pytest.approx(volume * 1e9, rel=0.01)
    np.testing.assert_allclose(mesh.bounds, part.bounds(), atol=0.01 * R)


def test_a_turning_object_is_drawn_where_it_is_touched():
    spin = Spin((0.0, 0.0, math.pi), onset=0.0)
    for solid in (box((2e-3, 4e-3, 6e-3)), shape_solid(procedural.make("brick", 0), diagonal=8e-3)):
        surface = object_surface(PlacedObject(solid, (0.01, 0.02, 0.03), motion=spin))
        corners = surface.at(0.5, (1, 1, 1)).corners.reshape(-1, 3)
        low, high = solid.bounds
        # A quarter turn about the object's own z: (x, y) becomes (−y, x).
        expected = np.array([[-high[1], low[0], low[2]], [-low[1], high[0], high[2]]])
        drawn = np.array([corners.min(axis=0), corners.max(axis=0)]) - [0.01, 0.02, 0.03]
        np.testing.assert_allclose(drawn, expected, atol=1e-9)


def test_round_surfaces_are_shaded_smoothly_and_edges_sharply():
    round_mesh = part_mesh(Sphere((0.0, 0.0, 0.0), R))
    radial = round_mesh.vertices[round_mesh.faces] / R
    assert (np.sum(corner_normals(round_mesh) * radial, axis=-1) > math.cos(math.radians(1))).all()
    edged = part_mesh(Box((0.0, 0.0, 0.0), (1e-3, 1e-3, 1e-3)))
    assert np.allclose(np.abs(corner_normals(edged)).max(axis=-1), 1)


def test_an_object_is_drawn_where_it_is_touched():
    item = PlacedObject(rodgers_solid(), (1e-3, 2e-3, 3e-3), (0.1, 0.2, 0.3), Translation((0.1, 0.0, 0.0), 0.0))
    surface, obstacle = object_surface(item), item.obstacle()
    corners = np.vstack([part.vertices for part in obstacle.parts])
    for time in (0.0, 0.02):
        drawn = surface.at(time, (1.0, 1.0, 1.0)).corners.reshape(-1, 3)
        moved = corners + obstacle.motion(np.array([time]))[0]
        np.testing.assert_allclose(drawn.min(axis=0), moved.min(axis=0), atol=1e-9)
        np.testing.assert_allclose(drawn.max(axis=0), moved.max(axis=0), atol=1e-9)


def test_objects_without_a_mesh_are_drawn_from_their_parts(tmp_path):
    assert len(object_surface(PlacedObject(sphere(R))).corners) > 1000
    plain = object_surface(PlacedObject(box((1e-3, 2e-3, 3e-3))))
    path = tmp_path / "box.off"
    part_mesh(Box((0.0, 0.0, 0.0), (0.5, 1.0, 1.5))).to_trimesh().export(path)
    read = object_surface(PlacedObject(mesh_solid(path, unit="mm")))
    np.testing.assert_allclose(np.sort(plain.corners, axis=0), np.sort(read.corners, axis=0), atol=1e-9)


def test_a_tube_encloses_the_cone_it_stands_for():
    line = np.linspace([0.0, 0.0, 0.0], [6e-3, 8e-3, 0.0], 30)
    radii = np.linspace(2e-4, 1e-4, 30)
    drawn = tube(line, radii, np.ones((30, 3)))
    assert len(drawn.corners) == len(drawn.normals) == len(drawn.colors)
    mesh = Mesh(drawn.corners.reshape(-1, 3), np.arange(3 * len(drawn.corners)).reshape(-1, 3))
    frustum = math.pi * 1e-2 / 3 * (2e-4**2 + 2e-4 * 1e-4 + 1e-4**2)
    # The cross-section is a heptagon: sin(2π/7)/(2π/7) of the circle.
    share = math.sin(2 * math.pi / 7) / (2 * math.pi / 7)
    assert abs(mesh.scaled(1e3).to_trimesh().volume) == pytest.approx(share * frustum * 1e9, rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(drawn.normals, axis=-1), 1)


def test_a_ball_is_round():
    drawn = ball((1.0, 2.0, 3.0), 0.5, (1.0, 0.0, 0.0))
    np.testing.assert_allclose(np.linalg.norm(drawn.corners - [1, 2, 3], axis=-1), 0.5)


def test_a_smoothed_chain_keeps_its_ends_and_touches_its_inner_links_at_their_middles():
    joints = np.array([[0, 0, 0], [1, 0, 0], [2, 0.5, 0], [2.5, 1.5, 0], [2.5, 2.5, 0.3], [2, 3, 1]], dtype=float)
    line = smoothed(joints, 20)
    np.testing.assert_allclose(line[[0, -1]], joints[[0, -1]])
    for middle in (joints[1:-2] + joints[2:-1]) / 2:
        assert np.linalg.norm(line - middle, axis=1).min() < 0.02


@pytest.mark.parametrize("links", [1, 2, 7])
def test_a_straight_chain_stays_straight(links):
    joints = np.linspace([0.0, 0.0, 0.0], [1.0, 2.0, 3.0], links + 1)
    line = smoothed(joints, 5)
    np.testing.assert_allclose(np.cross(line, [1.0, 2.0, 3.0]), 0, atol=1e-12)
    np.testing.assert_allclose(line[[0, -1]], joints[[0, -1]], atol=1e-12)
