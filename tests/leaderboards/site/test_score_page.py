"""The report and a model's page hold the numbers, stand alone, and admit no script but ours."""

from __future__ import annotations

import base64
import hashlib
import re
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from brainbench.core.records import ResultRecord
from brainbench.core.statistics import compare_scores
from leaderboards import build_leaderboard, write_report
from leaderboards import text as words
from leaderboards.ranking import STANDINGS
from leaderboards.site import score_page
from tests.factories.html_page import HOSTILE, Page, poisoned
from tests.factories.records import draw_board, make_record


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
    pages = _every_page(poisoned(make_record(), "harmless"), tmp_path_factory.mktemp("harmless"))
    return [page.shape() for page in pages]


@pytest.mark.parametrize("text", HOSTILE)
def test_hostile_text_in_every_field_changes_no_element_of_the_pages(harmless, tmp_path, text):
    pages = _every_page(poisoned(make_record(), text), tmp_path)
    assert [page.shape() for page in pages] == harmless
    for page in pages:
        assert len(page.all("script")) == 1
        assert not [name for _, attributes in page.elements for name in attributes if re.match("on", name)]


def test_above_raw_input_and_above_chance_have_colours_of_their_own():
    style = (Path(score_page.__file__).parents[1] / "templates" / "page.css").read_text(encoding="utf-8")
    colours = dict(re.findall(r"\.chip\.([\w-]+) { color: var\(--(\w+)\)", style))
    assert colours["above-raw-input"] != colours["above-chance"]
    chips = set(re.findall(r"\.chip\.([\w-]+)", style))
    assert chips == {standing.replace(" ", "-") for standing in STANDINGS}
