"""Only comparable scores share a board, and only what was tested is ranked on it."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.records import ESTIMATOR_VERSION, ResultRecord
from brainbench.core.statistics import two_factor_error
from leaderboards.boards import NO_SCALE, _combined, conclusions, means_over, rank, table_of
from leaderboards.report.paper import references, write_paper
from leaderboards.site.build import build_leaderboard, table_rows
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


def test_a_model_that_was_scored_twice_has_one_rank_and_pushes_no_other_back():
    best, *others = draw_board({"best": 0.9, "good": 0.6, "level": 0.2}, raw=0.1)
    origin = best.score.provenance
    later = replace(origin, time="2030-01-01T00:00:00+00:00", settings={**origin.settings, "seed": 5})
    again = replace(best, score=replace(best.score, value=best.score.value + 0.02, provenance=later))
    (before,), (after,) = rank([best, *others]), rank([again, best, *others])
    assert {entry.name: entry.rank for entry in after.ranked} == {entry.name: entry.rank for entry in before.ranked}
    assert [entry.value for entry in after.entries if entry.first is None] == [best.score.value]
    assert after.leader is not None
    assert after.leader.value == again.score.value
    assert conclusions(after)[1:] == conclusions(before)[1:]


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
        {"settings": {"time": "mean", "estimator_version": ESTIMATOR_VERSION - 1}},
    ],
)
def test_other_recordings_stimuli_or_time_rule_make_another_board(change):
    here, there = make_record("a"), make_record("b")
    there = replace(there, score=replace(there.score, provenance={**there.score.provenance, **change}))
    assert [len(board.entries) for board in rank([here, there])] == [1, 1]


def test_other_estimators_and_metrics_make_other_boards():
    records = [make_record("a"), make_record("b", estimator="thesis"), make_record("c", metric="crossnobis")]
    assert [len(board.entries) for board in rank(records)] == [1, 1, 1]


def test_the_published_estimators_have_one_board_whatever_version_made_them():
    settings = {"time": "mean", "estimator_version": ESTIMATOR_VERSION - 1}
    here, there = make_record("a", estimator="thesis"), make_record("b", estimator="thesis")
    there = replace(there, score=replace(there.score, provenance={**there.score.provenance, "settings": settings}))
    assert [board.estimator for board in rank([here, there])] == ["thesis"]


def test_of_two_values_of_a_baseline_that_are_as_common_the_newest_is_shown_in_any_order():
    early, late = make_record("early"), make_record("late")
    late = replace(late, baselines={"raw input": replace(late.baselines["raw input"], value=0.4)})
    late = replace(
        late, score=replace(late.score, provenance={**late.score.provenance, "time": "2026-11-21T06:00-03:00"})
    )
    for records in ([early, late], [late, early]):
        (shown,) = [item for item in _board(records).baselines if item.name == "raw input"]
        assert shown.score.value == 0.4


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
    for rounding in (1e-15, 1e-5):  # of sums in another order, and of single precision on another processor
        records[0] = replace(records[0], baselines={"raw input": make_score("raw input", 0.223 + rounding)})
        assert not any(item.notes for item in _board(records).baselines)
    records[0] = replace(records[0], baselines={"raw input": make_score("raw input", 0.223, status="unreliable")})
    assert any(item.notes for item in _board(records).baselines)
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


def test_conclusions_of_many_models_say_how_many_pass_the_test_by_chance():
    many = conclusions(_board(draw_board({f"m{place}": -0.5 for place in range(40)})))
    assert any("40 of 40 models. Each is tested alone: about 2 of as many" in text for text in many)
    few = conclusions(_board(draw_board({f"m{place}": -0.5 for place in range(4)})))
    assert not any("tested alone" in text for text in few)


WIDE = {"best": 0.9, "fair": 0.4, "poor": 0.1}


def _on(record: ResultRecord, benchmark: str, animals: str = "") -> ResultRecord:
    """A record of a benchmark, on recordings of its own."""
    origin = record.score.provenance
    recordings = {**origin.recordings, "content_hash": f"{benchmark}-0123456789"}
    stated = {"name": benchmark, "hash": "00", "citation": f"{benchmark} et al. (2026), doi:10.1000/{benchmark}."}
    subjects = tuple(replace(part, subject=f"{animals or benchmark}-{part.subject}") for part in record.score.subjects)
    score = replace(
        record.score, subjects=subjects, provenance=replace(origin, recordings=recordings, benchmark=stated)
    )
    return replace(record, score=score)


def _records(*benchmarks: str, truths=WIDE, animals: str = "", **design) -> list[ResultRecord]:
    design = {"spread": 0.2} | design
    return [
        _on(record, name, animals)
        for k, name in enumerate(benchmarks)
        for record in draw_board(truths, seed=k, **design)
    ]


def _means(records):
    names, means = means_over(rank(records))
    return names, {mean.name: mean for mean in means}


def test_the_mean_is_that_of_the_boards_and_ranks_follow_it():
    records = _records("lab", "other")
    names, means = _means(records)
    assert {*names} == {"lab", "other"}
    for name, mean in means.items():
        scores = [record.score.scaled for record in records if record.score.name == name]
        assert mean.value == pytest.approx(sum(scores) / 2)
        assert mean.interval.low < mean.value < mean.interval.high
    assert [means[name].rank for name in ("best", "fair", "poor")] == ["1", "2", "3"]


def test_independent_benchmarks_narrow_the_interval_and_shared_animals_do_not():
    def width(animals: str) -> float:
        interval = _means(_records("a", "b", animals=animals))[1]["fair"].interval
        return interval.high - interval.low

    single = [entry.interval for board in rank(_records("a", "b")) for entry in board.entries if entry.name == "fair"]
    widths = [interval.high - interval.low for interval in single]
    assert width("") < 0.85 * np.mean(widths)
    assert width("same") == pytest.approx(np.mean(widths), rel=0.05)


def test_a_model_that_misses_a_benchmark_is_listed_without_a_rank():
    records = [
        record
        for record in _records("lab", "other")
        if (record.score.name, record.score.provenance.benchmark_name) != ("best", "other")
    ]
    names, means = _means(records)
    assert (means["best"].rank, means["best"].unranked_because) == ("–", "no score on other")
    assert math.isnan(means["best"].value)
    assert means["fair"].rank == "1"
    assert table_of(names, [means["best"]])[2][0][-1] == "not ranked: no score on other"


def test_a_score_that_is_not_reliable_has_a_mean_and_no_rank():
    records = _records("lab", "other")
    doubtful = replace(records[0], score=replace(records[0].score, status="unreliable", reasons=("noise",)))
    means = _means([doubtful, *records[1:]])[1]
    assert means[doubtful.score.name].unranked_because == "lab: unreliable"
    assert math.isfinite(means[doubtful.score.name].value)


def test_one_benchmark_or_none_has_no_mean():
    assert means_over(rank(_records("lab"))) == ((), [])
    assert means_over(rank(draw_board(WIDE))) == ((), [])


def test_two_benchmarks_of_one_name_are_told_apart():
    records = _records("lab", "other")
    renamed = [
        replace(
            record, score=replace(record.score, provenance=replace(record.score.provenance, benchmark={"name": "lab"}))
        )
        for record in records
    ]
    assert all(name.startswith("lab (") for name in means_over(rank(renamed))[0])


def test_editions_of_a_benchmark_with_other_stimuli_are_not_one():
    records = _records("lab")
    stated = replace(records[0].score.provenance, stimuli={"content_hash": "other"})
    later = [replace(record, score=replace(record.score, provenance=stated)) for record in records]
    names, means = _means([*records, *later[:2]])
    assert all(name.startswith("lab (") for name in names)
    assert len({*names}) == 2
    assert sorted(mean.unranked_because[:11] for mean in means.values()) == ["", "", "no score on"]
    # Features that were computed elsewhere name no stimuli: they are of the edition with equal labels.
    elsewhere = replace(later[0].score.provenance, stimuli={})
    more = [replace(item, score=replace(item.score, provenance=elsewhere)) for item in _records("other", "lab")[-1:]]
    assert [*_means([*records, *_records("other"), *more])[0]] == ["lab", "other"]


def test_of_a_model_scored_twice_the_newest_record_counts():
    records = _records("lab", "other")
    origin = records[0].score.provenance
    newer = replace(records[0].score, value=0.5, provenance=replace(origin, time="2027-01-01"))
    mean = _means([*records, replace(records[0], score=newer)])[1][newer.name]
    assert mean.scores["lab"] == pytest.approx(newer.scaled)


def test_intervals_of_means_cover_the_truth():
    """Two benchmarks of different noise; 95 % intervals hold the truth in about 95 of 100 draws."""
    rng, hits, draws = np.random.default_rng(0), 0, 400
    from scipy.special import stdtrit

    for _ in range(draws):
        values, errors = [], []
        for animals, stimuli, noise in ((8, 30, 0.3), (12, 20, 0.1)):
            table = 0.5 + noise * (rng.normal(size=(animals, 1)) + 2 * rng.normal(size=(1, stimuli)))
            table += rng.normal(size=table.shape)
            left_out = (table.mean(axis=0).sum() - table.mean(axis=0)) / (stimuli - 1)
            values.append(table.mean())
            errors.append(two_factor_error([*table.mean(axis=1)], left_out))
        error, freedom = _combined(errors, [[0], [1]])
        hits += abs(np.mean(values) - 0.5) <= stdtrit(freedom, 0.975) * error
    assert 0.92 <= hits / draws <= 0.99


def test_the_site_and_the_supplement_show_benchmarks_citations_and_means(tmp_path):
    records = _records("lab", "other")
    page = build_leaderboard(records, tmp_path / "site").read_text()
    assert "Mean over benchmarks" in page
    assert "Cite: lab et al. (2026), doi:10.1000/lab." in page
    assert json.loads((tmp_path / "site" / "data" / "benchmarks.json").read_text())["models"][0]["name"] == "best"
    assert {row["benchmark"] for board in rank(records) for row in table_rows(board)} == {"lab", "other"}
    write_paper(records, tmp_path / "paper.md")
    text, bib = (tmp_path / "paper.md").read_text(), (tmp_path / "paper.bib").read_text()
    assert text.index("## Mean over benchmarks") < text.index("Benchmark: lab.")
    assert "Recordings from: lab et al. (2026), doi:10.1000/lab." in text
    assert "doi = {10.1000/lab}" in bib


def test_a_board_without_benchmarks_shows_none(tmp_path):
    build_leaderboard(draw_board(WIDE), tmp_path / "site")
    assert "Mean over benchmarks" not in (tmp_path / "site" / "index.html").read_text()
    assert not (tmp_path / "site" / "data" / "benchmarks.json").exists()


def test_a_layouts_citation_that_is_known_is_the_entry_of_the_bibliography():
    (record, *_) = _records("lab")
    origin = record.score.provenance
    known = {
        **origin.recordings,
        "citation": "Rodgers C. C., Scientific Data 9:620 (2022), doi:10.1038/s41597-022-01728-1",
    }
    score = replace(record.score, provenance=replace(origin, recordings=known))
    keys = [work.key for work in references([replace(record, score=score)])]
    assert keys.count("rodgers2022") == 1
    assert not any(key.startswith("rodgersc") for key in keys)
