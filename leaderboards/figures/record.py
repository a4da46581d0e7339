"""The drawings of one model: its score beside baselines and animals, its raw comparison, its layers."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from brainbench.core.records import Interval, ResultRecord, Score
from leaderboards.figures.plots import ChartPoint, ChartRow, cut, cut_name, row_chart, score_scale
from leaderboards.figures.svg import Drawing
from leaderboards.text import number, span

PARTS = {"encoder": "c1", "attender": "c2", "decoder": "c3"}
"""Colour class of each part of a network."""
_WIDTH, _START = 490.0, 150.0


def beside(record: ResultRecord) -> Drawing:
    """Draw the score with those of animals and baselines, single animals as small points.

    On the common scale where the record states its chance, else in the metric's own unit.
    """
    known = math.isfinite(record.score.scaled)

    def rows(score: Score) -> tuple[Callable[[float], float], Interval | None]:
        return (score.on_scale, score.scaled_interval) if known else (float, score.interval)

    animals = record.animal_to_animal
    label = "score: 0 chance, 1 all that is reliable" if known else record.score.metric
    return _chart(record, label, "value", rows, rows(animals)[1] if animals and animals.status == "ok" else None)


def raw(record: ResultRecord) -> Drawing:
    """Draw the raw comparisons, not corrected for noise, with the noise ceiling as a band."""
    ceiling = record.score.ceiling
    band = None if ceiling is None else Interval(ceiling.lower, ceiling.upper)
    return _chart(record, "raw r; the band is the noise ceiling", "r", lambda _: (float, None), band)


_Reading = Callable[[Score], tuple[Callable[[float], float], Interval | None]]


def _chart(record: ResultRecord, label: str, name: str, reading: _Reading, band: Interval | None) -> Drawing:
    """Draw one row per score; ``name`` is the field of scores and animals that is drawn."""
    named = [(record.score.name, "c1", "dot", record.score)]
    named += [("animal-to-animal", "c7", "square", record.animal_to_animal)] if record.animal_to_animal else []
    named += [(key, "c0", "diamond", score) for key, score in record.baselines.items()]
    rows, values = [], []
    for key, kind, shape, score in named:
        place, interval = reading(score)
        value = place(getattr(score, name))
        singles = [place(getattr(item, name)) for item in score.subjects]
        hollow = "" if score.status == "ok" else " open"
        points = [ChartPoint(one, f"{kind} faint", size=2) for one in singles]
        points.append(ChartPoint(value, kind + hollow, f"{key}: {number(value)} {span(interval)}", 4, shape))
        rows.append(ChartRow(cut_name(key, 20), points, interval, kind))
        values += [value, *singles]
    scale = score_scale(values, [row.interval for row in rows], _START, _WIDTH - 20)
    return row_chart(f"{label}, {len(rows)} rows", rows, scale, label, width=_WIDTH, band=band)


def layers(records: Sequence[ResultRecord]) -> Drawing | None:
    """Draw the layers of one model against their scores, all seeds; None without layers."""
    score = records[0].score
    seeds = [record.score.layers for record in records]
    if not score.layers:
        return None
    rows = []
    for index, layer in enumerate(score.layers):
        kind = PARTS.get(layer.layer.partition(".")[0], "c1")
        chosen = layer.layer == score.layer
        found = [one[index].value for one in seeds if len(one) == len(score.layers)]
        finite = [value for value in found if math.isfinite(value)]
        points = [ChartPoint(value, f"{kind} faint", size=2.2) for value in finite if len(records) > 1]
        interval = layer.interval if len(records) == 1 else None
        if finite:
            mean = math.fsum(finite) / len(finite)
            tip = f"{layer.layer}: {number(mean)} {span(interval)}"
            points.append(ChartPoint(mean, kind if chosen else f"{kind} open", tip, 4))
        rows.append(ChartRow(cut(layer.layer, 22), points, interval, kind, "end title" if chosen else "end"))
    scale = score_scale([layer.value for one in seeds for layer in one], [row.interval for row in rows], 132, 470)
    words = f"Score of {len(score.layers)} layers of {score.name}"
    return row_chart(words, rows, scale, "score in the metric's own unit", step=20, width=_WIDTH)
