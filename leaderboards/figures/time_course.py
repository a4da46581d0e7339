"""A score over time with the latency of each layer, drawn from a record's statistics.

Scores are drawn on the scale that all metrics share: 0 is chance at that time and 1 all that is reliable.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from leaderboards.figures.plots import cut
from leaderboards.figures.svg import Drawing, Scale, scale_of, tick_text

ALPHA = 0.05
"""Times with a corrected p up to this are filled."""
_WIDTH, _LEFT, _RIGHT = 640.0, 150.0, 20.0
_CURVE, _ROW = 190.0, 18.0
_MOST_LAYERS = 60


def draw_time_course(statistics: Mapping[str, Any]) -> Drawing | None:
    """Draw the score at each time, and below it the latency of each layer; None without a usable score over time."""
    try:
        course = statistics["time_course"]
        points, layers = list(course["points"]), list(course["latencies"])[:_MOST_LAYERS]
        times = [_number(point["time"]) for point in points]
        half = _number(course["bin"]) / 2
        across = Scale(min(times) - half, max(times) + half, _LEFT, _WIDTH - _RIGHT)
        rows = [layer for layer in layers if math.isfinite(_number(layer["latency"]))]
        height = _CURVE + 40 + (len(rows) * _ROW + 46 if rows else 0)
        drawing = Drawing(_WIDTH, height, f"Score at {len(points)} times, and the latency of {len(rows)} layers")
        _curve(drawing, points, across)
        if rows:
            _latencies(drawing, rows, _number(course["largest_lag"]))
    except (KeyError, TypeError, ValueError, AttributeError):
        # Statistics are free text in a record that somebody else may have written.
        return None
    return drawing


def _curve(drawing: Drawing, points: Sequence[Mapping[str, Any]], across: Scale) -> None:
    shown = []
    for point in points:
        chance = _number(point["chance"])
        value, *ends = ((one - chance) / (1 - chance) for one in (_number(point["value"]), *_ends(point["interval"])))
        if math.isfinite(value):
            shown.append((across.at(_number(point["time"])), value, ends, point))
    held = [min(max(end, -0.5), 1.5) for _, _, ends, _ in shown for end in ends]
    up = scale_of([*(value for _, value, *_ in shown), *held], _CURVE, 22, top=1.0)
    drawing.text(_LEFT, 14, "score at each time: 0 chance, 1 all that is reliable", "title small")
    for tick in up.ticks:
        drawing.line(_LEFT, up.at(tick), _WIDTH - _RIGHT, up.at(tick), "one" if tick in (0, 1) else "grid")
        drawing.text(_LEFT - 6, up.at(tick) + 4, tick_text(tick), "end quiet small")
    _ticks(drawing, across, _CURVE, "seconds after the window begins")
    if len(shown) > 1:
        drawing.path("M" + "L".join(f"{x:.1f} {up.at(value):.1f}" for x, value, *_ in shown), "line edge")
    for x, value, ends, point in shown:
        if ends:
            drawing.line(x, up.at(ends[0]), x, up.at(ends[1]), "span c1")
        clear = _number(point["p"]) <= ALPHA
        tip = f"{_number(point['time']):.3g} s: {value:.2f}, p = {_number(point['p']):.2g}"
        drawing.mark(x, up.at(value), "dot", "c1" if clear else "c1 open", tip, 3.5)


def _latencies(drawing: Drawing, rows: Sequence[Mapping[str, Any]], largest: float) -> None:
    across = Scale(-largest, largest, _LEFT, _WIDTH - _RIGHT)
    top = _CURVE + 62
    bottom = top + len(rows) * _ROW - 6
    drawing.text(_LEFT, top - 14, "latency of the best match of each layer", "title small")
    drawing.line(across.at(0), top - 6, across.at(0), bottom, "one")
    for index, layer in enumerate(rows):
        y, latency, span = top + index * _ROW + 5, _number(layer["latency"]), _ends(layer["interval"])
        drawing.text(_LEFT - 8, y + 4, cut(str(layer["layer"]), 22), "end small")
        if span:
            drawing.line(across.at(span[0]), y, across.at(span[1]), y, "span c1")
        drawing.mark(across.at(latency), y, "dot", "c1", f"{layer['layer']}: {1000 * latency:.0f} ms", 3.5)
    _ticks(drawing, across, bottom, "seconds by which neurons follow the model")


def _ticks(drawing: Drawing, across: Scale, y: float, words: str) -> None:
    drawing.line(across.start, y, across.end, y)
    for tick in across.ticks:
        drawing.text(across.at(tick), y + 15, tick_text(tick), "mid quiet small")
    drawing.text(across.end, y + 28, words, "end quiet small")


def _number(value: Any) -> float:
    """Return a number of a record, in which NaN is null."""
    return math.nan if value is None else float(value)


def _ends(interval: Mapping[str, Any] | None) -> tuple[float, ...]:
    ends = () if interval is None else (_number(interval["low"]), _number(interval["high"]))
    return ends if all(map(math.isfinite, ends)) else ()
