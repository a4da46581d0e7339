"""A study measures each setting once, into a table that goes on where it stopped."""

from __future__ import annotations

import pytest

from brainbench.core.errors import DataError
from brainbench.core.files import read_json
from brainbench.tradeoffs.study import Study, front, run_study


def _make_study(calls, numbers, **fixed):
    def measure(row):
        calls.append(row["links"])
        return {"error": 1 / row["links"], "cost": float(row["links"])}

    return Study("brainbench tradeoff test", [{"links": number} for number in numbers], measure, fixed=fixed)


def test_what_a_table_holds_is_not_measured_again(tmp_path):
    calls = []
    first = run_study(_make_study(calls, [2, 4], protocol=1), tmp_path / "table.json")
    both = run_study(_make_study(calls, [4, 8], protocol=1), tmp_path / "table.json")
    assert calls == [2, 4, 8]
    assert both[:2] == first
    table = read_json(tmp_path / "table.json")
    assert table["points"] == both
    assert table["made_by"] == "brainbench tradeoff test"


def test_a_table_of_another_protocol_is_refused(tmp_path):
    run_study(_make_study([], [2], protocol=1), tmp_path / "table.json")
    with pytest.raises(DataError, match=r"table\.json' was not measured with protocol 2"):
        run_study(_make_study([], [2], protocol=2), tmp_path / "table.json")


def test_the_front_leaves_out_failed_and_beaten_settings():
    rows = [{"links": n, "error": error, "cost": cost} for n, error, cost in [(6, 0.1, 1), (8, 0.2, 2), (10, 0.05, 3)]]
    rows.append({"links": 4, "error": None, "cost": None})
    assert [point.settings["links"] for point in front(rows, "error", ["links"])] == [6, 10]
