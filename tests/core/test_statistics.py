import pytest

from brainbench.core.errors import DataError
from brainbench.core.statistics import wilson_interval


def test_wilson_equals_a_published_value():
    # 10 of 100 (Newcombe 1998, method 3, without continuity correction): .0552 to .1744.
    interval = wilson_interval(10, 100)
    assert (interval.low, interval.high) == pytest.approx((0.0552, 0.1744), abs=5e-5)
    assert wilson_interval(0, 10).low == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(DataError, match="at least one observation"):
        wilson_interval(0, 0)
