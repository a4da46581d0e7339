"""Whisker stimuli: forces and moments at the base of whiskers that touch objects.

``whiskers``, ``objects`` and ``motion`` make ``scenes``; ``engines`` simulate them (:func:`simulate`), many at once as
``sweeps``; the wrenches go to a stimulus set or as an array [K, T, C, H, W] to a model (:func:`load_stimuli`).
``validation`` holds engines against closed forms, ``figures`` draws scenes and traces.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.engines import get_engine
    from brainbench.stimuli.engines.fidelity import Fidelity
    from brainbench.stimuli.motion.recorded import Recorded, load_trajectory
    from brainbench.stimuli.motion.trajectories import Path, Spin, Still, Translation, Whisking
    from brainbench.stimuli.objects.placed_object import PlacedObject
    from brainbench.stimuli.objects.shapenet import load_shapenet
    from brainbench.stimuli.objects.solid import Solid
    from brainbench.stimuli.readout import to_frame, to_grid
    from brainbench.stimuli.scenes.frames import Frames
    from brainbench.stimuli.scenes.recipes import describe_recipe, get_recipe, list_recipes
    from brainbench.stimuli.scenes.scene import Animal, Head, Scene
    from brainbench.stimuli.scenes.scene_files import Recipe, load_scene
    from brainbench.stimuli.simulation import simulate
    from brainbench.stimuli.sources import Stimuli, load_stimuli
    from brainbench.stimuli.stimulus_set import read_stimulus_set, write_stimulus_set
    from brainbench.stimuli.sweeps.grid import SweepGrid
    from brainbench.stimuli.validation import references
    from brainbench.stimuli.whiskers.array import WhiskerArray
    from brainbench.stimuli.whiskers.whisker import Whisker

__all__ = [
    "Animal",
    "Fidelity",
    "Frames",
    "Head",
    "Path",
    "PlacedObject",
    "Recipe",
    "Recorded",
    "Scene",
    "Solid",
    "Spin",
    "Still",
    "Stimuli",
    "SweepGrid",
    "Translation",
    "Whisker",
    "WhiskerArray",
    "Whisking",
    "describe_recipe",
    "get_engine",
    "get_recipe",
    "list_recipes",
    "load_scene",
    "load_shapenet",
    "load_stimuli",
    "load_trajectory",
    "read_stimulus_set",
    "references",
    "simulate",
    "to_frame",
    "to_grid",
    "write_stimulus_set",
]

_MODULES = {
    ".engines": ("get_engine",),
    ".engines.fidelity": ("Fidelity",),
    ".motion.recorded": ("Recorded", "load_trajectory"),
    ".motion.trajectories": ("Path", "Spin", "Still", "Translation", "Whisking"),
    ".objects.placed_object": ("PlacedObject",),
    ".objects.shapenet": ("load_shapenet",),
    ".objects.solid": ("Solid",),
    ".readout": ("to_frame", "to_grid"),
    ".scenes.frames": ("Frames",),
    ".scenes.recipes": ("describe_recipe", "get_recipe", "list_recipes"),
    ".scenes.scene": ("Animal", "Head", "Scene"),
    ".scenes.scene_files": ("Recipe", "load_scene"),
    ".simulation": ("simulate",),
    ".sources": ("Stimuli", "load_stimuli"),
    ".stimulus_set": ("read_stimulus_set", "write_stimulus_set"),
    ".sweeps.grid": ("SweepGrid",),
    ".validation.references.": ("references",),
    ".whiskers.array": ("WhiskerArray",),
    ".whiskers.whisker": ("Whisker",),
}
__getattr__, __dir__ = lazy_exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
