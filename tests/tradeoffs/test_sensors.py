"""The reference of tactile queries: distances to all triangles, in double precision."""

from __future__ import annotations

import numpy as np

from brainbench.geometry import Mesh, winding_number
from brainbench.tradeoffs.sensors import study, triangle_distance


def test_every_part_is_measured() -> None:
    assert {row["part"] for row in study().settings} == {"mesh", "primitive", "points", "taxels"}


def test_distances_to_triangles_in_double_precision_are_exact_for_a_cube() -> None:
    import trimesh

    box = trimesh.creation.box((2.0, 4.0, 6.0))
    mesh = Mesh(box.vertices, box.faces)
    points = np.random.default_rng(0).uniform(-4, 4, (200, 3))
    distance, normal = triangle_distance(mesh, points)
    over = np.abs(points) - [1, 2, 3]
    exact = np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(axis=1), 0)
    np.testing.assert_allclose(distance, exact, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1)
    np.testing.assert_array_equal(winding_number(mesh, points) > 0.5, distance < 0)
    # The same cube in tenths of millimetres.
    small = Mesh(1e-4 * box.vertices, box.faces)
    np.testing.assert_allclose(triangle_distance(small, 1e-4 * points)[0], 1e-4 * exact, atol=1e-15)
