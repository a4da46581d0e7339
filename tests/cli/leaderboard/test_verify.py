from __future__ import annotations

import json
import shutil
from pathlib import Path

from brainbench.core.records import ResultRecord
from leaderboards.store import read_record


def test_a_record_is_added_known_and_confirmed_by_scoring_again(run, scored, tmp_path):
    path, where = scored
    board = tmp_path / "board"
    board.mkdir()
    (board / f".{path.name}").write_text("{")  # of an addition that was killed at its first record
    first = json.loads(run("leaderboard", "add", str(path), "--to", str(board), "--json").out)
    assert [item["state"] for item in first["results"]] == ["added"]
    again = json.loads(run("leaderboard", "add", str(path), "--to", str(board), "--json").out)
    assert [item["state"] for item in again["results"]] == ["known"]
    result = run("leaderboard", "verify", str(board), "--recordings", where, "--trust-code")
    assert result.status == 0, result.err
    assert "confirmed: scored again with the same result" in result.out


def _forge(path: Path) -> Path:
    """Raise the value and give the file the name that fits it, as a careful cheat would."""
    data = json.loads(path.read_text())
    data["score"]["value"] += 0.2
    forged = path.parent / "forged" / ResultRecord.from_json(data).file_name
    forged.parent.mkdir(exist_ok=True)
    forged.write_text(json.dumps(data))
    assert read_record(forged)
    return forged


def test_an_edited_record_is_refused_and_a_renamed_forgery_does_not_repeat(run, scored, tmp_path):
    path, where = scored
    board = tmp_path / "board"
    run("leaderboard", "add", str(path), "--to", str(board))
    forged = _forge(path)
    refused = run("leaderboard", "add", str(forged), "--to", str(board))
    assert refused.status == 1
    assert "the same computation gave" in refused.out
    assert len(list(board.iterdir())) == 1
    checked = run("leaderboard", "verify", str(forged), "--recordings", where, "--trust-code")
    assert checked.status == 1
    assert "differs: scored again with another result" in checked.out
    assert "score.value" in checked.out
    edited = shutil.copy(forged, tmp_path / path.name)
    refused = run("leaderboard", "add", str(edited), "--to", str(board))
    assert refused.status == 1
    assert "was edited or renamed" in refused.out
    assert run("leaderboard", "add", str(forged), "--to", str(board), "--keep-both").status == 0
    assert "conflict:" in run("leaderboard", "verify", str(board), "--no-score").out


def test_recordings_elsewhere_must_be_given_to_repeat_a_score(run, scored):
    path, _ = scored
    result = run("leaderboard", "verify", str(path), "--trust-code")
    assert result.status == 1
    assert "give them with --recordings PATH" in result.out
