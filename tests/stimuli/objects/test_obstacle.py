"""Convex parts and their bounds."""

import math

import numpy as np
import pytest

from brainbench.core.errors import UsageError
from brainbench.core.rotations import to_matrices
from brainbench.geometry import Mesh
from brainbench.stimuli.objects.obstacle import (
    Box,
    Capsule,
    ConvexPart,
    Cylinder,
    Obstacle,
    Sphere,
)

TURN = (math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8))


def test_bounds_enclose_each_shape_tightly():
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], float)
    np.testing.assert_allclose(ConvexPart(cube).bounds(), [[0, 0, 0], [1, 2, 3]])
    np.testing.assert_allclose(Sphere((1, 2, 3), 0.5).bounds(), [[0.5, 1.5, 2.5], [1.5, 2.5, 3.5]])
    np.testing.assert_allclose(Capsule((0, 0, 0), (0, 0, 2), 0.5).bounds(), [[-0.5, -0.5, -0.5], [0.5, 0.5, 2.5]])
    np.testing.assert_allclose(Cylinder((0, 0, 0), (0, 0, 2), 0.5).bounds(), [[-0.5, -0.5, 0], [0.5, 0.5, 2]])
    edge = math.sqrt(2)
    np.testing.assert_allclose(Box((0, 0, 0), (1, 1, 1), TURN).bounds(), [[-edge, -edge, -1], [edge, edge, 1]])


def test_a_slanted_cylinder_stays_inside_its_bounds():
    start, end, radius = np.array([0.0, 0, 0]), np.array([1.0, 2.0, 0.5]), 0.3
    low, high = Cylinder(tuple(start), tuple(end), radius).bounds()
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.linalg.svd(axis[None])[2][1:]
    angles = np.linspace(0, 2 * np.pi, 721)
    rim = radius * (np.cos(angles)[:, None] * side[0] + np.sin(angles)[:, None] * side[1])
    points = np.concatenate([start + rim, end + rim])
    assert (points >= low - 1e-12).all()
    assert (points <= high + 1e-12).all()
    np.testing.assert_allclose([points.min(0), points.max(0)], [low, high], atol=1e-4)


@pytest.mark.parametrize("faces", [4, 5, 63, 64, 65, 500])
def test_the_boxes_of_a_surface_hold_each_of_its_triangles_and_are_at_most_sixty_four(faces):
    generator = np.random.default_rng(faces)
    surface = Mesh(generator.normal(size=(40, 3)), generator.integers(0, 40, (faces, 3)))
    corners = surface.vertices[surface.faces][:, None]
    inside = (corners >= surface.boxes[:, None, 0]) & (corners <= surface.boxes[:, None, 1])
    assert inside.all(axis=(2, 3)).any(axis=1).all()
    assert len(surface.boxes) <= 64


def test_a_quarter_turn_about_z_takes_x_to_y():
    quarter = (math.sqrt(0.5), 0, 0, math.sqrt(0.5))
    np.testing.assert_allclose(to_matrices(quarter) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Capsule((0, 0, 0), (0, 0, 0), 1.0), "are the same point"),
        (lambda: Box((0, 0, 0), (1, 1, 1), (1, 1, 0, 0)), "must have length 1"),
        (lambda: ConvexPart(np.zeros((3, 3))), "at least four finite vertices"),
        (lambda: ConvexPart(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])), "lie in one plane"),
        (lambda: Obstacle(()), "at least one part"),
        (lambda: Obstacle((), surface=Mesh(np.zeros((3, 3)), np.zeros((4, 3), int))), "at least four vertices"),
        (lambda: Obstacle((), surface=Mesh(np.eye(4, 3), np.array([[0, 1, 2]]))), "four faces"),
        (lambda: Obstacle(("ball",)), r"parts of an obstacle must be .*Box\(…\).*received 'ball'"),  # pyright: ignore[reportArgumentType]
    ],
)
def test_impossible_shapes_are_refused(make, message):
    with pytest.raises(UsageError, match=message):
        make()
