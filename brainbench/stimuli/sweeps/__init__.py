"""Data sets of many sweeps: objects that brush past the whiskers under the conditions of a grid.

A ``grid`` and objects are ``sweep_scenes``; a ``plan`` cuts them into shards by ``split``; ``generation`` lets
``running`` make the missing shards (``simulation``, ``shards``: one HDF5 file each, layout in ``docs/datasets.md``) and
writes the ``manifest``. Shards are independent and renamed when complete, so a run that was killed goes on.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.sweeps.generation import generate
    from brainbench.stimuli.sweeps.grid import Span, Sweep, SweepGrid
    from brainbench.stimuli.sweeps.plan import GenerationPlan, GenerationSettings
    from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes

__all__ = ["GRIDS", "GenerationPlan", "GenerationSettings", "Span", "Sweep", "SweepGrid", "SweepScenes", "generate"]

_MODULES = {
    ".generation": ("generate",),
    ".grid": ("Span", "Sweep", "SweepGrid"),
    ".plan": ("GenerationPlan", "GenerationSettings"),
    ".sweep_scenes": ("GRIDS", "SweepScenes"),
}
__getattr__, __dir__ = lazy_exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
