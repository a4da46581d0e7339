import json
from pathlib import Path

import numpy as np

from brainbench.models.features import write_features

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
