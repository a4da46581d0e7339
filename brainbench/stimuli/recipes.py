"""Named recipes: scene files that ship with the package (``data/recipes/*.toml``, open to reading and copying),
and grids of sweeps (:data:`brainbench.stimuli.sweeps.GRIDS`) over objects that the user brings."""

from __future__ import annotations

from importlib import resources
from typing import TYPE_CHECKING

from brainbench.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from importlib.resources.abc import Traversable

    from brainbench.stimuli.objects import Solid
    from brainbench.stimuli.scene_files import Recipe


def list_recipes() -> tuple[str, ...]:
    """Names that :func:`get_recipe` knows."""
    from brainbench.stimuli.sweeps import GRIDS

    return tuple(sorted([*_scene_files(), *GRIDS]))


def get_recipe(
    name: str,
    *,
    whiskers: str = "all",
    objects: Iterable[Solid] | Mapping[str, Solid | Callable[[], Solid]] | None = None,
) -> Recipe:
    """Return a recipe, with only the selected whiskers.

    Args:
        name: one of :func:`list_recipes`.
        whiskers: a selection; see :meth:`WhiskerArray.select`.
        objects: what the sweeps of ``thesis-low`` and ``thesis-high`` move past the whiskers: solids, or a
            mapping from names to solids or to functions that load them. The scenes of these recipes are a
            lazy sequence (:class:`brainbench.stimuli.sweeps.SweepScenes`): each is built when it is asked for.

    Raises:
        UsageError: there is no such recipe, the selection names no whisker, or objects are missing or superfluous.
    """
    from brainbench.stimuli.sweeps import GRIDS, SweepScenes, describe_grid

    if name in GRIDS:
        from brainbench.stimuli.scene_files import Recipe

        if objects is None:
            raise UsageError(
                f"The recipe {name!r} moves objects past the whiskers and needs some: "
                f"get_recipe({name!r}, objects=[sphere(0.01), …]), or: brainbench stimuli sweep {name} OBJECT …"
            )
        return Recipe(name, describe_grid(name), SweepScenes(GRIDS[name], objects, whiskers=whiskers))
    path = _file(name)
    if objects is not None:
        raise UsageError(f"The recipe {name!r} has objects of its own; only {', '.join(GRIDS)} take some.")
    from brainbench.stimuli.scene_files import load_scene

    with resources.as_file(path) as file:
        return load_scene(file, whiskers=whiskers)


def describe_recipe(name: str) -> str:
    """Return the recipe's description; of a published sweep grid with our count and the published ones."""
    import tomllib

    from brainbench.stimuli.sweeps import GRIDS, describe_grid

    if name in GRIDS:
        return describe_grid(name)
    return str(tomllib.loads(_file(name).read_text(encoding="utf-8")).get("description", ""))


def _scene_files() -> list[str]:
    return [item.name.removesuffix(".toml") for item in _folder().iterdir() if item.name.endswith(".toml")]


def _folder() -> Traversable:
    return resources.files("brainbench.stimuli").joinpath("data", "recipes")


def _file(name: str) -> Traversable:
    if name not in _scene_files():
        raise unknown_name("stimulus recipe", name, list_recipes())
    return _folder().joinpath(f"{name}.toml")
