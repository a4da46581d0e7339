"""Reports for a paper's supplement: methods, tables, vector figures and citations, as Markdown, HTML or PDF.

Everything is said by the records. Figures are the SVG drawings of the site (:mod:`leaderboards.figures.charts`); PDF is
made from the HTML by WeasyPrint (extra ``board``), which keeps them vectors.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from brainbench.core.errors import DataError, missing_dependency, unknown_name
from brainbench.core.files import atomic_path, write_text
from brainbench.core.records import ResultRecord
from leaderboards import text as words
from leaderboards.boards import Board, rank
from leaderboards.conclusions import conclusions
from leaderboards.entries import Entry
from leaderboards.figures.architecture import diagram
from leaderboards.figures.charts import Figure, board_figures
from leaderboards.figures.record import layers
from leaderboards.figures.svg import STYLE, standalone
from leaderboards.report.citations import Reference, references
from leaderboards.site.page import render
from leaderboards.store import StoredRecord

FORMATS = ("md", "html", "pdf")
_WORDY = ("model", "baseline", "animal", "statement", "stated", "layer", "standing")
RANKS = (
    " Models were told apart by a paired t test over animals and stimuli on scores scaled between chance and all that "
    "is reliable, at a false discovery rate of 5 % over all pairs; models that are not told apart share ranks."
)


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


@dataclass(frozen=True)
class Section:
    """One board of a report."""

    title: str
    methods: str
    conclusions: tuple[str, ...]
    tables: tuple[PaperTable, ...]
    figures: tuple[Figure, ...]
    absent: tuple[Figure, ...]
    """Figures that the records cannot fill."""


@dataclass(frozen=True)
class Paper:
    """A report before it has a format."""

    title: str
    synthetic: bool
    sections: tuple[Section, ...]
    references: tuple[Reference, ...]
    commands: tuple[str, ...]
    """Command lines that make the records again."""


def write_paper(
    records: Iterable[StoredRecord | ResultRecord],
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    title: str = "Leaderboard report",
) -> list[Path]:
    """Write a report and return its files, the main one first.

    Markdown comes with a folder of SVG files and the citations as ``.bib``; HTML and PDF hold their figures, and
    bring a ``.bib`` too. A single record gives the report of that model, with its architecture and layers.

    Args:
        records: What :func:`leaderboards.read_records` returned, or records in memory.
        path: The main file.
        format: ``md``, ``html`` or ``pdf``; by the file's suffix if not given.
        title: Heading.

    Raises:
        UsageError: there is no such format.
        DataError: there is no usable record.
        MissingDependencyError: WeasyPrint, which makes PDF, is not installed.
    """
    path = Path(path)
    kind = format or path.suffix.removeprefix(".").lower()
    if kind not in FORMATS:
        raise unknown_name("report format", kind, FORMATS)
    found = [item.record if isinstance(item, StoredRecord) else item for item in records]
    usable = [record for record in found if record is not None]
    if not usable:
        raise DataError("There are no usable result records for a report; make one with: brainbench score MODEL")
    paper = make_paper(usable, title)
    bib = write_text(path.with_suffix(".bib"), "\n\n".join(item.bibtex for item in paper.references) + "\n")
    if kind == "md":
        return [write_text(path, _markdown(paper, path)), bib, *_write_figures(paper, path)]
    text = render("paper.html.j2", paper=paper, drawn=_inline)
    if kind == "html":
        return [write_text(path, text), bib]
    _write_pdf(text, path)
    return [path, bib]


def make_paper(records: Sequence[ResultRecord], title: str) -> Paper:
    """Return the report of records, board by board."""
    boards = rank(records)
    commands = dict.fromkeys(text for record in records if (text := record.score.provenance.command))
    return Paper(
        title,
        any(board.synthetic for board in boards),
        tuple(_section(board) for board in boards),
        tuple(references(records)),
        tuple(commands),
    )


def _write_pdf(text: str, path: Path) -> None:
    """Print a page that needs nothing from elsewhere."""
    try:
        import weasyprint  # pyright: ignore[reportMissingImports]
    except (ImportError, OSError) as error:  # OSError: its system libraries are missing
        purpose = f"Writing PDF (or write {path.with_suffix('.html').name} and print it from a browser)"
        raise missing_dependency("weasyprint", extra="board", purpose=purpose) from error

    def refuse(url: str, *_: object, **__: object) -> dict[str, object]:
        raise ValueError(f"A report loads nothing from elsewhere; asked for {url}.")

    with atomic_path(path) as temporary:
        weasyprint.HTML(string=text, url_fetcher=refuse).write_pdf(temporary)


def board_methods(board: Board) -> str:
    """Return a paragraph for a paper's methods section, made only of what the records state."""
    entries, recorded = board.entries, [record for entry in board.entries for record in entry.records]
    score = max(entries, key=lambda entry: len(entry.score.layers)).score
    if len(recorded) == 1:
        return words.methods(recorded[0])
    seeds = max(entry.seeds for entry in entries)
    fidelity = score.provenance.settings.get("fidelity")
    models, records = words.plural(len(entries), "model"), words.plural(len(recorded), "record")
    animals, shown = words.plural(len(score.subjects), "animal"), len(board.conditions)
    text = (
        f"{models} ({records}) were compared with {board.recordings} ({animals}, "
        f"{words.plural(shown, 'stimulus', 'stimuli')}){f' by {board.metric}' if board.metric else ''}, "
        f"with noise correction by the estimator '{board.estimator}'."
    )
    text += words.stated("Stimuli", board.stimuli.rstrip("."))
    text += f" They were simulated at the fidelity '{fidelity}'." if isinstance(fidelity, str) else ""
    text += words.stated("Time axis", board.time) + words.stated("Layer", score.layer_rule)
    text += words.stated("Interval of a record", words.level(score.interval) if score.interval else "")
    if seeds > 1:
        text += (
            f" Untrained networks were drawn from up to {seeds} seeds; their score is the mean over seeds, the "
            "variance over seeds is part of their interval, and the spread is the standard deviation over seeds."
        )
    # The mean under permutation is one record's own.
    text += words.stated("Significance", re.sub(r"; mean score under permutation [−\-.\d]+", "", score.p_method))
    text += words.stated("Noise ceiling", score.ceiling.method if score.ceiling else "")
    text += RANKS
    hashes = f" Hash of the recordings {board.recordings_hash}." if board.recordings_hash else ""
    hashes += f" Hash of the stimuli {board.stimuli_hash}." if board.stimuli_hash else ""
    versions = sorted({record.score.provenance.version for record in recorded})
    return text + words.made_by(versions, synthetic=board.synthetic, hashes=hashes)


def _section(board: Board) -> Section:
    entries = board.entries
    figures = board_figures(board)
    if len(entries) == 1:
        figures = _single(entries[0]) + [figure for figure in figures if figure.key in ("fit", "rdms")]
    tables = [_models(entries), _baselines(board)]
    if len(entries) == 1:
        tables += [_animals(entries[0]), _card(entries[0])]
    return Section(
        f"{board.recordings}, {board.metric or 'metric not stated'}, {board.estimator}",
        board_methods(board),
        tuple(conclusions(board)),
        tuple(table for table in tables if table.rows),
        tuple(figure for figure in figures if figure.drawing is not None),
        tuple(figure for figure in figures if figure.drawing is None),
    )


def _single(entry: Entry) -> list[Figure]:
    graph, drawn = entry.card.graph, layers(entry.records)
    found = []
    if graph is not None:
        caption = "Solid arrows act within the stream, dashed ones are feedback."
        found.append(Figure("architecture", f"Architecture of {entry.name}", caption, diagram(graph, entry.name)))
    if drawn is not None:
        caption = "Score of each layer; filled is the layer chosen on held-out data. For reading only."
        found.append(Figure("layers", "Layers", caption, drawn))
    return found


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
            "layer": entry.score.layer or "",
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
    rows = [
        (item.name, *map(words.number, (item.score.scaled, item.score.value)), words.span(item.score.scaled_interval))
        for item in board.baselines
    ]
    return PaperTable("Baselines and animal-to-animal.", ("baseline", "score", "value", "interval"), tuple(rows))


def _animals(entry: Entry) -> PaperTable:
    columns = ("animal", "value", "raw r", "reliability", "units", "trials", "layer")
    rows = [
        (
            item.subject, words.number(item.value), words.number(item.r), words.number(item.reliability, 2),
            words.count(item.units), words.count(item.trials), item.layer or "",
        )
        for item in entry.score.subjects
    ]  # fmt: skip
    return PaperTable("Animals, each at the layer chosen on the others.", columns, tuple(rows))


def _card(entry: Entry) -> PaperTable:
    rows = (*words.card_rows(entry.card), *words.training_rows(entry.card))
    return PaperTable("The model.", ("statement", "stated"), tuple(rows))


def _inline(figure: Figure) -> str:
    from markupsafe import Markup

    return Markup(figure.drawing.render(style=STYLE)) if figure.drawing else Markup("")


def _figure_path(path: Path, place: int, figure: Figure) -> Path:
    return path.with_name(f"{path.stem}-figures") / f"{place}-{figure.key}.svg"


def _write_figures(paper: Paper, path: Path) -> list[Path]:
    return [
        write_text(_figure_path(path, place, figure), standalone(figure.drawing))
        for place, section in enumerate(paper.sections, start=1)
        for figure in section.figures
        if figure.drawing is not None
    ]


def _markdown(paper: Paper, path: Path) -> str:
    blocks = [f"# {_escape(paper.title)}"]
    blocks += [f"> **{words.SYNTHETIC}**"] if paper.synthetic else []
    for place, section in enumerate(paper.sections, start=1):
        blocks += [f"## {_escape(section.title)}", "### Methods", _escape(section.methods), "### Results"]
        blocks += ["\n".join(f"- {_escape(text)}" for text in section.conclusions)]
        for table in section.tables:
            blocks += [_escape(table.caption), _rows(table)]
        for figure in section.figures:
            target = _figure_path(path, place, figure).relative_to(path.parent).as_posix().replace(" ", "%20")
            title = _escape(figure.title)
            blocks += [f"![{title}]({target})", f"*{title}.* {_escape(figure.caption)}"]
        if section.absent:
            blocks.append("Not drawn: " + " ".join(f"{f.title}: {f.lacking}." for f in section.absent))
    if paper.commands:
        commands = "\n".join(text.replace("`", "'") for text in paper.commands)
        blocks += ["## To make these records again", f"```\n{commands}\n```"]
    blocks += ["## References", "\n".join(f"- {_escape(item.text)}" for item in paper.references)]
    blocks.append(f"BibTeX entries: `{path.with_suffix('.bib').name}`.")
    return "\n\n".join(blocks) + "\n"


def _rows(table: PaperTable) -> str:
    ends = ["---:" if number else "---" for number in table.numbers]
    lines = [table.columns, ends, *([_escape(cell) for cell in row] for row in table.rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


_ESCAPED = str.maketrans({mark: f"\\{mark}" for mark in "\\`*_{}[]|#!"} | {"<": "&lt;", ">": "&gt;"})


def _escape(text: str) -> str:
    """Escape what Markdown or HTML inside it would read as markup."""
    return " ".join(text.translate(_ESCAPED).split())
