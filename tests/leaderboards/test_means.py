"""Means over benchmarks: intervals cover, animals that are shared count once, and who misses one has no rank."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from brainbench.core.records import ResultRecord
from brainbench.core.statistics import two_factor_error
from leaderboards.boards import rank
from leaderboards.means import _combined, means_over, table_of
from leaderboards.report.paper import references, write_paper
from leaderboards.site.build import build_leaderboard
from leaderboards.site.table import table_rows
from tests.factories.records import draw_board

TRUTHS = {"best": 0.9, "fair": 0.4, "poor": 0.1}


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


def _records(*benchmarks: str, truths=TRUTHS, animals: str = "", **design) -> list[ResultRecord]:
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
    assert means_over(rank(draw_board(TRUTHS))) == ((), [])


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
    build_leaderboard(draw_board(TRUTHS), tmp_path / "site")
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
