"""Vector drawings: escaped text, marks, axes with round ticks, and charts of rows with labels and intervals.

Drawn on the server side so that one drawing serves the site, the reports and a paper. Marks take their colours from
classes, not from ``style`` attributes, because the pages forbid those; :func:`standalone` adds the colours for a file
of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from brainbench.core.errors import visible_lines
from brainbench.core.records import Interval
from brainbench.core.statistics import is_finite

STYLE = (Path(__file__).parents[1] / "templates" / "figure.css").read_text(encoding="utf-8")
"""Colours of a drawing that stands alone; the pages bring their own for light and dark."""

COLOURS = 8  # classes `c1` to `c8`; `c0` is grey


@dataclass
class Drawing:
    """An SVG image that is being drawn; places in pixels from the top left."""

    width: float
    height: float
    title: str
    """The drawing in words, for readers who do not see it."""
    parts: list[str] = field(default_factory=list)

    def text(self, x: float, y: float, text: str, kind: str = "") -> None:
        """Write one line; ``kind`` holds classes such as ``end quiet small``."""
        self.parts.append(f'<text x="{_n(x)}" y="{_n(y)}"{_class(kind)}>{escape(visible_lines(text))}</text>')

    def line(self, x1: float, y1: float, x2: float, y2: float, kind: str = "line") -> None:
        """Draw a straight line."""
        self.parts.append(f'<line x1="{_n(x1)}" y1="{_n(y1)}" x2="{_n(x2)}" y2="{_n(y2)}"{_class(kind)}/>')

    def rect(
        self, x: float, y: float, width: float, height: float, kind: str = "", *, rx: float = 0, tip: str = ""
    ) -> None:
        """Draw a rectangle with corners of radius ``rx``; ``tip`` is shown on hovering."""
        round_ = f' rx="{_n(rx)}"' if rx else ""
        size = f'width="{_n(max(width, 0))}" height="{_n(max(height, 0))}"'
        self.parts.append(f'<rect x="{_n(x)}" y="{_n(y)}" {size}{round_}{_class(kind)}{_end("rect", tip)}')

    def path(self, d: str, kind: str = "line") -> None:
        """Draw a path given by its commands."""
        self.parts.append(f'<path d="{d}"{_class(kind)}/>')

    def mark(self, x: float, y: float, shape: str, kind: str, tip: str = "", size: float = 4.5) -> None:
        """Draw a point: ``dot``, ``square``, ``diamond``, ``up``, ``down`` or ``cross``."""
        self.parts.append(f'<path d="{_SHAPES[shape](x, y, size)}"{_class(kind)}{_end("path", tip)}')

    def render(self, *, style: str = "") -> str:
        """Return the SVG element."""
        label = escape(visible_lines(self.title))
        return (
            f'<svg class="figure" xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_n(self.width)} {_n(self.height)}" '
            f'width="{_n(self.width)}" height="{_n(self.height)}" role="img" aria-label="{label}">'
            f"{f'<style>{style}</style>' if style else ''}{''.join(self.parts)}</svg>"
        )

    def __html__(self) -> str:
        """Return the element for a template, which escapes nothing in it."""
        return self.render()


_SHAPES: dict[str, Callable[[float, float, float], str]] = {
    "dot": lambda x, y, s: f"M{_n(x - s)} {_n(y)}a{s} {s} 0 1 0 {2 * s} 0a{s} {s} 0 1 0 {-2 * s} 0z",
    "square": lambda x, y, s: f"M{_n(x - s)} {_n(y - s)}h{2 * s}v{2 * s}h{-2 * s}z",
    "diamond": lambda x, y, s: (
        f"M{_n(x)} {_n(y - 1.3 * s)}l{1.3 * s} {1.3 * s}l{-1.3 * s} {1.3 * s}l{-1.3 * s} {-1.3 * s}z"
    ),
    "up": lambda x, y, s: f"M{_n(x)} {_n(y - 1.2 * s)}l{1.2 * s} {2.1 * s}h{-2.4 * s}z",
    "down": lambda x, y, s: f"M{_n(x)} {_n(y + 1.2 * s)}l{1.2 * s} {-2.1 * s}h{-2.4 * s}z",
    "cross": lambda x, y, s: f"M{_n(x - s)} {_n(y - s)}l{2 * s} {2 * s}m0 {-2 * s}l{-2 * s} {2 * s}",
}
"""Commands of the path of a point at x, y of a size."""


def standalone(drawing: Drawing) -> str:
    """Return a drawing as a file of its own, with its colours and a white ground."""
    ground = f'<rect width="{_n(drawing.width)}" height="{_n(drawing.height)}" fill="#fff"/>'
    copy = Drawing(drawing.width, drawing.height, drawing.title, [ground, *drawing.parts])
    return copy.render(style=STYLE)


@dataclass(frozen=True)
class Scale:
    """A linear or logarithmic axis from values to pixels."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def at(self, value: float) -> float:
        """Return the place of a value, held inside the axis."""
        low, high = (math.log10(self.low), math.log10(self.high)) if self.log else (self.low, self.high)
        place = math.log10(max(value, 1e-300)) if self.log else value
        share = min(max((place - low) / (high - low), 0.0), 1.0)
        return self.start + share * (self.end - self.start)

    @property
    def ticks(self) -> list[float]:
        """Round values along the axis."""
        if self.log:
            powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            steps = (1, 2, 5) if self.high / self.low < 300 else (1,)
            return [m * 10.0**k for k in powers for m in steps if self.low <= m * 10.0**k <= self.high * 1.0001]
        step = nice((self.high - self.low) / 4)
        first = math.ceil(self.low / step - 1e-9)
        return [step * i for i in range(first, math.floor(self.high / step + 1e-9) + 1)]


def nice(step: float) -> float:
    """Return the round number (1, 2, 2.5 or 5 times a power of ten) next above a step.

    >>> nice(0.3), nice(0.21), nice(7)
    (0.5, 0.25, 10.0)
    """
    power = 10.0 ** math.floor(math.log10(step))
    return next(factor * power for factor in (1, 2, 2.5, 5, 10) if factor * power >= step * (1 - 1e-9))


def scale_of(
    values: Sequence[float], start: float, end: float, *, floor: float | None = 0.0, top: float | None = None
) -> Scale:
    """Return a linear axis that holds the finite values, ``floor`` and ``top``, with a little room."""
    finite = [value for value in values if math.isfinite(value)]
    held = [*finite, *([floor] if floor is not None else []), *([top] if top is not None else [])] or [0.0, 1.0]
    low, high = min(held), max(held)
    room = 0.04 * ((high - low) or 1.0)
    return Scale(low if low == floor else low - room, high + room, start, end)


def shorten(text: str, length: int) -> str:
    """Cut a text behind a number of characters."""
    return text if len(text) <= length else text[: length - 1] + "…"


def tick_text(value: float) -> str:
    """Write a tick's value shortly: ``0.25``, ``−1``, ``2 M``."""
    for size, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if abs(value) >= size:
            return f"{value / size:g}{unit}"
    return f"{round(value, 10):g}".replace("-", "−")


def _n(value: float) -> str:
    return f"{value:.2f}".rstrip("0").rstrip(".") if value % 1 else f"{value:.0f}"


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""


def _end(element: str, tip: str) -> str:
    """Close an element, with the text that is shown on hovering."""
    return f"><title>{escape(visible_lines(tip))}</title></{element}>" if tip else "/>"


WIDTH = 760.0
SHOWN = 60  # most models in one figure; the table holds all


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
    classes: dict[str, str] = {}
    for name in names:
        if name not in classes:
            used = sum(kind != "c0" for kind in classes.values())
            classes[name] = "c0" if name in ("untrained", "not stated") else f"c{used % COLOURS + 1}"
    # Grey sets untrained networks back behind trained ones; alone they need not step back.
    return dict.fromkeys(classes, "c1") if len(classes) == 1 else classes


_NAMES = ("grey", "blue", "orange", "teal", "violet", "ochre", "pink", "green", "sky")
"""Colour names of the classes ``c0`` to ``c8``."""


def legend_words(colour: dict[str, str]) -> str:
    """Return the sentence that says what the colours mean."""
    pairs = ", ".join(f"{name} {_NAMES[int(kind[1:])]}" for name, kind in colour.items())
    return f"Colours: {pairs}." if pairs else ""


def cut_words(count: int, limit: int = SHOWN) -> str:
    """Return the sentence that says how many models are shown, empty if all are."""
    return f" Shown are the first {limit} of {count} models; the table holds all." if count > limit else ""


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
