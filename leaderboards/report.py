"""The HTML pages: the report of one score, and the leaderboard of many.

Each page is one file without script libraries, fonts or anything else from the network. Charts are
table rows with small inline SVG (:mod:`leaderboards._figures`); every text of a record is escaped
and a content security policy stops whatever else might try to run (:mod:`leaderboards._page`).
Equal records give equal pages.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path

from brainbench.errors import DataError
from brainbench.files import write_text
from brainbench.types import ResultRecord
from leaderboards import _words
from leaderboards._downloads import boards_csv, link, records_zip
from leaderboards._page import render
from leaderboards._views import board_view, report_view
from leaderboards.ranking import rank
from leaderboards.store import StoredRecord


def write_report(record: ResultRecord, path: str | os.PathLike[str]) -> Path:
    """Write the report of one score as a self-contained HTML page, atomically, and return its path.

    The page shows the score with interval, status and reasons, p, reliability and noise ceiling;
    baselines and animal-to-animal beside it; both RDMs; every layer with the held-out choice and
    the optimistic maximum marked; the animals; methods, model card and provenance.
    """
    link_to_record = link(record.to_json() + "\n", "application/json")
    return write_text(path, render("report.html.j2", **report_view(record), record_link=link_to_record))


def build_leaderboard(
    records: Iterable[StoredRecord | ResultRecord],
    path: str | os.PathLike[str],
    *,
    title: str = "Which networks process touch like a brain?",
) -> Path:
    """Write the leaderboard as one self-contained HTML page, atomically, and return its path.

    Args:
        records: what :func:`leaderboards.read_records` returned, or records in memory. Files with
            problems are listed on the page and left out of the boards.
        path: the page to write.
        title: its heading.

    Raises:
        DataError: there is nothing to show.
    """
    stored = list(records)
    if not stored:
        raise DataError(
            "There are no result records to build a leaderboard from; make one with: "
            "brainbench score MODEL --out FOLDER"
        )
    good = [item if isinstance(item, ResultRecord) else item.record for item in stored]
    usable = [record for record in good if record is not None]
    boards = rank(usable)
    page = render(
        "leaderboard.html.j2",
        title=title,
        count_sentence=f"{_words.plural(len(usable), 'result')} on {_words.plural(len(boards), 'board')}.",
        boards=[board_view(board) for board in boards],
        problems=[item for item in stored if isinstance(item, StoredRecord) and item.record is None],
        csv_link=link(boards_csv(boards), "text/csv"),
        zip_link=link(records_zip(boards), "application/zip"),
    )
    return write_text(path, page)
