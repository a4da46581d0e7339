"""Recordings are split, the held-out part is committed to, submissions are scored on it; foreign code is not run."""

from __future__ import annotations

import json
import os
import re
import stat
from dataclasses import replace
from pathlib import Path

import pytest

from brainbench.core.errors import DataError
from brainbench.core.records import ModelCard
from brainbench.datasets import open_recordings
from leaderboards.held_out import DATA, SALT, Commitment
from leaderboards.store import read_record, write_record
from tests.factories.records import make_record

LABELS = tuple("abcdefgh")
PARTS = ("--conditions", "trials:texture")


def _hold_out(run, study, *what):
    return run("leaderboard", "hold-out", study["data"], *what, *PARTS, "--out", study["board"], "--secret",
               study["secret"], "--json")  # fmt: skip


@pytest.mark.parametrize(("what", "held"), [("animals", 2), ("stimuli", 4)])
def test_both_parts_together_are_the_recordings_and_the_hash_opens(run, study, what, held):
    result = _hold_out(run, study, f"--{what}", str(held))
    assert result.status == 0, result.err
    public, kept = open_recordings(Path(study["board"]) / "public.h5"), open_recordings(Path(study["secret"]) / DATA)
    name = {"animals": "subject", "stimuli": "stimulus"}[what]
    parts = [set(map(str, part[name].values)) for part in (public, kept)]
    assert parts[0] | parts[1] == set({"animals": "wxyz", "stimuli": LABELS}[what])
    assert not parts[0] & parts[1]
    assert len(parts[1]) == held
    assert public.attrs["content_hash"] != kept.attrs["content_hash"]
    told = Commitment.read(Path(study["board"]) / "held-out.json")
    assert (told.kind, told.held) == (what, held)
    assert told.open(study["secret"]) == Path(study["secret"]) / DATA
    published = "".join(path.read_text(errors="ignore") for path in Path(study["board"]).glob("*.json"))
    assert (Path(study["secret"]) / SALT).read_text().strip() not in published


def test_nobody_else_can_read_what_is_held_back(run, study):
    before = os.umask(0)
    try:
        assert _hold_out(run, study, "--animals", "2").status == 0
    finally:
        os.umask(before)
    secret = Path(study["secret"])
    assert stat.S_IMODE(secret.stat().st_mode) == 0o700
    assert {path.name: oct(stat.S_IMODE(path.stat().st_mode)) for path in secret.iterdir()} == {
        DATA: "0o600", SALT: "0o600"
    }  # fmt: skip


def test_another_file_or_salt_does_not_open_the_commitment(run, study):
    _hold_out(run, study, "--animals", "2")
    told = Commitment.read(Path(study["board"]) / "held-out.json")
    salt = Path(study["secret"]) / SALT
    right = salt.read_text()
    salt.write_text("0" * 64)
    with pytest.raises(DataError, match="commits"):
        told.open(study["secret"])
    salt.write_text(right)
    (Path(study["secret"]) / DATA).write_bytes(b"others")
    with pytest.raises(DataError, match="commits"):
        told.open(study["secret"])
    with pytest.raises(DataError, match="lacks"):
        told.open(study["out"])


@pytest.mark.parametrize(
    "what", [(), ("--animals", "1"), ("--animals", "3"), ("--stimuli", "6"), ("--animals", "2", "--stimuli", "3")]
)
def test_parts_too_small_to_score_are_refused(run, study, what):
    assert _hold_out(run, study, *what).status == 2
    assert not Path(study["secret"]).exists()


def test_an_earlier_secret_is_not_overwritten(run, study):
    _hold_out(run, study, "--animals", "2")
    again = _hold_out(run, study, "--animals", "2")
    assert again.status == 2
    assert study["secret"] in again.err


def test_the_public_part_does_not_take_the_place_of_the_recordings(run, study):
    _hold_out(run, study, "--animals", "2")
    public = Path(study["board"]) / "public.h5"
    before = public.read_bytes()
    for source in (public, public.parent):
        again = _hold_out(run, study | {"data": str(source), "secret": study["secret"] + "2"}, "--animals", "2")
        assert (again.status, public.read_bytes()) == (2, before)
        assert "would take the place" in again.err


@pytest.mark.parametrize(("what", "held"), [("animals", 2), ("stimuli", 4)])
def test_a_submission_is_scored_on_what_is_held_out(run, study, what, held):
    _hold_out(run, study, f"--{what}", str(held))
    public = str(Path(study["board"]) / "public.h5")
    given = ("--recordings", public, "--match", str(Path(study["board"]) / "match.json"))
    scored = run("score", study["features"], *given, "--out", study["out"], "--json")
    assert scored.status == 0, scored.err
    path = json.loads(scored.out)["record_path"]
    check = ("leaderboard", "verify", path, "--held-out", str(Path(study["board"]) / "held-out.json"), "--secret",
             study["secret"], "--recordings", public, "--json")  # fmt: skip
    (result,) = json.loads(run(*check, "--trust-code").out)
    assert result["verdict"] == "confirmed"
    assert result["held_out"] == f"{held} {what}"
    for name in ("on_public", "on_held_out"):
        assert result[name]["standing"]
        score = result[name]["score"]
        assert score is None or score == round(score, 2)
    untrusted = run(*check)
    assert untrusted.status == 1
    (result,) = json.loads(untrusted.out)
    assert result["verdict"] == "not repeated"
    assert "on_held_out" not in result


def test_code_that_a_record_names_is_not_run(run, tmp_path):
    spy = tmp_path / "spy.py"
    spy.write_text(f"open({str(tmp_path / 'ran')!r}, 'w').close()\n\n\ndef make():\n    return None\n")
    for settings in ({"model": f"{spy}:make", "metric": "rsa"}, {"model": "s4-small", "metric": f"{spy}:make"}):
        record = make_record("spy")
        origin = {**record.score.provenance, "settings": settings, "recordings": {"source": "demo"}}
        record = replace(record, score=replace(record.score, provenance=origin), card=ModelCard("spy", family="s4"))
        path = write_record(record, tmp_path / "records")
        assert read_record(path)
        result = run("leaderboard", "verify", str(path))
        assert result.status == 1
        assert "--trust-code" in result.out
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "odd", [{"seed": "x"}, {"layers": 3}, {"time": 4}, {"bin": -1}, {"units_reliability": [2]}, {"metric": ["rsa"]}]
)
def test_settings_of_other_kinds_are_named_and_not_repeated(run, tmp_path, odd):
    record = make_record("s4-small")
    settings = {"model": "s4-small", "metric": "rsa", **odd}
    origin = {**record.score.provenance, "settings": settings, "recordings": {"source": "demo"}}
    path = write_record(replace(record, score=replace(record.score, provenance=origin)), tmp_path)
    (result,) = json.loads(run("leaderboard", "verify", str(path), "--json").out)
    assert result["verdict"] == "not repeated"
    assert re.search(rf"\b{next(iter(odd))}'?(:| must be| of)", result["problem"])
