"""The figures of a leaderboard, drawn from its entries: those of the reference thesis, and the layers of a model.

Every function returns a :class:`Figure`; one that the records cannot fill says what they lack. Figure numbers
are those of the thesis, chapter 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from brainbench.core.records import Interval
from brainbench.core.statistics import is_finite
from leaderboards.entries import Entry, twins
from leaderboards.figures.plots import (
    SHOWN,
    WIDTH,
    Figure,
    ablation,
    colours,
    cut,
    cut_name,
    cut_words,
    draw_axis,
    draw_band,
    draw_interval,
    draw_matrix,
    legend_words,
    scatter,
    score_scale,
)
from leaderboards.figures.svg import Drawing, Scale, scale_of, tick_text
from leaderboards.ranking import Board
from leaderboards.text import number, span

_PARTS = {"encoder": "c1", "attender": "c2", "decoder": "c3"}


def board_figures(board: Board, entries: Sequence[Entry]) -> list[Figure]:
    """Return all figures of a board, drawn or with what they lack."""
    drawers: tuple[Callable[[Board, Sequence[Entry]], Figure], ...] = (
        fit_per_model, layer_fit, rdm_panel, accuracy, accuracy_against_fit, parameters_against_fit, augmentation,
        masking,
    )  # fmt: skip
    return [draw(board, entries) for draw in drawers]


def fit_per_model(board: Board, entries: Sequence[Entry]) -> Figure:
    """Neural fit of every model beside its untrained twin, with animal-to-animal and baselines (figure 3.7 b)."""
    key, title = "fit", "Neural fit of every model"
    twin = twins(entries)
    shown = [entry for entry in entries if math.isfinite(entry.value)]
    # A twin is drawn on the row of the network trained from it, not once more on its own.
    partnered = {entry.architecture for entry in shown if entry.trained}
    rows = [entry for entry in shown if entry.trained or entry.architecture not in partnered]
    if not rows:
        return Figure(key, title, "", None, "no record has a defined score")
    many, rows = len(rows), rows[:SHOWN]
    base = [item for item in board.baselines if math.isfinite(item.score.value)]
    values = [entry.value for entry in rows] + [item.score.value for item in base]
    intervals = [entry.interval for entry in rows] + [item.score.interval for item in base]
    scale = score_scale(values, intervals, 250, WIDTH - 20)
    drawing = Drawing(WIDTH, 44 + 19 * (len(rows) + len(base)), f"{title}: {len(rows)} models, best first")
    draw_axis(drawing, scale, 30, drawing.height - 8, "noise-corrected RSA")
    animals = next((b.score for b in base if b.kind == "animals" and is_finite(b.score.interval)), None)
    draw_band(drawing, scale, animals.interval if animals else None, 30, drawing.height - 8)
    colour = colours(entry.card.objective or "not stated" for entry in rows)
    y = 44.0
    for entry in rows:
        kind = colour[entry.card.objective or "not stated"]
        drawing.text(242, y + 4, cut_name(entry.name, 36), "end" if entry.first is not None else "end quiet")
        draw_interval(drawing, scale, entry.interval, y, kind)
        for row in entry.rows if entry.seeds > 1 else ():
            drawing.mark(scale.at(row.record.score.value), y, "dot", f"{kind} faint", size=2)
        other = twin.get(entry.architecture) if entry.trained else None
        if other is not None and math.isfinite(other.value):
            drawing.mark(scale.at(other.value), y, "dot", "c0 open", f"untrained twin {number(other.value)}", 3.5)
        hollow = " open" if entry.status != "ok" else ""
        drawing.mark(
            scale.at(entry.value),
            y,
            "dot",
            kind + hollow,
            f"{entry.name}: {number(entry.value)} {span(entry.interval)}",
        )
        y += 19
    for item in base:
        drawing.text(242, y + 4, item.name, "end quiet")
        draw_interval(drawing, scale, item.score.interval, y, "c7" if item.kind == "animals" else "c0")
        shape = "square" if item.kind == "animals" else "diamond"
        drawing.mark(
            scale.at(item.score.value),
            y,
            shape,
            "c7" if item.kind == "animals" else "c0",
            f"{item.name}: {number(item.score.value)}",
            4,
        )
        y += 19
    ceiling = next((e.score.ceiling for e in rows if e.score.ceiling), None)
    caption = (
        "Noise-corrected score with its interval; 1 is all that recordings this noisy can show. "
        + ("The band is the interval of animal-to-animal. " if animals else "")
        + ("Small dots are seeds. " if any(e.seeds > 1 for e in rows) else "")
        + ("Hollow grey points are untrained twins. " if any(e.trained for e in rows) else "")
        + (
            f"Noise ceiling of the raw comparison: {number(ceiling.lower)} to {number(ceiling.upper)}. "
            if ceiling
            else ""
        )
        + legend_words(colour)
        + cut_words(many)
    )
    return Figure(key, f"{title} (as figure 3.7 b)", caption, drawing)


def layer_fit(board: Board, entries: Sequence[Entry]) -> Figure:
    """Neural fit of every layer, a small panel per model, coloured by part of the network (figure 3.4)."""
    del board
    key, title = "layers", "Neural fit by layer (as figure 3.4)"
    rows = [entry for entry in entries if any(math.isfinite(layer.value) for layer in entry.score.layers)]
    if not rows:
        return Figure(key, title, "", None, "no record holds scores of layers")
    many, rows = len(rows), rows[:24]
    columns, w, h = 4, WIDTH / 4, 112.0
    drawing = Drawing(WIDTH, math.ceil(len(rows) / columns) * h + 6, f"Score of every layer of {len(rows)} models")
    values = [layer.value for entry in rows for layer in entry.score.layers]
    for index, entry in enumerate(rows):
        x0, y0 = (index % columns) * w, (index // columns) * h
        scale = scale_of(values, y0 + h - 14, y0 + 24, top=1.0)
        drawing.text(x0 + 24, y0 + 14, cut_name(entry.name, 27), "small title")
        for tick in (0.0, 0.5, 1.0):
            drawing.line(x0 + 24, scale.at(tick), x0 + w - 8, scale.at(tick), "one" if tick == 1 else "grid")
            drawing.text(x0 + 20, scale.at(tick) + 3.5, tick_text(tick), "end quiet small")
        layers = entry.score.layers
        step = (w - 36) / len(layers)
        for i, layer in enumerate(layers):
            if not math.isfinite(layer.value):
                continue
            zero, top = scale.at(0.0), scale.at(layer.value)
            kind = _PARTS.get(layer.layer.partition(".")[0], "c0")
            tip = f"{layer.layer}: {number(layer.value)} {span(layer.interval)}"
            drawing.rect(x0 + 26 + i * step, min(zero, top), max(step - 1.5, 1), abs(zero - top), kind, tip=tip)
    caption = (
        "Mean noise-corrected score of each layer, in the network's order: encoder blue, attender orange, decoder "
        "green. A layer without a bar has no defined score. For reading only: picking the best layer here would "
        "flatter a model." + cut_words(many, 24)
    )
    return Figure(key, title, caption, drawing)


def rdm_panel(board: Board, entries: Sequence[Entry]) -> Figure:
    """RDMs of the raw input, of the best models of each kind and of the brain (figure 3.5)."""
    key, title = "rdms", "Representational dissimilarity (as figure 3.5)"
    picked: list[tuple[str, str, Sequence[float]]] = []
    raw = next((b.score for b in board.baselines if b.name == "raw input"), None)
    if raw is not None and raw.model_rdm:
        picked.append(("raw input", f"score {number(raw.value)}", raw.model_rdm))
    for label, test in (
        ("supervised", lambda e: e.card.objective == "supervised"),
        ("self-supervised", lambda e: e.trained and e.card.objective != "supervised"),
        ("untrained", lambda e: not e.trained),
    ):
        best = next((e for e in entries if e.score.model_rdm and e.status == "ok" and test(e)), None)
        if best is not None:
            picked.append((f"best {label}", f"{best.name}, {best.score.layer}", best.score.model_rdm))
    brain = next((e.score.brain_rdm for e in entries if e.score.brain_rdm), ())
    if brain:
        picked.append(("brain", board.recordings, brain))
    size = len(board.conditions)
    picked = [item for item in picked if len(item[2]) == size * (size - 1) // 2]
    if not picked or size < 2:
        return Figure(key, title, "", None, "no record holds RDMs")
    side = min(WIDTH / len(picked) - 16, 170.0)
    drawing = Drawing(WIDTH, side + 48, f"{len(picked)} dissimilarity matrices of {size} stimuli")
    for index, (name, detail, pairs) in enumerate(picked):
        x0 = index * (WIDTH / len(picked))
        drawing.text(x0, 13, name, "title")
        drawing.text(x0, 28, cut(detail, max(12, int(side / 6.3))), "quiet small")
        draw_matrix(drawing, x0, 38, side, pairs, board.conditions)
    caption = (
        "Each cell is the dissimilarity of two stimuli in the order of the records "
        f"({', '.join(board.conditions[:8])}{', …' if size > 8 else ''}); dark is alike, bright is different, each "
        "matrix over its own range, as comparisons by correlation ignore scale."
    )
    return Figure(key, title, caption, drawing)


def accuracy(board: Board, entries: Sequence[Entry]) -> Figure:
    """Task accuracy beside that of the untrained twin (figure 3.6)."""
    del board
    key, title = "accuracy", "Task accuracy (as figure 3.6)"
    rows = sorted((e for e in entries if e.card.top1 is not None), key=lambda e: -(e.card.top1 or 0))
    if not rows:
        return Figure(
            key, title, "", None, "no record states a task accuracy (top1 on its model card); trained models do"
        )
    untrained = twins(entries)
    many, rows = len(rows), [e for e in rows if e.trained][:SHOWN] or rows[:SHOWN]
    reach = max(0.05, *(max(e.card.top1 or 0, e.card.top5 or 0, e.card.twin_top1 or 0) for e in rows))
    scale = Scale(0.0, min(1.0, reach * 1.05), 250, WIDTH - 20)
    drawing = Drawing(WIDTH, 44 + 19 * len(rows), f"{title}: {len(rows)} models")
    draw_axis(drawing, scale, 30, drawing.height - 8, "accuracy on held-out objects")
    colour = colours(entry.card.objective or "not stated" for entry in rows)
    y = 44.0
    for entry in rows:
        kind = colour[entry.card.objective or "not stated"]
        card = entry.card
        drawing.text(242, y + 4, cut_name(entry.name, 36), "end")
        twin = _twin_accuracy(entry, untrained)
        if twin is not None:
            drawing.rect(250, y - 6, scale.at(twin) - 250, 4, f"{kind} faint", tip=f"untrained twin {number(twin)}")
        drawing.rect(
            250, y - 2, scale.at(card.top1 or 0) - 250, 8, kind, tip=f"{entry.name}: top-1 {number(card.top1)}"
        )
        draw_interval(drawing, scale, card.accuracy_interval, y + 2, "line")
        if card.top5 is not None:
            drawing.mark(scale.at(card.top5), y + 2, "diamond", f"{kind} open", f"top-5 {number(card.top5)}", 3.2)
        y += 19
    lack = (
        ""
        if any(_twin_accuracy(entry, untrained) is not None for entry in rows)
        else " No record states the accuracy of an untrained twin."
    )
    caption = (
        f"Top-1 accuracy (bar, Wilson interval) and top-5 (diamond). The thin bar is the untrained twin's.{lack} "
        f"{legend_words(colour)}{cut_words(many)}"
    )
    return Figure(key, title, caption, drawing)


def _twin_accuracy(entry: Entry, untrained: Mapping[str, Entry]) -> float | None:
    """What the record says of its twin, or else what the twin's own record says."""
    if entry.card.twin_top1 is not None:
        return entry.card.twin_top1
    other = untrained.get(entry.architecture)
    return None if other is None else other.card.top1


def accuracy_against_fit(board: Board, entries: Sequence[Entry]) -> Figure:
    """Task accuracy against neural fit, with regression and its interval (figure 3.8 a, b)."""
    del board
    key, title = "accuracy-fit", "Task accuracy against neural fit (as figure 3.8)"
    points = [(e.card.top1, e.value, e) for e in entries if e.card.top1 is not None and e.status == "ok"]
    if len(points) < 3:
        return Figure(
            key,
            title,
            "",
            None,
            f"{len(points)} records state both a task accuracy and a trusted score; at least 3 are needed",
        )
    return scatter(key, title, points, "top-1 accuracy", fit=True)


def parameters_against_fit(board: Board, entries: Sequence[Entry]) -> Figure:
    """Number of parameters against neural fit (figure 3.3)."""
    del board
    key, title = "parameters", "Parameters against neural fit (as figure 3.3)"
    points = [(float(e.card.parameters), e.value, e) for e in entries if e.card.parameters and e.status == "ok"]
    if len(points) < 2:
        return Figure(key, title, "", None, "fewer than 2 records state parameters and have a trusted score")
    return scatter(key, title, points, "parameters", log=True)


def augmentation(board: Board, entries: Sequence[Entry]) -> Figure:
    """Neural fit under each augmentation, for models trained with several (figure 3.8 c)."""
    del board
    key, title = "augmentation", "Augmentation ablation (as figure 3.8 c)"
    return ablation(key, title, entries, _augmentation, lambda e: _masking(e) if e.masking else "", "augmentation")


def masking(board: Board, entries: Sequence[Entry]) -> Figure:
    """Neural fit by the share of masked time steps, for models trained with several."""
    del board
    key, title = "masking", "Temporal masking"
    return ablation(key, title, entries, _masking, _augmentation, "share of masked steps")


def _augmentation(entry: Entry) -> str:
    return (entry.card.augmentation or "").partition(" + ")[0]


def _masking(entry: Entry) -> str:
    return f"{entry.masking:.0%} masked" if entry.trained else ""


def layers_of(entry: Entry) -> Drawing | None:
    """Draw the layers of one model against their scores, all seeds; None without layers."""
    layers = entry.score.layers
    if not layers:
        return None
    values = [layer.value for row in entry.rows for layer in row.record.score.layers]
    intervals = [layer.interval for layer in layers] if entry.seeds == 1 else []
    ends = [end for i in intervals if i and is_finite(i) for end in (i.low, i.high)]
    scale = score_scale(values, [Interval(min(ends), max(ends))] if ends else [], 132, 470)
    drawing = Drawing(490, 44 + 20 * len(layers), f"Score of {len(layers)} layers of {entry.name}")
    draw_axis(drawing, scale, 30, drawing.height - 8, "noise-corrected score")
    for index, layer in enumerate(layers):
        y = 44.0 + 20 * index
        kind = _PARTS.get(layer.layer.partition(".")[0], "c1")
        chosen = layer.layer == entry.score.layer
        drawing.text(124, y + 4, cut(layer.layer, 22), "end title" if chosen else "end")
        found = [
            row.record.score.layers[index].value for row in entry.rows if len(row.record.score.layers) == len(layers)
        ]
        finite = [value for value in found if math.isfinite(value)]
        if entry.seeds == 1:
            draw_interval(drawing, scale, layer.interval, y, kind)
        for value in finite if entry.seeds > 1 else ():
            drawing.mark(scale.at(value), y, "dot", f"{kind} faint", size=2.2)
        if finite:
            mean = math.fsum(finite) / len(finite)
            tip = f"{layer.layer}: {number(mean)} {span(layer.interval) if entry.seeds == 1 else ''}"
            drawing.mark(scale.at(mean), y, "dot", kind if chosen else f"{kind} open", tip, 4)
    return drawing
