"""Marks stand where their numbers say, and nothing off the axis is dropped in silence."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.records import Interval
from leaderboards.figures.marks import LIMITS, MARGIN, Axis, axis_of, rdm_picture

ANY = st.floats(allow_nan=True, allow_infinity=True) | st.floats(-2, 2)


@given(values=st.lists(ANY, max_size=6))
def test_axis_holds_zero_one_and_whatever_fits_its_limits(values):
    axis = axis_of(values)
    assert LIMITS[0] <= axis.low <= 0
    assert 1 <= axis.high <= LIMITS[1]
    assert {0.0, 1.0} <= set(axis.ticks)
    assert all(axis.low <= value <= axis.high for value in values if LIMITS[0] <= value <= LIMITS[1])


@given(value=ANY, low=ANY, high=ANY, points=st.lists(ANY, max_size=4))
def test_every_mark_lies_inside_and_what_lies_outside_shows_an_arrow(value, low, high, points):
    axis = Axis(-0.5, 1.0, ())
    mark = axis.mark(value, Interval(low, high), points)
    for place in (mark.x, mark.low, mark.high, *mark.points):
        assert place is None or MARGIN <= place <= 100 - MARGIN
    interval = [low, high] if math.isfinite(low) and math.isfinite(high) else []
    seen = [item for item in (value, *interval, *points) if math.isfinite(item)]
    assert mark.more_left == any(item < -0.5 for item in seen)
    assert mark.more_right == any(item > 1.0 for item in seen)
    assert len(mark.points) == sum(-0.5 <= point <= 1.0 for point in points)
    assert (mark.x is not None) == (-0.5 <= value <= 1.0)


def test_positions_are_linear_in_the_value():
    axis = Axis(0.0, 1.0, ())
    assert [axis.at(value) for value in (0.0, 0.5, 1.0)] == [MARGIN, 50.0, 100 - MARGIN]


@pytest.mark.parametrize(
    ("pairs", "labels"), [((), ()), ((), ("a",)), ((0.1, 0.2), ("a", "b", "c")), ((math.nan,), "ab")]
)
def test_there_is_no_picture_without_a_matrix(pairs, labels):
    assert rdm_picture(pairs, labels) is None


def test_undefined_pairs_are_counted_and_a_constant_matrix_is_drawn():
    picture = rdm_picture((0.5, math.nan, 0.5), ("a", "b", "c"))
    assert picture is not None
    assert "from 0.5 to 0.5" in picture.description
    assert "Undefined pairs: 1." in picture.description
