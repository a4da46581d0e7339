"""Parts of the figures of a leaderboard: charts of rows, colours, labels."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from brainbench.core.records import Interval
from brainbench.core.statistics import is_finite
from leaderboards.figures.svg import COLOURS, Drawing, Scale, shorten, tick_text

WIDTH = 760.0
SHOWN = 60
"""Most models in one figure; the table holds all."""


@dataclass(frozen=True)
class Figure:
    """One figure with its caption, or the reason why there is none."""

    key: str
    """Short name for links and files."""
    title: str
    caption: str = ""
    drawing: Drawing | None = None
    lacking: str = ""
    """Entries that the records would have to hold; empty when the figure is drawn."""


def interval_ends(interval: Interval | None) -> tuple[float, ...]:
    """Return both ends of an interval, nothing where it has none."""
    return (interval.low, interval.high) if interval and is_finite(interval) else ()


def score_scale(values: Sequence[float], intervals: Sequence[Interval | None], start: float, end: float) -> Scale:
    """Return an axis from 0 to 1 that widens for values, and for interval ends as far as −1 and 1.5."""
    ends = [end_ for interval in intervals for end_ in interval_ends(interval)]
    finite = [value for value in (*values, *ends) if math.isfinite(value)]
    low, high = max(min([0.0, *finite]), -1.0), min(max([1.0, *finite]), 1.5)
    return Scale(low, high + 0.02, start, end)


@dataclass(frozen=True)
class ChartPoint:
    """A mark at a value of a row's axis; nothing is drawn where the value is NaN."""

    value: float
    kind: str
    """Classes, such as ``c1 open``."""
    tip: str = ""
    size: float = 4.5
    shape: str = "dot"


@dataclass(frozen=True)
class ChartRow:
    """One row of a chart: a label, an interval and marks, drawn in this order."""

    label: str
    points: Sequence[ChartPoint]
    interval: Interval | None = None
    kind: str = ""
    """Colour class of the interval."""
    label_kind: str = "end"
    group: str | None = None
    """Heading of the rows that begin here, at the left edge."""


def row_chart(
    title: str,
    rows: Sequence[ChartRow],
    scale: Scale,
    label: str,
    *,
    step: float = 19.0,
    width: float = WIDTH,
    band: Interval | None = None,
) -> Drawing:
    """Draw rows below one another along one axis; ``band`` is an interval shaded over the whole height."""
    drawing = Drawing(width, 44 + step * len(rows), title)
    top, bottom = 30, drawing.height - 8
    for tick in scale.ticks:
        drawing.line(scale.at(tick), top, scale.at(tick), bottom, "one" if tick == 1 else "grid")
        drawing.text(scale.at(tick), top - 6, tick_text(tick), "mid quiet")
    drawing.text(scale.end, 11, label, "end quiet small")
    if ends := interval_ends(band):
        left, right = map(scale.at, ends)
        drawing.rect(left, top, right - left, bottom - top, "band")
    for index, row in enumerate(rows):
        y = 44 + step * index
        if row.group is not None:
            drawing.text(6, y + 4, row.group, "title small")
        drawing.text(scale.start - 8, y + 4, row.label, row.label_kind)
        if ends := interval_ends(row.interval):
            left, right = map(scale.at, ends)
            drawing.line(left, y, right, y, f"span {row.kind}")
        for point in row.points:
            if math.isfinite(point.value):
                drawing.mark(scale.at(point.value), y, point.shape, point.kind, point.tip, point.size)
    return drawing


def left_axis(drawing: Drawing, up: Scale, left: float, right: float) -> None:
    """Draw the grid of a vertical axis with its ticks."""
    for tick in up.ticks:
        drawing.line(left, up.at(tick), right, up.at(tick), "one" if tick == 1 else "grid")
        drawing.text(left - 8, up.at(tick) + 4, tick_text(tick), "end quiet")


def legend(drawing: Drawing, marks: Iterable[tuple[str, str, str]], x: float, y: float = 24.0) -> None:
    """Draw names, each behind its shape and colour, below one another."""
    for place, (name, shape, kind) in enumerate(marks):
        drawing.mark(x, y - 4 + 17 * place, shape, kind, size=4)
        drawing.text(x + 12, y + 17 * place, cut(name, 26), "small")


def colours(names: Iterable[str]) -> dict[str, str]:
    """Give each name a colour class, ``untrained`` grey, in the order in which they come."""
    found: dict[str, str] = {}
    for name in names:
        if name not in found:
            used = sum(kind != "c0" for kind in found.values())
            found[name] = "c0" if name in ("untrained", "not stated") else f"c{used % COLOURS + 1}"
    # Grey sets untrained networks back behind trained ones; alone they need not step back.
    return dict.fromkeys(found, "c1") if len(found) == 1 else found


_NAMES = ("grey", "blue", "orange", "teal", "violet", "ochre", "pink", "green", "sky")
"""Colour names of the classes ``c0`` to ``c8``."""


def legend_words(colour: dict[str, str]) -> str:
    """Return the sentence that says what the colours mean."""
    told = ", ".join(f"{name} {_NAMES[int(kind[1:])]}" for name, kind in colour.items())
    return f"Colours: {told}." if told else ""


def cut_words(count: int, shown: int = SHOWN) -> str:
    """Return the sentence that says how many models are shown, empty if all are."""
    return f" Shown are the first {shown} of {count} models; the table holds all." if count > shown else ""


def cut(text: str, length: int) -> str:
    """Shorten a label; of a path the last part stays."""
    return shorten(text.rpartition("/")[2] or text, length)


def cut_name(name: str, length: int) -> str:
    """Shorten a model's name in its middle: its end says how it was trained. ``./`` marks one of a local folder.

    >>> cut_name("local-dir:zhuang-intersection-ln-small.simclr.masked75", 30)
    './zhuang-inter…simclr.masked75'
    """
    folder, mark, inside = name.partition("local-dir:")
    text = f"./{inside}" if mark and not folder and "/" not in inside else name.rpartition("/")[2] or name
    head = (length - 1) // 2
    return text if len(text) <= length else f"{text[:head]}…{text[head + 1 - length :]}"
