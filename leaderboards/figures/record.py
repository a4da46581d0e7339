"""The drawings of one model: its graph, its score beside baselines and animals, its layers, and its score over time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from brainbench.core.errors import visible_name
from brainbench.core.records import GraphNode, Interval, ModelGraph, ResultRecord, Score
from leaderboards.figures import svg
from leaderboards.text import number, span

_BOX, _HEIGHT, _GAP, _LANE = 236.0, 34.0, 15.0, 13.0
_CLASSES = {"input": "c0", "encoder": "c1", "attender": "c2", "decoder": "c3"}


@dataclass(frozen=True)
class _Box:
    node: GraphNode
    names: tuple[str, ...]  # the layers drawn as this box


def diagram(graph: ModelGraph, title: str) -> svg.Drawing:
    """Draw a model's graph."""
    boxes = _folded(graph)
    place = {name: index for index, box in enumerate(boxes) for name in box.names}
    inside = [edge for edge in graph.edges if edge.source in place and edge.target in place]
    edges = {(place[edge.source], place[edge.target], edge.feedback) for edge in inside}
    skips = sorted((e for e in edges if not e[2] and e[1] - e[0] > 1), key=lambda e: (e[1] - e[0], e[0]))
    loops = sorted((e for e in edges if e[2] or e[1] < e[0]), key=lambda e: (abs(e[0] - e[1]), e[1]))
    right, left = _lanes(skips), _lanes(loops)
    margin = 14 + _LANE * (max(left, default=-1) + 1)
    width = margin + _BOX + 14 + _LANE * (max(right, default=-1) + 1)
    height = len(boxes) * (_HEIGHT + _GAP) - _GAP + 12
    feedback = sum(edge.feedback for edge in graph.edges)
    words = f"Architecture of {title}: {len(graph.nodes)} parts, {feedback} feedback connections"
    drawing = svg.Drawing(width, height, words)
    for index, box in enumerate(boxes):
        _draw_box(drawing, box, margin, _top(index))
    for source, target, feedback in sorted(edges):
        if not feedback and target == source + 1:
            x, y = margin + _BOX / 2, _top(source) + _HEIGHT
            drawing.path(f"M{x} {y}V{y + _GAP}", "edge")
            _head(drawing, x, y + _GAP, 0, 1)
    for lane, (source, target, _) in zip(right, skips, strict=True):
        _arc(drawing, margin + _BOX, 1, lane, _top(source), _top(target), "edge")
    for lane, (source, target, _) in zip(left, loops, strict=True):
        _arc(drawing, margin, -1, lane, _top(source), _top(target), "edge feedback")
    return drawing


def layer_order(score: Score) -> ModelGraph | None:
    """Return the layers of a score as a graph without connections, for a record that holds no graph."""
    if not score.layers:
        return None
    nodes = tuple(GraphNode(layer.layer, layer.layer.partition(".")[0], "") for layer in score.layers)
    return ModelGraph(nodes, ())


def _folded(graph: ModelGraph) -> list[_Box]:
    """Join runs of alike parts that are connected only to the next one."""
    ins = {node.name: [e for e in graph.edges if e.target == node.name] for node in graph.nodes}
    outs = {node.name: [e for e in graph.edges if e.source == node.name] for node in graph.nodes}
    runs: list[list[GraphNode]] = []
    for node in graph.nodes:
        last = runs[-1][-1] if runs else node
        alike = (last.part, last.kind, last.memory) == (node.part, node.kind, node.memory)
        if alike and len(ins[node.name]) == 1 and ins[node.name] == outs[last.name]:
            runs[-1].append(node)
        else:
            runs.append([node])
    folded = [run for nodes in runs for run in ([nodes] if len(nodes) > 2 else [[node] for node in nodes])]
    return [_Box(run[0], tuple(node.name for node in run)) for run in folded]


def _lanes(edges: Sequence[tuple[int, int, bool]]) -> list[int]:
    """Give each edge the innermost lane in which it crosses no other."""
    spans: list[list[tuple[int, int]]] = []
    lanes = []
    for source, target, _ in edges:
        low, high = min(source, target), max(source, target)
        lane = next((i for i, used in enumerate(spans) if all(high <= a or low >= b for a, b in used)), len(spans))
        if lane == len(spans):
            spans.append([])
        spans[lane].append((low, high))
        lanes.append(lane)
    return lanes


def _top(index: int) -> float:
    return 6 + index * (_HEIGHT + _GAP)


def _draw_box(drawing: svg.Drawing, box: _Box, x: float, y: float) -> None:
    node = box.node
    kind = _CLASSES.get(node.part, "c0")
    drawing.rect(x, y, _BOX, _HEIGHT, "box", rx=5)
    drawing.rect(x, y, 4, _HEIGHT, kind, rx=2)
    short = node.name.partition(".")[2] or node.name
    if len(box.names) > 1:
        short = f"{len(box.names)} × {short.rstrip('0123456789')}"
    drawing.text(x + 13, y + 14, svg.shorten(short, 22), "title")
    drawing.text(
        x + 13, y + 27, svg.shorten(f"{node.kind}{' · ' + node.memory if node.memory else ''}", 40), "quiet small"
    )
    if node.shape:
        drawing.text(x + _BOX - 8, y + 14, "×".join(map(str, node.shape)), "end quiet small")


def _arc(drawing: svg.Drawing, x: float, side: int, lane: int, source: float, target: float, kind: str) -> None:
    out = x + side * (10 + _LANE * lane)
    down = target > source
    y1, y2 = source + _HEIGHT * 0.68, target + _HEIGHT * (0.32 if down else 0.5)
    turn, bend = (5 if y2 > y1 else -5), out - side * 5
    drawing.path(
        f"M{x} {y1:.1f}H{bend:.1f}Q{out} {y1:.1f} {out} {y1 + turn:.1f}V{y2 - turn:.1f}"
        f"Q{out} {y2:.1f} {bend:.1f} {y2:.1f}H{x + side * 3}",
        kind,
    )
    _head(drawing, x, y2, -side, 0, kind="c2" if "feedback" in kind else "c0")


def _head(drawing: svg.Drawing, x: float, y: float, dx: int, dy: int, kind: str = "c0") -> None:
    """Draw an arrow head whose tip is at (x, y), pointing along (dx, dy)."""
    bx, by = x - 6 * dx, y - 6 * dy
    drawing.path(f"M{x} {y:.1f}L{bx + 3.2 * dy} {by + 3.2 * dx:.1f}L{bx - 3.2 * dy} {by - 3.2 * dx:.1f}z", kind)


ALPHA = 0.05  # times with a corrected p up to this are filled
_COURSE_WIDTH, _LEFT, _RIGHT = 640.0, 150.0, 20.0
_CURVE, _ROW = 190.0, 18.0
_MOST_LAYERS = 60


def draw_time_course(statistics: Mapping[str, Any]) -> svg.Drawing | None:
    """Draw the score at each time, and below it the latency of each layer; None without a usable score over time."""
    try:
        course = statistics["time_course"]
        points, layers = list(course["points"]), list(course["latencies"])[:_MOST_LAYERS]
        times = [_number(point["time"]) for point in points]
        half = _number(course["bin"]) / 2
        across = svg.Scale(min(times) - half, max(times) + half, _LEFT, _COURSE_WIDTH - _RIGHT)
        rows = [layer for layer in layers if math.isfinite(_number(layer["latency"]))]
        height = _CURVE + 40 + (len(rows) * _ROW + 46 if rows else 0)
        drawing = svg.Drawing(
            _COURSE_WIDTH, height, f"Score at {len(points)} times, and the latency of {len(rows)} layers"
        )
        _curve(drawing, points, across)
        if rows:
            _latencies(drawing, rows, _number(course["largest_lag"]))
    except (KeyError, TypeError, ValueError, AttributeError):
        # Statistics are free text in a record that somebody else may have written.
        return None
    return drawing


def _curve(drawing: svg.Drawing, points: Sequence[Mapping[str, Any]], across: svg.Scale) -> None:
    defined = []
    for point in points:
        chance = _number(point["chance"])
        value, *ends = ((one - chance) / (1 - chance) for one in (_number(point["value"]), *_ends(point["interval"])))
        if math.isfinite(value):
            defined.append((across.at(_number(point["time"])), value, ends, point))
    held = [min(max(end, -0.5), 1.5) for _, _, ends, _ in defined for end in ends]
    up = svg.scale_of([*(value for _, value, *_ in defined), *held], _CURVE, 22, top=1.0)
    drawing.text(_LEFT, 14, "score at each time: 0 chance, 1 all that is reliable", "title small")
    for tick in up.ticks:
        drawing.line(_LEFT, up.at(tick), _COURSE_WIDTH - _RIGHT, up.at(tick), "one" if tick in (0, 1) else "grid")
        drawing.text(_LEFT - 6, up.at(tick) + 4, svg.tick_text(tick), "end quiet small")
    _ticks(drawing, across, _CURVE, "seconds after the window begins")
    if len(defined) > 1:
        drawing.path("M" + "L".join(f"{x:.1f} {up.at(value):.1f}" for x, value, *_ in defined), "line edge")
    for x, value, ends, point in defined:
        if ends:
            drawing.line(x, up.at(ends[0]), x, up.at(ends[1]), "span c1")
        clear = _number(point["p"]) <= ALPHA
        tip = f"{_number(point['time']):.3g} s: {value:.2f}, p = {_number(point['p']):.2g}"
        drawing.mark(x, up.at(value), "dot", "c1" if clear else "c1 open", tip, 3.5)


def _latencies(drawing: svg.Drawing, rows: Sequence[Mapping[str, Any]], largest: float) -> None:
    across = svg.Scale(-largest, largest, _LEFT, _COURSE_WIDTH - _RIGHT)
    top = _CURVE + 62
    bottom = top + len(rows) * _ROW - 6
    drawing.text(_LEFT, top - 14, "latency of the best match of each layer", "title small")
    drawing.line(across.at(0), top - 6, across.at(0), bottom, "one")
    for index, layer in enumerate(rows):
        y, latency, span = top + index * _ROW + 5, _number(layer["latency"]), _ends(layer["interval"])
        drawing.text(_LEFT - 8, y + 4, svg.cut(str(layer["layer"]), 22), "end small")
        if span:
            drawing.line(across.at(span[0]), y, across.at(span[1]), y, "span c1")
        drawing.mark(across.at(latency), y, "dot", "c1", f"{layer['layer']}: {1000 * latency:.0f} ms", 3.5)
    _ticks(drawing, across, bottom, "seconds by which neurons follow the model")


def _ticks(drawing: svg.Drawing, across: svg.Scale, y: float, words: str) -> None:
    drawing.line(across.start, y, across.end, y)
    for tick in across.ticks:
        drawing.text(across.at(tick), y + 15, svg.tick_text(tick), "mid quiet small")
    drawing.text(across.end, y + 28, words, "end quiet small")


def _number(value: Any) -> float:
    """Return a number of a record, in which NaN is null."""
    return math.nan if value is None else float(value)


def _ends(interval: Mapping[str, Any] | None) -> tuple[float, ...]:
    ends = () if interval is None else (_number(interval["low"]), _number(interval["high"]))
    return ends if all(map(math.isfinite, ends)) else ()


_MOST_STIMULI = 24  # stimuli that are drawn: those that add most to a score, and those that take most from it


def stimulus_parts(score: Score) -> svg.Drawing | None:
    """Draw by how much a score falls without each stimulus, most first; None where that is not stated."""
    pairs = zip(score.stimuli, score.without_stimulus, strict=False)
    falls = [(score.on_scale(score.value) - score.on_scale(without), name) for name, without in pairs]
    falls = sorted(((fall, name) for fall, name in falls if math.isfinite(fall)), reverse=True)
    if len(falls) < 2:
        return None
    left_out = len(falls) - _MOST_STIMULI
    if left_out > 0:
        falls = [*falls[: _MOST_STIMULI // 2], *falls[-_MOST_STIMULI // 2 :]]
    rows = [
        svg.ChartRow(
            svg.cut_name(name, 20),
            [svg.ChartPoint(fall, "c1" if fall > 0 else "c2", f"{name}: {fall:+.4f}", 3.5)],
            Interval(min(fall, 0.0), max(fall, 0.0)),
            "c1" if fall > 0 else "c2",
        )
        for fall, name in falls
    ]
    words = f"the score falls by, without each stimulus{f' ({left_out} in between not drawn)' if left_out > 0 else ''}"
    scale = svg.scale_of([fall for fall, _ in falls], _START, _WIDTH - 20)
    return svg.row_chart(f"{words}, {len(rows)} stimuli", rows, scale, words, step=15, width=_WIDTH)


def unit_parts(statistics: Mapping[str, Any]) -> svg.Drawing | None:
    """Draw how alike units and their matched features are, by animal and by group; None where no units are matched."""
    try:
        units, rows, values = statistics["units"], [], []
        for animal, parts in list(units["animals"].items())[:_MOST_LAYERS]:
            part = [_number(value) for value in parts]
            finite = [value for value in part if math.isfinite(value)]
            points = [svg.ChartPoint(value, "c1 faint", size=2) for value in finite]
            mean = math.fsum(finite) / len(finite) if finite else math.nan
            points.append(svg.ChartPoint(mean, "c1", f"{animal}: {number(mean)}, {len(part)} units"))
            rows.append(svg.ChartRow(svg.cut_name(animal, 20), points))
            values += finite
        for column, groups in units.get("groups", {}).items():
            for name, group in list(groups.items())[:_MOST_LAYERS]:
                low, high = map(_number, group["interval"] or (math.nan, math.nan))
                interval = Interval(low, high) if math.isfinite(low + high) else None
                tip = f"{name}: {number(_number(group['value']))}, {group['units']} units, {group['animals']} animals"
                point = svg.ChartPoint(_number(group["value"]), "c3", tip, shape="diamond")
                label = f"{str(column).replace('_', ' ')} {name}"
                rows.append(svg.ChartRow(svg.cut_name(label, 20), [point], interval, "c3"))
        words = "correlation of each unit with its match"
        return svg.row_chart(
            f"{words}, {len(rows)} rows", rows, svg.scale_of(values, _START, _WIDTH - 20), words, width=_WIDTH
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        # As above: anyone may have written it.
        return None


PARTS = {"encoder": "c1", "attender": "c2", "decoder": "c3"}  # colour class of each part of a network
_WIDTH, _START = 490.0, 150.0


def beside(record: ResultRecord) -> svg.Drawing:
    """Draw the score with those of animals and baselines, single animals as small points.

    On the common scale where the record states its chance, else in the metric's own unit.
    """
    scaled = math.isfinite(record.score.scaled)

    def rows(score: Score) -> tuple[Callable[[float], float], Interval | None]:
        """Return what places a value of a score on the axis, and its interval there."""
        return (score.on_scale, score.scaled_interval) if scaled else (float, score.interval)

    animals = record.animal_to_animal
    label = "score: 0 chance, 1 all that is reliable" if scaled else record.score.metric
    return _chart(record, label, "value", rows, rows(animals)[1] if animals and animals.status == "ok" else None)


def raw(record: ResultRecord) -> svg.Drawing:
    """Draw the raw comparisons, not corrected for noise, with the noise ceiling as a band."""
    ceiling = record.score.ceiling
    band = None if ceiling is None else Interval(ceiling.lower, ceiling.upper)
    return _chart(record, "raw r; the band is the noise ceiling", "r", lambda _: (float, None), band)


_Reading = Callable[[Score], tuple[Callable[[float], float], Interval | None]]


def _chart(record: ResultRecord, label: str, name: str, reading: _Reading, band: Interval | None) -> svg.Drawing:
    """Draw one row per score; ``name`` is the field of scores and animals that is drawn."""
    marks = [(visible_name(record.score.name), "c1", "dot", record.score)]
    marks += [("animal-to-animal", "c7", "square", record.animal_to_animal)] if record.animal_to_animal else []
    marks += [(key, "c0", "diamond", score) for key, score in record.baselines.items()]
    rows, values = [], []
    for key, kind, shape, score in marks:
        place, interval = reading(score)
        value = place(getattr(score, name))
        singles = [place(getattr(item, name)) for item in score.subjects]
        hollow = "" if score.status == "ok" else " open"
        points = [svg.ChartPoint(one, f"{kind} faint", size=2) for one in singles]
        points.append(svg.ChartPoint(value, kind + hollow, f"{key}: {number(value)} {span(interval)}", 4, shape))
        rows.append(svg.ChartRow(svg.cut_name(key, 20), points, interval, kind))
        values += [value, *singles]
    scale = svg.score_scale(values, [row.interval for row in rows], _START, _WIDTH - 20)
    return svg.row_chart(f"{label}, {len(rows)} rows", rows, scale, label, width=_WIDTH, band=band)


def layers(records: Sequence[ResultRecord]) -> svg.Drawing | None:
    """Draw the layers of one model against their scores, all seeds; None without layers."""
    score = records[0].score
    seeds = [record.score.layers for record in records]
    if not score.layers:
        return None
    rows = []
    for index, layer in enumerate(score.layers):
        kind = PARTS.get(layer.layer.partition(".")[0], "c1")
        chosen = layer.layer == score.layer
        values = [one[index].value for one in seeds if len(one) == len(score.layers)]
        finite = [value for value in values if math.isfinite(value)]
        points = [svg.ChartPoint(value, f"{kind} faint", size=2.2) for value in finite if len(records) > 1]
        interval = layer.interval if len(records) == 1 else None
        if finite:
            mean = math.fsum(finite) / len(finite)
            tip = f"{layer.layer}: {number(mean)} {span(interval)}"
            points.append(svg.ChartPoint(mean, kind if chosen else f"{kind} open", tip, 4))
        rows.append(svg.ChartRow(svg.cut(layer.layer, 22), points, interval, kind, "end title" if chosen else "end"))
    scale = svg.score_scale([layer.value for one in seeds for layer in one], [row.interval for row in rows], 132, 470)
    words = f"Score of {len(score.layers)} layers of {visible_name(score.name)}"
    return svg.row_chart(words, rows, scale, "score in the metric's own unit", step=20, width=_WIDTH)
