"""The trade-off between Monte-Carlo error and time."""

from __future__ import annotations

import pytest

from brainbench.tradeoffs.scores import SyntheticData, study
from brainbench.tradeoffs.study import run_study


def test_the_error_falls_with_every_number():
    data = SyntheticData(animals=2, units=20, trials=12, repeats=5)
    rows = run_study(study(data, splits=(10, 300, 1000), permutations=(100, 1999, 10_000)))
    by = {(row["quantity"], row["count"]): row for row in rows}
    assert by["splits", 1000]["error"] < by["splits", 10]["error"] / 2
    assert all(row["seconds"] > 0 for row in rows)
    assert by["permutations", 10_000]["error"] < by["permutations", 100]["error"]
    assert by["permutations", 10_000]["error"] == pytest.approx((0.05 * 0.95 / 10_000) ** 0.5, rel=0.8)
    assert [row["count"] for row in rows if row["default"]] == [300, 1999]
