"""Building blocks of the families: their volumes are known, and their convex parts fill them."""

import numpy as np
import pytest

from brainbench.geometry import convex_hull
from brainbench.stimuli.objects.procedural.bodies import WEDGES, ShapeSampler, around, block, lathe, prism, rod, tube


def _filled(body):
    return sum(convex_hull(points, "part").volume for points in body.parts)


def test_drawn_proportions_are_within_their_ranges_and_remembered_in_order():
    draw = ShapeSampler(np.random.default_rng(3))
    for _ in range(50):
        share, count, name = draw(share=(0.2, 0.3), count=range(3, 5), name=["a", "b"])
        assert 0.2 <= share <= 0.3
        assert count in (3, 4)
        assert name in ("a", "b")
    assert list(draw.drawn.items()) == [("share", share), ("count", count), ("name", name)]


def test_parts_follow_a_body_that_is_stretched_turned_and_moved():
    body = block(1.0, 2.0, 3.0).stretched(x=2.0).turned(z=90.0).moved(x=5.0)
    (part,) = body.parts
    # 2 × 2 × 3, and a quarter turn about z exchanges x and y.
    np.testing.assert_allclose([part.min(axis=0), part.max(axis=0)], [[4, -1, -1.5], [6, 1, 1.5]], atol=1e-12)
    np.testing.assert_allclose(np.reshape(body.solid.bounding_box(), (2, 3)), [part.min(axis=0), part.max(axis=0)])
    assert body.solid.volume() == pytest.approx(12)


def test_a_union_has_the_parts_of_both_and_a_difference_has_none():
    left, right = block(1.0, 1.0, 1.0), block(1.0, 1.0, 1.0).moved(x=0.5)
    union = left + right
    assert union.solid.volume() == pytest.approx(1.5)
    assert len(union.parts) == 2
    assert (left - right).solid.volume() == pytest.approx(0.5)
    assert (left - right).parts is None
    assert ((left - right) + right).parts is None


@pytest.mark.parametrize("detail", [2_000, 5_000, 20_000])
def test_round_bodies_have_a_whole_number_of_facets_in_each_wedge(detail):
    facets = around(detail)
    assert facets % WEDGES == 0
    assert rod(1.0, 2.0, facets).solid.volume() == pytest.approx(2 * np.pi, rel=0.02)


def test_a_hollow_turned_body_is_filled_by_its_parts_and_open_at_the_top():
    outline = [(1.0, 0.0), (1.0, 0.2), (1.0, 1.0)]
    cup = lathe(outline, 4 * WEDGES, wall=0.25, floor=0.2)
    expected = np.pi * (0.2 + 0.8 * (1 - 0.75**2))
    assert cup.solid.volume() == pytest.approx(expected, rel=0.01)
    assert _filled(cup) == pytest.approx(cup.solid.volume(), rel=0.02)
    assert lathe(outline, 4 * WEDGES).solid.volume() == pytest.approx(np.pi, rel=0.01)


def test_a_closed_tube_has_the_volume_of_pappus_and_an_open_one_has_ends():
    angle = 2 * np.pi * np.arange(200) / 200
    circle = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    ring = tube(circle, 0.2, 48, closed=True)
    assert ring.solid.volume() == pytest.approx(2 * np.pi * np.pi * 0.2**2, rel=0.01)
    assert ring.solid.genus() == 1
    bar = tube(np.linspace([0, 0, 0], [0, 0, 3], 5), 0.2, 48, closed=False)
    assert bar.solid.volume() == pytest.approx(3 * np.pi * 0.2**2, rel=0.01)
    assert bar.solid.genus() == 0


def test_a_tapered_prism_is_a_frustum_of_one_part():
    square = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    body = prism(square, 3.0, top=0.5)
    # A frustum: h/3 (A + a + sqrt(A a)).
    assert body.solid.volume() == pytest.approx(4 + 1 + 2)
    assert _filled(body) == pytest.approx(7)
