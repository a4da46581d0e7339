"""Named recipes: scene files that ship with the package (``data/recipes/*.toml``), open to reading and copying."""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING

from brainbench.errors import unknown_name

if TYPE_CHECKING:
    from importlib.resources.abc import Traversable

    from brainbench.stimuli.scene_files import Recipe


def list_recipes() -> tuple[str, ...]:
    """Names that :func:`get_recipe` knows."""
    return tuple(sorted(item.name.removesuffix(".toml") for item in _folder().iterdir() if item.name.endswith(".toml")))


def get_recipe(name: str, *, whiskers: str = "all") -> Recipe:
    """Return a recipe, with only the selected whiskers.

    Raises:
        UsageError: there is no such recipe, or the selection names no whisker.
    """
    from brainbench.stimuli.scene_files import load_scene

    with resources.as_file(_file(name)) as path:
        return load_scene(path, whiskers=whiskers)


def describe_recipe(name: str) -> str:
    """Return the recipe's description."""
    import tomllib

    return str(tomllib.loads(_file(name).read_text(encoding="utf-8")).get("description", ""))


def _folder() -> Traversable:
    return resources.files("brainbench.stimuli").joinpath("data", "recipes")


def _file(name: str) -> Traversable:
    if name not in list_recipes():
        raise unknown_name("stimulus recipe", name, list_recipes())
    return _folder().joinpath(f"{name}.toml")
