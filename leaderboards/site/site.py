"""The static site of a leaderboard: a folder of pages that need no server and no network.

``index.html`` holds the table as compact columns that its script shows 50 rows at a time, so that it opens
quickly however many records there are; what concerns one model alone is on that model's page. Besides
there are ``figures.html``, the records themselves, and the table as CSV, JSON and Parquet.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import atomic_path, write_text
from brainbench.core.records import ModelGraph, ResultRecord
from brainbench.core.statistics import is_finite
from leaderboards import text as words
from leaderboards.audit import remarks
from leaderboards.entries import Entry, entries_of
from leaderboards.figures.architecture import diagram, layer_order
from leaderboards.figures.charts import board_figures, layers_of
from leaderboards.figures.marks import MARGIN, Axis, axis_of
from leaderboards.ranking import Board, rank
from leaderboards.schema import record_schema
from leaderboards.site.downloads import boards_csv, boards_parquet, boards_table, records_zip
from leaderboards.site.page import drawn, render, script_json
from leaderboards.site.table import COLUMNS, board_label, compact
from leaderboards.site.view_models import report_view
from leaderboards.store import StoredRecord

PAGE = 50
"""Rows of the table shown at once."""


def build_leaderboard(
    records: Iterable[StoredRecord | ResultRecord],
    folder: str | os.PathLike[str],
    *,
    title: str = "Which networks process touch like a brain?",
) -> Path:
    """Write the site into ``folder`` and return its first page.

    Every file appears whole or not at all, the first page last; files of an earlier build that are no
    longer needed are removed if they are of this site. Equal records give equal files.

    Args:
        records: What :func:`leaderboards.read_records` returned, or records in memory. Files with problems
            are listed on the first page and left out of the boards.
        folder: Folder of the site; made if it is not there.
        title: Heading of the first page.

    Raises:
        DataError: there is nothing to show.
        UsageError: ``folder`` is a file, or a folder that holds something else.
    """
    stored = [StoredRecord(Path(), item) if isinstance(item, ResultRecord) else item for item in records]
    if not stored:
        raise DataError(
            "There are no result records to build a leaderboard from; make one with: "
            "brainbench score MODEL --out FOLDER"
        )
    root = _folder(Path(folder))
    usable = [item.record for item in stored if item.record is not None]
    boards = rank(usable)
    doubts = remarks(stored)
    listed = [(board, entries_of(board, doubts)) for board in boards]
    kept = _write_models(root, listed) | _write_data(root, boards)
    synthetic = any(board.synthetic for board in boards)
    shown = [{"label": board_label(board), "figures": board_figures(board, entries)} for board, entries in listed]
    for view in shown if len(shown) > 1 else []:
        number = shown.index(view) + 1
        view["figures"] = [_numbered(figure, number) for figure in view["figures"]]
    write_text(
        root / "figures.html",
        render("board_figures.html.j2", title="Figures", boards=shown, synthetic=synthetic, here="figures", root=""),
    )
    _sweep(root, kept)
    return write_text(
        root / "index.html",
        render(
            "index.html.j2",
            title=title,
            count_sentence=_count(listed),
            boards=boards,
            synthetic=synthetic,
            tie_rules=list(dict.fromkeys(board.ties for board in boards)),
            problems=[item for item in stored if item.record is None],
            downloads=_downloads(root),
            data=script_json({"boards": compact(listed), "columns": COLUMNS, "page": PAGE, "margin": MARGIN}),
            here="table",
            root="",
        ),
    )


def _folder(root: Path) -> Path:
    ours = root / "index.html"
    if root.is_file() or root.suffix.lower() in (".html", ".htm"):
        raise UsageError(
            f"A leaderboard is a folder; received {str(root)!r}. For a single page use: brainbench leaderboard report"
        )
    if root.is_dir() and any(root.iterdir()) and not ours.is_file() and not (root / "data").is_dir():
        raise UsageError(f"The folder {str(root)!r} holds something else; give a new folder or an earlier build.")
    root.mkdir(parents=True, exist_ok=True)
    return root


def _numbered(figure: Any, number: int) -> Any:
    from dataclasses import replace

    return replace(figure, key=f"{figure.key}-{number}")


def _count(listed: Sequence[tuple[Board, Sequence[Entry]]]) -> str:
    models = sum(len(entries) for _, entries in listed)
    results = sum(len(board.rows) for board, _ in listed)
    text = f"{words.plural(models, 'model')}"
    text += f", {words.plural(results, 'record')}" if results != models else ""
    return text + (f" on {words.plural(len(listed), 'board')}." if len(listed) != 1 else ".")


def _write_models(root: Path, listed: Sequence[tuple[Board, Sequence[Entry]]]) -> set[Path]:
    kept = set()
    for board, entries in listed:
        for entry in entries:
            path = root / "models" / entry.page
            write_text(path, render("model.html.j2", **model_view(board, entry), here="", root="../"))
            kept.add(path)
            for row in entry.rows:
                file = root / "records" / row.file_name
                if not file.is_file():
                    write_text(file, row.record.to_json() + "\n")
                kept.add(file)
    return kept


def model_view(board: Board, entry: Entry) -> dict[str, Any]:
    """Return what ``model.html.j2`` shows."""
    record = entry.rows[0].record
    axis = _axis(entry)
    graph: ModelGraph | None = entry.card.graph or layer_order(record.score)
    card = entry.card
    task = [("top-1", words.number(card.top1)), ("interval", words.span(card.accuracy_interval))]
    task += [("top-5", words.number(card.top5))] if card.top5 is not None else []
    if card.twin_top1 is not None:
        span = words.span(card.twin_interval)
        task.append(("untrained twin, top-1", f"{words.number(card.twin_top1)} {span}".strip()))
    task += [("data (hash)", card.accuracy_data or ""), ("collapsed", "yes" if card.collapsed else "no")]
    return report_view(record) | {
        "title": f"{entry.name}: brainbench leaderboard",
        "entry": entry,
        "board": board,
        "seeds": [(row, axis.mark(row.record.score.value, row.record.score.interval)) for row in entry.rows],
        "seed_axis": axis,
        "loading": words.loading(record),
        "graph": drawn(diagram(graph, entry.name)) if graph else None,
        "connected": card.graph is not None,
        "layer_chart": drawn(layers_of(entry)),
        "task": [(label, text) for label, text in task if text],
        "training": words.training_rows(card),
        "file_name": entry.rows[0].file_name,
    }


def _axis(entry: Entry) -> Axis:
    ends = [
        end
        for row in entry.rows
        if (interval := row.record.score.interval) and is_finite(interval)
        for end in (interval.low, interval.high)
    ]
    return axis_of([*(row.record.score.value for row in entry.rows), *ends])


def _write_data(root: Path, boards: Sequence[Board]) -> set[Path]:
    data = root / "data"
    write_text(data / "leaderboard.csv", boards_csv(boards))
    table = boards_table(boards)
    from brainbench.core.files import write_json

    write_json(data / "leaderboard.json", table)
    write_json(data / "record.schema.json", record_schema())
    with atomic_path(data / "records.zip") as temporary:
        temporary.write_bytes(records_zip(boards))
    kept = {data / name for name in ("leaderboard.csv", "leaderboard.json", "record.schema.json", "records.zip")}
    if boards_parquet(table, data / "leaderboard.parquet"):
        kept.add(data / "leaderboard.parquet")
    return kept


def _downloads(root: Path) -> list[tuple[str, str]]:
    offered = (
        ("data/leaderboard.csv", "Table (CSV)"),
        ("data/leaderboard.parquet", "Table (Parquet)"),
        ("data/leaderboard.json", "Table (JSON)"),
        ("data/records.zip", "All records (JSON files, zip)"),
        ("data/record.schema.json", "JSON Schema of a record"),
    )
    return [(address, label) for address, label in offered if (root / address).is_file()]


def _sweep(root: Path, kept: set[Path]) -> None:
    """Remove pages, records and tables of an earlier build."""
    for folder, pattern in (("models", "*--*.html"), ("records", "*--*.json"), ("data", "leaderboard.*")):
        for path in (root / folder).glob(pattern):
            if path not in kept:
                path.unlink()
