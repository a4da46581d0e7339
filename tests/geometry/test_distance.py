import math
from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from brainbench.core.errors import UsageError
from brainbench.geometry import Mesh, deviation, hausdorff, winding_number
from brainbench.geometry.distance import point_triangle_distance


def _mesh(solid):
    return Mesh(solid.vertices, solid.faces)


def _box(*size, at=(0.0, 0.0, 0.0)):
    box = trimesh.creation.box(extents=size)
    return Mesh(box.vertices + np.asarray(at), box.faces)


def test_the_winding_number_is_one_inside_and_zero_outside():
    torus = _mesh(trimesh.creation.torus(1.0, 0.3))
    np.testing.assert_allclose(
        winding_number(torus, [[1, 0, 0], [0, 0, 0], [0, 1.1, 0.1], [2, 2, 2]]), [1, 0, 1, 0], atol=1e-9
    )


def test_a_hemisphere_wraps_half_way_round_its_centre():
    ball = trimesh.creation.icosphere(subdivisions=4)
    upper = ball.faces[ball.triangles_center[:, 2] > 0]
    assert winding_number(Mesh(ball.vertices, upper), [[0, 0, 0]])[0] == pytest.approx(0.5, abs=0.01)


@settings(max_examples=60)
@given(arrays(float, (4, 3), elements=st.floats(-1, 1, width=32)))
def test_the_distance_from_a_triangle_is_that_of_its_nearest_point(corners):
    point, triangle = corners[0], corners[1:]
    share = np.linspace(0, 1, 60)
    u, v = np.meshgrid(share, share)
    inside = u + v <= 1
    spread = triangle[0] + u[inside, None] * (triangle[1] - triangle[0]) + v[inside, None] * (triangle[2] - triangle[0])
    sampled = np.linalg.norm(spread - point, axis=1).min()
    exact = point_triangle_distance(point[None], triangle[None])[0]
    size = np.ptp(triangle, axis=0).max()
    assert exact <= sampled + 1e-9
    assert exact >= sampled - size / 20


def _exact_distance(point, triangle):
    """Distance in rational arithmetic: the nearest of the feet on corners, edges and plane that lie in the triangle."""
    p = [Fraction(x) for x in point]
    corners = [[Fraction(x) for x in corner] for corner in triangle]

    def dot(u, v):
        return sum(x * y for x, y in zip(u, v, strict=True))

    def less(u, v):
        return [x - y for x, y in zip(u, v, strict=True)]

    squares = []
    for count in (1, 2, 3):
        for first, *others in combinations(corners, count):
            span, there = [less(other, first) for other in others], less(p, first)
            gram = [[dot(u, v) for v in span] for u in span]
            right = [dot(u, there) for u in span]
            # Cramer's rule for the foot's coordinates in the span of the edges.
            if count == 1:
                shares = []
            elif count == 2:
                if gram[0][0] == 0:
                    continue
                shares = [right[0] / gram[0][0]]
            else:
                whole = gram[0][0] * gram[1][1] - gram[0][1] ** 2
                if whole == 0:
                    continue
                shares = [
                    (right[0] * gram[1][1] - right[1] * gram[0][1]) / whole,
                    (right[1] * gram[0][0] - right[0] * gram[0][1]) / whole,
                ]
            if min([*shares, 1 - sum(shares)]) >= 0:
                for share, edge in zip(shares, span, strict=True):
                    there = less(there, [share * x for x in edge])
                squares.append(dot(there, there))
    return math.sqrt(min(squares))


@pytest.mark.parametrize("size", [1.0, 1e-3, 1e-5, 1e-8])
def test_triangles_of_any_size_are_as_far_as_exact_arithmetic_says(size):
    rng = np.random.default_rng(3)
    triangles = rng.normal(size=(400, 3, 3))
    # Slivers, and triangles that lie somewhere else than at the origin.
    triangles[:100, 2] = triangles[:100, 0] + rng.normal(size=(100, 1)) * (triangles[:100, 1] - triangles[:100, 0])
    triangles[:100, 2] += 10.0 ** rng.uniform(-12, -2, (100, 1)) * rng.normal(size=(100, 3))
    triangles = size * triangles + rng.choice([0.0, 0.1], (400, 1, 1))
    points = triangles.mean(axis=1) + size * 10 ** rng.uniform(-3, 1, (400, 1)) * rng.normal(size=(400, 3))
    exact = [_exact_distance(point, triangle) for point, triangle in zip(points, triangles, strict=True)]
    # Coordinates of a decimetre are rounded to 1e-17 m.
    np.testing.assert_allclose(point_triangle_distance(points, triangles), exact, rtol=1e-6, atol=1e-15 + 1e-11 * size)


def test_of_a_triangle_without_an_area_the_nearest_corner_counts():
    corners = np.array([[5.67037439e-08, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert point_triangle_distance(np.zeros((1, 3)), corners[None])[0] == 0.0


def test_equal_surfaces_are_no_distance_apart_and_a_shift_is_its_length():
    box = _box(1, 2, 3)
    assert hausdorff(box, box) == pytest.approx(0, abs=1e-12)
    assert hausdorff(box, _box(1, 2, 3.2)) == pytest.approx(0.1, rel=0.02)


def test_concentric_balls_differ_by_their_radii():
    small, large = (_mesh(trimesh.creation.icosphere(4, radius)) for radius in (1.0, 1.2))
    assert hausdorff(small, large) == pytest.approx(0.2, rel=0.01)


def test_exact_pieces_do_not_deviate_even_when_they_overlap_or_touch():
    whole = _box(2, 1, 1)
    halves = [_box(1, 1, 1, at=(-0.5, 0, 0)), _box(1, 1, 1, at=(0.5, 0, 0))]
    overlapping = [_box(1.5, 1, 1, at=(-0.25, 0, 0)), _box(1.5, 1, 1, at=(0.25, 0, 0))]
    for pieces in (halves, overlapping, [whole]):
        found = deviation(whole, pieces)
        assert found.largest == pytest.approx(0, abs=1e-9)


def test_a_deviation_needs_pieces():
    with pytest.raises(UsageError, match=r"pieces .*at least 1; received 0"):
        deviation(_box(2, 1, 1), [])


def test_what_is_added_and_what_is_missing_are_told_apart():
    whole = _box(2, 1, 1)
    assert deviation(whole, [_box(2.2, 1, 1)]).outward == pytest.approx(0.1, rel=0.02)
    assert deviation(whole, [_box(2.2, 1, 1)]).inward == 0
    short = deviation(whole, [_box(1.6, 1, 1)])
    assert short.inward == pytest.approx(0.2, rel=0.02)
    assert short.outward == pytest.approx(0, abs=1e-12)


def test_filling_the_hole_of_a_ring_counts_by_its_depth():
    torus = _mesh(trimesh.creation.torus(1.0, 0.2, major_sections=64, minor_sections=32))
    found = deviation(torus, [torus.hull()])
    # The middle of the lid over the hole lies √(1² + .2²) − .2 from the tube, the centre of the hole 0.8.
    assert 0.78 < found.outward <= np.hypot(1, 0.2) - 0.2 + 0.01
    assert found.inward == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("samples", [0, -5, 1.5])
def test_no_distance_is_told_without_a_sample(samples):
    box = _box(1, 1, 1)
    with pytest.raises(UsageError, match=f"samples .*at least 1; received {samples}"):
        deviation(box, [box], samples=samples)
