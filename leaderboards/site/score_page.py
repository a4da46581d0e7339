"""The pages of one score: a report that stands alone, and a model's page on a site.

Each page is one file without script libraries, fonts or anything else from the network. Every text of a record is
escaped, and a content security policy lets nothing but our own style and script take effect (:func:`render`). Equal
records give equal pages.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import os
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from brainbench.core.errors import visible, visible_lines, visible_name
from brainbench.core.files import to_plain, write_text
from brainbench.core.records import ResultRecord
from brainbench.core.statistics import compare_scores
from leaderboards import text
from leaderboards import text as words
from leaderboards.boards import RAW_INPUT
from leaderboards.entries import Entry
from leaderboards.figures.rdms import colour_stops, rdm_picture
from leaderboards.figures.record import (
    beside,
    diagram,
    draw_time_course,
    layer_order,
    layers,
    raw,
    stimulus_parts,
    unit_parts,
)
from leaderboards.ranking import MEANINGS, lacking, not_repeatable, standing_of

_TEMPLATES = Path(__file__).parents[1] / "templates"


def render(template: str, **values: Any) -> str:
    """Fill ``template`` with every value escaped, under a content security policy.

    The policy names our style and script by their hash, so even markup that slipped past the
    escaping could not run, load or send anything.
    """
    return _environment().get_template(template).render(**values, **_policy())


@cache
def _policy() -> dict[str, Any]:
    style, script = ((_TEMPLATES / name).read_text(encoding="utf-8") for name in ("page.css", "page.js"))
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_source_hash(style)}'; script-src '{_source_hash(script)}'; "
        "base-uri 'none'; form-action 'none'"
    )
    return {"policy": policy, "style": Markup(style), "script": Markup(script)}


def render_markdown(template: str, **values: Any) -> str:
    """Fill ``template`` with every value escaped for Markdown, and for the HTML that Markdown may hold."""
    environment = _environment().overlay(autoescape=False, finalize=escape_markdown)
    return environment.get_template(template).render(**values)


_MARKDOWN = str.maketrans({mark: f"\\{mark}" for mark in "\\`*_{}[]|#!"} | {"<": "&lt;", ">": "&gt;"})


def escape_markdown(value: Any) -> Any:
    """Return a value as text of one line that Markdown, and the HTML in it, take literally; markup stays as it is."""
    return value if isinstance(value, Markup) else " ".join(visible_lines(str(value)).translate(_MARKDOWN).split())


def script_json(value: Any) -> Any:
    """Return ``value`` as JSON that can stand inside a script element: nothing in it can end the element."""
    text = json.dumps(_visible_texts(to_plain(value)), ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for mark, escaped in (("<", "\\u003c"), (">", "\\u003e"), ("&", "\\u0026")):
        text = text.replace(mark, escaped)
    return Markup(text)


def _visible_texts(value: Any) -> Any:
    """Return plain values, or what a template shows, with control characters as escapes; markup stays as it is."""
    if isinstance(value, dict):
        return {visible(key): _visible_texts(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_visible_texts(inner) for inner in value]
    return visible_lines(value) if type(value) is str else value


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, finalize=_visible_texts,
    )  # fmt: skip
    helpers = (words.number, words.probability, words.count, words.span, words.level)
    environment.filters |= {helper.__name__: helper for helper in helpers}
    environment.globals |= {"STANDING": MEANINGS, "SYNTHETIC": words.SYNTHETIC, "p_sentence": words.p_sentence}
    environment.globals["colour_stops"] = colour_stops()
    return environment


def _source_hash(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


_MOST_PAIRS = 100  # an RDM with more pairs than this is shown as a picture only; its numbers are in the record


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
    sentences, untested = [*filter(None, (text.unique_sentence(score),))], []
    for name, baseline in others.items():
        comparison = compare_scores(score, baseline)
        if not comparison.verdict or not "ok" == score.status == baseline.status:
            untested.append(name)
            continue
        words = f"difference {text.number(comparison.difference)} {text.span(comparison.interval)}"
        sentences.append(f"{comparison.verdict} {name}: {words}.")
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
    name = visible_name(score.name)
    rows = [("model", name, score), ("animals", "animal-to-animal", record.animal_to_animal)]
    rows += [("baseline", name, item) for name, item in record.baselines.items()]
    pairs = list(zip(combinations(score.stimuli, 2), score.model_rdm, score.brain_rdm, strict=False))
    return {
        "name": name,
        "title": f"{name}: brainbench score",
        "record": record,
        "standing": standing_of(score, above_raw=above),
        "scaled": math.isfinite(score.scaled),
        "not_repeatable": not_repeatable(record),
        "ways": text.ways_to_get(record),
        "recordings": score.provenance.recordings_name,
        "beside": beside(record),
        "raw": raw(record),
        "rows": [item for item in rows if item[2] is not None],
        "layer_chart": layers([record]),
        "layer_p": score.provenance.layer_p,
        "model_rdm": rdm_picture(score.model_rdm, score.stimuli),
        "brain_rdm": rdm_picture(score.brain_rdm, score.stimuli),
        "pairs": pairs if len(pairs) <= _MOST_PAIRS else [],
        "groups": text.group_rows(score.provenance.statistics),
        "parts": [part for part in (stimulus_parts(score), unit_parts(score.provenance.statistics)) if part],
        "time_course": draw_time_course(score.provenance.statistics),
        "comparisons": comparisons(record),
        "methods": text.methods([record]),
        "command": score.provenance.command,
        "card": text.card_rows(card) if card else [],
        "provenance": text.provenance_rows(score.provenance),
        "file_name": record.file_name,
        "graph": diagram(card.graph, name) if card and card.graph else None,
    }
