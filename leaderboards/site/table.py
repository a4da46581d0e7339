"""The table of the site as data: its columns, and every board's rows in compact form."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from brainbench.core.records import Interval
from leaderboards.entries import Entry
from leaderboards.figures.marks import interval_ends, score_axis
from leaderboards.ranking import Baseline, Board, RankedRecord

COLUMNS: tuple[dict[str, Any], ...] = (
    {"key": "rank", "label": "rank", "title": "rank", "number": True, "shown": True},
    {"key": "model", "label": "model", "title": "model", "shown": True},
    {"key": "score", "label": "score", "title": "score and interval", "number": True, "shown": True, "down": True},
    {"key": "interval", "label": "interval", "title": "interval as a picture", "shown": True},
    {"key": "spread", "label": "spread", "title": "spread over seeds", "number": True, "wide": True, "shown": True},
    {"key": "p", "label": "p", "title": "permutation p", "number": True, "wide": True, "shown": True},
    {"key": "raw", "label": "raw r", "title": "raw r", "number": True, "wide": True, "down": True},
    {"key": "top1", "label": "top-1", "title": "top-1 accuracy", "number": True, "wide": True, "down": True},
    {"key": "top5", "label": "top-5", "title": "top-5 accuracy", "number": True, "wide": True, "down": True},
    {"key": "layer", "label": "layer", "title": "layer", "wide": True, "shown": True},
    {"key": "parameters", "label": "parameters", "title": "parameters", "number": True, "whole": True, "wide": True,
     "shown": True, "down": True},
    {"key": "cost", "label": "multiply-adds", "title": "multiply-adds per step", "number": True, "whole": True,
     "wide": True, "down": True},
    {"key": "encoder", "label": "encoder", "title": "encoder", "wide": True},
    {"key": "attender", "label": "attender", "title": "attender", "wide": True},
    {"key": "objective", "label": "objective", "title": "objective", "wide": True},
    {"key": "augmentation", "label": "augmentation", "title": "augmentation", "wide": True},
    {"key": "seeds", "label": "seeds", "title": "number of seeds", "number": True, "whole": True, "wide": True},
    {"key": "animals", "label": "animals", "title": "number of animals", "number": True, "whole": True, "wide": True},
    {"key": "status", "label": "status", "title": "status", "wide": True, "shown": True},
    {"key": "version", "label": "version", "title": "brainbench version", "wide": True},
)  # fmt: skip


def board_label(board: Board) -> str:
    """Return the recordings of a board and what tells it from others of the same recordings."""
    return f"{board.recordings}: {_rules(board)}"


def compact(listed: Sequence[tuple[Board, Sequence[Entry]]]) -> list[dict[str, Any]]:
    """Return every board as columns: what the script of the first page shows."""
    found = []
    for index, (board, entries) in enumerate(listed, start=1):
        axis = score_axis(item.score for item in (*entries, *board.baselines))
        animals = next((b.score for b in board.baselines if b.kind == "animals" and b.score.status == "ok"), None)
        rows = [*map(_model_row, entries), *map(_baseline_row, board.baselines)]
        keys = dict.fromkeys(key for row in rows for key in row)
        found.append(
            {
                "key": str(index),
                "recordings": board.recordings + (f" ({board.recordings_hash[:6]})" if board.recordings_hash else ""),
                "label": _rules(board),
                "about": _about(board),
                "axis": {"low": axis.low, "high": axis.high, "ticks": axis.ticks},
                "band": list(interval_ends(animals.interval)) or None if animals else None,
                "data": {key: [row.get(key) for row in rows] for key in keys},
            }
        )
    return found


def _rules(board: Board) -> str:
    parts = [board.metric or "metric not stated", board.estimator]
    parts += [f"time {board.time}"] if board.time else []
    parts += [f"stimuli {board.stimuli_hash[:6]}"] if board.stimuli_hash else []
    return ", ".join(parts)


def _about(board: Board) -> list[str]:
    parts = [f"{board.recordings}: {len(board.conditions)} stimuli, estimator {board.estimator}."]
    if board.stimuli:
        parts.append(board.stimuli)
    parts.append(
        f"Hash of the recordings {board.recordings_hash or 'unknown'}, "
        f"of the stimuli {board.stimuli_hash or 'unknown'}."
    )
    if not board.comparable:
        parts.append("These records do not say which recordings they used, so they are listed but not ranked.")
    return parts


def _model_row(entry: Entry) -> dict[str, Any]:
    card, score = entry.card, entry.score
    low, high = _ends(entry.interval)
    unranked = [f"not ranked: {entry.unranked_because}"] if entry.unranked_because else []
    return {
        "kind": "model",
        "model": entry.name,
        "name": entry.name,
        "page": entry.page,
        "first": entry.first,
        "last": entry.last,
        "placed": entry.first is not None,
        "score": _short(entry.value),
        "low": low,
        "high": high,
        "spread": _short(entry.spread),
        "p": _short(entry.p, 6),
        "raw": _short(entry.r),
        "layer": score.layer,
        "status": entry.status,
        "notes": [*entry.notes, *unranked] or None,
        "parameters": card.parameters,
        "cost": card.multiply_adds,
        "top1": _short(card.top1),
        "top5": _short(card.top5),
        "encoder": card.encoder,
        "attender": card.attender,
        "objective": card.objective,
        "augmentation": card.augmentation,
        "seed": card.seed,
        "seeds": entry.seeds,
        "animals": len(score.subjects) or None,
        "version": score.provenance.version or None,
        "runs": [_run(row) for row in entry.rows] if entry.seeds > 1 else None,
    }


def _run(row: RankedRecord) -> list[Any]:
    score, card = row.record.score, row.record.card
    placed = (_short(score.value), *_ends(score.interval), _short(score.p, 6), row.first, row.last)
    return [card.seed if card else None, *placed, score.status, _short(score.r), score.layer]


def _baseline_row(baseline: Baseline) -> dict[str, Any]:
    score = baseline.score
    low, high = _ends(score.interval)
    return {
        "kind": baseline.kind,
        "model": baseline.name,
        "name": baseline.name,
        "placed": score.status == "ok",
        "first": None,
        "last": None,
        "score": _short(score.value),
        "low": low,
        "high": high,
        "p": _short(score.p, 6),
        "raw": _short(score.r),
        "status": score.status,
        "notes": list(baseline.notes) or None,
    }


def _ends(interval: Interval | None) -> tuple[float | None, float | None]:
    low, high = interval_ends(interval) or (None, None)
    return _short(low), _short(high)


def _short(value: float | None, digits: int = 4) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)
