from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from leaderboards.store import read_record, write_record
from tests.factories.records import make_record

PARTS = ("--conditions", "trials:texture")


def test_a_folder_becomes_a_site_and_a_report_and_a_score_its_own(run, scored, files, tmp_path):
    path, where = scored
    site = tmp_path / "site"
    assert json.loads(run("leaderboard", "build", str(path.parent), "--out", str(site), "--json").out)["records"] == 1
    assert (site / "index.html").is_file()
    result = run("leaderboard", "report", str(site), "--out", str(tmp_path / "r.md"), "--json")
    assert [Path(name).suffix for name in json.loads(result.out)["files"][:2]] == [".md", ".bib"]
    assert run("leaderboard", "report", str(site), "--format", "docx").status == 2
    given = ("--stimuli", files["arrays"], "--recordings", where, *PARTS, "--out", files["out"])
    result = run("score", files["model"], *given, "--report", str(tmp_path / "one.html"))
    assert result.status == 0, result.err
    assert "paper" in result.out
    assert "<svg" in (tmp_path / "one.html").read_text()
    record = max(path.parent.glob("*.json"), key=lambda item: item.stat().st_mtime)
    assert "--report" not in read_record(record).score.provenance["command"]


def test_a_site_is_opened_in_a_browser_and_its_place_is_said_where_there_is_none(run, scored, monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr("webbrowser.open", lambda address: bool(asked.append(address)))
    path, _ = scored
    result = run("leaderboard", "build", str(path.parent), "--out", str(tmp_path / "site"), "--open")
    assert result.status == 0, result.err
    assert asked == [(tmp_path / "site" / "index.html").as_uri()]
    assert "No browser" in result.err
    assert run("leaderboard", "build", str(path.parent / "none")).status == 2


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


def test_the_leaderboard_is_built_from_records(run, files, tmp_path):
    _score(run, files, files["features"])
    page = tmp_path / "board"
    broken = Path(files["out"]) / "broken.json"
    broken.write_text("{")
    result = run("leaderboard", "build", files["out"], "--out", str(page), "--json")
    data = json.loads(result.out)
    assert data["records"] == 1
    assert len(data["problems"]) == 1
    assert "features" in (page / "index.html").read_text()


def test_the_leaderboard_of_no_records_says_how_to_get_some(run, tmp_path):
    result = run("leaderboard", "build", str(tmp_path / "none"), "--out", str(tmp_path / "page"))
    assert result.status == 2
    assert not (tmp_path / "page").exists()
    assert "brainbench score" in result.err


def test_of_records_that_cannot_be_read_no_board_is_written(run, tmp_path):
    (tmp_path / "broken.json").write_text("{")
    result = run("leaderboard", "build", str(tmp_path / "broken.json"), "--out", str(tmp_path / "page"))
    assert result.status == 1
    assert "None of these records can be read" in result.err
    assert "broken.json" in result.err
    assert not (tmp_path / "page").exists()


ACTS = "\x1b[31mred\x1b[0m\x1b]0;title\x07\u202ex\n::error::y"


def test_text_of_others_is_data_wherever_it_is_shown(run, tmp_path):
    for folder, name in {"before": "zhuang", "after": ACTS}.items():
        write_record(make_record(name), tmp_path / folder)
    acting = next((tmp_path / "after").iterdir())
    renamed = acting.rename(acting.with_name(f"x\n::error::x--{acting.stem.rpartition('--')[2]}.json"))
    after, site = str(tmp_path / "after"), tmp_path / "site"
    outputs = [
        run("leaderboard", "verify", "--no-score", after).out,
        run("leaderboard", "diff", str(tmp_path / "before"), after).out,
        run("leaderboard", "add", str(renamed), "--to", str(tmp_path / "board")).out,
    ]
    assert run("leaderboard", "build", after, "--out", str(site)).status == 0
    assert run("leaderboard", "report", after, "--out", str(tmp_path / "report.md")).status == 0
    files = [*site.rglob("*.html"), *site.rglob("*.csv"), *tmp_path.rglob("*.svg"), *tmp_path.glob("report.*")]
    assert not [line for text in outputs for line in text.splitlines() if line.startswith("::")]
    outputs += [path.read_text() for path in files]
    for text in outputs:
        assert not set(text) & set("\x1b\x07\u202e")


def test_a_name_that_reads_like_one_of_the_registry_or_a_benchmark_is_refused(run, tmp_path):
    write_record(make_record("s4-sm\u0430ll"), tmp_path / "twin")
    for name in ("touch", "t\u043euch"):
        record = make_record(f"mine-{len(name.encode())}")
        origin = replace(record.score.provenance, benchmark={"name": name})
        write_record(replace(record, score=replace(record.score, provenance=origin)), tmp_path / "twin")
    added = run("leaderboard", "add", str(tmp_path / "twin"), "--to", str(tmp_path / "board"))
    assert added.status == 1
    assert r"its name 's4-sm\u0430ll' reads like 's4-small'" in added.out
    assert "reads like 'touch'" in added.out or r"reads like 't\u043euch'" in added.out
    run("leaderboard", "build", str(tmp_path / "twin"), "--out", str(tmp_path / "site"))
    shown = (tmp_path / "site" / "data" / "leaderboard.csv").read_text()
    assert r"s4-sm\u0430ll" in shown
    for text in (shown, *(path.read_text() for path in (tmp_path / "site").glob("*.html"))):
        assert "\u0430" not in text


def test_names_that_read_alike_are_refused_or_marked(run, tmp_path):
    for name in ("zhuang-small", "zhuang-small ", "zhuang\u2010small"):
        write_record(make_record(name), tmp_path / "alike")
    added = run("leaderboard", "add", str(tmp_path / "alike"), "--to", str(tmp_path / "board"))
    assert (added.status, added.out.count("reads like")) == (1, 2)
    assert len(list((tmp_path / "board").iterdir())) == 1
    assert "look-alike: its name reads like" in run("leaderboard", "verify", "--no-score", str(tmp_path / "alike")).out
    run("leaderboard", "build", str(tmp_path / "alike"), "--out", str(tmp_path / "site"))
    table = (tmp_path / "site" / "data" / "leaderboard.csv").read_text()
    assert "zhuang-small\\x20" in table
    assert "zhuang\\u2010small" in table
