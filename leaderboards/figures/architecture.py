"""The architecture diagram of a model, drawn from the graph on its card.

Parts stand below one another from input to output. Connections between neighbours are arrows, those that
skip parts run on the right, feedback runs dashed on the left. Repeated blocks that only follow one another
are drawn once with their number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from brainbench.core.records import GraphNode, ModelGraph, Score
from leaderboards.figures.svg import Drawing, shorten

_BOX, _HEIGHT, _GAP, _LANE = 236.0, 34.0, 15.0, 13.0
_CLASSES = {"input": "c0", "encoder": "c1", "attender": "c2", "decoder": "c3"}


@dataclass(frozen=True)
class _Box:
    node: GraphNode
    names: tuple[str, ...]
    """The layers drawn as this box."""


def diagram(graph: ModelGraph, title: str) -> Drawing:
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
    drawing = Drawing(width, height, words)
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
    taken: list[list[tuple[int, int]]] = []
    lanes = []
    for source, target, _ in edges:
        low, high = min(source, target), max(source, target)
        lane = next((i for i, used in enumerate(taken) if all(high <= a or low >= b for a, b in used)), len(taken))
        if lane == len(taken):
            taken.append([])
        taken[lane].append((low, high))
        lanes.append(lane)
    return lanes


def _top(index: int) -> float:
    return 6 + index * (_HEIGHT + _GAP)


def _draw_box(drawing: Drawing, box: _Box, x: float, y: float) -> None:
    node = box.node
    kind = _CLASSES.get(node.part, "c0")
    drawing.rect(x, y, _BOX, _HEIGHT, "box", rx=5)
    drawing.rect(x, y, 4, _HEIGHT, kind, rx=2)
    short = node.name.partition(".")[2] or node.name
    if len(box.names) > 1:
        short = f"{len(box.names)} × {short.rstrip('0123456789')}"
    drawing.text(x + 13, y + 14, shorten(short, 22), "title")
    drawing.text(x + 13, y + 27, shorten(f"{node.kind}{' · ' + node.memory if node.memory else ''}", 40), "quiet small")
    if node.shape:
        drawing.text(x + _BOX - 8, y + 14, "×".join(map(str, node.shape)), "end quiet small")


def _arc(drawing: Drawing, x: float, side: int, lane: int, source: float, target: float, kind: str) -> None:
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


def _head(drawing: Drawing, x: float, y: float, dx: int, dy: int, kind: str = "c0") -> None:
    """Draw an arrow head whose tip is at (x, y), pointing along (dx, dy)."""
    bx, by = x - 6 * dx, y - 6 * dy
    drawing.path(f"M{x} {y:.1f}L{bx + 3.2 * dy} {by + 3.2 * dx:.1f}L{bx - 3.2 * dy} {by - 3.2 * dx:.1f}z", kind)
