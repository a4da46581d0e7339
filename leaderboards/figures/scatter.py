"""Scatter plots of a board: accuracy and parameters of its models against their neural fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from brainbench.core.records import Interval
from leaderboards.entries import Entry
from leaderboards.figures.plots import WIDTH, Figure, colours, left_axis, legend
from leaderboards.figures.svg import Drawing, Scale, scale_of, tick_text
from leaderboards.standing import DOUBTFUL
from leaderboards.text import number, span

_LEAST_VARIANCE = 1e-100
"""Products of two smaller ones would be zero in floating point."""
_SHAPES = {"supervised": "square", "simclr": "cross", "simsiam": "up", "ae": "down", "untrained": "dot"}


def accuracy_against_fit(entries: Sequence[Entry], *, supervised: bool = False) -> Figure:
    """Draw the task accuracy against the neural fit, with its regression (figure 3.8 a; b: supervised ones alone)."""
    key, title, kind = "accuracy-fit", "Task accuracy against neural fit (as figure 3.8 a)", ""
    if supervised:
        entries = [entry for entry in entries if entry.card.objective == "supervised"]
        key, kind = "supervised-fit", "supervised "
        title = "Accuracy of supervised networks against neural fit (as figure 3.8 b)"
    label, read = _accuracy_of(entries)
    points = [(value, e.scaled, e) for e in entries if (value := read(e)) is not None and _trusted(e)]
    if len(points) < 3:
        lacking = f"{len(points)} {kind}records state both a task accuracy and a trusted score; at least 3 are needed"
        return Figure(key, title, lacking=lacking)
    return scatter(key, title, points, label, fit=True)


def parameters_against_fit(entries: Sequence[Entry]) -> Figure:
    """Draw the number of parameters against the neural fit (figure 3.3 b)."""
    key, title = "parameters", "Parameters against neural fit (as figure 3.3 b)"
    points = [(float(e.card.parameters), e.scaled, e) for e in entries if e.card.parameters and _trusted(e)]
    if len(points) < 2:
        return Figure(key, title, lacking="fewer than 2 records state parameters and have a trusted score")
    return scatter(key, title, points, "parameters", log=True)


def parameters_against_accuracy(entries: Sequence[Entry]) -> Figure:
    """Draw the number of parameters against the task accuracy (figure 3.3 c)."""
    key, title = "parameters-accuracy", "Parameters against task accuracy (as figure 3.3 c)"
    label, read = _accuracy_of(entries)
    found = [(e.card.parameters, read(e), e) for e in entries]
    points = [(float(count), value, e) for count, value, e in found if count and value is not None]
    if len(points) < 2:
        return Figure(key, title, lacking="fewer than 2 records state both parameters and a task accuracy")
    return scatter(key, title, points, "parameters", up_label=label, log=True)


def _accuracy_of(entries: Sequence[Entry]) -> tuple[str, Callable[[Entry], float | None]]:
    """Return which accuracy is drawn, with what reads it: top-5 where all entries with an accuracy state it."""
    stated = [entry.card for entry in entries if entry.card.top1 is not None]
    name = "top5" if stated and all(card.top5 is not None for card in stated) else "top1"

    def read(entry: Entry) -> float | None:
        cards = [record.card for record in entry.records if record.card is not None]
        values = [value for card in cards if (value := getattr(card, name)) is not None]
        return math.fsum(values) / len(values) if values else None

    return f"{name[:3]}-{name[3:]} accuracy", read


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
    key: str, title: str, points: Sequence[tuple[float, float, Entry]], label: str, up_label: str = "neural fit",
    *, log: bool = False, fit: bool = False,
) -> Figure:  # fmt: skip
    """Return a scatter plot of entries, with a regression line where one is asked for."""
    height, left, right, bottom = 400.0, 56.0, WIDTH - 190, 352.0
    drawing = Drawing(WIDTH, height, f"{title}: {len(points)} models")
    xs, ys = [x for x, *_ in points], [y for _, y, _ in points]
    across = Scale(min(xs) / 1.4, max(xs) * 1.4, left, right, log=True) if log else scale_of(xs, left, right)
    up = scale_of(ys, bottom, 16, floor=None)
    left_axis(drawing, up, left, right)
    for tick in across.ticks:
        drawing.line(across.at(tick), 16, across.at(tick), bottom, "grid")
        drawing.text(across.at(tick), bottom + 18, tick_text(tick), "mid quiet")
    drawing.text((left + right) / 2, height - 8, label, "mid")
    drawing.text(left - 44, 12, up_label, "")
    caption = fitted(drawing, across, up, xs, ys) if fit else ""
    colour = colours(encoder_of(entry) for *_, entry in points)
    for x, y, entry in points:
        kind = colour[encoder_of(entry)]
        shape = _SHAPES.get(entry.card.objective or "", "diamond")
        drawing.mark(across.at(x), up.at(y), shape, kind, f"{entry.name}: {label} {x:g}, {up_label} {number(y)}", 4.5)
    objectives = dict.fromkeys(entry.card.objective or "not stated" for *_, entry in points)
    legend(drawing, [(name, "dot", kind) for name, kind in colour.items()], WIDTH - 172)
    shapes = [(name, _SHAPES.get(name, "diamond"), "c0") for name in objectives]
    legend(drawing, shapes, WIDTH - 172, 32.0 + 17 * len(colour))
    drawing.height = max(height, 36.0 + 17 * (len(colour) + len(shapes)))
    caption += "Colours are encoders, shapes are objectives; untrained models are means over their seeds."
    return Figure(key, title, caption, drawing)


def encoder_of(entry: Entry) -> str:
    """Return the encoder for colours: with and without layer norm are one."""
    return (entry.card.encoder or "not stated").removesuffix("-ln")


def fitted(drawing: Drawing, across: Scale, up: Scale, xs: Sequence[float], ys: Sequence[float]) -> str:
    """Draw the least-squares line of three points or more with the 95 % band of its mean; return the caption's part."""
    from scipy.special import stdtrit

    slope, start, r, interval = regression(xs, ys)
    if math.isnan(r):
        return "All accuracies or all scores are equal, so there is no line. "
    n, x, y = len(xs), np.array(xs), np.array(ys)
    places = np.linspace(x.min(), x.max(), 41)
    line = start + slope * places
    error = math.sqrt(np.sum((y - start - slope * x) ** 2) / (n - 2))
    spread = np.sqrt(1 / n + (places - x.mean()) ** 2 / np.sum((x - x.mean()) ** 2))
    half = float(stdtrit(n - 2, 0.975)) * error * spread
    over, under = zip(places, line + half, strict=True), zip(places[::-1], (line - half)[::-1], strict=True)
    outline = "L".join(f"{across.at(one):.1f} {up.at(other):.1f}" for one, other in (*over, *under))
    drawing.path(f"M{outline}z", "fitband")
    drawing.line(across.at(places[0]), up.at(line[0]), across.at(places[-1]), up.at(line[-1]), "fit")
    text = f" {span(interval)}" if interval else ""
    return f"Least-squares line with the 95 % band of its mean over {n} models: r = {number(r, 2)}{text}. "


def _trusted(entry: Entry) -> bool:
    return entry.standing not in DOUBTFUL and math.isfinite(entry.scaled)
