"""The static site of a leaderboard: a folder of pages that need no server and no network.

``index.html`` holds the table as compact columns that its script shows 50 rows at a time, so that it opens
quickly however many records there are; what concerns one model alone is on that model's page. Besides
there are ``figures.html``, the records themselves, and the table as CSV, JSON and Parquet.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import atomic_path, write_json, write_text
from brainbench.core.records import ResultRecord
from leaderboards import text as words
from leaderboards.audit import remarks
from leaderboards.entries import Entry, entries_of
from leaderboards.figures.charts import board_figures
from leaderboards.figures.marks import MARGIN
from leaderboards.ranking import Board, rank
from leaderboards.schema import record_schema
from leaderboards.site.downloads import boards_table, records_zip, table_csv, table_parquet
from leaderboards.site.page import render, script_json
from leaderboards.site.score_page import model_page
from leaderboards.site.table import COLUMNS, board_label, compact
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
    kept, downloads = _write_models(root, listed), _write_data(root, boards)
    synthetic = any(board.synthetic for board in boards)
    shown = []
    for place, (board, entries) in enumerate(listed, start=1):
        figures = board_figures(board, entries)
        if len(listed) > 1:
            figures = [replace(figure, key=f"{figure.key}-{place}") for figure in figures]
        shown.append({"label": board_label(board), "figures": figures})
    write_text(
        root / "figures.html",
        render("board_figures.html.j2", title="Figures", boards=shown, synthetic=synthetic, here="figures", root=""),
    )
    _sweep(root, kept | downloads.keys())
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
            downloads=[(path.relative_to(root).as_posix(), label) for path, label in downloads.items()],
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


def _count(listed: Sequence[tuple[Board, Sequence[Entry]]]) -> str:
    models = sum(len(entries) for _, entries in listed)
    results = sum(len(board.rows) for board, _ in listed)
    text = f"{words.plural(models, 'model')}"
    text += f", {words.plural(results, 'record')}" if results != models else ""
    return text + (f" on {words.plural(len(listed), 'board')}." if len(listed) != 1 else ".")


def _write_models(root: Path, listed: Sequence[tuple[Board, Sequence[Entry]]]) -> set[Path]:
    kept = set()
    for _, entries in listed:
        for entry in entries:
            path = root / "models" / entry.page
            write_text(path, model_page(entry))
            kept.add(path)
            for row in entry.rows:
                file = root / "records" / row.record.file_name
                if not file.is_file():
                    write_text(file, row.record.to_json() + "\n")
                kept.add(file)
    return kept


def _write_data(root: Path, boards: Sequence[Board]) -> dict[Path, str]:
    """Write the downloads and return each file with its label."""
    data, table = root / "data", boards_table(boards)
    offered = {write_text(data / "leaderboard.csv", table_csv(table)): "Table (CSV)"}
    if table_parquet(table, data / "leaderboard.parquet"):
        offered[data / "leaderboard.parquet"] = "Table (Parquet)"
    offered[write_json(data / "leaderboard.json", table)] = "Table (JSON)"
    with atomic_path(data / "records.zip") as temporary:
        temporary.write_bytes(records_zip(boards))
    offered[data / "records.zip"] = "All records (JSON files, zip)"
    offered[write_json(data / "record.schema.json", record_schema())] = "JSON Schema of a record"
    return offered


def _sweep(root: Path, kept: set[Path]) -> None:
    """Remove pages, records and tables of an earlier build."""
    for folder, pattern in (("models", "*--*.html"), ("records", "*--*.json"), ("data", "leaderboard.*")):
        for path in (root / folder).glob(pattern):
            if path not in kept:
                path.unlink()
