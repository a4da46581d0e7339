"""The page says what was judged, and the figures stand beside it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import pytest

from leaderboards.reproduction.campaign import join_campaign, read_campaign
from leaderboards.reproduction.page import PAGE, write_page
from tests.factories.campaigns import draw_campaign

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    out = tmp_path_factory.mktemp("page")
    files, judged = write_page(draw_campaign(1, synthetic=True), out)
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
    assert "not trained yet" in next(line for line in text.splitlines() if "zhuang-lstm.simsiam" in line)


def test_a_board_on_which_the_rule_decides_nothing_says_so(written, tmp_path):
    campaign = draw_campaign(1, synthetic=True)
    few = replace(campaign, boards=tuple(replace(board, conditions=board.conditions[:6]) for board in campaign.boards))
    files, _ = write_page(few, tmp_path)
    told = "the rule leaves all undecided: it needs at least 10 stimuli (here 6)."
    assert told in files[0].read_text(encoding="utf-8")
    assert told not in written[2]


def test_figures_of_the_study_are_drawn_for_light_and_dark(written):
    files, _, text = written
    drawn = {path.stem for path in files[1:]}
    assert drawn == {
        "parameters", "parameters-accuracy", "layers", "rdms", "rdm-lines", "accuracy", "fit", "accuracy-fit",
        "supervised-fit", "augmentation", "masking",
    }  # fmt: skip
    for path in files[1:]:
        svg = path.read_text(encoding="utf-8")
        ElementTree.fromstring(svg)
        assert "prefers-color-scheme:dark" in svg
        assert path.relative_to(files[0].parent).as_posix() in text


@pytest.mark.slow
def test_the_page_of_the_documentation_is_that_of_the_campaign_beside_the_code(tmp_path):
    folder = ROOT / "leaderboards" / "reproduction"
    begun = (folder / "trainings.jsonl").exists() or (folder / "records").exists()
    files, _ = write_page(read_campaign(folder) if begun else join_campaign([], []), tmp_path)
    assert files[0].read_text(encoding="utf-8") == (ROOT / "docs" / PAGE).read_text(encoding="utf-8")


def test_a_campaign_without_records_or_of_nothing_gives_a_page(tmp_path):
    lines = draw_campaign(1).trainings
    lines.append(replace(lines[0], name="full", model="zhuang+gpt"))
    text = write_page(join_campaign(lines, []), tmp_path)[0][0].read_text(encoding="utf-8")
    assert "No network has been scored yet" in text
    assert "| Trained networks fit better than the raw input |" in text
    assert "not scored yet" in text
    assert "| zhuang+gpt." in next(line for line in text.splitlines() if "another size" in line)
    assert all(len({len(row) for row in table}) == 1 for table in _tables(text))
    text = write_page(join_campaign([], []), tmp_path)[0][0].read_text(encoding="utf-8")
    assert "not trained yet" in text
    assert "Figures 3.3 to 3.8" in text
