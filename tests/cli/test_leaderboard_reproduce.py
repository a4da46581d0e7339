"""``brainbench leaderboard reproduce`` from the command line."""

from __future__ import annotations

import json

from tests.factories.campaigns import draw_trainings, write_campaign


def test_a_campaign_becomes_a_page(run, tmp_path):
    folder = write_campaign(tmp_path / "campaign", draw_trainings(1))
    result = run("leaderboard", "reproduce", str(folder), "--out", str(tmp_path / "out"), "--json")
    assert result.status == 0, result.err
    found = json.loads(result.out)
    verdicts = {item["claim"]["key"]: item["verdict"] for item in found["judgements"]}
    assert verdicts["gpt-accuracy"] == "holds"
    assert (tmp_path / "out" / "what-reproduces.md").is_file()
    assert "gpt-accuracy" in run("leaderboard", "reproduce", str(folder), "--out", str(tmp_path / "out")).out


def test_a_folder_that_is_no_campaign_is_refused_in_one_sentence(run, tmp_path):
    result = run("leaderboard", "reproduce", str(tmp_path))
    assert result.status != 0
    assert "trainings.jsonl" in result.err
    assert "Traceback" not in result.err
