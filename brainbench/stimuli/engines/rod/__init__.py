"""Our own whisker solver in Warp: implicit, O(links), rigid contact with exact surfaces, on CPU and GPU."""

from __future__ import annotations

from brainbench.stimuli.engines.rod.engine import RodEngine

__all__ = ["RodEngine"]
