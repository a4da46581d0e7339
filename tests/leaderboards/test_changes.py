"""Differences are named by their place, builds are compared by model, ranks moved by others are said."""

from __future__ import annotations

import math
import zipfile
from dataclasses import replace

import pytest

from brainbench.core.errors import DataError, DataFileNotFoundError
from leaderboards.changes import compare_builds, differences, open_build
from leaderboards.store import read_records, write_record


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


def test_numbers_within_the_tolerance_are_equal(make_record):
    record = make_record()
    near = replace(record, score=replace(record.score, value=0.5235))
    assert differences(record, near) == []
    assert [item.what for item in differences(record, near, tolerance=1e-4)] == ["score.value"]


def test_builds_show_what_came_went_changed_and_moved(make_record, tmp_path):
    old = _build([make_record("stays", 0.2), make_record("goes", 0.3), make_record("changes", 0.9)], tmp_path / "old")
    changed = make_record("changes", 0.5)
    provenance = {**changed.score.provenance, "version": "9.0"}
    changed = replace(changed, score=replace(changed.score, provenance=provenance))
    new = _build([make_record("stays", 0.2), changed, make_record("comes", 0.95)], tmp_path / "new")
    found = {change.name: change for change in compare_builds(old, new)}
    assert {name: change.kind for name, change in found.items()} == {
        "comes (seed 3)": "added",
        "goes (seed 3)": "removed",
        "changes (seed 3)": "changed",
        "stays (seed 3)": "moved",
    }
    assert found["changes (seed 3)"].causes == ("brainbench version: 0.1.0 → 9.0",)
    assert (found["changes (seed 3)"].before, found["changes (seed 3)"].after) == ("0.900, rank 1", "0.500, rank 2")
    assert (found["stays (seed 3)"].before, found["stays (seed 3)"].after) == ("0.200, rank 2–3", "0.200, rank 3")
    assert compare_builds(new, new) == []


def test_a_site_is_read_by_the_records_it_holds(make_record, tmp_path):
    path = write_record(make_record(), tmp_path)
    (tmp_path / "site" / "data").mkdir(parents=True)
    archive = tmp_path / "site" / "data" / "records.zip"
    with zipfile.ZipFile(archive, "w") as file:
        file.write(path, f"../../{path.name}")
    (stored,) = open_build(tmp_path / "site")
    assert stored.record == make_record()
    archive.write_bytes(b"no archive")
    with pytest.raises(DataError, match="cannot be read"):
        open_build(tmp_path / "site")
    with pytest.raises(DataFileNotFoundError):
        open_build(tmp_path / "nowhere")


def test_another_record_with_the_same_numbers_is_restated(make_record, tmp_path):
    record = make_record("net")
    more = replace(record, score=replace(record.score, provenance={**record.score.provenance, "note": "said later"}))
    (change,) = compare_builds(_build([record], tmp_path / "old"), _build([more], tmp_path / "new"))
    assert (change.kind, change.causes) == ("restated", ())
