"""The HTML pages: the report of one score, and the leaderboard of many.

Each page is one file without script libraries, fonts or anything else from the network. Charts are
table rows with small inline SVG (:mod:`leaderboards._figures`); every text of a record is escaped
and a content security policy stops whatever else might try to run (:mod:`leaderboards._page`).
Equal records give equal pages.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from brainbench.errors import DataError
from brainbench.files import write_text
from brainbench.types import Interval, LayerScore, ResultRecord, Score
from leaderboards import _origin, _words
from leaderboards._downloads import boards_csv, link, records_zip
from leaderboards._figures import Axis, Mark, axis_of, rdm_picture, score_axis
from leaderboards._page import render
from leaderboards.ranking import Board, RankedRecord, rank
from leaderboards.store import StoredRecord, record_name

_SHAPES = {"model": "dot", "baseline": "diamond", "animals": "square"}

_MOST_PAIRS = 100
"""An RDM with more pairs than this is shown as a picture only; its numbers are in the record."""


@dataclass(frozen=True)
class _ScoreRow:
    label: str
    kind: str
    score: Score
    mark: Mark
    raw_mark: Mark

    @property
    def shape(self) -> str:
        return _SHAPES[self.kind]


@dataclass(frozen=True)
class _LayerRow:
    layer: LayerScore
    mark: Mark
    kind: str
    note: str
    shape: str
    open: bool


@dataclass(frozen=True)
class _BoardRow:
    label: str
    kind: str
    score: Score
    mark: Mark
    small: tuple[str, ...]
    rank: str = ""
    first: int | str = ""
    anchor: str = ""
    parameters: int | None = None
    apart: bool = False
    """True for the first row below the ranked ones."""

    @property
    def shape(self) -> str:
        return _SHAPES[self.kind]

    @property
    def key(self) -> str:
        return _key(self.score.value)

    @property
    def p_key(self) -> str:
        return _key(self.score.p)

    @property
    def raw_key(self) -> str:
        return _key(self.score.r)


def write_report(record: ResultRecord, path: str | os.PathLike[str]) -> Path:
    """Write the report of one score as a self-contained HTML page, atomically, and return its path.

    The page shows the score with interval, status and reasons, p, reliability and noise ceiling;
    baselines and animal-to-animal beside it; both RDMs; every layer with the held-out choice and
    the optimistic maximum marked; the animals; methods, model card and provenance.
    """
    score = record.score
    others = [("animal-to-animal", "animals", record.animal_to_animal)] if record.animal_to_animal else []
    named = [(score.name, "model", score), *others, *((name, "baseline", s) for name, s in record.baselines.items())]
    singles = [subject.value for subject in score.subjects] + [layer.value for layer in score.layers]
    axis = _wider(score_axis(item for _, _, item in named), singles)
    ceiling = score.ceiling
    raw_axis = axis_of([item.r for _, _, item in named] + ([ceiling.lower, ceiling.upper] if ceiling else []))
    rows = [
        _ScoreRow(
            label,
            kind,
            item,
            axis.mark(item.value, item.interval, (subject.value for subject in item.subjects)),
            raw_axis.mark(item.r, None, (subject.r for subject in item.subjects)),
        )
        for label, kind, item in named
    ]
    page = render(
        "report.html.j2",
        title=f"{score.name}: brainbench score",
        record=record,
        recordings=_origin.recordings_name(score),
        axis=axis,
        raw_axis=raw_axis,
        band=_band(record.animal_to_animal),
        ceiling=(ceiling.lower, ceiling.upper) if ceiling else None,
        rows=rows,
        comparisons=_words.comparisons(record),
        model_rdm=rdm_picture(score.model_rdm, score.stimuli),
        brain_rdm=rdm_picture(score.brain_rdm, score.stimuli),
        pairs=_pairs(score),
        layers=_layer_rows(score, axis),
        layer_reference=score.value if score.status != "undefined" and score.layers else None,
        animals=[(subject, axis.mark(subject.value)) for subject in score.subjects],
        methods=_words.methods(record),
        command=_origin.command(score),
        card=_words.card_rows(record.card) if record.card else [],
        provenance=_words.provenance_rows(score.provenance),
        file_name=record_name(record),
        record_link=link(record.to_json() + "\n", "application/json"),
    )
    return write_text(path, page)


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
        boards=[_board_view(board) for board in boards],
        problems=[item for item in stored if isinstance(item, StoredRecord) and item.record is None],
        csv_link=link(boards_csv(boards), "text/csv"),
        zip_link=link(records_zip(boards), "application/zip"),
    )
    return write_text(path, page)


def _board_view(board: Board) -> dict[str, Any]:
    scores = [row.record.score for row in board.rows] + [baseline.score for baseline in board.baselines]
    axis = score_axis(scores)
    layer_axis = axis_of(layer.value for row in board.rows for layer in row.record.score.layers)
    animals = next((baseline.score for baseline in board.baselines if baseline.kind == "animals"), None)
    return {
        "board": board,
        "size": _words.plural(len(board.rows), "result"),
        "axis": axis,
        "layer_axis": layer_axis,
        "band": _band(animals),
        "ceiling": next((score.ceiling for score in scores if score.ceiling), None),
        "rows": _board_rows(board, axis),
        "brain_rdm": next((picture for s in scores if (picture := rdm_picture(s.brain_rdm, s.stimuli))), None),
        "models": [_model_view(row, layer_axis) for row in board.rows],
    }


def _board_rows(board: Board, axis: Axis) -> list[_BoardRow]:
    """Put the baselines in their places among the ranked rows; what is not ranked follows below."""
    ranked = [_model_row(row, axis) for row in board.rows if row.first is not None]
    unranked = [_model_row(row, axis) for row in board.rows if row.first is None]
    for baseline in board.baselines:
        score = baseline.score
        row = _BoardRow(baseline.name, baseline.kind, score, axis.mark(score.value, score.interval), baseline.notes)
        (ranked if score.status == "ok" else unranked).append(row)
    ranked.sort(key=lambda row: -row.score.value)
    if ranked and unranked:
        first = unranked[0]
        unranked[0] = _BoardRow(**{**first.__dict__, "apart": True})
    return ranked + unranked


def _model_row(row: RankedRecord, axis: Axis) -> _BoardRow:
    record = row.record
    card = record.card
    small = [part for part in (card.objective, card.augmentation) if part] if card else []
    small += ["collapsed to one class"] if card and card.collapsed else []
    small += [f"not ranked: {row.unranked_because}"] if row.unranked_because else []
    return _BoardRow(
        record.score.name,
        "model",
        record.score,
        axis.mark(record.score.value, record.score.interval),
        (*small, *row.notes),
        row.rank,
        row.first or "",
        _anchor(row),
        card.parameters if card else None,
    )


def _model_view(row: RankedRecord, axis: Axis) -> dict[str, Any]:
    record, score = row.record, row.record.score
    facts = [
        ("score", f"{_words.number(score.value)} {_words.span(score.interval)}".strip()),
        ("p", f"{_words.probability(score.p)}; {_words.p_sentence(score)}".strip("; ")),
        ("raw r", _words.number(score.r)),
        ("reliability", f"{_words.number(score.reliability)} {_words.span(score.reliability_interval)}".strip()),
        ("layer", f"{score.layer or 'none'}; {score.layer_rule}".strip("; ")),
        ("optimistic maximum", f"{_words.number(score.best_layer_value)} at {score.best_layer} (not a result)"),
        ("animals", str(len(score.subjects))),
        *(_words.card_rows(record.card) if record.card else []),
        ("record", row.file_name),
        ("brainbench", str(score.provenance.get("version") or "unknown version")),
    ]
    return {
        "row": row,
        "anchor": _anchor(row),
        "layers": _layer_rows(score, axis),
        "model_rdm": rdm_picture(score.model_rdm, score.stimuli),
        "brain_rdm": rdm_picture(score.brain_rdm, score.stimuli),
        "facts": facts,
        "command": _origin.command(score),
    }


def _layer_rows(score: Score, axis: Axis) -> list[_LayerRow]:
    rows = []
    for layer in score.layers:
        notes = ["chosen on held-out data"] if layer.layer == score.layer else []
        best = layer.layer == score.best_layer
        notes += ["optimistic maximum, not a result"] if best else []
        kind = "chosen" if layer.layer == score.layer else "best" if best else "layer"
        rows.append(
            _LayerRow(
                layer, axis.mark(layer.value), kind, "; ".join(notes), "diamond" if best else "dot", kind == "best"
            )
        )
    return rows


def _pairs(score: Score) -> list[tuple[str, str, float, float]]:
    """Return (stimulus, stimulus, model, brain) for each pair when both RDMs are there and short enough to read."""
    if not 0 < len(score.model_rdm) == len(score.brain_rdm) <= _MOST_PAIRS:
        return []
    return [
        (first, second, model, brain)
        for (first, second), model, brain in zip(
            combinations(score.stimuli, 2), score.model_rdm, score.brain_rdm, strict=True
        )
    ]


def _wider(axis: Axis, values: Iterable[float]) -> Axis:
    return axis_of([axis.low, axis.high, *values])


def _band(score: Score | None) -> tuple[float, float] | None:
    interval: Interval | None = score.interval if score and score.status == "ok" else None
    return (interval.low, interval.high) if interval else None


def _anchor(row: RankedRecord) -> str:
    return f"m-{row.identity}"


def _key(value: float) -> str:
    return "" if math.isnan(value) else repr(value)
