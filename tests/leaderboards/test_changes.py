"""Differences are named by their place, builds are compared by model, ranks moved by others are said."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from brainbench.core.errors import DataFileNotFoundError
from leaderboards import build_leaderboard
from leaderboards.changes import compare_builds, differences, open_build
from leaderboards.store import read_records, write_record
from tests.factories.records import draw_board


def _build(records, folder):
    for record in records:
        write_record(record, folder)
    return read_records(folder)


def test_a_record_does_not_differ_from_itself(make_record):
    record = make_record(p=math.nan)
    assert differences(record, record, tolerance=0.0) == []


def test_each_difference_is_named_by_its_place(make_record):
    record = make_record()
    layers = (replace(record.score.layers[0], value=0.6), *record.score.layers[1:])
    score = replace(record.score, value=0.6, status="unreliable", layers=layers)
    card = replace(record.card, weights="abc")
    found = {
        item.what: (item.before, item.after) for item in differences(record, replace(record, score=score, card=card))
    }
    assert found == {
        "card.weights": (None, "abc"),
        "score.value": (0.523, 0.6),
        "score.status": ("ok", "unreliable"),
        "score.layers[0](conv3).value": (0.529, 0.6),
    }


def test_records_in_two_places_are_read_once(make_record, tmp_path):
    for folder in ("one", "other"):
        write_record(make_record(), tmp_path / folder / "records")
    write_record(make_record("another"), tmp_path / "other" / "records")
    found = open_build(tmp_path / "one", tmp_path / "other")
    assert sorted(item.record.score.name for item in found) == ["another", "zhuang"]


def test_numbers_within_the_tolerance_are_equal(make_record):
    record = make_record()
    near = replace(record, score=replace(record.score, value=0.5235))
    assert differences(record, near) == []
    assert [item.what for item in differences(record, near, tolerance=1e-4)] == ["score.value"]


def _named(truths, **design):
    return {record.score.name: record for record in draw_board(truths, spread=0.1, **design)}


def test_builds_show_what_came_went_changed_and_moved(tmp_path):
    drawn = _named({"stays": 0.2, "changes": 0.9, "goes": 0.55, "comes": 0.6})
    changed = _named({"stays": 0.2, "changes": 0.4}, seed=1)["changes"]
    provenance = {**changed.score.provenance, "version": "9.0"}
    changed = replace(changed, score=replace(changed.score, provenance=provenance))
    old = _build([drawn["stays"], drawn["goes"], drawn["changes"]], tmp_path / "old")
    new = _build([drawn["stays"], changed, drawn["comes"], drawn["goes"]], tmp_path / "new")
    without = _build([drawn["stays"], changed, drawn["comes"]], tmp_path / "without")
    found = {change.name: change for change in compare_builds(old, without)}
    assert {name: change.kind for name, change in found.items()} == {
        "comes (seed 0)": "added",
        "goes (seed 0)": "removed",
        "changes (seed 0)": "changed",
    }
    assert found["changes (seed 0)"].causes[0] == "brainbench version: 0.1.0 → 9.0"
    assert found["changes (seed 0)"].before.endswith("rank 1")
    assert found["changes (seed 0)"].after.endswith("rank 2")
    moved = {change.name: change for change in compare_builds(old, new) if change.kind == "moved"}
    assert moved["stays (seed 0)"].before.endswith("rank 3")
    assert moved["stays (seed 0)"].after.endswith("rank 4")
    assert compare_builds(new, new) == []


def test_a_standing_that_changes_alone_is_told(make_record, tmp_path):
    record = make_record("net")
    chance = replace(record, score=replace(record.score, p=0.4))
    (change,) = compare_builds(_build([record], tmp_path / "old"), _build([chance], tmp_path / "new"))
    assert change.before.partition(",")[0] == change.after.partition(",")[0]
    assert "not told apart from chance" in change.after
    assert "not told apart from chance" not in change.before


def test_a_site_is_read_by_the_records_it_holds(make_record, tmp_path):
    site = build_leaderboard([make_record()], tmp_path / "site").parent
    (stored,) = open_build(site)
    assert stored.record == make_record()
    with pytest.raises(DataFileNotFoundError):
        open_build(tmp_path / "nowhere")


def test_another_record_with_the_same_numbers_is_restated(make_record, tmp_path):
    record = make_record("net")
    more = replace(record, score=replace(record.score, provenance={**record.score.provenance, "note": "said later"}))
    (change,) = compare_builds(_build([record], tmp_path / "old"), _build([more], tmp_path / "new"))
    assert (change.kind, change.causes) == ("restated", ())
