"""Our own whisker solver in Warp: implicit, O(links), rigid contact with exact surfaces, on CPU and GPU."""

from __future__ import annotations

from brainbench.stimuli.backends.rod.backend import RodBackend

__all__ = ["RodBackend"]
