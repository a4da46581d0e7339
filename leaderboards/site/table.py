"""The table of a leaderboard as data: one list of rows for the page, the CSV and the JSON, so that they agree."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence
from typing import Any

from brainbench.core.errors import visible
from brainbench.core.records import Score
from leaderboards.boards import Baseline, Board, conclusions
from leaderboards.entries import Entry
from leaderboards.figures.svg import interval_ends, score_scale
from leaderboards.ranking import standing_of
from leaderboards.text import ways_to_get, with_floats

COLUMNS: tuple[dict[str, Any], ...] = (
    {"key": "rank", "label": "rank", "title": "rank", "number": True, "shown": True},
    {"key": "name", "label": "model", "title": "model", "shown": True},
    {"key": "score", "label": "score", "title": "score and interval", "number": True, "shown": True, "down": True},
    {"key": "interval", "label": "interval", "title": "interval as a picture", "shown": True},
    {"key": "unique", "label": "unique", "title": "unique part, beyond raw input and contacts", "number": True,
     "wide": True, "down": True, "shown": True},
    {"key": "standing", "label": "standing", "title": "standing", "wide": True, "shown": True},
    {"key": "p", "label": "p", "title": "permutation p", "number": True, "wide": True, "shown": True},
    {"key": "spread", "label": "spread", "title": "spread over seeds", "number": True, "wide": True},
    {"key": "value", "label": "value", "title": "value in the metric's own unit", "number": True, "wide": True,
     "down": True, "shown": True},
    {"key": "r", "label": "raw r", "title": "raw r", "number": True, "wide": True, "down": True},
    {"key": "top1", "label": "top-1", "title": "top-1 accuracy", "number": True, "wide": True, "down": True},
    {"key": "top5", "label": "top-5", "title": "top-5 accuracy", "number": True, "wide": True, "down": True},
    {"key": "layer", "label": "layer", "title": "layer", "wide": True, "shown": True},
    {"key": "parameters", "label": "parameters", "title": "parameters", "number": True, "whole": True, "wide": True,
     "down": True},
    {"key": "multiply_adds", "label": "multiply-adds", "title": "multiply-adds per step", "number": True,
     "whole": True, "wide": True, "down": True},
    {"key": "encoder", "label": "encoder", "title": "encoder", "wide": True},
    {"key": "attender", "label": "attender", "title": "attender", "wide": True},
    {"key": "objective", "label": "objective", "title": "objective", "wide": True},
    {"key": "augmentation", "label": "augmentation", "title": "augmentation", "wide": True},
    {"key": "seeds", "label": "seeds", "title": "number of seeds", "number": True, "whole": True, "wide": True},
    {"key": "animals", "label": "animals", "title": "number of animals", "number": True, "whole": True, "wide": True},
    {"key": "version", "label": "version", "title": "brainbench version", "wide": True},
)  # fmt: skip

_COMMON = ("benchmark", "recordings", "recordings_hash", "stimuli_hash", "time", "estimator", "metric", "synthetic")
_CARD = ("family", "encoder", "attender", "objective", "augmentation", "parameters", "multiply_adds", "top1", "top5")
FIELDS = (
    *_COMMON, "kind", "rank_first", "rank_last", "name", "scaled", "scaled_low", "scaled_high", "unique", "standing",
    "same_as", "unranked_because", "notes", "p", "spread", "value", "low", "high", "r", "reliability", "ceiling_lower",
    "ceiling_upper", "layer", "seeds", "animals", *_CARD, "seed", "weights", "version", "get", "page", "records",
)  # fmt: skip
"""Columns of the downloads."""


def board_label(board: Board) -> str:
    """Return benchmark and recordings of a board and what tells it from others of the same recordings."""
    return f"{f'{board.benchmark}: ' if board.benchmark else ''}{board.recordings}: {_rules(board)}"


def table_rows(board: Board) -> list[dict[str, Any]]:
    """Return every entry of a board and its baselines by :data:`FIELDS`; None where nothing is known."""
    common = {name: getattr(board, name) for name in _COMMON}
    rows = [*map(_entry_row, board.entries), *map(_baseline_row, board.baselines)]
    return [{name: _known((common | row).get(name)) for name in FIELDS} for row in rows]


def table_csv(rows: Iterable[dict[str, Any]]) -> str:
    """Return :func:`table_rows` as CSV with one header line."""
    stream = io.StringIO()
    writer: csv.DictWriter[str] = csv.DictWriter(stream, FIELDS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({name: _cell(value) for name, value in row.items()} for row in rows)
    return stream.getvalue()


def page_board(key: str, board: Board, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return a board and its :func:`table_rows` as columns, by a key: what the script of the first page shows."""
    # Records of earlier versions state no chance: a board of such alone shows the metric's own values.
    scaled = any(row["scaled"] is not None for row in rows)
    score, low, high = ("scaled", "scaled_low", "scaled_high") if scaled else ("value", "low", "high")
    columns = []
    for row, entry in zip(rows, [*board.entries, *[None] * len(board.baselines)], strict=True):
        cells = {name: value for name, value in row.items() if name not in _COMMON}
        cells |= {"score": row[score], "score_low": row[low], "score_high": row[high]}
        if entry is not None:
            cells |= {"apart": entry.not_repeatable or None, "seed": entry.card.seed}
            cells |= {"runs": [record.score.scaled for record in entry.records] if entry.seeds > 1 else None}
        columns.append({name: with_floats(value, _six_decimals) for name, value in cells.items()})
    trusted = [row for row in columns if row["standing"] != "unreliable"]
    values = [row[name] for row in trusted for name in ("score", "score_low", "score_high") if row[name] is not None]
    axis = score_scale(values, [], 0, 1)
    animals = next((row for row in columns if row["kind"] == "animals" and row["score_low"] is not None), None)
    return {
        "key": key,
        "recordings": (f"{board.benchmark}: " if board.benchmark else "")
        + board.recordings
        + (f" ({board.recordings_hash[:6]})" if board.recordings_hash else ""),
        "label": _rules(board),
        "about": _about(board),
        "conclusions": conclusions(board),
        "scaled": scaled,
        "ranked": bool(board.ranked),
        "axis": {"low": axis.low, "high": axis.high, "ticks": axis.ticks},
        "band": [animals["score_low"], animals["score_high"]] if animals else None,
        "data": {
            name: [row.get(name) for row in columns] for name in dict.fromkeys(key for row in columns for key in row)
        },
    }


def _rules(board: Board) -> str:
    parts = [board.metric or "metric not stated", board.estimator]
    parts += [f"time {board.time}"] if board.time else []
    parts += [f"stimuli {board.stimuli_hash[:6]}"] if board.stimuli_hash else []
    return ", ".join(parts)


def _about(board: Board) -> list[str]:
    first = f"{board.recordings}: {len(board.conditions)} stimuli, estimator {board.estimator}."
    brain, stimuli = board.recordings_hash or "unknown", board.stimuli_hash or "unknown"
    about = [f"Benchmark {board.benchmark}." if board.benchmark else "", first, board.stimuli]
    about += [f"Cite: {work.rstrip('.')}." for work in board.citations]
    return [*filter(None, about), f"Hash of the recordings {brain}, of the stimuli {stimuli}."]


def _entry_row(entry: Entry) -> dict[str, Any]:
    score, card = entry.score, entry.card
    low, high = interval_ends(entry.interval) or (None, None)
    # Where there are several seeds, what one of them states does not stand for all.
    alone = {"low": None, "high": None} if entry.seeds > 1 else {"seed": card.seed, "weights": card.weights}
    names = ("name", "scaled", "unique", "standing", "p", "spread", "value", "r", "seeds")
    return {
        **_score_row(score), **{name: getattr(card, name) for name in _CARD},
        **{name: getattr(entry, name) for name in names},
        **{name: getattr(entry, name) or None for name in ("same_as", "unranked_because", "layer", "page")},
        "kind": "model", "rank_first": entry.first, "rank_last": entry.last, "scaled_low": low, "scaled_high": high,
        "notes": "; ".join(entry.notes) or None, "version": score.provenance.version or None,
        "get": "; ".join(ways_to_get(entry.records[0])),
        "records": " ".join(record.identity for record in entry.records), **alone,
    }  # fmt: skip


def _baseline_row(baseline: Baseline) -> dict[str, Any]:
    score = baseline.score
    tested = math.isfinite(score.p) or score.status != "ok"
    return _score_row(score) | {
        "kind": baseline.kind,
        "name": baseline.name,
        "standing": standing_of(score, above_raw=False) if tested else None,
        "notes": "; ".join(baseline.notes) or None,
    }


def _score_row(score: Score) -> dict[str, Any]:
    row = {name: getattr(score, name) for name in ("scaled", "value", "p", "r", "reliability", "layer")}
    row |= zip(("low", "high"), interval_ends(score.interval), strict=False)
    row |= zip(("scaled_low", "scaled_high"), interval_ends(score.scaled_interval), strict=False)
    row |= {"animals": len(score.subjects) or None}
    if score.ceiling:
        row |= {"ceiling_lower": score.ceiling.lower, "ceiling_upper": score.ceiling.upper}
    return row


def _known(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _six_decimals(value: float) -> float | None:
    return round(value, 6) if math.isfinite(value) else None


def _cell(value: Any) -> Any:
    if value is None:
        return ""
    value = visible(value) if isinstance(value, str) else value
    # A spreadsheet would run text that starts like a formula.
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")):
        return f"'{value}"
    return value
