"""``brainbench benchmark``: a lab makes and packs, a stranger scores the one file and gets the lab's score."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

VOLATILE = ("time", "seconds", "command", "benchmark")


def _steady(value):
    if isinstance(value, dict):
        return {key: _steady(inner) for key, inner in value.items() if key not in VOLATILE}
    return [_steady(inner) for inner in value] if isinstance(value, list) else value


def _record(folder: Path) -> dict:
    (path,) = folder.glob("*.json")
    return json.loads(path.read_text())


def test_a_stranger_gets_the_labs_score_byte_for_byte_from_one_file(run, study, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    how = ("--recordings", "data", "--conditions", "trials:texture", "--stimuli", "eight.h5")
    about = (
        "--citation",
        "Doe (2026)",
        "--contact",
        "doe@lab",
        "--source",
        "DANDI",
        "--doi",
        "10.1/2",
        "--licence",
        "CC0",
    )
    result = run("benchmark", "make", *how, *about, "--out", "lab.toml", "--json")
    assert result.status == 0, result.err
    stated = json.loads(result.out)
    assert stated["benchmark"]["citation"] == "Doe (2026)"
    assert f'hash = "{stated["hash"]}"' in Path("lab.toml").read_text()
    assert run("benchmark", "pack", "lab.toml", "--out", "lab.zip").status == 0
    assert run("score", study["features"], *how, "--out", "ours").status == 0

    fresh = tmp_path / "fresh"
    fresh.mkdir()
    shutil.move("lab.zip", fresh)
    shutil.move("data", tmp_path / "gone")
    shutil.move("eight.h5", tmp_path / "gone")
    monkeypatch.chdir(fresh)
    result = run("score", study["features"], "--benchmark", "lab.zip", "--out", "theirs")
    assert result.status == 0, result.err
    assert "lab: data" in result.out
    lab, stranger = _record(tmp_path / "ours"), _record(fresh / "theirs")
    assert json.dumps(_steady(stranger)) == json.dumps(_steady(lab))
    assert stranger["score"]["provenance"]["benchmark"]["citation"] == "Doe (2026)"
    assert stranger["score"]["provenance"]["command"].endswith("--benchmark lab.zip")

    (record,) = (fresh / "theirs").glob("*.json")
    result = run("leaderboard", "verify", str(record), "--trust-code")
    assert "made on the benchmark 'lab'; give it with --benchmark FILE" in result.out + result.err
    result = run("leaderboard", "verify", str(record), "--benchmark", "lab.zip", "--trust-code")
    assert "confirmed: scored again with the same result" in result.out, result.out + result.err

    result = run("score", study["features"], "--benchmark", "lab.zip", "--fidelity", "balanced", "--metric", "cka")
    assert result.status == 2
    assert "metric is a matter of the benchmark 'lab', which states 'rsa'; received 'cka'" in result.err


def test_a_typed_default_that_contradicts_is_refused(run, lab):
    result = run("score", str(lab / "features.h5"), "--benchmark", str(lab / "lab.toml"), "--seed=0")
    assert result.status == 2
    assert "seed is a matter of the benchmark 'lab', which states 1; received 0" in result.err


def test_check_tells_what_is_wrong_by_its_exit_status(run, lab):
    result = run("benchmark", "check", str(lab / "lab.toml"))
    assert result.status == 0, result.err
    assert "note   contact is empty: whom to ask" in result.out
    (lab / "eight.h5").write_bytes(b"other")
    result = run("benchmark", "check", str(lab / "lab.toml"))
    assert result.status == 1
    assert "'eight.h5' is not the file that the benchmark 'lab' lists" in result.err


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("make", "--out", "lab.zip"), "--out is a file that ends in .toml"),
        (("pack", "lab.toml", "--out", "lab.tar"), "--out is a file that ends in .zip"),
        (("check", "lab.tml"), "Unknown benchmark 'lab.tml'"),
    ],
)
def test_wrong_words_are_one_sentence(run, words, sentence):
    result = run("benchmark", *words)
    assert result.status == 2
    assert sentence in result.err


def test_a_benchmark_is_added_listed_and_scored_by_its_name(run, lab, monkeypatch):
    monkeypatch.setenv("BRAINBENCH_CONFIG", str(lab / "settings"))
    assert "No benchmark has a name here" in run("benchmark", "list").out
    assert run("benchmark", "add", str(lab / "lab.toml")).status == 0
    assert [*json.loads(run("benchmark", "list", "--json").out)] == ["lab"]
    shutil.rmtree(lab / "data")
    result = run("score", str(lab / "features.h5"), "--benchmark", "lab", "--out", str(lab / "out"))
    assert result.status == 0, result.err
    jobs = ("leaderboard", "add", "--model", str(lab / "features.h5"), "--benchmark", "lab", "--to", str(lab / "out"))
    result = run(*jobs)
    assert result.status == 0, result.err
    assert "1 known" in result.out
