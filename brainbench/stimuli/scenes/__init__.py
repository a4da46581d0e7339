"""Scenes: a whisker array, its motion, the objects in its way, and the times at which forces are read.

A name goes through ``recipes``, a TOML file through ``scene_files`` (with ``motion_tables``, ``object_tables`` and
their reader ``toml_tables``) to a :class:`Scene`, whose :class:`Frames` say how forces are read. Engines take its jobs.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from brainbench.core.lazy import lazy_exports

if TYPE_CHECKING:
    from brainbench.stimuli.scenes.frames import Frames
    from brainbench.stimuli.scenes.recipes import describe_recipe, get_recipe, list_recipes
    from brainbench.stimuli.scenes.scene import Animal, Head, Scene
    from brainbench.stimuli.scenes.scene_files import Recipe, load_scene

__all__ = ["Animal", "Frames", "Head", "Recipe", "Scene", "describe_recipe", "get_recipe", "list_recipes", "load_scene"]

_MODULES = {
    ".frames": ("Frames",),
    ".recipes": ("describe_recipe", "get_recipe", "list_recipes"),
    ".scene": ("Animal", "Head", "Scene"),
    ".scene_files": ("Recipe", "load_scene"),
}
__getattr__, __dir__ = lazy_exports(__name__, {name: module for module, names in _MODULES.items() for name in names})
