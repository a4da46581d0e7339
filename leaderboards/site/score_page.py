"""The pages of one score: a report that stands alone, and a model's page on a site.

Each page is one file without script libraries, fonts or anything else from the network. Charts are
table rows with small inline SVG (:mod:`leaderboards.figures.marks`); every text of a record is escaped
and a content security policy stops whatever else might try to run (:mod:`leaderboards.site.page`).
Equal records give equal pages.
"""

from __future__ import annotations

import base64
import os
from pathlib import Path
from typing import Any

from brainbench.core.files import write_text
from brainbench.core.records import ResultRecord
from leaderboards import text
from leaderboards.entries import Entry
from leaderboards.figures.architecture import diagram, layer_order
from leaderboards.figures.charts import layers_of
from leaderboards.figures.marks import axis_of, interval_ends, record_charts
from leaderboards.figures.time_course import draw_time_course
from leaderboards.ranking import comparisons
from leaderboards.site.page import render


def write_report(record: ResultRecord, path: str | os.PathLike[str]) -> Path:
    """Write the report of one score as a self-contained HTML page, atomically, and return its path.

    The page shows the score with interval, status and reasons, p, reliability and noise ceiling;
    baselines and animal-to-animal beside it; both RDMs; every layer with the held-out choice and
    the optimistic maximum marked; the animals; methods, model card and provenance.
    """
    view = _score_view(record)
    # Base64, so that nothing in the record can be read as markup.
    embedded = base64.b64encode((record.to_json() + "\n").encode()).decode()
    return write_text(path, render("report.html.j2", **view, record_link=f"data:application/json;base64,{embedded}"))


def model_page(entry: Entry) -> str:
    """Return a model's page on a site."""
    record, card = entry.rows[0].record, entry.card
    scores = [row.record.score for row in entry.rows]
    axis = axis_of([*(score.value for score in scores), *(end for s in scores for end in interval_ends(s.interval))])
    graph = card.graph or layer_order(record.score)
    view = _score_view(record) | {
        "title": f"{entry.name}: brainbench leaderboard",
        "entry": entry,
        "seeds": [(row.record, axis.mark(row.record.score.value, row.record.score.interval)) for row in entry.rows],
        "seed_axis": axis,
        "loading": text.loading(record),
        "graph": diagram(graph, entry.name) if graph else None,
        "connected": card.graph is not None,
        "layer_chart": layers_of(entry),
        "task": text.accuracy_rows(card),
        "training": text.training_rows(card),
    }
    return render("model.html.j2", **view, here="", root="../")


def _score_view(record: ResultRecord) -> dict[str, Any]:
    """Return what both templates show of a score."""
    score, card = record.score, record.card
    return {
        "title": f"{score.name}: brainbench score",
        "record": record,
        "recordings": score.provenance.recordings_name,
        **record_charts(record),
        "time_course": draw_time_course(score.provenance.statistics),
        "comparisons": comparisons(record),
        "methods": text.methods(record),
        "command": score.provenance.command,
        "card": text.card_rows(card) if card else [],
        "provenance": text.provenance_rows(score.provenance),
        "file_name": record.file_name,
        "graph": diagram(card.graph, score.name) if card and card.graph else None,
    }
