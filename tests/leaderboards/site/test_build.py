"""The site holds every record, keeps boards apart, offers its data, and runs nothing that a record brings along."""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import math
import re
import shutil
import zipfile
from collections import Counter
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from brainbench.core.errors import BrainbenchError, DataError, UsageError
from brainbench.core.records import ResultRecord
from brainbench.core.statistics import compare_scores
from leaderboards import build_leaderboard, read_records, write_record, write_report
from leaderboards import text as words
from leaderboards.boards import rank
from leaderboards.ranking import STANDINGS
from leaderboards.site.build import COLUMNS, FIELDS, MANIFEST
from tests.factories.records import draw_board, make_record
from tests.factories.sweep_batches import files_of

VOID = {"meta", "img", "br", "hr", "input", "link"}


class Page(HTMLParser):
    """The parsed page; fails on tags that do not nest."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str]]] = []
        self.open: list[str] = []
        self.texts: list[tuple[str, str]] = []
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)
        self.close()
        assert self.open == []
        self.text = " ".join(" ".join(text for tag, text in self.texts if tag not in ("style", "script")).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert len(dict(attrs)) == len(attrs), f"{tag} repeats an attribute"
        self.elements.append((tag, {name: value or "" for name, value in attrs}))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, {name: value or "" for name, value in attrs}))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append((self.open[-1] if self.open else "", data))

    def all(self, tag: str) -> list[dict[str, str]]:
        return [attributes for name, attributes in self.elements if name == tag]

    def shape(self) -> list[tuple[str, tuple[str, ...]]]:
        return [(tag, tuple(attributes)) for tag, attributes in self.elements]


HOSTILE = (
    "</script><script>document.title='pwned'</script>",
    '"><img src=x onerror="document.title=\'pwned\'">',
    "' onmouseover='document.title=1' x='",
    "</style><svg onload=document.title='pwned'>",
    "javascript:document.title='pwned'",
    "{{ 7 * 7 }}{% raw %}",
    "]]><!--<title>pwned</title>",
)
"""Texts that would do harm if they ran."""


def _poison(data: Any, text: str) -> Any:
    """Replace every string of a record but its status, keys of open mappings included."""
    if isinstance(data, dict):
        poisoned = {key: value if key == "status" else _poison(value, text) for key, value in data.items()}
        for key in ("baselines", "provenance"):
            if key in poisoned:
                poisoned[key] |= {text: next(iter(poisoned[key].values()))}
        return poisoned
    if isinstance(data, list):
        return [_poison(item, text) for item in data]
    return text if isinstance(data, str) else data


def _poisoned(record: ResultRecord, text: str) -> ResultRecord:
    return ResultRecord.from_json(_poison(json.loads(record.to_json()), text))


@pytest.fixture
def site(make_record, tmp_path):
    return build_leaderboard([make_record("a"), make_record("b")], tmp_path / "site").parent


def _refused(make_record, site, culprit):
    before = files_of(site)
    with pytest.raises(BrainbenchError) as caught:
        build_leaderboard([make_record("c")], site)
    assert culprit in str(caught.value)
    assert files_of(site) == before


def test_the_manifest_lists_every_file_with_its_hash(site):
    listed = json.loads((site / MANIFEST).read_text())
    assert {*listed, MANIFEST} == set(map(str, files_of(site)))
    assert all(len(digest) == 64 for digests in listed.values() for digest in digests)


@pytest.mark.parametrize(
    "name", ["records/mine.json", "data/leaderboard.xlsx", "models/x--y.html", ".git/HEAD", "n.txt"]
)
def test_a_file_that_no_build_wrote_stops_the_build(make_record, site, name):
    (site / name).parent.mkdir(exist_ok=True)
    (site / name).write_text("precious")
    _refused(make_record, site, name)


def test_a_file_that_was_changed_since_stops_the_build(make_record, site):
    (site / "index.html").write_text("my own words")
    _refused(make_record, site, "index.html")


def test_links_are_neither_followed_nor_removed(make_record, site, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (site / "models" / "x").symlink_to(tmp_path / "elsewhere")
    _refused(make_record, site, "models/x")


def test_a_folder_of_records_is_no_site(make_record, tmp_path):
    from leaderboards import write_record

    path = write_record(make_record("a"), tmp_path / "records")
    (tmp_path / "data").mkdir()
    with pytest.raises(UsageError):
        build_leaderboard(read_records(tmp_path), tmp_path)
    assert [item.relative_to(tmp_path) for item in tmp_path.rglob("*.*")] == [path.relative_to(tmp_path)]


@pytest.mark.parametrize("text", ["{", "[1]", '{"index.html": 3}', "\x00"])
def test_without_a_whole_manifest_nothing_counts_as_built(make_record, site, text):
    (site / MANIFEST).write_text(text)
    _refused(make_record, site, MANIFEST)
    (site / MANIFEST).unlink()
    _refused(make_record, site, "no build")


def test_temporary_files_of_a_build_killed_elsewhere_do_not_stop_the_build(make_record, site, tmp_path):
    (site / "models" / ".x-0123456789abcdef.html").write_text("half")
    build_leaderboard([make_record("a")], site)
    (tmp_path / "new").mkdir()
    (tmp_path / "new" / ".build-manifest-0123456789abcdef.json").write_text("half")
    build_leaderboard([make_record("a")], tmp_path / "new")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / ".mine-0123456789abcdef.json").write_text("half")
    with pytest.raises(UsageError, match="mine"):
        build_leaderboard([make_record("a")], tmp_path / "other")


def test_an_error_leaves_the_earlier_site(make_record, site, monkeypatch):
    from leaderboards.site import build

    before = files_of(site)
    monkeypatch.setattr(build, "to_json", lambda _: (_ for _ in ()).throw(MemoryError))
    with pytest.raises(MemoryError):
        build_leaderboard([make_record("c")], site)
    assert files_of(site) == before


def test_a_copy_of_a_site_can_be_built_again(make_record, site, tmp_path):
    shutil.copytree(site, tmp_path / "copy")
    build_leaderboard([make_record("c")], tmp_path / "copy")
    assert len(list((tmp_path / "copy" / "models").iterdir())) == 1


CHROMIUM = shutil.which("chromium")
browser = pytest.mark.skipif(CHROMIUM is None, reason="needs the chromium browser")


def build(records: list[Any], folder: Path, **options: Any) -> Path:
    return build_leaderboard(records, folder / "site", **options).parent


def data(site: Path) -> dict[str, Any]:
    page = Page(site / "index.html")
    return json.loads(next(text for owner, text in page.texts if owner == "script"))


def columns(board: dict[str, Any], *names: str) -> list[tuple[Any, ...]]:
    return list(zip(*(board["data"][name] for name in names), strict=True))


def _seeded(record, seed: int, by: float):
    card = replace(record.card, seed=seed, objective="untrained", weights=f"w{seed}")
    subjects = tuple(replace(item, value=item.value + by) for item in record.score.subjects)
    left_out = tuple(value + by for value in record.score.without_stimulus)
    score = replace(record.score, value=record.score.value + by, subjects=subjects, without_stimulus=left_out)
    return replace(record, card=card, score=score)


def test_the_page_says_what_the_board_lets_conclude_and_how_to_get_a_model(tmp_path):
    site = build(draw_board({"s4-small": 0.9, "weak": 0.3}, spread=0.1, truth="s4-small"), tmp_path)
    page, (board,) = Page(site / "index.html"), data(site)["boards"]
    for sentence in board["conclusions"]:
        assert sentence in page.text
    assert "hidden network was found" in page.text
    assert columns(board, "get")[0] == ('brainbench score s4-small; brainbench.load_model("s4-small")',)
    model = Page(next((site / "models").glob("s4-small--*")))
    assert "brainbench score s4-small" in model.text
    assert "rank 1" in model.text


def test_boards_are_kept_apart_and_the_page_says_so(make_record, tmp_path):
    site = build([make_record("a"), make_record("b", estimator="thesis")], tmp_path)
    assert [board["data"]["name"][0] for board in data(site)["boards"]] == ["a", "b"]
    assert "Scores are comparable only within a board" in Page(site / "index.html").text


def test_bad_files_are_listed_and_left_out(make_record, tmp_path):
    write_record(make_record("good"), tmp_path / "store")
    edited = write_record(make_record("edited"), tmp_path / "store")
    edited.write_text(edited.read_text().replace("0.523", "0.993"))
    page = Page(build(read_records(tmp_path / "store"), tmp_path) / "index.html")
    assert "1 file is left out" in page.text
    assert f"{edited.name!r} was edited or renamed" in page.text
    assert "0.993" not in page.source


def test_conflicts_and_stale_records_are_said_in_the_row_and_on_the_page(make_record, tmp_path):
    site = build([make_record("a", 0.5), make_record("a", 0.6)], tmp_path)
    (board,) = data(site)["boards"]
    assert all("conflict:" in notes for notes in board["data"]["notes"][:2])
    assert "the same computation gave" in Page(next((site / "models").iterdir())).text


def test_downloads_hold_the_records_and_the_table(make_record, tmp_path):
    records = [make_record("=HYPERLINK(1)", 0.3), make_record("b", 0.8), make_record("c", status="undefined")]
    site = build(records, tmp_path)
    rows = list(csv.DictReader((site / "data" / "leaderboard.csv").read_text().splitlines()))
    models = [(row["name"], row["value"], row["scaled"]) for row in rows if row["kind"] == "model"]
    assert models == [("b", "0.8", "0.8"), ("'=HYPERLINK(1)", "0.3", "0.3"), ("c", "", "")]
    zipfile.ZipFile(site / "data" / "records.zip").extractall(tmp_path / "unpacked")
    identities = {record.identity for record in records}
    for folder in (tmp_path / "unpacked", site / "records"):
        assert {item.record.identity for item in read_records(folder) if item.record} == identities
    links = {link["href"] for link in Page(site / "index.html").all("a") if "download" in link}
    assert all((site / link).is_file() for link in links)
    assert len(links) == 4


def test_equal_records_give_equal_sites_in_any_order_and_a_rebuild_leaves_nothing_old(make_record, tmp_path):
    records = [make_record(name, 0.5) for name in "abcd"]
    (tmp_path / "x").mkdir()
    one, other = build(records, tmp_path), build(records[::-1], tmp_path / "x")
    names = sorted(path.relative_to(one) for path in one.rglob("*.*"))
    assert names == sorted(path.relative_to(other) for path in other.rglob("*.*"))
    assert all((one / name).read_bytes() == (other / name).read_bytes() for name in names)
    build(records[:1], tmp_path)
    assert len(list((one / "models").iterdir())) == len(list((one / "records").iterdir())) == 1


def test_nothing_to_show_and_foreign_folders_are_errors_that_say_what_to_do(make_record, tmp_path):
    with pytest.raises(DataError, match=r"no result records.*brainbench score MODEL --out FOLDER"):
        build_leaderboard([], tmp_path / "site")
    with pytest.raises(UsageError, match="A leaderboard is a folder"):
        build_leaderboard([make_record()], tmp_path / "board.html")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("precious")
    with pytest.raises(UsageError, match="thesis"):
        build_leaderboard([make_record()], tmp_path / "mine")


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_cannot_leave_the_data_of_the_table(make_record, tmp_path, text):
    record = _poisoned(make_record(), text)
    bad = tmp_path / "store" / "bad.json"
    bad.parent.mkdir()
    bad.write_text(json.dumps({"schema": 2, "score": text}))
    site = build([*read_records(bad), record], tmp_path, title=text)
    page = Page(site / "index.html")
    assert len(page.all("script")) == 2
    assert data(site)["boards"][0]["data"]["name"][0] == text


@pytest.fixture(scope="module")
def chromium():
    playwright = pytest.importorskip("playwright.sync_api")
    with playwright.sync_playwright() as api:
        # These pages hold what strangers wrote: the browser runs in its sandbox, or the test does not run.
        try:
            found = api.chromium.launch(executable_path=CHROMIUM, args=["--disable-gpu"], chromium_sandbox=True)
        except playwright.Error as error:
            pytest.skip(f"Chromium has no sandbox here ({error.message.splitlines()[0]})")
        yield found


@pytest.mark.slow
@browser
def test_nothing_hostile_runs_in_a_browser_and_our_script_does(make_record, tmp_path, chromium):
    site = build(
        [_poisoned(make_record(value=0.1 * i), text) for i, text in enumerate(HOSTILE)], tmp_path, title="calm"
    )
    page = chromium.new_page()
    for path in (site / "index.html", site / "figures.html", *(site / "models").iterdir()):
        page.goto(path.as_uri())
        assert page.title() in ("calm", "Figures") or page.title().endswith(": brainbench leaderboard")
        assert page.evaluate("typeof pwned") == "undefined"
    page.goto((site / "index.html").as_uri())
    for place in range(page.locator("#recordings option").count()):
        page.select_option("#recordings", index=place)
        assert page.locator("table.ranking tbody tr.model").count() == 1
        assert page.title() == "calm"


@pytest.mark.slow
@browser
def test_filters_sorting_columns_and_seeds_are_kept_in_the_address(make_record, tmp_path, chromium):
    def named(name, value, encoder, parameters):
        record = make_record(name, value)
        return replace(record, card=replace(record.card, encoder=encoder, parameters=parameters))

    twin = named("twin", 0.5, "zhuang", 2_000_000)
    records = [named("big", 0.9, "zhuang", 40_000_000), named("small", 0.3, "s4", 300_000)]
    records += [_seeded(twin, seed, 0.1 * seed) for seed in range(3)]
    site = build(records, tmp_path)
    page = chromium.new_page()
    page.goto((site / "index.html").as_uri())

    def names() -> list[str]:
        found = page.locator("#ranking tbody tr.model th bdi").all_inner_texts()
        return found

    assert names() == ["big", "twin", "small"]
    page.select_option("#encoder", "zhuang")
    assert names() == ["big", "twin"]
    page.locator("#ranking th button", has_text="score").click()
    assert names() == ["twin", "big"]
    page.locator("summary", has_text="Columns").click()
    page.get_by_role("checkbox", name="layer").uncheck()
    assert page.locator("#ranking thead th").all_inner_texts().count("layer") == 0
    address = page.url
    again = chromium.new_page()
    again.goto(address)
    assert again.locator("#ranking tbody tr.model th bdi").all_inner_texts() == names()
    assert again.locator("#encoder").input_value() == "zhuang"
    again.get_by_role("button", name="Clear").click()
    assert again.locator("#ranking tbody tr.model th bdi").all_inner_texts() == ["big", "twin", "small"]
    again.select_option("#parameters", "0-1e6")
    assert "1 of 3 models" in again.locator("#status").inner_text()
    again.fill("#q", "nothing like this")
    assert "No model fits" in again.locator("#ranking tbody").inner_text()


def test_a_light_reading_gives_the_same_site_and_a_large_board_pages_of_its_best(tmp_path, monkeypatch):
    for number in range(4):
        write_record(make_record(f"model-{number}", 0.4 + number / 10), tmp_path / "store")
    whole = build_leaderboard(read_records(tmp_path / "store"), tmp_path / "whole").parent
    light = read_records(tmp_path / "store", light=True)
    assert not any(item.record.baselines["random features"].model_rdm for item in light)
    assert light[0].record.score.brain_rdm is light[1].record.score.brain_rdm
    site = build_leaderboard(light, tmp_path / "light").parent
    files = {path.relative_to(site): path.read_bytes() for path in site.rglob("*") if path.is_file()}
    assert files == {path.relative_to(whole): path.read_bytes() for path in whole.rglob("*") if path.is_file()}
    monkeypatch.setattr("leaderboards.site.build.MODEL_PAGES", 3)
    few = build_leaderboard(light, tmp_path / "few").parent
    assert len(list((few / "models").iterdir())) == 3
    pages = [
        row["page"] for row in json.loads((few / "data" / "leaderboard.json").read_text()) if row["kind"] == "model"
    ]
    assert (len(pages), pages.count(None)) == (4, 1)
    path = light[0].path
    path.write_text(path.read_text().replace("model-0", "model-X"))
    with pytest.raises(DataError, match="changed while it was read"):
        build_leaderboard(light, tmp_path / "few")


def test_every_row_says_rank_score_and_interval_and_baselines_follow(tmp_path):
    records = draw_board({"low": 0.0, "a": 0.9, "b": 0.85}, spread=0.1)
    (board,) = data(build(records, tmp_path))["boards"]
    (found,) = rank(records)
    shown = columns(board, "name", "rank_first", "rank_last", "score", "score_low", "score_high", "kind")
    for entry, row in zip(found.entries, shown, strict=False):
        ends = [pytest.approx(value, abs=1e-5) for value in (entry.scaled, entry.interval.low, entry.interval.high)]
        assert row == (entry.name, entry.first, entry.last, *ends, "model")
    assert [row[0] for row in shown[3:]] == ["animal-to-animal", "raw input", "random features"]
    assert [row[-1] for row in shown[3:]] == ["animals", "baseline", "baseline"]
    assert [row[1:3] for row in shown] == [(1, 2), (1, 2), (3, 3), (None, None), (None, None), (None, None)]
    assert board["ranked"]
    assert len(board["band"]) == 2


def test_every_column_has_its_data(make_record, tmp_path):
    (board,) = data(build([make_record()], tmp_path))["boards"]
    keys = {column["key"] for column in COLUMNS} - {"rank", "interval"}
    assert keys <= set(board["data"])


def test_the_unique_part_has_a_column_where_a_record_states_it(make_record, tmp_path):
    record = make_record()
    keys = [column["key"] for column in data(build([record], tmp_path / "without"))["columns"]]
    assert "unique" not in keys
    stated = {"statistics": {"unique": {"status": "ok", "unique": 0.75, "interval": [0.6, 0.9], "controls": ["raw"]}}}
    record = replace(record, score=replace(record.score, provenance=stated))
    page = data(build([record], tmp_path / "with"))
    assert "unique" in [column["key"] for column in page["columns"]]
    assert page["boards"][0]["data"]["unique"][0] == 0.75


def test_page_csv_and_json_agree(tmp_path):
    records = draw_board({"low": 0.0, "a": 0.9, "b": 0.85, "c": 0.3})
    records[1] = replace(records[1], card=replace(records[1].card, family="user module"))
    site = build(records, tmp_path)
    plain = json.loads((site / "data" / "leaderboard.json").read_text())
    written = list(csv.DictReader((site / "data" / "leaderboard.csv").read_text().splitlines()))
    assert [list(row) for row in written] == [list(FIELDS)] * len(plain)
    (board,) = data(site)["boards"]
    assert len(plain) == len(written) == len(board["data"]["name"]) == 7
    for index, (row, cells) in enumerate(zip(plain, written, strict=True)):
        for name, value in row.items():
            assert cells[name] == ("" if value is None else str(value))
            if name in board["data"]:
                shown = board["data"][name][index]
                assert shown == (pytest.approx(value, abs=1e-6) if isinstance(value, float) else value)
        assert board["data"]["score"][index] == pytest.approx(row["scaled"], abs=1e-6)


def test_a_board_whose_records_state_no_chance_shows_their_own_values(make_record, tmp_path):
    records = [make_record("a", 0.4, chance=math.nan), make_record("b", 0.6, chance=math.nan)]
    records = [replace(record, baselines={}, animal_to_animal=None) for record in records]
    (board,) = data(build(records, tmp_path))["boards"]
    assert not board["scaled"]
    assert columns(board, "name", "score", "scaled") == [("b", 0.6, None), ("a", 0.4, None)]


def test_seeds_are_folded_into_one_row_with_their_spread(tmp_path):
    record, other = draw_board({"net": 0.5, "other": 0.2})
    site = build([*(_seeded(record, seed, by) for seed, by in enumerate((-0.1, 0.0, 0.1))), other], tmp_path)
    (board,) = data(site)["boards"]
    rows = {name: row for name, *row in columns(board, "name", "score", "spread", "seeds", "runs")}
    middle = record.score.scaled
    assert rows["net"][:3] == [pytest.approx(middle, abs=1e-5), pytest.approx(0.1), 3]
    assert rows["net"][3] == [pytest.approx(middle + by, abs=1e-5) for by in (-0.1, 0.0, 0.1)]
    assert rows["other"][2:] == [1, None]
    assert len(list((site / "models").iterdir())) == 2
    assert len(list((site / "records").iterdir())) == 4
    page = Page(next((site / "models").glob("net--*")))
    assert "Over 3 seeds" in page.text
    assert "spread over seeds 0.100" in page.text


def report(record: ResultRecord, folder: Path) -> Page:
    return Page(write_report(record, folder / "report.html"))


def model(record: ResultRecord, folder: Path) -> Page:
    site = build_leaderboard([record], folder / "site").parent
    (path,) = (site / "models").iterdir()
    return Page(path)


def first(records: list[Any], folder: Path) -> Page:
    return Page(build_leaderboard(records, folder / "site"))


def figures(record: ResultRecord, folder: Path) -> Page:
    return Page(build_leaderboard([record], folder / "site").with_name("figures.html"))


@pytest.fixture(params=["report", "model"])
def page(request, make_record, tmp_path) -> Page:
    return {"report": report, "model": model}[request.param](make_record("zhuang-ln"), tmp_path)


@pytest.fixture(params=["report", "model", "first", "figures"])
def any_page(request, make_record, tmp_path) -> Page:
    record = make_record("zhuang-ln")
    if request.param == "first":
        return first([record], tmp_path)
    return {"report": report, "model": model, "figures": figures}[request.param](record, tmp_path)


def test_page_shows_every_number_of_the_result(page):
    for number in (
        "0.523",
        "[0.423, 0.623]",
        "0.013",
        "0.411",
        "0.734",
        "[0.612, 0.845]",
        "0.601 to 0.797",
        "0.688",
    ):
        assert number in page.text
    for number in ("0.529", "−0.127", "0.712", "0.223", "0.487", "37,988,821", "0.352"):
        assert number in page.text
    for text in ("conv3", "chosen on the other animals", "optimistic maximum", "raw input", "animal-to-animal"):
        assert text in page.text


def test_report_shows_animals_methods_provenance_and_command(make_record, tmp_path):
    page = report(make_record("zhuang-ln"), tmp_path)
    for text in (
        "mouse-a",
        "0.551",
        "0.77",
        "mouse-b",
        "unreliable",
        "402",
        "numpy: 2.3.1",
        "spoil: 12",
        "9f3c2a7be1d04455",
    ):
        assert text in page.text
    assert "brainbench score zhuang-ln" in page.text
    assert "was compared with demo (2 animals, 6 stimuli) by correlation distance" in page.text
    assert "Not compared with raw input, random features, animal-to-animal: this needs at least 4 animals" in page.text


def test_a_report_compares_with_baselines_by_paired_differences(tmp_path):
    (record,) = draw_board({"net": 0.8}, raw=0.2)
    page = report(record, tmp_path)
    found = compare_scores(record.score, record.baselines["raw input"])
    assert f"Above raw input: difference {words.number(found.difference)} {words.span(found.interval)}" in page.text
    assert "above raw input" in page.text
    (weak,) = draw_board({"net": 0.2}, raw=0.2)
    assert "Not told apart from raw input" in report(weak, tmp_path).text


def test_synthetic_recordings_are_announced_and_real_ones_are_not(make_record, tmp_path):
    note = "Synthetic demo recordings: ranks say nothing about brains."
    for synthetic in (True, False):
        record = make_record(synthetic=synthetic)
        assert (note in report(record, tmp_path).text) is synthetic
        assert (note in first([record], tmp_path).text) is synthetic


def test_undefined_and_unreliable_scores_give_their_reason(make_record, tmp_path):
    undefined = report(make_record(status="undefined"), tmp_path)
    assert "No number exists." in undefined.text
    assert "two of three animals are noise" in undefined.text
    unreliable = report(make_record(status="unreliable"), tmp_path)
    assert "not to be trusted" in unreliable.text
    assert "not ranked (undefined)" in model(make_record("a", status="undefined"), tmp_path).text
    assert "not ranked (unreliable)" in model(make_record("b", status="unreliable"), tmp_path).text


def test_smallest_possible_p_is_said_to_be_that(make_record, tmp_path):
    assert "this is the smallest that 6 stimuli can give" in report(make_record(p=1 / 720), tmp_path).text
    assert "the smallest possible is 0.0014" in report(make_record(p=0.02), tmp_path).text


def test_a_bare_record_still_makes_every_page(tmp_path):
    from brainbench.core.records import Score

    record = ResultRecord(Score("bare", 0.5, "ok"))
    for page in (report(record, tmp_path), model(record, tmp_path)):
        assert "holds no RDM" in page.text
    assert "not ranked (not repeatable here" in model(record, tmp_path).text
    assert "Not drawn yet" in figures(record, tmp_path).text


def test_pages_need_nothing_from_outside(any_page):
    page = any_page
    links = [value for _, attributes in page.elements for name, value in attributes.items() if name in ("src", "href")]
    assert links
    assert all(link.startswith(("data:", "#")) or not re.match("[a-z]*:|/", link) for link in links)
    source = page.source.replace("http://www.w3.org/2000/svg", "")  # names of a language, not addresses
    assert "http://" not in source
    assert "https://" not in source


def test_every_internal_link_has_its_target_and_ids_are_unique(any_page):
    page = any_page
    ids = Counter(attributes["id"] for _, attributes in page.elements if "id" in attributes)
    assert set(ids.values()) == {1}
    targets = {attributes["href"][1:] for _, attributes in page.elements if attributes.get("href", "").startswith("#")}
    assert targets <= set(ids)


def test_figures_and_tables_speak_to_screen_readers(any_page):
    page = any_page
    assert all(len(image["alt"]) > 20 for image in page.all("img"))
    assert all("scope" in header for header in page.all("th"))
    assert len(page.all("caption")) == len(page.all("table"))
    assert all(
        picture.get("aria-hidden") == "true" for picture in page.all("svg") if "plot" in picture.get("class", "")
    )


def test_policy_admits_our_script_and_style_alone(any_page):
    page = any_page
    (policy,) = [meta["content"] for meta in page.all("meta") if meta.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    for tag in ("style", "script"):
        text = [text for owner, text in page.texts if owner == tag][-1]  # the first script of the table is its data
        digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert not [attributes for _, attributes in page.elements if "style" in attributes]


def test_rdm_pictures_hold_the_matrix(make_record, tmp_path):
    import struct
    import zlib

    page = report(make_record(), tmp_path)
    model, brain = page.all("img")
    assert "6 by 6 matrix of dissimilarities from 0.0323 to 0.677" in model["alt"]
    assert "most different concave-medium and concave-far" in brain["alt"]
    data = base64.b64decode(brain["src"].partition(",")[2])
    chunks, place = {}, 8
    while place < len(data):
        (length,), kind = struct.unpack(">I", data[place : place + 4]), data[place + 4 : place + 8]
        chunks[kind] = data[place + 8 : place + 8 + length]
        assert struct.unpack(">I", data[place + 8 + length : place + 12 + length])[0] == zlib.crc32(kind + chunks[kind])
        place += 12 + length
    raw = zlib.decompress(chunks[b"IDAT"])
    rows = [raw[i * 7 + 1 : i * 7 + 7] for i in range(6)]
    # brain_rdm is (i + j) / 9, so the palette must rank the cells by i + j.
    order = sorted({i + j for i in range(6) for j in range(6) if i != j})
    assert [[order.index(i + j) + 1 if i != j else 0 for j in range(6)] for i in range(6)] == [
        list(row) for row in rows
    ]


def test_report_stays_light(make_record, tmp_path):
    assert len(report(make_record(), tmp_path).source) < 80_000


def test_a_trusted_score_keeps_its_caveats(make_record, tmp_path):
    record = make_record(reasons=("one animal: no confidence interval",), interval=None)
    for page in (report(record, tmp_path), model(record, tmp_path)):
        assert "one animal: no confidence interval" in page.text


def test_numbers_that_do_not_exist_are_never_drawn(make_record, make_score, tmp_path):
    from dataclasses import replace

    from brainbench.core.records import Ceiling, Interval

    nothing = Interval(float("nan"), float("nan"))
    record = make_record(interval=nothing, ceiling=Ceiling(float("nan"), float("nan")), r=float("nan"))
    record = replace(record, animal_to_animal=make_score("animal-to-animal", 0.5, interval=nothing))
    for page in (report(record, tmp_path), model(record, tmp_path)):
        values = [value for tag, attributes in page.elements if tag != "a" for value in attributes.values()]
        assert not [value for value in values if re.search(r"\bnan\b", value)]
    assert "Not told apart" not in report(record, tmp_path).text


def _every_page(record: ResultRecord, folder: Path) -> list[Page]:
    site = build_leaderboard([record], folder / "site").parent
    return [report(record, folder), Page(site / "figures.html"), Page(next((site / "models").iterdir()))]


@pytest.fixture(scope="module")
def harmless(tmp_path_factory) -> list[list[tuple[str, tuple[str, ...]]]]:
    pages = _every_page(_poisoned(make_record(), "harmless"), tmp_path_factory.mktemp("harmless"))
    return [page.shape() for page in pages]


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_in_every_field_changes_no_element_of_the_pages(harmless, tmp_path, text):
    pages = _every_page(_poisoned(make_record(), text), tmp_path)
    assert [page.shape() for page in pages] == harmless
    for page in pages:
        assert len(page.all("script")) == 1
        assert not [name for _, attributes in page.elements for name in attributes if re.match("on", name)]


def test_above_raw_input_and_above_chance_have_colours_of_their_own():
    style = (Path(words.__file__).parent / "templates" / "page.css").read_text(encoding="utf-8")
    colours = dict(re.findall(r"\.chip\.([\w-]+) { color: var\(--(\w+)\)", style))
    assert colours["above-raw-input"] != colours["above-chance"]
    chips = set(re.findall(r"\.chip\.([\w-]+)", style))
    assert chips == {standing.replace(" ", "-") for standing in STANDINGS}
