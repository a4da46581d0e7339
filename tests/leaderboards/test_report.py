"""The pages hold the numbers, stand alone, and run nothing that a record brings along."""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import json
import re
import shutil
import subprocess
import zipfile
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from brainbench.errors import DataError
from brainbench.types import ResultRecord
from leaderboards import build_leaderboard, read_records, write_record, write_report

VOID = {"meta", "img", "br", "hr", "input", "link"}
HOSTILE = (
    "</script><script>document.title='pwned'</script>",
    '"><img src=x onerror="document.title=\'pwned\'">',
    "' onmouseover='document.title=1' x='",
    "</style><svg onload=document.title='pwned'>",
    "javascript:document.title='pwned'",
    "{{ 7 * 7 }}{% raw %}",
    "]]><!--<title>pwned</title>",
)


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


def report(record: ResultRecord, folder: Path) -> Page:
    return Page(write_report(record, folder / "report.html"))


def board(records: list[Any], folder: Path) -> Page:
    return Page(build_leaderboard(records, folder / "board.html"))


@pytest.fixture(params=["report", "board"])
def page(request, make_record, tmp_path) -> Page:
    record = make_record("zhuang-ln")
    return report(record, tmp_path) if request.param == "report" else board([record], tmp_path)


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
    assert "was compared with demo (2 animals, 6 stimuli) by representational similarity analysis" in page.text
    assert "Above raw input (0.223): the intervals do not overlap." in page.text
    assert "Not told apart from random features (0.487): the intervals overlap." in page.text


def test_synthetic_recordings_are_announced_and_real_ones_are_not(make_record, tmp_path):
    note = "Synthetic demo recordings: ranks say nothing about brains."
    for synthetic in (True, False):
        record = make_record(synthetic=synthetic)
        assert (note in report(record, tmp_path).text) is synthetic
        assert (note in board([record], tmp_path).text) is synthetic


def test_undefined_and_unreliable_scores_give_their_reason(make_record, tmp_path):
    undefined = report(make_record(status="undefined"), tmp_path)
    assert "No number exists." in undefined.text
    assert "two of three animals are noise" in undefined.text
    unreliable = report(make_record(status="unreliable"), tmp_path)
    assert "not to be trusted" in unreliable.text
    page = board([make_record("a", status="undefined"), make_record("b", status="unreliable")], tmp_path)
    assert "not ranked: undefined" in page.text
    assert "not ranked: unreliable" in page.text


def test_smallest_possible_p_is_said_to_be_that(make_record, tmp_path):
    assert "this is the smallest that 6 stimuli can give" in report(make_record(p=1 / 720), tmp_path).text
    assert "the smallest possible is 0.0014" in report(make_record(p=0.02), tmp_path).text


def test_a_bare_record_still_makes_both_pages(tmp_path, make_score):
    from brainbench.types import Score

    record = ResultRecord(Score("bare", 0.5, "ok"))
    assert "holds no RDM" in report(record, tmp_path).text
    assert "listed but not ranked" in board([record], tmp_path).text


def test_pages_need_nothing_from_outside(page):
    links = [value for _, attributes in page.elements for name, value in attributes.items() if name in ("src", "href")]
    assert links
    assert all(link.startswith(("data:", "#")) for link in links)
    assert "http://" not in page.source
    assert "https://" not in page.source


def test_every_internal_link_has_its_target_and_ids_are_unique(page):
    ids = Counter(attributes["id"] for _, attributes in page.elements if "id" in attributes)
    assert set(ids.values()) == {1}
    targets = {attributes["href"][1:] for _, attributes in page.elements if attributes.get("href", "").startswith("#")}
    assert targets <= set(ids)


def test_figures_and_tables_speak_to_screen_readers(page):
    assert all(len(image["alt"]) > 20 for image in page.all("img"))
    assert all("scope" in header for header in page.all("th"))
    assert len(page.all("caption")) == len(page.all("table"))
    assert all(
        picture.get("aria-hidden") == "true" for picture in page.all("svg") if "plot" in picture.get("class", "")
    )


def test_policy_admits_our_script_and_style_alone(page):
    (policy,) = [meta["content"] for meta in page.all("meta") if meta.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy
    for tag in ("style", "script"):
        (text,) = [text for owner, text in page.texts if owner == tag]
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


def test_downloads_hold_the_records(make_record, tmp_path):
    records = [make_record("=HYPERLINK(1)", 0.3), make_record("b", 0.8), make_record("c", status="undefined")]
    table, archive = (
        base64.b64decode(link["href"].partition("base64,")[2])
        for link in board(records, tmp_path).all("a")
        if "download" in link
    )
    rows = list(csv.DictReader(io.StringIO(table.decode())))
    models = [(row["name"], row["value"], row["rank_first"]) for row in rows if row["row"] == "model"]
    assert models == [("b", "0.8", "1"), ("'=HYPERLINK(1)", "0.3", "2"), ("c", "", "")]
    assert [row["name"] for row in rows if row["row"] == "baseline"] == [
        "animal-to-animal",
        "raw input",
        "random features",
    ]
    zipfile.ZipFile(io.BytesIO(archive)).extractall(tmp_path / "unpacked")
    unpacked = read_records(tmp_path / "unpacked")
    assert {item.record.identity for item in unpacked if item.record} == {record.identity for record in records}
    (link,) = [link for link in report(records[1], tmp_path).all("a") if "download" in link]
    (tmp_path / link["download"]).write_bytes(base64.b64decode(link["href"].partition("base64,")[2]))
    assert read_records(tmp_path / link["download"])[0].record == records[1]


def test_bad_files_are_listed_and_left_out(make_record, tmp_path):
    write_record(make_record("good"), tmp_path / "store")
    edited = write_record(make_record("edited"), tmp_path / "store")
    edited.write_text(edited.read_text().replace("0.523", "0.993"))
    page = board(read_records(tmp_path / "store"), tmp_path)
    assert "1 file is left out" in page.text
    assert f"{edited.name!r} was edited or renamed" in page.text
    assert "0.993" not in page.text
    edited.write_text("{")
    good = next(item.path for item in read_records(tmp_path / "store") if item.record)
    good.unlink()
    assert "0 results on 0 boards" in board(read_records(tmp_path / "store"), tmp_path).text


def test_nothing_to_show_is_an_error_that_says_what_to_do(tmp_path):
    with pytest.raises(DataError, match=r"no result records.*brainbench score MODEL --out FOLDER"):
        build_leaderboard([], tmp_path / "board.html")


def test_different_recordings_are_kept_apart_and_the_page_says_so(make_record, tmp_path):
    page = board([make_record("a"), make_record("b", estimator="thesis")], tmp_path)
    assert "Do not compare numbers between the 2 boards." in page.text
    assert "2 results on 2 boards." in page.text


def test_equal_records_give_equal_pages_in_any_order(make_record, tmp_path):
    records = [make_record(name, 0.5) for name in "abcd"]
    assert board(records, tmp_path).source == board(records[::-1], tmp_path).source


def test_three_hundred_records_fit_one_page(make_record, tmp_path):
    page = board([make_record(f"model-{i}", i / 300) for i in range(300)], tmp_path)
    assert len(page.all("details")) == 300
    assert len(page.source) < 3_000_000
    assert page.source.index(">model-299<") < page.source.index(">model-0<")


def test_report_stays_light(make_record, tmp_path):
    assert len(report(make_record(), tmp_path).source) < 80_000


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


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_in_every_field_changes_no_element_of_the_page(make_record, tmp_path, text):
    harmless, hostile = (_poisoned(make_record(), word) for word in ("harmless", text))
    assert report(hostile, tmp_path).shape() == report(harmless, tmp_path).shape()
    bad = tmp_path / "store" / f"{text.replace('/', '')}.json"
    bad.parent.mkdir()
    pages = []
    for record in (harmless, hostile):
        bad.write_text(json.dumps({"schema": 1, "score": text if record is hostile else "x"}))
        page = Page(build_leaderboard([*read_records(bad), record], tmp_path / "board.html", title=record.score.name))
        assert len(page.all("script")) == 1
        assert not [name for _, attributes in page.elements for name in attributes if re.match("on", name)]
        pages.append(page.shape())
    assert pages[0] == pages[1]


@pytest.mark.slow
@pytest.mark.skipif(not shutil.which("chromium"), reason="needs the chromium browser")
def test_nothing_hostile_runs_in_a_browser(make_record, tmp_path):
    records = [_poisoned(make_record(), text) for text in HOSTILE]
    build_leaderboard(records, tmp_path / "board.html", title="calm")
    done = subprocess.run(
        ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", (tmp_path / "board.html").as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    assert "<title>calm</title>" in done.stdout
    assert '<th scope="col" class="n" data-sort="ascending"><button' in done.stdout  # our own script did run


def test_a_trusted_score_keeps_its_caveats(make_record, tmp_path):
    record = make_record(reasons=("one animal: no confidence interval",), interval=None)
    for page in (report(record, tmp_path), board([record], tmp_path)):
        assert "one animal: no confidence interval" in page.text
    assert "not ranked: no interval" in board([record], tmp_path).text


def test_values_beyond_the_axis_are_arrows_and_keep_their_number(make_record, tmp_path):
    page = board([make_record("far", 7.25, status="unreliable"), make_record("near", 0.4)], tmp_path)
    assert "7.250" in page.text
    uses = [use["href"] for use in page.all("use") if use.get("class") == "arrow"]
    assert set(uses) == {"#right"}
    ticks = [text for tag, text in page.texts if tag == "text"]
    assert max(float(tick.replace("−", "-")) for tick in ticks) == 1.5


def test_numbers_that_do_not_exist_are_never_drawn(make_record, make_score, tmp_path):
    from dataclasses import replace

    from brainbench.types import Ceiling, Interval

    nothing = Interval(float("nan"), float("nan"))
    record = make_record(interval=nothing, ceiling=Ceiling(float("nan"), float("nan")), r=float("nan"))
    record = replace(record, animal_to_animal=make_score("animal-to-animal", 0.5, interval=nothing))
    for page in (report(record, tmp_path), board([record], tmp_path)):
        values = [value for tag, attributes in page.elements if tag != "a" for value in attributes.values()]
        assert not [value for value in values if re.search(r"\bnan\b", value)]
    assert "Not told apart" not in report(record, tmp_path).text
