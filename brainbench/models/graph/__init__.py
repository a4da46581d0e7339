"""Temporal graphs: a specification becomes nodes, which are unrolled over time; PyTorchTNN's files are imported."""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.models.graph.spec import GraphSpec
    from brainbench.models.graph.temporal_graph import TemporalGraph

__all__ = ["GraphSpec", "TemporalGraph"]

__getattr__, __dir__ = lazy_exports(__name__)
