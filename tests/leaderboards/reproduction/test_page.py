"""The page says what was judged, and the figures stand beside it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tests.factories.benchmark_programs import benchmark_program
from tests.factories.campaigns import draw_campaign, draw_records, draw_trainings, write_campaign

CAMPAIGN, PAGE = benchmark_program("reproduction.campaign"), benchmark_program("reproduction.page")

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("page")
    files, judged = PAGE.write_page(draw_campaign(1, synthetic=True), out)
    return files, judged, files[0].read_text(encoding="utf-8")


def _tables(text):
    """Rows of each table of a page, as lists of cells."""
    blocks = re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE)
    return [[re.split(r"(?<!\\)\|", line)[1:-1] for line in block.splitlines()] for block in blocks]


def test_tables_are_whole_and_say_the_verdicts(written):
    _, judged, text = written
    for table in _tables(text):
        assert len({len(row) for row in table}) == 1
    for item in judged:
        assert item.verdict in text
    assert "0.035" in text or "holds" in text
    assert "Synthetic" in text
    row = next(line for line in text.splitlines() if line.startswith("| A GPT attender makes"))
    assert "0.027" in row  # the published effect
    assert row.rstrip(" |").endswith("holds")


def test_a_board_on_which_the_rule_decides_nothing_says_so(written, tmp_path):
    campaign = draw_campaign(1, synthetic=True)
    (board,) = campaign.boards
    few = replace(campaign, boards=(replace(board, lacks="at least 10 stimuli (here 6)"),))
    files, _ = PAGE.write_page(few, tmp_path)
    told = "the rule leaves all undecided: it needs at least 10 stimuli (here 6)."
    assert told in files[0].read_text(encoding="utf-8")
    assert told not in written[2]


def test_figures_of_the_study_are_drawn_for_light_and_dark(written):
    files, _, text = written
    images = [path for path in files[1:] if path.suffix == ".svg"]
    assert {path.stem for path in images} == {
        "parameters", "parameters-accuracy", "layers", "rdms", "rdm-lines", "accuracy", "fit", "accuracy-fit",
        "supervised-fit", "augmentation", "masking", "students",
    }  # fmt: skip
    for path in images:
        svg = path.read_text(encoding="utf-8")
        ElementTree.fromstring(svg)
        assert "prefers-color-scheme:dark" in svg
        assert path.relative_to(files[0].parent).as_posix() in text


@pytest.mark.slow
def test_the_page_of_the_documentation_is_that_of_the_campaign_in_the_repository(tmp_path):
    files, _ = PAGE.write_page(CAMPAIGN.read_campaign(ROOT / "leaderboards" / "reproduction"), tmp_path)
    for file in files:
        assert file.read_bytes() == (ROOT / "docs" / file.relative_to(tmp_path)).read_bytes()


def test_the_program_writes_the_page_and_prints_verdicts(tmp_path, monkeypatch, capsys):
    folder, out = write_campaign(tmp_path / "campaign", draw_trainings(1), draw_records(1)[:3]), tmp_path / "out"
    monkeypatch.setattr("sys.argv", ["reproduction", str(folder), "--out", str(out)])
    benchmark_program("reproduction.__main__").main()
    lines = capsys.readouterr().out.splitlines()
    assert next(line for line in lines if line.startswith("gpt-accuracy ")).endswith("holds")
    assert lines[-1] == str(out / PAGE.PAGE)
    assert (out / PAGE.PAGE).is_file()


def test_networks_of_another_size_and_what_is_missing_are_named(tmp_path):
    lines = draw_campaign(1).trainings
    full = replace(lines[0], name="full", model="zhuang+gpt", objective="simclr", augmentation="physical")
    lost = replace(full, name="lost", model="zhuang", status="diverged")
    campaign = CAMPAIGN.join_campaign([*lines, full, lost], draw_records(1)[:1])
    text = PAGE.write_page(campaign, tmp_path)[0][0].read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if "another size" in line]
    assert [row.split(" | ")[0] for row in rows] == ["| zhuang+gpt.simclr", "| zhuang.simclr"]
    assert [row.count("diverged") for row in rows] == [0, 2]
    assert sum("not scored yet" in line for line in text.splitlines()) > 10
    assert all(len({len(row) for row in table}) == 1 for table in _tables(text))
    assert "not trained yet" in next(line for line in text.splitlines() if "GPT attender fits better" in line)
