"""Reports say what the records say, in every format, with their citations."""

from __future__ import annotations

import re
import sys
from dataclasses import replace

import pytest

from brainbench.core.errors import DataError, MissingDependencyError, UsageError
from leaderboards.report.paper import references, write_paper


def _records(make_record):
    zhuang = "Zhuang, Kubilius, Hartmann & Yamins 2017, Toward goal-driven"
    first = make_record("net.simclr", 0.7, metric="RSA: correlation RDM, pearson comparison")
    first = replace(first, card=replace(first.card, citation=zhuang, objective="simclr"))
    other = make_record("other | one", 0.3, metric="RSA: correlation RDM, pearson comparison", layer_rule="only layer")
    return [first, other]


def test_markdown_holds_methods_tables_figures_and_references(make_record, tmp_path):
    main, bib, *figures = write_paper(_records(make_record), tmp_path / "report.md", title="A *report*")
    text = main.read_text()
    assert text.startswith("# A \\*report\\*\n")
    assert "2 models (2 records) were compared with demo (2 animals, 6 stimuli)" in text
    assert "Layer: chosen on the other animals / only layer. Interval: 95 % interval" in text
    assert "| net.simclr | 0.700 | \\[0.600, 0.800\\]" in text
    assert "| other \\| one | 0.300 |" in text
    assert "ranks need at least 4 animals (here 1)" in text  # of two, one is reliable
    assert "Not drawn:" in text
    assert "brainbench score net.simclr" in text
    links = re.findall(r"\]\(([^)]+\.svg)\)", text)
    assert [tmp_path / link for link in links] == figures
    assert all(figure.read_text().startswith("<svg") for figure in figures)
    keys = re.findall(r"@\w+\{(\w+),", bib.read_text())
    assert keys[0] == "brainbench"
    assert {"kriegeskorte2008", "nili2014", "zhuang2017", "chen2020"} <= set(keys)
    assert len(keys) == len(set(keys))


def test_html_is_one_file_with_vector_figures(make_record, tmp_path):
    text = write_paper(_records(make_record), tmp_path / "report.html")[0].read_text()
    assert text.count("<svg") >= 3
    assert "<script" not in text
    assert not re.search(r'(src|href)="(?!data:image/png)', text)


def test_hostile_text_stays_text_in_a_report(make_record, tmp_path):
    record = make_record("<img src=x onerror=alert(1)>[a](javascript:1)")
    page = write_paper([record], tmp_path / "report.html")[0].read_text()
    assert "<img" not in page
    text = write_paper([record], tmp_path / "report.md")[0].read_text()
    outside = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    assert "<img" not in outside
    assert not re.search(r"(?<!\\)\]\(javascript", outside)


def test_one_record_gives_the_report_of_that_model(make_record, tmp_path):
    text = write_paper([make_record("net")], tmp_path / "one.md")[0].read_text()
    assert "The model net was compared with demo" in text
    assert "mouse-a" in text
    assert "37,988,821" in text
    assert "1-layers.svg" in text


def test_an_unknown_format_and_no_records_are_errors(make_record, tmp_path):
    with pytest.raises(UsageError, match="Unknown report format 'docx'"):
        write_paper([make_record()], tmp_path / "a.docx")
    with pytest.raises(DataError, match="no usable result records"):
        write_paper([], tmp_path / "a.md")


CITATIONS = {
    "Doe {2020}, A network": ("doe2020anetwork", r"Doe \textbraceleft{}2020\textbraceright{}, A network", None),
    r"Doe & Roe, 5 % of $a_b #1 \x ~^": (
        "doeroe5ofab1x", r"Doe \& Roe, 5 \% of \$a\_b \#1 \textbackslash{}x \textasciitilde{}\textasciicircum{}", None,
    ),
    "田中 太郎 (2020)": ("work2020", "田中 太郎 (2020)", None),
    "Dœ J. (doi:10.1000/x_y(1)).": ("djdoi101000xy1", r"Dœ J. (doi:10.1000/x\_y(1)).", "10.1000/x_y(1)"),
    "Nili 2014": (None, "Nili 2014", None),
}  # fmt: skip


@pytest.mark.parametrize("citation", CITATIONS)
def test_a_citation_is_kept_in_its_own_words_with_the_signs_of_tex_as_text(make_record, citation):
    key, note, doi = CITATIONS[citation]
    record = make_record()
    works = references([replace(record, card=replace(record.card, citation=citation))])
    (work,) = [item for item in works if item.text == citation]
    assert key in (None, work.key)
    assert f"  note = {{{note}}}" in work.bibtex
    assert ("doi = " in work.bibtex) == bool(doi)
    assert doi is None or f"doi = {{{doi}}}" in work.bibtex


def test_works_whose_first_words_agree_are_two_entries(make_record):
    record, first = make_record(), "Doe J., On the whiskers of rats and mice, part one"
    both = (first, first.replace("one", "two"), first, "Nili 2014")
    records = [replace(record, card=replace(record.card, citation=text)) for text in both]
    works = references(records)
    assert [work.text for work in works if work.text in both] == [both[0], both[1], both[3]]
    assert len({work.key for work in works}) == len(works)
    assert "nili2014" not in [work.key for work in works if work.text == both[3]]


def test_without_the_library_the_error_says_what_to_install_and_no_file_is_touched(make_record, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    earlier = tmp_path / "earlier.pdf"
    earlier.write_bytes(b"%PDF earlier")
    for path in (tmp_path / "a.pdf", earlier):
        with pytest.raises(MissingDependencyError, match=r"\[board\]"):
            write_paper([make_record()], path)
    assert not (tmp_path / "a.pdf").exists()
    assert earlier.read_bytes() == b"%PDF earlier"


def test_weasyprint_makes_a_pdf_with_vector_figures(make_record, tmp_path):
    pytest.importorskip("weasyprint")
    content = write_paper([make_record("net")], tmp_path / "a.pdf")[0].read_bytes()
    assert content.startswith(b"%PDF")
