"""Reports for a paper's supplement: methods, tables, vector figures and citations, as Markdown, HTML or PDF.

Everything is said by the records. Figures are the SVG drawings of the site (:mod:`leaderboards.figures.charts`); PDF is
made from the HTML by WeasyPrint (extra ``board``), which keeps them vectors.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError, check_name, listing, missing_dependency, visible
from brainbench.core.files import content_hash, write_together
from brainbench.core.records import ResultRecord
from brainbench.core.version import __version__
from leaderboards import text as words
from leaderboards.boards import Board, conclusions, means_over, rank, table_of
from leaderboards.entries import Entry
from leaderboards.figures.charts import board_figures
from leaderboards.figures.record import diagram, layers
from leaderboards.figures.svg import STYLE, Figure, standalone
from leaderboards.site.build import board_label, render, render_markdown
from leaderboards.store import StoredRecord


@dataclass(frozen=True)
class Reference:
    """One work."""

    key: str
    text: str
    """As a reader reads it."""
    bibtex: str


@cache
def _works() -> dict[str, Reference]:
    """Return the entries of ``references.bib`` by key: one field a line, entries set apart by an empty line."""
    text = Path(__file__).with_name("references.bib").read_text(encoding="utf-8").replace("VERSION", __version__)
    return {work.key: work for work in map(_work, text.strip().split("\n\n"))}


def _work(bibtex: str) -> Reference:
    fields = dict(re.findall(r"^  (\w+) = \{(.*)\},?$", bibtex, re.MULTILINE))
    names = [name.strip("{}").partition(",")[0] for name in fields["author"].split(" and ")]
    who = " and ".join(names) if len(names) < 3 else f"{names[0]} et al."
    place = fields.get("journal") or fields.get("booktitle") or f"Version {fields['version']}"
    place += f" {fields['volume']}" if "volume" in fields else ""
    key = bibtex.partition("{")[2].partition(",")[0]
    return Reference(key, f"{who} ({fields['year']}). {fields['title'].strip('{}')}. {place}.", bibtex)


_ARCHITECTURES = {
    "Zhuang, Kubilius": "zhuang2017",
    "He, Zhang": "he2016",
    "Gu, Goel": "gu2022",
    "Gu & Dao": "gu2023",
    "Radford, Wu": "radford2019",
}
_OBJECTIVES = {"simclr": "chen2020", "simsiam": "chen2021"}
_METRICS = {
    "crossnobis": "walther2016",
    "cka": "kornblith2019",
    "procrustes": "williams2021",
    "soft-matching": "khosla2023",
}


def references(records: Iterable[ResultRecord]) -> list[Reference]:
    """Return the works behind the records: toolkit, recordings, statistics, architectures, objectives.

    An architecture's citation that is not known here is kept in its own words as an entry ``@misc``.
    """
    references: dict[str, Reference] = {"brainbench": _works()["brainbench"]}
    for record in records:
        score, card = record.score, record.card
        keys, works = [], score.provenance.citations
        if "RSA" in score.metric:
            keys += ["kriegeskorte2008", "spearman1910", "brown1910"]
        if score.ceiling is not None:
            keys.append("nili2014")
        keys += [key for word, key in _METRICS.items() if word in score.metric.lower()]
        if "rodgers" in f"{score.provenance.stimuli_name} {score.provenance.recordings_name}".lower():
            keys.append("rodgers2022")
        if card is not None:
            keys += [key for words, key in _ARCHITECTURES.items() if words in (card.citation or "")]
            keys += [_OBJECTIVES[card.objective]] if card.objective in _OBJECTIVES else []
            keys += ["wilson1927"] if card.accuracy_interval is not None else []
            if card.citation and not any(words in card.citation for words in _ARCHITECTURES):
                works = [*works, card.citation]
        for work in works:
            if work.startswith("Rodgers C. C., Scientific Data 9:620"):
                keys.append("rodgers2022")
            else:
                references.setdefault((reference := _other(work, references)).key, reference)
        for key in keys:
            references.setdefault(key, _works()[key])
    return list(references.values())


_TEX = str.maketrans(
    {sign: f"\\{sign}" for sign in "&%$#_"}
    | {"\\": r"\textbackslash{}", "{": r"\textbraceleft{}", "}": r"\textbraceright{}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
)
"""Signs that TeX would obey → what prints them."""


def _other(text: str, references: Mapping[str, Reference]) -> Reference:
    """Return a work in its own words, under a key that no other work has."""
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    key = re.sub(r"[^a-z0-9]+", "", plain)[:24]
    key = key if key[:1].isalpha() else f"work{key}"
    if key in (works := {**_works(), **references}) and works[key].text != text:
        key += f"-{content_hash(text)[:6]}"
    fields = f"  note = {{{visible(text).translate(_TEX)}}}"
    if doi := re.search(r"\b10\.\d{4,9}/(?:[^\s,;<>\"{}\\()\[\]]|\([^\s()]*\))+", visible(text)):
        fields += f",\n  doi = {{{doi[0].rstrip('.')}}}"
    return Reference(key, text, f"@misc{{{key},\n{fields}\n}}")


FORMATS = ("md", "html", "pdf")
_WORDY = ("model", "baseline", "animal", "statement", "stated", "layer", "standing")


@dataclass(frozen=True)
class PaperTable:
    """A table of texts."""

    caption: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]

    @property
    def numbers(self) -> tuple[bool, ...]:
        """True for each column of numbers, which are set flush right."""
        return tuple(name not in _WORDY for name in self.columns)


def write_paper(
    records: Iterable[StoredRecord | ResultRecord],
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    title: str = "Leaderboard report",
) -> list[Path]:
    """Write a report of stored records, or records in memory, and return its files, the main one first.

    All files appear together. Markdown comes with a folder of SVG files and the citations as ``.bib``; HTML and PDF
    hold their figures, and bring a ``.bib`` too. A single record gives the report of that model, with its
    architecture and layers. The format is ``md``, ``html`` or ``pdf``, by the file's suffix if not given.
    """
    path = Path(path)
    kind = format or path.suffix.removeprefix(".").lower()
    check_name("report format", kind, FORMATS)
    usable = [*filter(None, (item.record if isinstance(item, StoredRecord) else item for item in records))]
    if not usable:
        raise DataError("There are no usable result records for a report; make one with: brainbench score MODEL")
    boards = rank(usable)
    cited = references(usable)
    sections = [_section(board, place, path) for place, board in enumerate(boards, start=1)]
    bib = {path.with_suffix(".bib"): "\n\n".join(item.bibtex for item in cited) + "\n"}
    paper = {
        "title": title,
        "synthetic": any(board.synthetic for board in boards),
        "sections": [*_over_benchmarks(boards, path), *sections],
        "references": cited,
        "commands": [*filter(None, dict.fromkeys(map(words.command_of, usable)))],
        "bib": path.with_suffix(".bib").name,
    }
    if kind == "md":
        drawn = [figure for section in sections for figure in section["figures"]]
        figures = {place: standalone(figure.drawing) for figure, place in drawn}
        return write_together({path: render_markdown("paper.md.j2", **paper), **bib, **figures})
    text = render("paper.html.j2", **paper, style_of_figures=STYLE)
    return write_together({path: text if kind == "html" else _pdf(text, path), **bib})


def _pdf(text: str, path: Path) -> bytes:
    """Print a page that needs nothing from elsewhere."""
    instead = f"write {path.with_suffix('.html').name} and print it from a browser"
    try:
        import weasyprint  # pyright: ignore[reportMissingImports]
    except (ImportError, OSError) as error:  # OSError: its system libraries are missing
        raise missing_dependency("weasyprint", extra="board", purpose=f"Writing PDF (or {instead})") from error

    def refuse(url: str, *_: object, **__: object) -> dict[str, object]:
        """Refuse to load anything for the page."""
        raise ValueError(f"A report loads nothing from elsewhere; asked for {url}.")

    try:
        return weasyprint.HTML(string=text, url_fetcher=refuse).write_pdf()
    except Exception as error:
        why = f"{type(error).__name__}: {str(error)[:80]}"
        raise DataError(f"WeasyPrint could not print {str(path)!r} ({why}); {instead}.") from error


def _over_benchmarks(boards: Sequence[Board], path: Path) -> list[dict[str, Any]]:
    """Return the section of means over benchmarks, where there are several."""
    names, means = means_over(boards)
    if not names:
        return []
    table = PaperTable(*table_of(names, means))
    empty = {"conclusions": [], "figures": [], "absent": [], "folder": path.parent}
    methods = f"The benchmarks are {listing(names, limit=20, quoted=False)}. Each has a section of its own below."
    return [{"title": "Mean over benchmarks", "methods": methods, "tables": [table], **empty}]


def _section(board: Board, place: int, path: Path) -> dict[str, Any]:
    """Return what the templates show of one board; each figure with the file that Markdown brings along."""
    entries, figures = board.entries, board_figures(board)
    if len(entries) == 1:
        figures = _single(entries[0]) + [figure for figure in figures if figure.key in ("fit", "rdms")]
    tables = [_models(entries), _baselines(board)]
    if len(entries) == 1:
        stated = (*words.card_rows(entries[0].card), *words.training_rows(entries[0].card))
        tables += [_animals(entries[0]), PaperTable("The model.", ("statement", "stated"), stated)]
    folder = path.with_name(f"{path.stem}-figures")
    return {
        "title": board_label(board),
        "methods": words.methods([record for entry in entries for record in entry.records]),
        "conclusions": conclusions(board),
        "tables": [table for table in tables if table.rows],
        "figures": [(figure, folder / f"{place}-{figure.key}.svg") for figure in figures if figure.drawing is not None],
        "absent": [figure for figure in figures if figure.drawing is None],
        "folder": path.parent,
    }


def _single(entry: Entry) -> list[Figure]:
    graph, drawn = entry.card.graph, layers(entry.records)
    rows = []
    if graph is not None:
        caption = "Solid arrows act within the stream, dashed ones are feedback."
        rows.append(Figure("architecture", f"Architecture of {entry.name}", caption, diagram(graph, entry.name)))
    if drawn is not None:
        caption = "Score of each layer; filled is the layer chosen on held-out data. For reading only."
        rows.append(Figure("layers", "Layers", caption, drawn))
    return rows


def _models(entries: Sequence[Entry]) -> PaperTable:
    rows = [
        {
            "model": entry.name,
            "rank": "" if entry.first is None else entry.rank,
            "score": words.number(entry.scaled),
            "interval": words.span(entry.interval),
            "spread": words.number(entry.spread) if entry.seeds > 1 else "",
            "p": words.probability(entry.p),
            "value": words.number(entry.value),
            "raw r": words.number(entry.r),
            "layer": entry.layer,
            "parameters": words.count(entry.card.parameters),
            "top-1": "" if entry.card.top1 is None else words.number(entry.card.top1),
            "standing": entry.standing + (f", same computation as {entry.same_as}" if entry.same_as else ""),
        }
        for entry in entries
    ]
    used = tuple(name for name in rows[0] if any(row[name] for row in rows))
    caption = "Models, best first; the score is 0 at chance and 1 at all that is reliable."
    return PaperTable(caption, used, tuple(tuple(row[name] for name in used) for row in rows))


def _baselines(board: Board) -> PaperTable:
    pairs = ((baseline.name, baseline.score) for baseline in board.baselines)
    rows = ((name, words.number(s.scaled), words.number(s.value), words.span(s.scaled_interval)) for name, s in pairs)
    return PaperTable("Baselines and animal-to-animal.", ("baseline", "score", "value", "interval"), tuple(rows))


def _animals(entry: Entry) -> PaperTable:
    columns = ("animal", "value", "raw r", "reliability", "units", "trials", "layer")
    rows = [
        (
            subject.subject, words.number(subject.value), words.number(subject.r), words.number(subject.reliability, 2),
            words.count(subject.units), words.count(subject.trials), subject.layer or "",
        )
        for subject in entry.score.subjects
    ]  # fmt: skip
    return PaperTable("Animals, each at the layer chosen on the others.", columns, tuple(rows))
