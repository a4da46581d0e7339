"""From records to what the templates show: the rows of charts and tables, in order."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

from brainbench.core.records import LayerScore, ResultRecord, Score
from brainbench.core.statistics import is_finite
from leaderboards import text
from leaderboards.figures.architecture import diagram
from leaderboards.figures.marks import Axis, Mark, axis_of, rdm_picture, score_axis
from leaderboards.site.page import drawn
from leaderboards.store import record_name

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
    p: float | None
    """Corrected for the number of layers; None when the record states none."""


def report_view(record: ResultRecord) -> dict[str, Any]:
    """Return what ``report.html.j2`` shows."""
    score = record.score
    others = [("animal-to-animal", "animals", record.animal_to_animal)] if record.animal_to_animal else []
    named = [(score.name, "model", score), *others, *((name, "baseline", s) for name, s in record.baselines.items())]
    singles = [subject.value for subject in score.subjects] + [layer.value for layer in score.layers]
    axis = _wider(score_axis(item for _, _, item in named), singles)
    ceiling = _ends(score)
    raw_axis = axis_of([item.r for _, _, item in named] + list(ceiling or ()))
    rows = [
        _ScoreRow(
            label,
            kind,
            item,
            axis.mark(item.value, item.interval, [subject.value for subject in item.subjects]),
            raw_axis.mark(item.r, None, [subject.r for subject in item.subjects]),
        )
        for label, kind, item in named
    ]
    return {
        "title": f"{score.name}: brainbench score",
        "record": record,
        "recordings": score.provenance.recordings_name,
        "axis": axis,
        "raw_axis": raw_axis,
        "band": _band(record.animal_to_animal),
        "ceiling": ceiling,
        "rows": rows,
        "comparisons": text.comparisons(record),
        "model_rdm": rdm_picture(score.model_rdm, score.stimuli),
        "brain_rdm": rdm_picture(score.brain_rdm, score.stimuli),
        "pairs": _pairs(score),
        "layers": _layer_rows(score, axis),
        "layer_reference": score.value if score.status != "undefined" and score.layers else None,
        "animals": [(subject, axis.mark(subject.value)) for subject in score.subjects],
        "methods": text.methods(record),
        "command": score.provenance.command,
        "card": text.card_rows(record.card) if record.card else [],
        "provenance": text.provenance_rows(score.provenance),
        "file_name": record_name(record),
        "graph": drawn(diagram(record.card.graph, score.name)) if record.card and record.card.graph else None,
    }


def _layer_rows(score: Score, axis: Axis) -> list[_LayerRow]:
    rows = []
    tests = score.provenance.layer_p
    for layer in score.layers:
        notes = ["chosen on held-out data"] if layer.layer == score.layer else []
        best = layer.layer == score.best_layer
        notes += ["optimistic maximum, not a result"] if best else []
        kind = "chosen" if layer.layer == score.layer else "best" if best else "layer"
        rows.append(
            _LayerRow(
                layer,
                axis.mark(layer.value, layer.interval),
                kind,
                "; ".join(notes),
                "diamond" if best else "dot",
                kind == "best",
                tests.get(layer.layer),
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
    interval = score.interval if score and score.status == "ok" else None
    return (interval.low, interval.high) if interval and is_finite(interval) else None


def _ends(score: Score) -> tuple[float, float] | None:
    """Return the noise ceiling if there is one."""
    ceiling = score.ceiling
    return (
        (ceiling.lower, ceiling.upper)
        if ceiling and math.isfinite(ceiling.lower) and math.isfinite(ceiling.upper)
        else None
    )
