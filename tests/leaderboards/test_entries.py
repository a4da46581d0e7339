"""Seeds fold into one entry whose interval is that of the animals' means."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from brainbench.core.records import SubjectScore
from brainbench.core.statistics import t_interval
from leaderboards.entries import entries_of, twins
from leaderboards.ranking import rank


def _run(record, seed: int, values: list[float], *, objective: str = "untrained", **changes):
    card = replace(record.card, seed=seed, objective=objective, weights=f"{objective}{seed}", **changes)
    subjects = tuple(SubjectScore(f"animal-{i}", value, value, 0.9) for i, value in enumerate(values))
    return replace(record, card=card, score=replace(record.score, value=float(np.mean(values)), subjects=subjects))


def _entries(*records):
    (board,) = rank(records)
    return entries_of(board)


def test_the_interval_joins_the_t_intervals_over_animals_and_over_seeds(make_record):
    values = np.random.default_rng(0).normal(0.6, 0.1, size=(3, 5))  # seed, animal
    (entry,) = _entries(*(_run(make_record("net"), seed, list(row)) for seed, row in enumerate(values)))
    halves = [stats.t.ppf(0.975, len(means) - 1) * stats.sem(means) for means in (values.mean(0), values.mean(1))]
    half = math.hypot(*halves)
    assert entry.interval.low == pytest.approx(values.mean() - half)
    assert entry.interval.high == pytest.approx(values.mean() + half)
    assert entry.value == pytest.approx(values.mean())
    assert entry.spread == pytest.approx(values.mean(axis=1).std(ddof=1))
    assert entry.interval.method == "t over 5 animals and 3 seeds, added in squares"


def test_a_single_record_keeps_its_own_interval(make_record):
    record = make_record("net")
    (entry,) = _entries(record)
    assert entry.interval == record.score.interval
    assert math.isnan(entry.spread)


def test_objectives_and_augmentations_are_entries_of_their_own_and_twins_are_found(make_record):
    plain = _run(make_record("zhuang-small"), 0, [0.3, 0.4])
    trained = _run(make_record("zhuang-small.simclr"), 0, [0.7, 0.8], objective="simclr", twin="zhuang-small")
    masked = replace(trained, card=replace(trained.card, training={"masking": 0.75}, weights="m"))
    masked = replace(masked, score=replace(masked.score, value=0.71))
    entries = _entries(plain, trained, masked)
    assert [(entry.name, entry.trained, entry.masking) for entry in entries] == [
        ("zhuang-small.simclr", True, 0.0),
        ("zhuang-small.simclr", True, 0.75),
        ("zhuang-small", False, 0.0),
    ]
    assert twins(entries)[entries[0].architecture].name == "zhuang-small"


def test_a_second_record_of_a_seed_is_not_averaged_in(make_record):
    old = _run(make_record("net"), 0, [0.2, 0.3])
    new = _run(make_record("net"), 0, [0.6, 0.7])
    old, new = (
        replace(record, score=replace(record.score, provenance={**record.score.provenance, "time": time}))
        for record, time in ((old, "2026-01"), (new, "2026-02"))
    )
    first, second = _entries(old, new)
    assert (first.seeds, second.seeds) == (1, 1)
    assert first.value == pytest.approx(0.65)
    assert second.notes == ("an earlier record of a model that stands above or below once more",)


def test_one_seed_without_a_trusted_score_keeps_the_entry_from_being_ranked(make_record):
    good = _run(make_record("net"), 0, [0.6, 0.7])
    bad = _run(make_record("net"), 1, [0.6, 0.7])
    bad = replace(bad, score=replace(bad.score, status="unreliable"))
    (entry,) = _entries(good, bad)
    assert entry.status == "unreliable"
    assert entry.rank == "–"
    assert entry.unranked_because


def _half_width(values):
    interval = t_interval(values)
    return (interval.high - interval.low) / 2


def test_the_interval_covers_the_architectures_mean_under_both_kinds_of_chance():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(1000):
        values = rng.normal(0, 0.1, (5, 1)) + rng.normal(0, 0.1, (1, 6)) + rng.normal(0, 0.05, (5, 6))
        covered += abs(values.mean()) <= math.hypot(*(_half_width(values.mean(axis)) for axis in (0, 1)))
    assert 0.94 < covered / 1000 < 0.995


def test_the_page_keeps_its_address_when_a_seed_is_added(make_record):
    runs = [_run(make_record("net"), seed, [0.4 + 0.1 * seed, 0.5]) for seed in range(3)]
    (before,), (after,) = _entries(*runs[:2]), _entries(*runs)
    assert before.page == after.page
