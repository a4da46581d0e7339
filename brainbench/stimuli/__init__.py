"""Whisker stimuli: arrays, objects, motion, scenes and their simulation into forces and moments.

The public names are imported on first use.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

_LAZY = {
    "Animal": "scene",
    "Fidelity": "fidelity",
    "Frames": "frames",
    "Head": "scene",
    "Path": "motion",
    "PlacedObject": "objects",
    "Recipe": "scene_files",
    "Recorded": "trajectory",
    "Scene": "scene",
    "Solid": "objects",
    "Spin": "motion",
    "Still": "motion",
    "Stimuli": "sets",
    "SweepGrid": "sweep_grid",
    "Translation": "motion",
    "Whisker": "whisker",
    "WhiskerArray": "morphology",
    "Whisking": "motion",
    "describe_recipe": "recipes",
    "get_backend": "backends",
    "get_recipe": "recipes",
    "list_recipes": "recipes",
    "load_scene": "scene_files",
    "load_shapenet": "shapenet",
    "load_stimuli": "sets",
    "load_trajectory": "trajectory",
    "read_stimulus_set": "storage",
    "simulate": "simulation",
    "to_frame": "readout",
    "to_grid": "readout",
    "write_stimulus_set": "storage",
}

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
    "get_backend",
    "get_recipe",
    "list_recipes",
    "load_scene",
    "load_shapenet",
    "load_stimuli",
    "load_trajectory",
    "read_stimulus_set",
    "simulate",
    "to_frame",
    "to_grid",
    "write_stimulus_set",
]

if TYPE_CHECKING:
    from brainbench.stimuli.backends import get_backend
    from brainbench.stimuli.fidelity import Fidelity
    from brainbench.stimuli.frames import Frames
    from brainbench.stimuli.morphology import WhiskerArray
    from brainbench.stimuli.motion import Path, Spin, Still, Translation, Whisking
    from brainbench.stimuli.objects import PlacedObject, Solid
    from brainbench.stimuli.readout import to_frame, to_grid
    from brainbench.stimuli.recipes import describe_recipe, get_recipe, list_recipes
    from brainbench.stimuli.scene import Animal, Head, Scene
    from brainbench.stimuli.scene_files import Recipe, load_scene
    from brainbench.stimuli.sets import Stimuli, load_stimuli
    from brainbench.stimuli.shapenet import load_shapenet
    from brainbench.stimuli.simulation import simulate
    from brainbench.stimuli.storage import read_stimulus_set, write_stimulus_set
    from brainbench.stimuli.sweep_grid import SweepGrid
    from brainbench.stimuli.trajectory import Recorded, load_trajectory
    from brainbench.stimuli.whisker import Whisker


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'brainbench.stimuli' has no attribute {name!r}")
    value = getattr(import_module(f"brainbench.stimuli.{_LAZY[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
