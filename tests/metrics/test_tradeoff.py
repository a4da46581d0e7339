"""The trade-off between Monte-Carlo error and time."""

from __future__ import annotations

import pytest

from brainbench.core.errors import UsageError
from brainbench.metrics.tradeoff import measure_tradeoff


def test_the_error_falls_with_every_number():
    points = measure_tradeoff(
        animals=2,
        units=20,
        trials=12,
        splits=(10, 300, 1000),
        permutations=(100, 1999, 10_000),
        repeats=5,
    )
    by = {(point.quantity, point.count): point for point in points}
    assert by["splits", 1000].error < by["splits", 10].error / 2
    assert all(point.seconds > 0 for point in points)
    assert by["permutations", 10_000].error < by["permutations", 100].error
    assert by["permutations", 10_000].error == pytest.approx((0.05 * 0.95 / 10_000) ** 0.5, rel=0.8)
    assert [point.count for point in points if point.default] == [300, 1999]


def test_misuse_is_told_in_a_sentence():
    with pytest.raises(UsageError, match="repeats of a trade-off must be"):
        measure_tradeoff(repeats=1)
