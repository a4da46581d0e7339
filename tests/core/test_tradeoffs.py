"""Trade-off fronts."""

import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from brainbench.core.errors import UsageError
from brainbench.core.tradeoffs import TradeoffPoint, cheapest, pareto_front

POINTS = st.lists(
    st.builds(TradeoffPoint, error=st.floats(1e-4, 1), cost=st.floats(1e-3, 100)), min_size=1, max_size=30
)


@given(POINTS)
def test_nothing_on_the_front_is_beaten_and_everything_else_is(points):
    front = pareto_front(points)
    for point in points:
        beaten = any(
            other.error <= point.error
            and other.cost <= point.cost
            and (other.error, other.cost) != (point.error, point.cost)
            for other in points
        )
        on_front = any((item.error, item.cost) == (point.error, point.cost) for item in front)
        assert on_front != beaten


@given(POINTS, st.floats(1e-3, 1))
def test_the_cheapest_is_good_enough_and_no_good_enough_point_is_cheaper(points, error):
    good = [point.cost for point in points if point.error <= error]
    if good:
        found = cheapest(points, error)
        assert found.error <= error
        assert found.cost == min(good)
    else:
        with pytest.raises(UsageError, match=re.escape(f"error of {error:g}")):
            cheapest(points, error)


def test_failed_measurements_are_never_chosen():
    points = [TradeoffPoint(math.nan, 1), TradeoffPoint(math.inf, 1), TradeoffPoint(0.1, 5, {"links": 3})]
    assert cheapest(points, 0.2).settings == {"links": 3}
    with pytest.raises(UsageError, match=r"setting .*usable"):
        cheapest(points[:2], 0.2)


def test_the_error_names_the_most_accurate_setting():
    with pytest.raises(UsageError, match=r"0\.01; .*0\.1 \(links 3\)"):
        cheapest([TradeoffPoint(0.1, 5, {"links": 3}), TradeoffPoint(0.5, 1, {"links": 2})], 0.01)
