"""Ranks say no more than the intervals do."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from brainbench.core.records import Interval
from leaderboards.ranking import PAIRED_ANIMALS, rank, rank_ranges

INTERVALS = st.lists(
    st.tuples(st.floats(-1, 1), st.floats(0, 1), st.floats(0, 1)).map(
        lambda drawn: (Interval(drawn[0], drawn[0] + drawn[1]), drawn[0] + drawn[1] * drawn[2])
    ),
    min_size=1,
    max_size=12,
)


@given(INTERVALS)
def test_ranges_equal_counting_every_pair(drawn):
    intervals = [interval for interval, _ in drawn]
    expected = [
        (
            1 + sum(other.low > interval.high for other in intervals),
            len(intervals) - sum(other.high < interval.low for other in intervals),
        )
        for interval in intervals
    ]
    assert rank_ranges(intervals) == expected


@given(INTERVALS)
def test_if_the_truth_lies_in_every_interval_the_true_rank_lies_in_every_range(drawn):
    truths = [truth for _, truth in drawn]
    for (first, last), truth in zip(rank_ranges([interval for interval, _ in drawn]), truths, strict=True):
        ahead = sum(other > truth for other in truths)
        level = sum(other == truth for other in truths)
        assert first <= ahead + level
        assert last >= ahead + 1


def test_separate_intervals_give_single_ranks_and_overlap_gives_shared_ones(make_record):
    (board,) = rank([make_record("low", 0.1), make_record("a", 0.8), make_record("b", 0.75)])
    assert [(row.record.score.name, row.rank) for row in board.rows] == [("a", "1–2"), ("b", "1–2"), ("low", "3")]


def test_only_trustworthy_scores_are_ranked(make_record):
    records = [
        make_record("good", 0.4),
        make_record("noisy", 0.9, status="unreliable"),
        make_record("none", status="undefined"),
        make_record("bare", 0.8, interval=None),
        make_record("endless", 0.7, interval=Interval(math.nan, math.nan)),
    ]
    (board,) = rank(records)
    assert [(row.record.score.name, row.rank, row.unranked_because) for row in board.rows] == [
        ("good", "1", ""),
        ("noisy", "–", "unreliable"),
        ("bare", "–", "no interval"),
        ("endless", "–", "no interval"),
        ("none", "–", "undefined"),
    ]


@pytest.mark.parametrize(
    "change",
    [
        {"recordings": {"source": "demo", "content_hash": "other"}},
        {"stimuli": {"description": "rodgers", "content_hash": "other"}},
        {"settings": {"time": "concatenate"}},
    ],
)
def test_other_recordings_stimuli_or_time_rule_make_another_board(make_record, change):
    here, there = make_record("a"), make_record("b")
    there = replace(there, score=replace(there.score, provenance={**there.score.provenance, **change}))
    assert [len(board.rows) for board in rank([here, there])] == [1, 1]


def test_other_estimators_and_metrics_make_other_boards(make_record):
    records = [make_record("a"), make_record("b", estimator="thesis"), make_record("c", metric="crossnobis")]
    assert [len(board.rows) for board in rank(records)] == [1, 1, 1]


def test_records_that_do_not_say_what_they_used_are_listed_without_a_rank(make_record):
    (board,) = rank([make_record("a", provenance={}), make_record("b", provenance={})])
    assert not board.comparable
    assert {row.unranked_because for row in board.rows} == {"recordings not identified"}


def test_features_computed_elsewhere_are_ranked_among_themselves_when_their_labels_agree(make_record):
    here = make_record("simulated")
    elsewhere = [make_record(name, value) for name, value in (("a", 0.2), ("b", 0.8))]
    for i, record in enumerate(elsewhere):
        known = {key: value for key, value in record.score.provenance.items() if key != "stimuli"}
        elsewhere[i] = replace(record, score=replace(record.score, provenance=known))
    boards = rank([here, *elsewhere])
    assert [[(row.record.score.name, row.rank) for row in board.rows] for board in boards] == [
        [("b", "1"), ("a", "2")],
        [("simulated", "1")],
    ]
    renamed = make_record("c", stimuli=tuple("uvwxyz"), provenance=elsewhere[0].score.provenance)
    assert len(rank([*elsewhere, renamed])) == 2


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
def test_boards_are_named_after_the_recordings_without_private_folders(make_record, source, name):
    (board,) = rank([make_record(provenance={"recordings": {"source": source}})])
    assert board.recordings == name


def test_baselines_appear_once_and_disagreement_is_said(make_record, make_score):
    records = [make_record(name) for name in "abc"]
    (board,) = rank(records)
    assert [(item.name, item.score.value, item.notes) for item in board.baselines] == [
        ("animal-to-animal", 0.712, ()),
        ("raw input", 0.223, ()),
        ("random features", 0.487, ()),
    ]
    records[0] = replace(records[0], baselines={"raw input": make_score("raw input", 0.223 + 1e-15)})
    assert not any(item.notes for item in rank(records)[0].baselines)
    records[0] = replace(records[0], baselines={"raw input": make_score("raw input", 0.9)})
    (board,) = rank(records)
    (raw,) = [item for item in board.baselines if item.name == "raw input"]
    assert raw.score.value == 0.223
    assert raw.notes == (
        "the records disagree: 2 different values from 0.223 to 0.900; shown is that of 2 of 3 records",
    )


def test_a_model_scored_twice_is_pointed_out(make_record):
    (board,) = rank([make_record("a", 0.5), make_record("a", 0.6), make_record("b", 0.4)])
    assert [bool(row.notes) for row in board.rows] == [True, True, False]
    assert "scored 2 times" in board.rows[0].notes[0]


def _paired(values, chance=None):
    """Rank models by the scores [model, animal] under intervals that all overlap."""
    animals = [{f"animal-{i}": float(value) for i, value in enumerate(row)} for row in values]
    return rank_ranges([Interval(0.0, 1.0)] * len(values), animals, chance)


def test_models_that_share_animals_are_told_apart_by_their_paired_difference():
    animal = np.random.default_rng(0).normal(0.5, 0.2, 11)
    noise = np.random.default_rng(1).normal(0, 0.02, (3, 11))
    assert _paired(animal + noise + np.array([[0.2], [0.1], [0.0]])) == [(1, 1), (2, 2), (3, 3)]


def test_too_few_animals_leave_the_decision_to_the_intervals():
    values = np.array([[0.9], [0.1]]) + np.linspace(0, 0.01, PAIRED_ANIMALS - 1)
    assert _paired(values) == [(1, 2), (1, 2)]


def test_paired_ranks_equal_scipys_tests_with_benjamini_and_hochberg():
    rng = np.random.default_rng(2)
    values = rng.normal(0, 0.1, (8, 9)) + np.linspace(0, 0.3, 8)[:, None]
    pairs = [(i, j) for i in range(8) for j in range(i)]
    p = stats.false_discovery_control([stats.ttest_rel(values[i], values[j]).pvalue for i, j in pairs], method="bh")
    apart = {pair for pair, value in zip(pairs, p, strict=True) if value <= 0.05}
    above = [sum(values[j].mean() > values[i].mean() for j in range(8) if {(i, j), (j, i)} & apart) for i in range(8)]
    below = [sum(values[j].mean() < values[i].mean() for j in range(8) if {(i, j), (j, i)} & apart) for i in range(8)]
    assert 0 < len(apart) < len(pairs)
    assert _paired(values) == [(1 + a, 8 - b) for a, b in zip(above, below, strict=True)]


def test_equal_models_are_rarely_told_apart():
    rng = np.random.default_rng(3)
    split = sum(_paired(rng.normal(0, 0.1, (6, 8))) != [(1, 6)] * 6 for _ in range(300))
    assert split / 300 < 0.08


def test_the_chance_of_seeds_widens_the_ties():
    animal = np.random.default_rng(0).normal(0.5, 0.2, 11)
    noise = np.random.default_rng(1).normal(0, 0.02, (2, 11))
    values = animal + noise + np.array([[0.1], [0.0]])
    assert _paired(values) == [(1, 1), (2, 2)]
    assert _paired(values, [0.01, 0.01]) == [(1, 2), (1, 2)]


def test_the_rule_that_was_used_is_said(make_record):
    (board,) = rank([make_record("a"), make_record("b")])
    assert board.ties.startswith("Models whose intervals overlap are tied")
