"""Only comparable scores share a board, and only what was tested is ranked on it."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from leaderboards.boards import NO_SCALE, conclusions, rank
from tests.factories.records import draw_board, make_record

TRUTHS = {"best": 0.95, "good": 0.6, "fair": 0.3, "nothing": 0.0}


def _board(records):
    (board,) = rank(records)
    return board


def _ranks(board):
    return {entry.name: entry.rank for entry in board.entries}


def _with(record, name=None, card=None, **changes):
    score = replace(record.score, name=name or record.score.name, **changes)
    return replace(record, score=score, card=replace(record.card, name=score.name, **(card or {})))


def test_models_that_differ_have_ranks_and_those_that_do_not_share_them():
    board = _board(draw_board(TRUTHS, spread=0.2))
    assert _ranks(board) == {"best": "1", "good": "2", "fair": "3", "nothing": "4"}
    tied = _board(draw_board({"a": 0.5, "b": 0.5, "low": 0.1}, spread=0.2))
    assert {_ranks(tied)["a"], _ranks(tied)["b"]} == {"1–2"}


def test_scores_on_fewer_units_have_a_board_of_their_own():
    one, other = draw_board({"one": 0.6, "other": 0.4})
    settings = {**other.score.provenance.settings, "units_reliability": 0.5}
    boards = rank([one, _with(other, provenance=replace(other.score.provenance, settings=settings))])
    assert [len(board.entries) for board in boards] == [1, 1]
    assert sorted("0.5" in board.estimator for board in boards) == [False, True]


def test_where_every_model_ties_none_has_a_rank():
    board = _board(draw_board({"a": 0.5, "b": 0.5, "c": 0.5}))
    assert set(_ranks(board).values()) == {"–"}
    assert board.ranked == ()
    assert [entry.unranked_because for entry in board.entries] == ["", "", ""]


def test_a_model_not_told_apart_from_chance_never_stands_above_raw_input():
    lucky, weak = draw_board({"lucky": 0.9, "weak": 0.5}, spread=0.1)
    board = _board([_with(lucky, p=0.4), weak])
    assert [entry.name for entry in board.entries] == ["weak", "lucky"]
    found = board.entries[1]
    assert found.standing == "not told apart from chance"
    assert not found.above_raw
    assert board.leader.name == "weak"
    assert not board.entries[0].below_leader


@pytest.mark.parametrize(("design", "what"), [({"animals": 3}, "animals"), ({"stimuli": 6}, "stimuli")])
def test_too_few_animals_or_stimuli_give_no_ranks_and_the_board_says_what_it_needs(design, what):
    board = _board(draw_board(TRUTHS, spread=0.1, **design))
    assert set(_ranks(board).values()) == {"–"}
    assert what in board.lacks
    assert all(what in entry.unranked_because for entry in board.entries)
    assert what in conclusions(board)[0]


def test_animals_that_are_not_reliable_do_not_make_a_board_large_enough():
    def cut(score):
        first, rest = score.subjects[:3], score.subjects[3:]
        return replace(score, subjects=(*first, *(replace(item, status="unreliable") for item in rest)))

    records = draw_board({"a": 0.9, "b": 0.1}, animals=8)
    (board,) = rank(replace(record, score=cut(record.score)) for record in records)
    assert board.lacks == "at least 4 animals (here 3)"
    assert not any("not told apart from any" in sentence for sentence in conclusions(board))


def test_records_of_earlier_versions_are_listed_without_a_rank_and_the_reason_is_said():
    new, old = draw_board({"new": 0.5, "old": 0.9})
    board = _board([new, _with(old, chance=math.nan, attainable=math.nan, without_stimulus=())])
    assert {entry.name: entry.unranked_because for entry in board.entries} == {"new": "", "old": NO_SCALE}


def test_only_trusted_scores_are_ranked():
    good, noisy, none = draw_board({"good": 0.4, "noisy": 0.9, "none": 0.9})
    records = [good, _with(noisy, status="unreliable"), _with(none, status="undefined", value=math.nan)]
    board = _board(records)
    assert [(entry.name, entry.standing) for entry in board.entries][1:] == [
        ("noisy", "unreliable"),
        ("none", "undefined"),
    ]
    assert all(entry.unranked_because == entry.standing for entry in board.entries[1:])


def test_rows_of_one_computation_share_a_rank_and_count_once():
    best, good, low = draw_board({"net": 0.9, "other": 0.5, "low": 0.2}, spread=0.1)
    board = _board([best, _with(best, "net+gpt", {"weights": "w"}), good, low])
    entries = {entry.name: entry for entry in board.entries}
    assert entries["net+gpt"].same_as == "net"
    assert entries["net"].same_as == ""
    assert {name: entry.rank for name, entry in entries.items()} == {
        "net": "1", "net+gpt": "1", "other": "2", "low": "3",
    }  # fmt: skip


def test_dissimilarities_taken_from_the_brain_stand_apart_whatever_they_score():
    records = draw_board(TRUTHS, spread=0.2)
    elsewhere = {"family": "features computed elsewhere", "seed": None}
    cheat = _with(records[0], "mds-of-brain", elsewhere, value=0.999)
    board = _board([*records, cheat])
    last = board.entries[-1]
    assert (last.name, last.rank) == ("mds-of-brain", "–")
    assert last.unranked_because.startswith("not repeatable here")
    assert board.leader.name == "best"
    assert _ranks(board)["best"] == "1"
    assert any("1 entry" in text for text in conclusions(board))


@pytest.mark.parametrize(
    "change",
    [
        {"recordings": {"source": "demo", "content_hash": "other"}},
        {"stimuli": {"description": "rodgers", "content_hash": "other"}},
        {"settings": {"time": "concatenate"}},
    ],
)
def test_other_recordings_stimuli_or_time_rule_make_another_board(change):
    here, there = make_record("a"), make_record("b")
    there = replace(there, score=replace(there.score, provenance={**there.score.provenance, **change}))
    assert [len(board.entries) for board in rank([here, there])] == [1, 1]


def test_other_estimators_and_metrics_make_other_boards():
    records = [make_record("a"), make_record("b", estimator="thesis"), make_record("c", metric="crossnobis")]
    assert [len(board.entries) for board in rank(records)] == [1, 1, 1]


def test_records_that_do_not_say_what_they_used_have_no_rank():
    board = _board([make_record("a", provenance={}), make_record("b", provenance={})])
    assert "which recordings" in board.lacks


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("/home/me/.cache/brainbench/demo", "demo"),
        ("C:\\data\\rodgers\\", "rodgers"),
        (["a/1.nwb", "a/2.nwb", "a/3.nwb", "a/4.nwb"], "1.nwb, 2.nwb, 3.nwb and 1 more"),
        (None, "unnamed recordings"),
        ({"x": 1}, "{'x': 1}"),
    ],
)
def test_boards_are_named_after_the_recordings_without_private_folders(source, name):
    assert _board([make_record(provenance={"recordings": {"source": source}})]).recordings == name


def test_baselines_appear_once_and_disagreement_is_said(make_score):
    records = [make_record(name) for name in "abc"]
    assert [(item.name, item.score.value, item.notes) for item in _board(records).baselines] == [
        ("animal-to-animal", 0.712, ()),
        ("raw input", 0.223, ()),
        ("random features", 0.487, ()),
    ]
    records[0] = replace(records[0], baselines={"raw input": make_score("raw input", 0.223 + 1e-15)})
    assert not any(item.notes for item in _board(records).baselines)
    records[0] = replace(records[0], baselines={"raw input": make_score("raw input", 0.9)})
    (raw,) = [item for item in _board(records).baselines if item.name == "raw input"]
    assert raw.score.value == 0.223
    assert "2 different values from 0.223 to 0.900" in raw.notes[0]


def test_conclusions_name_the_leader_who_is_above_raw_input_and_the_hidden_network():
    leader, truth, raw, chance = conclusions(_board(draw_board(TRUTHS, spread=0.2, truth="best")))
    assert "Highest score: best, " in leader
    assert "from the 3 other models" in leader
    assert "was found" in truth
    assert "3 of 4 models: best, good, fair" in raw
    assert "1 of 4 models" in chance


def test_conclusions_say_when_the_hidden_network_was_missed_tied_or_is_not_there():
    missed = conclusions(_board(draw_board(TRUTHS, spread=0.2, truth="fair")))[1]
    assert "not found, its rank is 3" in missed
    tied = _board(draw_board({"a": 0.9, "b": 0.9}, truth="b"))
    second = next(entry for entry in tied.entries if entry is not tied.leader)
    (told,) = [text for text in conclusions(replace(tied, truth=second.name)) if "made by" in text]
    assert "not told apart from the highest score" in told
    assert "not on this board" in conclusions(_board(draw_board(TRUTHS, truth="elsewhere")))[1]


def test_a_board_of_one_model_and_one_where_nothing_is_above_chance_say_so():
    assert "Highest score: alone" in conclusions(_board(draw_board({"alone": 0.8})))[0]
    assert "No model leads" in conclusions(_board(draw_board({"nothing": -0.5, "more": -0.5})))[0]
