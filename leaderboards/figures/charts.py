"""The figures of a leaderboard, drawn from its entries: those of the reference thesis, and the layers of a model.

Every function returns a :class:`Figure`; one that the records cannot fill says what they lack. Figure numbers
are those of the thesis, chapter 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from brainbench.core.records import Interval
from brainbench.core.statistics import is_finite
from leaderboards.boards import Board
from leaderboards.entries import Entry, twins
from leaderboards.figures import svg
from leaderboards.figures.rdms import rdm_lines, rdm_panel
from leaderboards.figures.record import PARTS
from leaderboards.ranking import DOUBTFUL
from leaderboards.text import number, span

_LEAST_VARIANCE = 1e-100  # products of two smaller ones would be zero in floating point
_SHAPES = {"supervised": "square", "simclr": "cross", "simsiam": "up", "ae": "down", "untrained": "dot"}


def accuracy_against_fit(entries: Sequence[Entry], *, supervised: bool = False) -> svg.Figure:
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
        return svg.Figure(key, title, lacking=lacking)
    return scatter(key, title, points, label, fit=True)


def parameters_against_fit(entries: Sequence[Entry]) -> svg.Figure:
    """Draw the number of parameters against the neural fit (figure 3.3 b)."""
    key, title = "parameters", "Parameters against neural fit (as figure 3.3 b)"
    points = [(float(e.card.parameters), e.scaled, e) for e in entries if e.card.parameters and _trusted(e)]
    if len(points) < 2:
        return svg.Figure(key, title, lacking="fewer than 2 records state parameters and have a trusted score")
    return scatter(key, title, points, "parameters", log=True)


def parameters_against_accuracy(entries: Sequence[Entry]) -> svg.Figure:
    """Draw the number of parameters against the task accuracy (figure 3.3 c)."""
    key, title = "parameters-accuracy", "Parameters against task accuracy (as figure 3.3 c)"
    label, read = _accuracy_of(entries)
    stated = [(e.card.parameters, read(e), e) for e in entries]
    points = [(float(count), value, e) for count, value, e in stated if count and value is not None]
    if len(points) < 2:
        return svg.Figure(key, title, lacking="fewer than 2 records state both parameters and a task accuracy")
    return scatter(key, title, points, "parameters", up_label=label, log=True)


def _accuracy_of(entries: Sequence[Entry]) -> tuple[str, Callable[[Entry], float | None]]:
    """Return which accuracy is drawn, with what reads it: top-5 where all entries with an accuracy state it."""
    stated = [entry.card for entry in entries if entry.card.top1 is not None]
    name = "top5" if stated and all(card.top5 is not None for card in stated) else "top1"

    def read(entry: Entry) -> float | None:
        """Return an entry's accuracy, mean over its seeds; None where no card states it."""
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
) -> svg.Figure:  # fmt: skip
    """Return a scatter plot of entries, with a regression line where one is asked for."""
    height, left, right, bottom = 400.0, 56.0, svg.WIDTH - 190, 352.0
    drawing = svg.Drawing(svg.WIDTH, height, f"{title}: {len(points)} models")
    xs, ys = [x for x, *_ in points], [y for _, y, _ in points]
    across = svg.Scale(min(xs) / 1.4, max(xs) * 1.4, left, right, log=True) if log else svg.scale_of(xs, left, right)
    up = svg.scale_of(ys, bottom, 16, floor=None)
    svg.left_axis(drawing, up, left, right)
    for tick in across.ticks:
        drawing.line(across.at(tick), 16, across.at(tick), bottom, "grid")
        drawing.text(across.at(tick), bottom + 18, svg.tick_text(tick), "mid quiet")
    drawing.text((left + right) / 2, height - 8, label, "mid")
    drawing.text(left - 44, 12, up_label, "")
    caption = fitted(drawing, across, up, xs, ys) if fit else ""
    colour = svg.colours(encoder_of(entry) for *_, entry in points)
    for x, y, entry in points:
        kind = colour[encoder_of(entry)]
        shape = _SHAPES.get(entry.card.objective or "", "diamond")
        drawing.mark(across.at(x), up.at(y), shape, kind, f"{entry.name}: {label} {x:g}, {up_label} {number(y)}", 4.5)
    objectives = dict.fromkeys(entry.card.objective or "not stated" for *_, entry in points)
    svg.legend(drawing, [(name, "dot", kind) for name, kind in colour.items()], svg.WIDTH - 172)
    shapes = [(name, _SHAPES.get(name, "diamond"), "c0") for name in objectives]
    svg.legend(drawing, shapes, svg.WIDTH - 172, 32.0 + 17 * len(colour))
    drawing.height = max(height, 36.0 + 17 * (len(colour) + len(shapes)))
    caption += "Colours are encoders, shapes are objectives; untrained models are means over their seeds."
    return svg.Figure(key, title, caption, drawing)


def encoder_of(entry: Entry) -> str:
    """Return the encoder for colours: with and without layer norm are one."""
    return (entry.card.encoder or "not stated").removesuffix("-ln")


def fitted(drawing: svg.Drawing, across: svg.Scale, up: svg.Scale, xs: Sequence[float], ys: Sequence[float]) -> str:
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


_Told = Callable[[Entry], str]


_PANEL_NAME = 23
"""Characters of a name above a panel: bold letters of 10.5 pixels take about 6.7 each, the panel leaves 158."""


def board_figures(board: Board) -> list[svg.Figure]:
    """Return all figures of a board, drawn or with what they lack."""
    entries, title = board.entries, "Augmentation ablation (as figure 3.8 c)"
    return [
        fit_per_model(board),
        layer_fit(entries),
        rdm_panel(board),
        rdm_lines(board),
        accuracy(entries),
        accuracy_against_fit(entries),
        accuracy_against_fit(entries, supervised=True),
        parameters_against_fit(entries),
        parameters_against_accuracy(entries),
        _ablation("augmentation", title, entries, _augmentation, partial(_masking, always=False), "augmentation"),
        _ablation("masking", "Temporal masking", entries, _masking, _augmentation, "share of masked steps"),
    ]


def fit_per_model(board: Board) -> svg.Figure:
    """Draw the neural fit of every model beside its untrained twin, with all baselines (figure 3.7 b)."""
    title = "Neural fit of every model"
    drawn = [entry for entry in board.entries if math.isfinite(entry.scaled)]
    # A twin is drawn on the row of the network trained from it, not once more on its own.
    partnered = {entry.architecture for entry in drawn if entry.trained}
    drawn = [entry for entry in drawn if entry.trained or entry.architecture not in partnered]
    if not drawn:
        return svg.Figure("fit", title, lacking="no record has a defined score that states its chance")
    models, untrained = drawn[: svg.SHOWN], twins(board.entries)
    base = [item for item in board.baselines if math.isfinite(item.score.scaled)]
    colour = svg.colours(map(_objective, models))
    rows = []
    for entry in models:
        kind = colour[_objective(entry)]
        seeds = [svg.ChartPoint(value, f"{kind} faint", size=2) for value in entry.sample.seeds]
        twin = _twin_points(entry, untrained, 3.5) if entry.trained else ()
        hollow = " open" if not entry.above_chance or entry.standing in DOUBTFUL else ""
        words = f"{entry.name}: {number(entry.scaled)} {span(entry.interval)}"
        mark = svg.ChartPoint(entry.scaled, kind + hollow, words)
        points = (*(seeds if entry.seeds > 1 else ()), *twin, mark)
        label_kind = "end" if not entry.unranked_because else "end quiet"
        rows.append(svg.ChartRow(svg.cut_name(entry.name, 36), points, entry.interval, kind, label_kind))
    for baseline in base:
        kind, shape = ("c7", "square") if baseline.kind == "animals" else ("c0", "diamond")
        mark = svg.ChartPoint(
            baseline.score.scaled, kind, f"{baseline.name}: {number(baseline.score.scaled)}", 4, shape
        )
        rows.append(svg.ChartRow(baseline.name, (mark,), baseline.score.scaled_interval, kind, "end quiet"))
    values = [entry.scaled for entry in models] + [item.score.scaled for item in base]
    scale = svg.score_scale(values, [row.interval for row in rows], 250, svg.WIDTH - 20)
    spans = (item.score.scaled_interval for item in base if item.kind == "animals")
    band = next(filter(is_finite, spans), None)
    drawing = svg.row_chart(f"{title}: {len(models)} models, best first", rows, scale, "scaled score", band=band)
    caption = "Score with its interval: 0 is chance, 1 all that is reliable. Hollow: not told apart from chance. "
    caption += "The band is the interval of animal-to-animal. " if band else ""
    caption += "Small dots are seeds. " if any(e.seeds > 1 for e in models) else ""
    caption += "Hollow grey points are untrained twins. " if any(e.trained for e in models) else ""
    return svg.Figure(
        "fit", f"{title} (as figure 3.7 b)", caption + svg.legend_words(colour) + svg.cut_words(len(drawn)), drawing
    )


def layer_fit(entries: Sequence[Entry]) -> svg.Figure:
    """Draw the neural fit of every layer, a small panel per model, coloured by part of the network (figure 3.4)."""
    key, title = "layers", "Neural fit by layer (as figure 3.4)"
    rows = [entry for entry in entries if any(math.isfinite(layer.value) for layer in entry.score.layers)]
    if not rows:
        return svg.Figure(key, title, lacking="no record holds scores of layers")
    many, rows = len(rows), rows[:24]
    columns, w, h = 4, svg.WIDTH / 4, 112.0
    height = math.ceil(len(rows) / columns) * h + 6
    drawing = svg.Drawing(svg.WIDTH, height, f"Score of every layer of {len(rows)} models")
    values = [layer.value for entry in rows for layer in entry.score.layers]
    for index, entry in enumerate(rows):
        x0, y0 = (index % columns) * w, (index // columns) * h
        scale = svg.scale_of(values, y0 + h - 14, y0 + 24, top=1.0)
        drawing.text(x0 + 24, y0 + 14, svg.cut_name(entry.name, _PANEL_NAME), "small title")
        for tick in (0.0, 0.5, 1.0):
            drawing.line(x0 + 24, scale.at(tick), x0 + w - 8, scale.at(tick), "one" if tick == 1 else "grid")
            drawing.text(x0 + 20, scale.at(tick) + 3.5, svg.tick_text(tick), "end quiet small")
        layers = entry.score.layers
        step = (w - 36) / len(layers)
        for i, layer in enumerate(layers):
            if not math.isfinite(layer.value):
                continue
            zero, top = scale.at(0.0), scale.at(layer.value)
            kind = PARTS.get(layer.layer.partition(".")[0], "c0")
            tip = f"{layer.layer}: {number(layer.value)} {span(layer.interval)}"
            drawing.rect(x0 + 26 + i * step, min(zero, top), max(step - 1.5, 1), abs(zero - top), kind, tip=tip)
    caption = (
        "Mean noise-corrected score of each layer, in the network's order: encoder blue, attender orange, decoder "
        "green. A layer without a bar has no defined score. For reading only: picking the best layer here would "
        f"flatter a model.{svg.cut_words(many, 24)}"
    )
    return svg.Figure(key, title, caption, drawing)


def accuracy(entries: Sequence[Entry]) -> svg.Figure:
    """Draw the task accuracy beside that of the untrained twin (figure 3.6)."""
    key, title = "accuracy", "Task accuracy (as figure 3.6)"
    stated = sorted((e for e in entries if e.card.top1 is not None), key=lambda e: -(e.card.top1 or 0))
    if not stated:
        return svg.Figure(
            key, title, lacking="no record states a task accuracy (top1 of its model card); trained ones do"
        )
    # Untrained networks are drawn as twins; a board of such alone still shows them.
    stated = [e for e in stated if e.trained] or stated
    models, untrained = stated[: svg.SHOWN], twins(entries)
    twin_accuracies = [_twin_accuracy(entry, untrained) for entry in models]
    colour = svg.colours(map(_objective, models))
    rows = []
    for entry, twin in zip(models, twin_accuracies, strict=True):
        kind, card = colour[_objective(entry)], entry.card
        top1 = card.top1 or 0.0  # only models that state it are drawn
        points = [svg.ChartPoint(top1, kind, f"{entry.name}: top-1 {number(top1)}")]
        if card.top5 is not None:
            points.insert(0, svg.ChartPoint(card.top5, f"{kind} open", f"top-5 {number(card.top5)}", 3.5, "diamond"))
        if twin is not None:
            points.insert(0, svg.ChartPoint(twin, "c0 open", f"untrained twin {number(twin)}", 3.5))
        rows.append(svg.ChartRow(svg.cut_name(entry.name, 36), points, card.accuracy_interval, kind))
    reach = max(0.05, *(max(e.card.top1 or 0, e.card.top5 or 0, e.card.twin_top1 or 0) for e in models))
    scale = svg.Scale(0.0, min(1.0, reach * 1.05), 250, svg.WIDTH - 20)
    drawing = svg.row_chart(f"{title}: {len(models)} models", rows, scale, "accuracy on held-out objects")
    lack = " No record states the accuracy of an untrained twin." if set(twin_accuracies) == {None} else ""
    caption = (
        f"Top-1 accuracy with its Wilson interval, top-5 (diamond) and the untrained twin's top-1 (hollow grey).{lack} "
        f"{svg.legend_words(colour)}{svg.cut_words(len(stated))}"
    )
    return svg.Figure(key, title, caption, drawing)


def _ablation(key: str, title: str, entries: Sequence[Entry], level: _Told, held: _Told, what: str) -> svg.Figure:
    """Draw the fit of models trained at several levels of one thing, on the same data, the other (``held``) fixed."""
    groups: dict[tuple[str, ...], dict[str, Entry]] = {}
    for entry in entries:
        if entry.trained and level(entry) and math.isfinite(entry.scaled):
            model = (entry.architecture, entry.card.objective or "", held(entry), entry.card.accuracy_data or "")
            groups.setdefault(model, {}).setdefault(level(entry), entry)
    groups = {name: levels for name, levels in groups.items() if len(levels) > 1}
    if not groups:
        return svg.Figure(key, title, lacking=f"no model was trained with more than one {what}")
    untrained = twins(entries)
    colour = svg.colours(label for levels in groups.values() for label in sorted(levels))
    rows, values = [], []
    for model, levels in groups.items():
        group = svg.cut(", ".join(part for part in model[:-1] if part), 50)
        for label, entry in sorted(levels.items()):
            top1 = f", top-1 {number(entry.card.top1)}" if entry.card.top1 is not None else ""
            mark = svg.ChartPoint(entry.scaled, colour[label], f"{entry.name}, {label}: {number(entry.scaled)}{top1}")
            points = (*_twin_points(entry, untrained, 3.2), mark)
            rows.append(svg.ChartRow(svg.cut(label, 22), points, entry.interval, colour[label], group=group))
            values.append(entry.scaled)
            group = ""
    scale = svg.score_scale(values, [row.interval for row in rows], 400, svg.WIDTH - 20)
    drawing = svg.row_chart(f"{title}: {len(groups)} models", rows, scale, "scaled score", step=20)
    caption = f"Scaled score with its interval by {what}; hollow grey points are untrained twins."
    return svg.Figure(key, title, caption, drawing)


def _objective(entry: Entry) -> str:
    return entry.card.objective or "not stated"


def _augmentation(entry: Entry) -> str:
    return (entry.card.augmentation or "").partition(" + ")[0]


def _masking(entry: Entry, *, always: bool = True) -> str:
    return f"{entry.masking:.0%} masked" if entry.trained and (always or entry.masking) else ""


def _twin_points(entry: Entry, untrained: Mapping[str, Entry], size: float) -> tuple[svg.ChartPoint, ...]:
    """Return the mark of a model's untrained twin, if its score is on the board."""
    twin = untrained.get(entry.architecture)
    if twin is None:
        return ()
    return (svg.ChartPoint(twin.scaled, "c0 open", f"untrained twin {number(twin.scaled)}", size),)


def _twin_accuracy(entry: Entry, untrained: Mapping[str, Entry]) -> float | None:
    """Return what the record says of its twin, or else what the twin's own record says."""
    if entry.card.twin_top1 is not None:
        return entry.card.twin_top1
    twin = untrained.get(entry.architecture)
    return None if twin is None else twin.card.top1
