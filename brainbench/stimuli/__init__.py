"""Whisker stimuli: arrays, objects and motion make scenes, engines simulate them into forces and moments."""

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

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "Animal": ".scenes.scene",
        "Fidelity": ".engines.fidelity",
        "Frames": ".scenes.frames",
        "Head": ".scenes.scene",
        "Path": ".motion.trajectories",
        "PlacedObject": ".objects.placed_object",
        "Recipe": ".scenes.scene_files",
        "Recorded": ".motion.recorded",
        "Scene": ".scenes.scene",
        "Solid": ".objects.solid",
        "Spin": ".motion.trajectories",
        "Still": ".motion.trajectories",
        "Stimuli": ".sources",
        "SweepGrid": ".sweeps.grid",
        "Translation": ".motion.trajectories",
        "Whisker": ".whiskers.whisker",
        "WhiskerArray": ".whiskers.array",
        "Whisking": ".motion.trajectories",
        "describe_recipe": ".scenes.recipes",
        "get_engine": ".engines",
        "get_recipe": ".scenes.recipes",
        "list_recipes": ".scenes.recipes",
        "load_scene": ".scenes.scene_files",
        "load_shapenet": ".objects.shapenet",
        "load_stimuli": ".sources",
        "load_trajectory": ".motion.recorded",
        "read_stimulus_set": ".stimulus_set",
        "references": ".validation.references.",
        "simulate": ".simulation",
        "to_frame": ".readout",
        "to_grid": ".readout",
        "write_stimulus_set": ".stimulus_set",
    },
)
