"""The static site of a leaderboard: a folder of pages that need no server and no network.

``index.html`` holds the table as compact columns that its script shows 50 rows at a time, so that it opens
quickly however many records there are; what concerns one model alone is on that model's page. Besides
there are ``figures.html``, the records themselves, and the table as CSV and JSON.
"""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import atomic_path, write_json, write_text
from brainbench.core.records import ResultRecord
from leaderboards import text as words
from leaderboards.audit import remarks
from leaderboards.boards import Board, rank
from leaderboards.conclusions import conclusions
from leaderboards.figures.charts import board_figures
from leaderboards.schema import record_schema
from leaderboards.site.page import render, script_json
from leaderboards.site.score_page import model_page
from leaderboards.site.table import COLUMNS, board_label, page_data, table_csv, table_rows
from leaderboards.store import StoredRecord, write_record

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
        DataError: there is nothing to show, or a record in memory contradicts itself.
        UsageError: ``folder`` is a file, or a folder that holds something else.
    """
    stored = [StoredRecord(Path(), item) if isinstance(item, ResultRecord) else item for item in records]
    if not stored:
        raise DataError(
            "There are no result records to build a leaderboard from; make one with: "
            "brainbench score MODEL --out FOLDER"
        )
    root = _folder(Path(folder))
    boards = rank([item.record for item in stored if item.record is not None], remarks(stored))
    kept, downloads = _write_models(root, boards), _write_data(root, boards)
    synthetic = any(board.synthetic for board in boards)
    shown = []
    for place, board in enumerate(boards, start=1):
        figures = board_figures(board)
        if len(boards) > 1:
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
            count_sentence=_count(boards),
            boards=boards,
            labels=[board_label(board) for board in boards],
            concluded=[conclusions(board) for board in boards],
            synthetic=synthetic,
            problems=[item for item in stored if item.record is None],
            downloads=[(path.relative_to(root).as_posix(), label) for path, label in downloads.items()],
            data=script_json({"boards": page_data(boards), "columns": COLUMNS, "page": PAGE}),
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


def _count(boards: Sequence[Board]) -> str:
    models = sum(len(board.entries) for board in boards)
    results = sum(entry.seeds for board in boards for entry in board.entries)
    text = f"{words.plural(models, 'model')}"
    text += f", {words.plural(results, 'record')}" if results != models else ""
    return text + (f" on {words.plural(len(boards), 'board')}." if len(boards) != 1 else ".")


def _write_models(root: Path, boards: Sequence[Board]) -> set[Path]:
    kept = set()
    for entry in (entry for board in boards for entry in board.entries):
        kept.add(write_text(root / "models" / entry.page, model_page(entry)))
        kept |= {write_record(record, root / "records") for record in entry.records}
    return kept


def _write_data(root: Path, boards: Sequence[Board]) -> dict[Path, str]:
    """Write the downloads and return each file with its label."""
    data, rows = root / "data", [row for board in boards for row in table_rows(board)]
    offered = {
        write_text(data / "leaderboard.csv", table_csv(rows)): "Table (CSV)",
        write_json(data / "leaderboard.json", rows): "Table (JSON)",
    }
    with atomic_path(data / "records.zip") as temporary:
        temporary.write_bytes(_records_zip(boards))
    offered[data / "records.zip"] = "All records (JSON files, zip)"
    offered[write_json(data / "record.schema.json", record_schema())] = "JSON Schema of a record"
    return offered


def _records_zip(boards: Sequence[Board]) -> bytes:
    """Return the record files under their content-hash names: unpacking into a folder merges them."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        records = [record for board in boards for entry in board.entries for record in entry.records]
        for record in sorted(records, key=lambda record: record.file_name):
            entry = zipfile.ZipInfo(record.file_name)  # its fixed date of 1980 keeps the bytes equal
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, record.to_json() + "\n")
    return stream.getvalue()


def _sweep(root: Path, kept: set[Path]) -> None:
    """Remove pages, records and tables of an earlier build."""
    for folder, pattern in (("models", "*--*.html"), ("records", "*--*.json"), ("data", "leaderboard.*")):
        for path in (root / folder).glob(pattern):
            if path not in kept:
                path.unlink()
