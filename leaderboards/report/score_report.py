"""The HTML pages: the report of one score, and the leaderboard of many.

Each page is one file without script libraries, fonts or anything else from the network. Charts are
table rows with small inline SVG (:mod:`leaderboards.figures.marks`); every text of a record is escaped
and a content security policy stops whatever else might try to run (:mod:`leaderboards.site.page`).
Equal records give equal pages.
"""

from __future__ import annotations

import os
from pathlib import Path

from brainbench.core.files import write_text
from brainbench.core.records import ResultRecord
from leaderboards.site.downloads import link
from leaderboards.site.page import render
from leaderboards.site.view_models import report_view


def write_report(record: ResultRecord, path: str | os.PathLike[str]) -> Path:
    """Write the report of one score as a self-contained HTML page, atomically, and return its path.

    The page shows the score with interval, status and reasons, p, reliability and noise ceiling;
    baselines and animal-to-animal beside it; both RDMs; every layer with the held-out choice and
    the optimistic maximum marked; the animals; methods, model card and provenance.
    """
    link_to_record = link(record.to_json() + "\n", "application/json")
    return write_text(path, render("report.html.j2", **report_view(record), record_link=link_to_record))
