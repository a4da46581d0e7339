from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from brainbench.cli.score import left_out, score_text
from brainbench.core.records import Interval, ModelCard, ResultRecord
from brainbench.core.statistics import compare_scores
from brainbench.datasets.ledger import Ledger
from brainbench.models.features import write_features
from tests.factories.records import draw_board, make_record, make_score


def test_the_first_lines_say_what_the_weights_are_and_whether_raw_input_is_beaten():
    good, level = draw_board({"good": 0.8, "level": 0.1}, raw=0.1)
    assert "above raw input" in score_text(good).splitlines()[1].lower()
    assert score_text(level).splitlines()[1].startswith("Not told apart from raw input")
    found = compare_scores(good.score, good.baselines["raw input"])
    assert f"{found.difference:.2f}" in score_text(good).splitlines()[1]
    assert score_text(good).splitlines()[2].startswith("Score")


@pytest.mark.parametrize(
    ("card", "told"),
    [
        (ModelCard("zhuang", "zhuang", "untrained", seed=0), "(random weights, seed 0)"),
        (ModelCard("zhuang", "zhuang", "simclr", seed=1), "(trained: simclr)"),
        (ModelCard("mine.py:make", "user module", seed=2), "(your code, seed 2)"),
    ],
)
def test_the_headline_tells_random_weights_from_trained_ones(card, told):
    assert told in score_text(replace(make_record(), card=card)).splitlines()[0]


def test_an_undefined_score_prints_its_reason_and_nothing_that_does_not_exist():
    text = score_text(make_record(status="undefined", layer=None, best_layer=None, interval=None))
    assert "None" not in text
    assert "nan" not in text
    assert "two of three animals are noise" in text.splitlines()[1]


def test_a_score_that_was_kept_is_printed_as_it_was():
    names = ("raw input", "random features", "presentation time")
    record = replace(make_record(), baselines={name: make_score(name, 0.99) for name in names})
    assert score_text(ResultRecord.from_json(json.loads(record.to_json()))) == score_text(record)


def test_an_interval_past_what_can_exist_is_cut_and_noted():
    text = score_text(make_record(reliability=0.9, reliability_interval=Interval(0.7, 1.1)))
    assert "0.90 [0.70, 1.00]" in text
    assert "cut at 1" in text


def test_what_was_not_used_is_told():
    ledger = Ledger()
    ledger.find("trials", 5, 4)
    ledger.leave("trials", "outside the recorded span")
    ledger.leave("units", "no spikes", 0)
    assert [*left_out({"ledger": ledger.stated()})] == ["Left out: 1 of 5 trials: outside the recorded span."]
    assert not [*left_out({})]


def test_a_title_of_the_user_replaces_the_name_of_the_file(run, files):
    asked = ("--conditions", "trials:texture", "--out", files["out"])
    folder = run("score", files["features"], "--recordings", f"{files['recordings']}/*.h5", *asked)
    assert folder.out.splitlines()[0].endswith("data")
    titled = run("score", files["features"], "--recordings", files["recordings"], "--title", "Two mice", *asked)
    assert titled.out.splitlines()[0].endswith("Two mice")


LABELS = ("a", "b", "c", "d")


def _score(run, files: dict[str, str], model: str, *more: str):
    return run(
        "score",
        model,
        "--recordings",
        files["recordings"],
        "--conditions",
        "trials:texture",
        "--out",
        files["out"],
        *more,
    )


def test_score_prints_the_statistics_and_writes_record_and_report(run, files):
    result = _score(run, files, files["features"])
    assert result.status == 0, result.err
    for word in ("score", "status", "reliability", "permutation p", "noise ceiling", "animal to animal"):
        assert word in result.out
    record = next(Path(files["out"]).glob("*.json"))
    report = record.with_suffix(".html")
    assert str(record) in result.out
    assert str(report) in result.out
    assert "<html" in report.read_text().lower()


def test_json_is_one_document_on_stdout(run, files):
    result = _score(run, files, files["features"], "--json")
    data = json.loads(result.out)
    assert Path(data["record_path"]).is_file()
    assert json.loads(Path(data["record_path"]).read_text()) == data["record"]
    assert data["record"]["score"]["stimuli"] == list(LABELS)


def test_json_holds_the_test_against_raw_input_that_is_printed(run, tmp_path, monkeypatch):
    (record,) = draw_board({"good": 0.8}, raw=0.1)
    doubtful = replace(record, score=replace(record.score, status="unreliable"))
    data = []
    for stored in (record, doubtful):
        monkeypatch.setattr("brainbench.scoring.kept_records.read_kept", lambda path, stored=stored: stored)
        data.append(json.loads(run("score", "zhuang-small", "--out", str(tmp_path), "--json").out))
    found = data[0]["against_raw_input"]
    assert f"difference {found['difference']:.2f}" in score_text(record).splitlines()[1]
    assert f"p = {found['p']:.2g}" in score_text(record).splitlines()[1]
    assert "against_raw_input" not in data[1], "an unreliable score is not compared"


def test_a_users_file_is_scored_on_a_users_arrays(run, files):
    result = _score(run, files, files["model"], "--stimuli", files["arrays"], "--json")
    assert result.status == 0, result.err
    record = json.loads(result.out)["record"]
    assert {item["layer"] for item in record["score"]["layers"]} == {"gru", "output"}
    assert set(record["baselines"]) == {"raw input", "random features", "presentation time"}


def test_labels_are_matched_by_a_file(run, files, tmp_path):
    other = write_features(
        tmp_path / "o.h5", ["w", "b", "c", "d"], {"fc": np.random.default_rng(1).normal(size=(4, 6))}
    )
    result = _score(run, files, str(other))
    assert result.status == 2
    assert "without a stimulus: 'a'" in result.err
    match = tmp_path / "match.csv"
    match.write_text("a,w\n")
    assert _score(run, files, str(other), "--match", str(match)).status == 0
