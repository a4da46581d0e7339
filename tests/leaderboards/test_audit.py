"""Stale and conflicting records are found, and nothing else is."""

from __future__ import annotations

from dataclasses import replace

from brainbench.core import records
from leaderboards.audit import MOST_NAMED, conflicting, remarks
from leaderboards.boards import rank
from leaderboards.store import StoredRecord


def _stored(record, path):
    return StoredRecord(path / "x.json", record)


def _with(record, **provenance):
    return replace(record, score=replace(record.score, provenance={**record.score.provenance, **provenance}))


def test_a_current_record_is_left_alone(make_record, tmp_path):
    assert remarks([_stored(make_record(), tmp_path)]) == {}


def test_an_older_estimator_is_stale_and_an_older_package_alone_is_not(make_record, tmp_path):
    assert remarks([_stored(_with(make_record(), version="0.0.9"), tmp_path)]) == {}
    record = _with(make_record(), settings={"estimator_version": 0})
    ((doubt,),) = remarks([_stored(record, tmp_path)]).values()
    assert doubt.startswith("stale: version 0 of the default estimator, now 2")


def test_stimuli_of_an_earlier_definition_of_a_fidelity_are_stale(make_record, tmp_path):
    settings = {"fidelity": "balanced", "whiskers": "all"}
    described = {"description": "rodgers, mouse"}
    old = _with(make_record("a"), settings=settings, time="2026-01", stimuli={**described, "content_hash": "1"})
    new = _with(make_record("b"), settings=settings, time="2026-02", stimuli={**described, "content_hash": "2"})
    coarse = _with(
        make_record("c"),
        settings={**settings, "fidelity": "fast"},
        time="2026-03",
        stimuli={**described, "content_hash": "3"},
    )
    found = remarks([_stored(record, tmp_path) for record in (old, new, coarse)])
    assert list(found) == [old.identity]
    assert "another engine or an earlier definition of fidelity 'balanced'" in found[old.identity][0]


def test_another_pairing_of_labels_is_another_computation_and_another_board(make_record, tmp_path):
    straight = {"convex": "convex", "concave": "concave"}
    one = _with(make_record("a", 0.5), pairs=straight)
    other = _with(make_record("a", 0.6), pairs={"convex": "concave", "concave": "convex"})
    assert remarks([_stored(record, tmp_path) for record in (one, other)]) == {}
    assert [len(board.entries) for board in rank([one, other])] == [1, 1]
    # A record of an earlier version, without pairs, paired equal labels.
    assert list(conflicting(_with(make_record("a", 0.6)), [one])) == [one]


def test_the_same_computation_with_other_numbers_is_a_conflict_on_both_sides(make_record, tmp_path):
    one, other, unrelated = make_record("a", 0.5), make_record("a", 0.6), make_record("b", 0.7)
    found = remarks([_stored(record, tmp_path) for record in (one, other, unrelated)])
    assert set(found) == {one.identity, other.identity}
    assert f"0.5000 here and 0.6000 in the record {other.identity}" in found[one.identity][0]
    assert list(conflicting(one, [one, other, unrelated])) == [other]


def test_many_contradicting_records_name_a_few_of_one_another(make_record, tmp_path):
    found = remarks([_stored(make_record("a", 0.01 * k), tmp_path) for k in range(30)])
    assert {len(sentences) for sentences in found.values()} == {MOST_NAMED}


def test_last_digits_and_other_options_are_no_conflict(make_record, tmp_path):
    one, near = make_record("a", 0.5), make_record("a", 0.5 + 1e-6)
    others = [
        _with(make_record("a", 0.6), settings={"time": "mean", "seed": 0} | change)
        for change in ({"seed": 1}, {"layer": "conv3"}, {"units_reliability": 0.5})
    ]
    assert remarks([_stored(record, tmp_path) for record in (one, near, *others)]) == {}


def test_a_record_is_hashed_once_however_many_rivals_ask_for_its_identity(make_record, monkeypatch):
    hashed = []
    monkeypatch.setattr(records, "record_identity", lambda data: hashed.append(data) or str(len(hashed)))
    one, other = make_record(value=0.5), make_record(value=0.7)
    assert list(conflicting(one, [other] * 20)) == [other] * 20
    assert len(hashed) == 2
