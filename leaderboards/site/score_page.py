"""The pages of one score: a report that stands alone, and a model's page on a site.

Each page is one file without script libraries, fonts or anything else from the network; every text of a record is
escaped and a content security policy stops whatever else might try to run (:mod:`leaderboards.site.page`). Equal
records give equal pages.
"""

from __future__ import annotations

import base64
import math
import os
from itertools import combinations
from pathlib import Path
from typing import Any

from brainbench.core.files import write_text
from brainbench.core.records import ResultRecord
from brainbench.core.statistics import compare_scores
from leaderboards import text
from leaderboards.boards import RAW_INPUT
from leaderboards.entries import Entry
from leaderboards.figures.architecture import diagram, layer_order
from leaderboards.figures.rdms import rdm_picture
from leaderboards.figures.record import beside, layers, raw
from leaderboards.figures.time_course import draw_time_course
from leaderboards.ranking import lacking
from leaderboards.site.page import render
from leaderboards.standing import not_repeatable, standing_of

_MOST_PAIRS = 100
"""An RDM with more pairs than this is shown as a picture only; its numbers are in the record."""


def write_report(record: ResultRecord, path: str | os.PathLike[str]) -> Path:
    """Write the report of one score as a self-contained HTML page, atomically, and return its path.

    The page shows the score with interval, standing and reasons, p, reliability and noise ceiling; baselines and
    animal-to-animal beside it; both RDMs; every layer with the held-out choice marked; the animals; methods, model
    card and provenance.
    """
    # Base64, so that nothing in the record can be read as markup.
    embedded = base64.b64encode((record.to_json() + "\n").encode()).decode()
    link = f"data:application/json;base64,{embedded}"
    page = render("report.html.j2", **_score_view(record), record_link=link)
    return write_text(path, page)


def model_page(entry: Entry) -> str:
    """Return a model's page on a site."""
    record, card = entry.records[0], entry.card
    graph = card.graph or layer_order(record.score)
    view = _score_view(record) | {
        "title": f"{entry.name}: brainbench leaderboard",
        "entry": entry,
        "standing": entry.standing,
        "graph": diagram(graph, entry.name) if graph else None,
        "connected": card.graph is not None,
        "layer_chart": layers(entry.records),
        "training": text.training_rows(card),
    }
    return render("model.html.j2", **view, here="", root="../")


def comparisons(record: ResultRecord) -> list[str]:
    """Say how the score stands to each baseline, by the paired test over animals and stimuli."""
    score, others = record.score, dict(record.baselines)
    if record.animal_to_animal is not None:
        others["animal-to-animal"] = record.animal_to_animal
    sentences, untested = [], []
    for name, other in others.items():
        found = compare_scores(score, other)
        if not found.verdict or not "ok" == score.status == other.status:
            untested.append(name)
            continue
        told = f"difference {text.number(found.difference)} {text.span(found.interval)}"
        sentences.append(f"{found.verdict} {name}: {told}.")
    if untested:
        lacks = lacking(sum(item.status == "ok" for item in score.subjects), len(score.stimuli))
        why = f"this needs {lacks}" if lacks else "not both state reliable values of single animals and stimuli"
        sentences.append(f"Not compared with {', '.join(untested)}: {why}.")
    return sentences


def _score_view(record: ResultRecord) -> dict[str, Any]:
    """Return what both templates show of a score."""
    score, card = record.score, record.card
    raw_input = record.baselines.get(RAW_INPUT)
    above = raw_input is not None and compare_scores(score, raw_input).verdict == "Above"
    named = [("model", score.name, score), ("animals", "animal-to-animal", record.animal_to_animal)]
    named += [("baseline", name, item) for name, item in record.baselines.items()]
    pairs = list(zip(combinations(score.stimuli, 2), score.model_rdm, score.brain_rdm, strict=False))
    return {
        "title": f"{score.name}: brainbench score",
        "record": record,
        "standing": standing_of(score, above_raw=above),
        "scaled": math.isfinite(score.scaled),
        "not_repeatable": not_repeatable(record),
        "ways": text.ways_to_get(record),
        "recordings": score.provenance.recordings_name,
        "beside": beside(record),
        "raw": raw(record),
        "rows": [item for item in named if item[2] is not None],
        "layer_chart": layers([record]),
        "layer_p": score.provenance.layer_p,
        "model_rdm": rdm_picture(score.model_rdm, score.stimuli),
        "brain_rdm": rdm_picture(score.brain_rdm, score.stimuli),
        "pairs": pairs if len(pairs) <= _MOST_PAIRS else [],
        "time_course": draw_time_course(score.provenance.statistics),
        "comparisons": comparisons(record),
        "methods": text.methods([record]),
        "command": score.provenance.command,
        "card": text.card_rows(card) if card else [],
        "provenance": text.provenance_rows(score.provenance),
        "file_name": record.file_name,
        "graph": diagram(card.graph, score.name) if card and card.graph else None,
    }
