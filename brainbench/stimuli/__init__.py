"""Whisker stimuli: forces and moments at the base of whiskers that touch objects.

``whiskers``, ``objects`` and ``motion`` make ``scenes``; ``engines`` simulate them (:func:`simulate`), many at once as
``sweeps``; the wrenches go to a stimulus set or as an array [K, T, C, H, W] to a model (:func:`load_stimuli`).
``fitting`` estimates whiskers and contacts from measurements. ``validation`` holds engines against closed
forms, ``figures`` draws scenes and traces.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.engines.fidelity import Fidelity
    from brainbench.stimuli.motion.trajectories import Whisking
    from brainbench.stimuli.objects.solid import PlacedObject, Solid
    from brainbench.stimuli.scenes.recipes import get_recipe, list_recipes
    from brainbench.stimuli.scenes.scene import Frames, Head, Scene
    from brainbench.stimuli.scenes.scene_files import load_scene
    from brainbench.stimuli.simulation import simulate
    from brainbench.stimuli.sources import Stimuli, load_stimuli
    from brainbench.stimuli.stimulus_set import read_stimulus_set, to_grid, write_stimulus_set
    from brainbench.stimuli.sweeps.sweep_scenes import SweepGrid
    from brainbench.stimuli.validation import references
    from brainbench.stimuli.whiskers.array import WhiskerArray
    from brainbench.stimuli.whiskers.whisker import Whisker

__all__ = [
    "Fidelity",
    "Frames",
    "Head",
    "PlacedObject",
    "Scene",
    "Solid",
    "Stimuli",
    "SweepGrid",
    "Whisker",
    "WhiskerArray",
    "Whisking",
    "get_recipe",
    "list_recipes",
    "load_scene",
    "load_stimuli",
    "read_stimulus_set",
    "references",
    "simulate",
    "to_grid",
    "write_stimulus_set",
]

__getattr__, __dir__ = lazy_exports(__name__)
