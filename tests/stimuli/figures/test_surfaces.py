from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from trimesh import creation

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh
from brainbench.stimuli.figures.surfaces import (
    VIEWS,
    Camera,
    Triangles,
    ball,
    corner_normals,
    draw,
    object_surface,
    part_mesh,
    smoothed,
    tube,
)
from brainbench.stimuli.motion.trajectories import Spin, Translation
from brainbench.stimuli.objects import procedural
from brainbench.stimuli.objects.obstacle import Box, Capsule, Cylinder, Sphere
from brainbench.stimuli.objects.solid import PlacedObject, box, mesh_solid, rodgers_solid, shape_solid, sphere

SIZE = (400, 300)
RADIUS = 5e-3


def _lens(view="oblique", projection="orthographic", size=SIZE, **options):
    return Camera(view, projection, target=(0.0, 0.0, 0.0), width=0.04, **options).lens(np.zeros((1, 3)), size)


def _ball(subdivisions=5, radius=RADIUS, centre=(0.0, 0.0, 0.0)):
    solid = creation.icosphere(subdivisions=subdivisions, radius=radius)
    mesh = Mesh(np.asarray(solid.vertices) + centre, np.asarray(solid.faces))
    return Triangles(mesh.vertices[mesh.faces], corner_normals(mesh), np.ones((len(mesh.faces), 3)))


def _quad(a, b, c, d, color):
    corners = np.array([[a, b, c], [a, c, d]], dtype=float)
    return Triangles(corners, np.broadcast_to([0.0, 0.0, 1.0], corners.shape), np.tile(color, (2, 1)).astype(float))


@pytest.mark.parametrize("view", ["top", "side", "oblique"])
def test_a_ball_covers_its_disc_and_shows_its_near_side(view):
    lens = _lens(view)
    layer = draw(_ball(), lens)
    assert len(layer.pixels) == pytest.approx(math.pi * (RADIUS * lens.scale) ** 2, rel=0.01)
    np.testing.assert_allclose(np.linalg.norm(layer.points, axis=1), RADIUS, rtol=2e-3)
    assert (layer.points @ lens.axes[2] > -1e-4).all()
    np.testing.assert_allclose(layer.normals, layer.points / RADIUS, atol=0.02)


def test_a_ball_in_perspective_covers_the_disc_of_its_tangent_cone():
    lens = _lens(projection="perspective", field_of_view=math.radians(60))
    layer = draw(_ball(), lens)
    # The silhouette of a ball at distance D has the angular radius asin(R/D).
    radius = lens.distance * lens.scale * math.tan(math.asin(RADIUS / lens.distance))
    assert len(layer.pixels) == pytest.approx(math.pi * radius**2, rel=0.01)
    np.testing.assert_allclose(np.linalg.norm(layer.points, axis=1), RADIUS, rtol=2e-3)


def test_a_wall_larger_than_the_picture_leaves_no_gap():
    wall = _quad((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (1, 0, 0))
    for projection in ("orthographic", "perspective"):
        layer = draw(wall, _lens((0.3, 0.2, 1.0), projection))
        assert len(layer.pixels) == SIZE[0] * SIZE[1]
        np.testing.assert_allclose(layer.points[:, 2], 0, atol=1e-7)


def test_two_walls_that_cross_hide_one_another_up_to_the_line_where_they_meet():
    one = _quad((-1, -1, -1), (1, -1, 1), (1, 1, 1), (-1, 1, -1), (1, 0, 0))
    other = _quad((-1, -1, 1), (1, -1, -1), (1, 1, -1), (-1, 1, 1), (0, 0, 1))
    lens = _lens("top")
    image = np.zeros((SIZE[1] * SIZE[0], 3))
    layer = draw(Triangles.joined([one, other]), lens)
    image[layer.pixels] = layer.colors
    red = image.reshape(SIZE[1], SIZE[0], 3)[..., 0]
    assert (red[:, :199] == 0).all()
    assert (red[:, 201:] == 1).all()


def test_the_order_of_the_triangles_does_not_matter():
    scene = Triangles.joined([_ball(3), _ball(3, 3e-3, (4e-3, 0.0, 2e-3))])
    order = np.random.default_rng(0).permutation(len(scene.corners))
    shuffled = Triangles(scene.corners[order], scene.normals[order], scene.colors[order])
    lens = _lens()
    np.testing.assert_array_equal(draw(scene, lens).nearness, draw(shuffled, lens).nearness)


def test_what_lies_behind_the_camera_or_beside_the_picture_is_not_drawn():
    lens = _lens("top", "perspective")
    behind = _ball(2, 1e-3, (0.0, 0.0, 2 * lens.distance))
    beside = _ball(2, 1e-3, (1.0, 0.0, 0.0))
    assert not len(draw(Triangles.joined([behind, beside]), lens).pixels)
    assert not len(draw(Triangles.joined([]), lens).pixels)


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


WIDE = (640, 480)
views = st.sampled_from(sorted(VIEWS)) | st.tuples(*[st.floats(-1, 1).filter(lambda value: abs(value) > 0.05)] * 3)
cameras = st.builds(Camera, view=views, projection=st.sampled_from(["perspective", "orthographic"]))
points = hnp.arrays(float, (5, 3), elements=st.floats(-0.02, 0.02))


@given(camera=cameras, cloud=points)
def test_everything_shown_lies_in_the_picture(camera, cloud):
    flat = camera.lens(cloud, WIDE).project(cloud)
    assert (flat[:, :2] >= 0).all()
    assert (flat[:, :2] <= WIDE).all()


@given(camera=cameras, cloud=points)
def test_a_picture_point_and_its_nearness_give_the_point_back(camera, cloud):
    lens = camera.lens(cloud, WIDE)
    x, y, nearness = lens.project(cloud).T
    np.testing.assert_allclose(lens.unproject(x, y, nearness), cloud, atol=1e-9)


@pytest.mark.parametrize(
    ("view", "right", "up"),
    [("top", (1, 0, 0), (0, 1, 0)), ("side", (0, 1, 0), (0, 0, 1)), ("front", (-1, 0, 0), (0, 0, 1))],
)
def test_views_show_dorsal_or_rostral_up(view, right, up):
    np.testing.assert_allclose(Camera(view).axes[:2], [right, up], atol=1e-12)


def test_an_orthographic_picture_is_to_scale():
    lens = Camera("top", "orthographic", target=(0.0, 0.0, 0.0), width=0.064).lens(np.zeros((1, 3)), WIDE)
    flat = lens.project(np.array([[0.0, 0.0, 0.0], [0.003, 0.004, 0.01]]))
    np.testing.assert_allclose(flat[:, :2], [[320, 240], [350, 200]])
    np.testing.assert_allclose(lens.pixel_size(np.zeros((1, 3))), 1e-4)


def test_perspective_enlarges_what_is_nearer_by_the_ratio_of_distances():
    camera = Camera("top", target=(0.0, 0.0, 0.0), width=0.064, field_of_view=2 * math.atan(0.5))
    lens = camera.lens(np.zeros((1, 3)), WIDE)
    assert lens.distance == pytest.approx(0.064)
    far, near = lens.project(np.array([[0.01, 0.0, 0.0], [0.01, 0.0, 0.032]]))[:, 0] - 320
    assert far == pytest.approx(100)
    assert near == pytest.approx(200)
    assert np.isnan(lens.project(np.array([0.0, 0.0, 0.065]))[2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"view": "abov"}, "Unknown view 'abov'"),
        ({"view": (0.0, 0.0, 0.0)}, "direction"),
        ({"view": (0.0, math.nan, 0.0)}, "view of a camera"),
    ],
)
def test_impossible_cameras_are_refused(options, message):
    with pytest.raises(UsageError, match=message):
        Camera(**options)
