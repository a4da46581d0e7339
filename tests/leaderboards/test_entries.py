"""Seeds fold into one entry, and copies of a computation are known."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from leaderboards.boards import rank
from leaderboards.entries import same_computation, twins
from tests.factories.records import draw_board


def _run(record, seed: int, by: float = 0.0, *, objective: str = "untrained", **changes):
    card = replace(record.card, seed=seed, objective=objective, weights=f"{objective}{seed}", **changes)
    subjects = tuple(replace(item, value=item.value + by) for item in record.score.subjects)
    left_out = tuple(value + by for value in record.score.without_stimulus)
    score = replace(record.score, value=record.score.value + by, subjects=subjects, without_stimulus=left_out)
    return replace(record, card=card, score=score)


def _entries(*records):
    (board,) = rank(records)
    return board.entries


def test_every_layer_that_a_seed_was_scored_at_is_named():
    (record,) = draw_board({"net": 0.6})
    other = replace(record, score=replace(record.score, layer="another"))
    (entry,) = _entries(_run(record, 0), _run(other, 1), _run(record, 2))
    assert entry.layer == f"{record.score.layer}, another"


@pytest.mark.parametrize("unknown", ["", "yesterday"])
def test_the_newest_record_of_a_model_is_that_of_the_latest_moment_in_any_zone(unknown):
    (record,) = draw_board({"net": 0.6})

    def made(time, weights):
        card = replace(record.card, weights=weights)
        return replace(
            record, card=card, score=replace(record.score, provenance={**record.score.provenance, "time": time})
        )

    east, west = made("2026-11-30T12:00:00+02:00", "east"), made("2026-11-30T11:00:00+00:00", "west")
    ranked = {entry.card.weights: not entry.unranked_because for entry in _entries(east, west, made(unknown, "none"))}
    assert ranked == {"west": True, "east": False, "none": False}


def test_one_seed_without_a_test_leaves_the_entry_untested():
    (record,) = draw_board({"net": 0.6})
    untested = replace(record, score=replace(record.score, p=math.nan))
    (entry,) = _entries(_run(record, 0), _run(untested, 1))
    assert entry.standing == "not tested"
    assert math.isnan(entry.p)
    assert not entry.above_chance


def test_seeds_are_one_entry_with_mean_interval_and_spread():
    (record,) = draw_board({"net": 0.6})
    (entry,) = _entries(*(_run(record, seed, by) for seed, by in enumerate((-0.1, 0.0, 0.1))))
    assert entry.seeds == 3
    assert entry.scaled == pytest.approx(record.score.scaled)
    assert entry.spread == pytest.approx(0.1)
    assert "3 seeds" in entry.interval.method
    single = record.score.scaled_interval
    assert entry.interval.high - entry.interval.low > single.high - single.low


def test_a_single_record_keeps_its_own_interval():
    (record,) = draw_board({"net": 0.6})
    (entry,) = _entries(record)
    assert entry.interval == record.score.scaled_interval
    assert math.isnan(entry.spread)


def test_objectives_and_augmentations_are_entries_of_their_own_and_twins_are_found():
    plain, trained, masked = draw_board({"zhuang-small": 0.3, "zhuang-small.simclr": 0.8, "other": 0.6})
    trained = _run(trained, 0, objective="simclr", twin="zhuang-small")
    masked = replace(masked, card=replace(trained.card, training={"masking": 0.75}, weights="m"))
    masked = replace(masked, score=replace(masked.score, name="zhuang-small.simclr"))
    found = _entries(plain, trained, masked)
    assert {(entry.name, entry.trained, entry.masking) for entry in found} == {
        ("zhuang-small.simclr", True, 0.0),
        ("zhuang-small.simclr", True, 0.75),
        ("zhuang-small", False, 0.0),
    }
    assert twins(found)[found[0].architecture].name == "zhuang-small"


def test_a_second_record_of_a_seed_is_not_averaged_in():
    (record,) = draw_board({"net": 0.5})

    def at(time, by):
        made = _run(record, 0, by)
        return replace(made, score=replace(made.score, provenance={**made.score.provenance, "time": time}))

    first, second = _entries(at("2026-01", -0.2), at("2026-02", 0.2))
    assert (first.seeds, second.seeds) == (1, 1)
    assert first.value == pytest.approx(record.score.value + 0.2)
    assert (first.unranked_because, second.unranked_because[:17]) == ("", "an earlier record")


@pytest.mark.parametrize("asked", [{"readout": "published"}, {"layer": "encoder.fc7"}, {"normalize": False}])
def test_scores_that_were_asked_for_otherwise_are_no_seeds_of_one_entry(asked):
    (record,) = draw_board({"net": 0.6})
    other = _run(record, 1)
    settings = {**other.score.provenance.settings, **asked}
    score = replace(other.score, provenance={**other.score.provenance, "settings": settings})
    entries = _entries(_run(record, 0), replace(other, score=score), _run(record, 2))
    assert sorted(entry.seeds for entry in entries) == [1, 2]
    assert [f"scored with {name} {value}" for name, value in asked.items()] == list(
        next(entry for entry in entries if entry.seeds == 1).notes
    )


def test_another_network_under_the_path_of_an_earlier_one_is_no_seed_of_it():
    (record,) = draw_board({"mine.py:make": 0.6})
    given = {"objective": "simclr", "family": "user module"}
    one, two, wider = (_run(record, seed, **given, parameters=count) for seed, count in enumerate((1000, 1000, 2000)))
    assert sorted(entry.seeds for entry in _entries(one, two, wider)) == [1, 2]


def test_one_seed_without_a_trusted_score_keeps_the_entry_from_being_ranked():
    (record,) = draw_board({"net": 0.6})
    bad = _run(record, 1)
    (entry,) = _entries(_run(record, 0), replace(bad, score=replace(bad.score, status="unreliable")))
    assert (entry.standing, entry.rank, entry.unranked_because) == ("unreliable", "–", "unreliable")


def test_the_page_keeps_its_address_when_a_seed_is_added():
    (record,) = draw_board({"net": 0.6})
    runs = [_run(record, seed, 0.1 * seed) for seed in range(3)]
    (before,), (after,) = _entries(*runs[:2]), _entries(*runs)
    assert before.page == after.page


def test_copies_of_a_layer_and_other_units_are_the_same_computation():
    one, other = _entries(*draw_board({"one": 0.6, "other": 0.4}))
    assert not same_computation(one, other)
    copy = replace(one.records[0].score, name="copy", layer="another.name")
    scaled = replace(copy, model_rdm=tuple(1e12 * value for value in copy.model_rdm))
    nudged = replace(copy, model_rdm=(copy.model_rdm[0] + 0.01, *copy.model_rdm[1:]))
    for score, same in ((copy, True), (scaled, True), (nudged, False)):
        entry = replace(one, records=(replace(one.records[0], score=score),))
        assert same_computation(one, entry) is same
