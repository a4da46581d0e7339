"""Parts of the figures of a leaderboard: charts of rows, scatter plots, matrices, colours."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from brainbench.core.records import Interval
from brainbench.core.statistics import is_finite
from leaderboards.entries import Entry
from leaderboards.figures.svg import COLOURS, Drawing, Scale, scale_of, shorten, tick_text
from leaderboards.text import number, span

WIDTH = 760.0
SHOWN = 60
"""Most models in one figure; the table holds all."""
_LEAST_VARIANCE = 1e-100
"""Products of two smaller ones would be zero in floating point."""
_SHAPES = {"supervised": "square", "simclr": "cross", "simsiam": "up", "ae": "down", "untrained": "dot"}


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


def regression(x: Sequence[float], y: Sequence[float]) -> tuple[float, float, float, Interval | None]:
    """Return slope, intercept, Pearson's r and its 95 % interval by Fisher's z (None below four points).

    r is NaN when either variable is constant, or so nearly that its variance cannot be divided by.
    """
    from scipy.stats import linregress, pearsonr

    if min(x) == max(x) or min(y) == max(y) or min(np.var(x), np.var(y)) < _LEAST_VARIANCE:
        return math.nan, math.nan, math.nan, None
    slope, start, r = np.array(linregress(x, y))[:3].tolist()
    interval = None
    if len(x) > 3 and abs(r) < 1:
        ends = pearsonr(x, y).confidence_interval(0.95)
        interval = Interval(float(ends.low), float(ends.high), 0.95, "Fisher's z")
    return slope, start, r, interval


def scatter(
    key: str,
    title: str,
    points: Sequence[tuple[float, float, Entry]],
    label: str,
    *,
    log: bool = False,
    fit: bool = False,
) -> Figure:
    """Return a scatter plot of entries, with a regression line where one is asked for."""
    height, left, bottom = 400.0, 56.0, 352.0
    drawing = Drawing(WIDTH, height, f"{title}: {len(points)} models")
    xs, ys = [x for x, *_ in points], [y for _, y, _ in points]
    if log:
        across = Scale(min(xs) / 1.4, max(xs) * 1.4, left, WIDTH - 190, log=True)
    else:
        across = scale_of(xs, left, WIDTH - 190)
    up = scale_of(ys, bottom, 16, floor=None)
    for tick in up.ticks:
        drawing.line(left, up.at(tick), WIDTH - 190, up.at(tick), "one" if tick == 1 else "grid")
        drawing.text(left - 8, up.at(tick) + 4, tick_text(tick), "end quiet")
    for tick in across.ticks:
        drawing.line(across.at(tick), 16, across.at(tick), bottom, "grid")
        drawing.text(across.at(tick), bottom + 18, tick_text(tick), "mid quiet")
    drawing.text((left + WIDTH - 190) / 2, height - 8, label, "mid")
    drawing.text(left - 44, 12, "neural fit", "")
    caption = ""
    if fit:
        caption = fitted(drawing, across, up, xs, ys)
    colour = colours(encoder_of(entry) for *_, entry in points)
    for x, y, entry in points:
        kind = colour[encoder_of(entry)]
        shape = _SHAPES.get(entry.card.objective or "", "diamond")
        drawing.mark(across.at(x), up.at(y), shape, kind, f"{entry.name}: {label} {x:g}, fit {number(y)}", 4.5)
    y = 24.0
    for name, kind in colour.items():
        drawing.mark(WIDTH - 172, y - 4, "dot", kind, size=4)
        drawing.text(WIDTH - 160, y, cut(name, 26), "small")
        y += 17
    y += 8
    for name in dict.fromkeys(entry.card.objective or "not stated" for *_, entry in points):
        drawing.mark(WIDTH - 172, y - 4, _SHAPES.get(name, "diamond"), "c0", size=4)
        drawing.text(WIDTH - 160, y, cut(name, 26), "small")
        y += 17
    drawing.height = max(height, y + 4)
    return Figure(
        key,
        title,
        f"{caption}Colours are encoders, shapes are objectives; untrained models are means over their seeds.",
        drawing,
    )


def encoder_of(entry: Entry) -> str:
    """Return the encoder for colours: with and without layer norm are one."""
    return (entry.card.encoder or "not stated").removesuffix("-ln")


def fitted(drawing: Drawing, across: Scale, up: Scale, xs: Sequence[float], ys: Sequence[float]) -> str:
    """Draw the least-squares line with the 95 % band of its mean; return the caption's sentence."""
    slope, start, r, interval = regression(xs, ys)
    if math.isnan(r):
        return "All accuracies or all scores are equal, so there is no line. "
    from scipy.special import stdtrit

    n, mx = len(xs), math.fsum(xs) / len(xs)
    sxx = math.fsum((x - mx) ** 2 for x in xs)
    rest = math.fsum((y - start - slope * x) ** 2 for x, y in zip(xs, ys, strict=True))
    places = [min(xs) + (max(xs) - min(xs)) * i / 40 for i in range(41)]
    if n > 2:
        t = float(stdtrit(n - 2, 0.975)) * math.sqrt(rest / (n - 2))
        half = [t * math.sqrt(1 / n + (x - mx) ** 2 / sxx) for x in places]
        over = [(across.at(x), up.at(start + slope * x + h)) for x, h in zip(places, half, strict=True)]
        under = [(across.at(x), up.at(start + slope * x - h)) for x, h in zip(places, half, strict=True)]
        outline = "L".join(f"{x:.1f} {y:.1f}" for x, y in [*over, *under[::-1]])
        drawing.path(f"M{outline}z", "fitband")
    ends = (min(xs), max(xs))
    first, last = ((across.at(x), up.at(start + slope * x)) for x in ends)
    drawing.line(*first, *last, "fit")
    text = f" {span(interval)}" if interval else ""
    return f"Least-squares line with the 95 % band of its mean over {n} models: r = {number(r, 2)}{text}. "


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


def colours(names: Iterable[str]) -> dict[str, str]:
    """Give each name a colour class, ``untrained`` grey, in the order in which they come."""
    found: dict[str, str] = {}
    for name in names:
        if name not in found:
            used = sum(kind != "c0" for kind in found.values())
            found[name] = "c0" if name in ("untrained", "not stated") else f"c{used % COLOURS + 1}"
    # Grey sets untrained networks back behind trained ones; alone they need not step back.
    return dict.fromkeys(found, "c1") if len(found) == 1 else found


_NAMES = dict(
    zip(
        [f"c{i}" for i in range(COLOURS + 1)],
        ("grey", "blue", "orange", "teal", "violet", "ochre", "pink", "green", "sky"),
        strict=True,
    )
)


def legend_words(colour: dict[str, str]) -> str:
    """Return the sentence that says what the colours mean."""
    return "Colours: " + ", ".join(f"{name} {_NAMES[kind]}" for name, kind in colour.items()) + "." if colour else ""


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
