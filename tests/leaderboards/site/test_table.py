"""The table of a board: rows, columns and what is said of them."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from leaderboards import build_leaderboard
from leaderboards.boards import rank
from leaderboards.site.table import COLUMNS, FIELDS
from tests.factories.html_page import Page
from tests.factories.records import draw_board


@pytest.fixture
def site(make_record, tmp_path):
    return build_leaderboard([make_record("a"), make_record("b")], tmp_path / "site").parent


def build(records: list[Any], folder: Path, **options: Any) -> Path:
    return build_leaderboard(records, folder / "site", **options).parent


def data(site: Path) -> dict[str, Any]:
    page = Page(site / "index.html")
    return json.loads(next(text for owner, text in page.texts if owner == "script"))


def columns(board: dict[str, Any], *names: str) -> list[tuple[Any, ...]]:
    return list(zip(*(board["data"][name] for name in names), strict=True))


def _seeded(record, seed: int, by: float):
    card = replace(record.card, seed=seed, objective="untrained", weights=f"w{seed}")
    subjects = tuple(replace(item, value=item.value + by) for item in record.score.subjects)
    left_out = tuple(value + by for value in record.score.without_stimulus)
    score = replace(record.score, value=record.score.value + by, subjects=subjects, without_stimulus=left_out)
    return replace(record, card=card, score=score)


def test_every_row_says_rank_score_and_interval_and_baselines_follow(tmp_path):
    records = draw_board({"low": 0.0, "a": 0.9, "b": 0.85}, spread=0.1)
    (board,) = data(build(records, tmp_path))["boards"]
    (found,) = rank(records)
    shown = columns(board, "name", "rank_first", "rank_last", "score", "score_low", "score_high", "kind")
    for entry, row in zip(found.entries, shown, strict=False):
        ends = [pytest.approx(value, abs=1e-5) for value in (entry.scaled, entry.interval.low, entry.interval.high)]
        assert row == (entry.name, entry.first, entry.last, *ends, "model")
    assert [row[0] for row in shown[3:]] == ["animal-to-animal", "raw input", "random features"]
    assert [row[-1] for row in shown[3:]] == ["animals", "baseline", "baseline"]
    assert [row[1:3] for row in shown] == [(1, 2), (1, 2), (3, 3), (None, None), (None, None), (None, None)]
    assert board["ranked"]
    assert len(board["band"]) == 2


def test_every_column_has_its_data(make_record, tmp_path):
    (board,) = data(build([make_record()], tmp_path))["boards"]
    keys = {column["key"] for column in COLUMNS} - {"rank", "interval"}
    assert keys <= set(board["data"])


def test_the_unique_part_has_a_column_where_a_record_states_it(make_record, tmp_path):
    record = make_record()
    keys = [column["key"] for column in data(build([record], tmp_path / "without"))["columns"]]
    assert "unique" not in keys
    stated = {"statistics": {"unique": {"status": "ok", "unique": 0.75, "interval": [0.6, 0.9], "controls": ["raw"]}}}
    record = replace(record, score=replace(record.score, provenance=stated))
    page = data(build([record], tmp_path / "with"))
    assert "unique" in [column["key"] for column in page["columns"]]
    assert page["boards"][0]["data"]["unique"][0] == 0.75


def test_page_csv_and_json_agree(tmp_path):
    records = draw_board({"low": 0.0, "a": 0.9, "b": 0.85, "c": 0.3})
    records[1] = replace(records[1], card=replace(records[1].card, family="user module"))
    site = build(records, tmp_path)
    plain = json.loads((site / "data" / "leaderboard.json").read_text())
    written = list(csv.DictReader((site / "data" / "leaderboard.csv").read_text().splitlines()))
    assert [list(row) for row in written] == [list(FIELDS)] * len(plain)
    (board,) = data(site)["boards"]
    assert len(plain) == len(written) == len(board["data"]["name"]) == 7
    for index, (row, cells) in enumerate(zip(plain, written, strict=True)):
        for name, value in row.items():
            assert cells[name] == ("" if value is None else str(value))
            if name in board["data"]:
                shown = board["data"][name][index]
                assert shown == (pytest.approx(value, abs=1e-6) if isinstance(value, float) else value)
        assert board["data"]["score"][index] == pytest.approx(row["scaled"], abs=1e-6)


def test_a_board_whose_records_state_no_chance_shows_their_own_values(make_record, tmp_path):
    records = [make_record("a", 0.4, chance=math.nan), make_record("b", 0.6, chance=math.nan)]
    records = [replace(record, baselines={}, animal_to_animal=None) for record in records]
    (board,) = data(build(records, tmp_path))["boards"]
    assert not board["scaled"]
    assert columns(board, "name", "score", "scaled") == [("b", 0.6, None), ("a", 0.4, None)]


def test_seeds_are_folded_into_one_row_with_their_spread(tmp_path):
    record, other = draw_board({"net": 0.5, "other": 0.2})
    site = build([*(_seeded(record, seed, by) for seed, by in enumerate((-0.1, 0.0, 0.1))), other], tmp_path)
    (board,) = data(site)["boards"]
    rows = {name: row for name, *row in columns(board, "name", "score", "spread", "seeds", "runs")}
    middle = record.score.scaled
    assert rows["net"][:3] == [pytest.approx(middle, abs=1e-5), pytest.approx(0.1), 3]
    assert rows["net"][3] == [pytest.approx(middle + by, abs=1e-5) for by in (-0.1, 0.0, 0.1)]
    assert rows["other"][2:] == [1, None]
    assert len(list((site / "models").iterdir())) == 2
    assert len(list((site / "records").iterdir())) == 4
    page = Page(next((site / "models").glob("net--*")))
    assert "Over 3 seeds" in page.text
    assert "spread over seeds 0.100" in page.text
