"""Temporal graphs: a specification becomes nodes, which are unrolled over time; PyTorchTNN's files are imported."""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.models.graph.spec import Convolution, Dense, Edge, GraphSpec, Memory, Node, Pool
    from brainbench.models.graph.temporal_graph import GraphState, TemporalGraph

__all__ = [
    "Convolution",
    "Dense",
    "Edge",
    "GraphSpec",
    "GraphState",
    "Memory",
    "Node",
    "Pool",
    "TemporalGraph",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Convolution": ".spec",
        "Dense": ".spec",
        "Edge": ".spec",
        "GraphSpec": ".spec",
        "GraphState": ".temporal_graph",
        "Memory": ".spec",
        "Node": ".spec",
        "Pool": ".spec",
        "TemporalGraph": ".temporal_graph",
    },
)
