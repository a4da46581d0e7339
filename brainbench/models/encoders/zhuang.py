"""The recurrent convolutional encoder of Zhuang et al. (2017), with any cell.

Six 2×2 convolutions (the first "valid", 5 × 7 → 4 × 6, the others "same"), two dense layers, feedback
3→2, 4→2, 4→3, 5→3, 5→4, 6→4, 6→5 and skips conv2, conv4 → fc7. With the time-decay cell every node has a
memory, as published; with a gated cell the convolutions carry it and the dense layers have none. The
feedforward control keeps nodes, skips and timing and drops feedback and memory.
"""

from __future__ import annotations

from itertools import pairwise

from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node

INPUT_SHAPE = (30, 5, 7)
"""Five sub-steps of six channels (sub-step-major) on the whisker grid."""

_FEEDBACK = ((3, 2), (4, 2), (4, 3), (5, 3), (5, 4), (6, 4), (6, 5))
_FULL = (96, 128, 256, 384, 384, 256)


def small_width(full: int) -> int:
    """Return the width of a ``-small`` variant: 3/16 of the full one, in every encoder."""
    return full * 3 // 16


def zhuang_graph(
    cell: str = "time-decay", layer_norm: bool = False, small: bool = False, *, feedforward: bool = False
) -> GraphSpec:
    """Return the encoder's graph with a cell of :mod:`brainbench.models.cells`.

    It has 512 features, or 96 when ``small`` (every width × 3/16, about 1.3 M parameters with the largest cell).
    ``feedforward`` leaves out memory and feedback; cell and layer norm then have no meaning.
    """
    scaled = small_width if small else int
    memory = None if feedforward else Memory(cell, layer_norm=layer_norm)
    names = [f"conv{index}" for index in range(1, 7)]
    nodes = [
        Node(name, Convolution(scaled(width), padding="valid" if name == "conv1" else "same"), memory)
        for name, width in zip(names, _FULL, strict=True)
    ]
    # Gated memories are convolutional and need a grid, which dense layers lack; a trace needs none.
    dense = Memory() if cell == "time-decay" and not feedforward else None
    nodes += [Node("fc7", Dense(scaled(1024)), dense), Node("fc8", Dense(scaled(512)), dense)]
    # Skips bring early responses to the dense layers before the last convolution has answered.
    forward = [*pairwise(names), ("conv2", "fc7"), ("conv4", "fc7"), ("conv6", "fc7")]
    edges = [Edge(*ends) for ends in (*forward, ("fc7", "fc8"))]
    if not feedforward:
        edges += [Edge(f"conv{source}", f"conv{target}", feedback=True) for source, target in _FEEDBACK]
    return GraphSpec(tuple(nodes), tuple(edges), ("conv1",), "fc8", INPUT_SHAPE)
