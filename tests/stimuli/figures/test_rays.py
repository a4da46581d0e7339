import math

import numpy as np
import pytest
from trimesh import creation

from brainbench.geometry import Mesh
from brainbench.stimuli.figures.camera import Camera
from brainbench.stimuli.figures.rays import Triangles, draw
from brainbench.stimuli.figures.surfaces import corner_normals

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
