"""Figures: force traces, trade-offs, and pictures and films of scenes, without a display or OpenGL.

``camera`` frames the world, ``surfaces`` makes triangles of objects and whiskers, ``raster`` finds the visible ones,
``shading`` lights them, ``annotation`` writes around them, and ``scenes`` joins these into pictures and ``films``.
``traces`` and ``tradeoff`` are charts; ``canvas`` holds what all share.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.figures.camera import Camera
    from brainbench.stimuli.figures.scenes import Style, film_times, render, still_time
    from brainbench.stimuli.figures.traces import plot

__all__ = ["Camera", "Style", "film_times", "plot", "render", "still_time"]

_MODULES = {
    ".camera": ("Camera",),
    ".scenes": ("Style", "film_times", "render", "still_time"),
    ".traces": ("plot",),
}
__getattr__, __dir__ = lazy_exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
