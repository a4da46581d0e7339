"""Named recipes: scene files that ship with the package (``data/recipes/*.toml``, open to reading and copying),
grids of sweeps (:data:`brainbench.stimuli.sweeps.sweep_scenes.GRIDS`) over objects that the user brings, and
``rodgers-recorded FILE``, the six Rodgers stimuli met by recorded whisking."""

from __future__ import annotations

import dataclasses
import math
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from brainbench.core.errors import UsageError, check_name

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping
    from importlib.resources.abc import Traversable

    from brainbench.stimuli.motion.recorded import Trajectory
    from brainbench.stimuli.objects.solid import Solid
    from brainbench.stimuli.scenes.scene_files import Recipe

RECORDED = "rodgers-recorded"  # recipe whose whisking comes from a file

_RECORDED_START = math.radians(-10)
"""Azimuth at which recorded whisking starts: retracted as in ``rodgers``, and as the published sample begins."""
_RAT_SCALE = 2.0  # Rat over mouse: rostro-caudal distances between facial landmarks (Bresee et al. 2023).


def list_recipes() -> tuple[str, ...]:
    """Return the names that :func:`get_recipe` knows."""
    from brainbench.stimuli.sweeps.sweep_scenes import GRIDS

    return tuple(sorted([*_scene_files(), *GRIDS, RECORDED]))


def is_recipe(source: str) -> bool:
    """Return whether ``source`` names a recipe, with or without a file behind it (``rodgers-recorded FILE``)."""
    return source in list_recipes() or source.startswith(f"{RECORDED} ")


def is_packaged(source: object) -> TypeGuard[str]:
    """Return whether ``source`` names a recipe that depends on nothing but the package."""
    return isinstance(source, str) and source in _scene_files()


def get_recipe(
    name: str,
    *,
    whiskers: str = "all",
    objects: Iterable[Solid] | Mapping[str, Solid | Callable[[], Solid]] | None = None,
    trajectory: Trajectory | None = None,
    species: str = "mouse",
) -> Recipe:
    """Return a recipe, with only the selected whiskers.

    Args:
        name: one of :func:`list_recipes`, or ``rodgers-recorded FILE`` with a trajectory file that
            :func:`brainbench.stimuli.motion.recorded.load_trajectory` reads without further help.
        whiskers: a selection; see :meth:`WhiskerArray.select`.
        objects: what the sweeps of ``thesis-low`` and ``thesis-high`` move past the whiskers: solids, or a
            mapping from names to solids or to functions that load them. The scenes of these recipes are a
            lazy sequence (:class:`brainbench.stimuli.sweeps.sweep_scenes.SweepScenes`): each is built when it is
            asked for.
        trajectory: what ``rodgers-recorded`` plays, instead of a file behind its name.
        species: whose array plays it, ``mouse`` or ``rat``. For the rat, objects and places are doubled.
    """
    from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes, describe_grid

    name, _, file = name.partition(" ") if name.startswith(f"{RECORDED} ") else (name, "", "")
    if name == RECORDED:
        return _rodgers_recorded(file.strip(), trajectory, species, whiskers)
    if trajectory is not None or species != "mouse":
        raise UsageError(f"The recipe {name!r} takes no trajectory and no other species; {RECORDED!r} does.")
    if name in GRIDS:
        from brainbench.stimuli.scenes.scene_files import Recipe

        if objects is None:
            raise UsageError(
                f"The recipe {name!r} moves objects past the whiskers and needs some: "
                f"get_recipe({name!r}, objects=[sphere(0.01), …]), or: brainbench stimuli sweep {name} OBJECT …"
            )
        return Recipe(name, describe_grid(name), SweepScenes(GRIDS[name], objects, whiskers=whiskers))
    path = recipe_file(name)
    if objects is not None:
        raise UsageError(f"The recipe {name!r} has objects of its own; only {', '.join(GRIDS)} take some.")
    from brainbench.stimuli.scenes.scene_files import load_scene

    with resources.as_file(path) as file:
        return load_scene(file, whiskers=whiskers)


def describe_recipe(name: str) -> str:
    """Return the recipe's description; of a published sweep grid with our count and the published ones."""
    import tomllib

    from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, describe_grid

    if name in GRIDS:
        return describe_grid(name)
    if name == RECORDED:
        return (
            "The six stimuli of `rodgers`, met by recorded whisking: rodgers-recorded FILE, a WHISKiT trajectory (base "
            "angular velocities, rad/s at 1 kHz, one line per whisker). Starts 10 degrees behind rest."
        )
    return str(tomllib.loads(recipe_file(name).read_text(encoding="utf-8")).get("description", ""))


def _rodgers_recorded(file: str, trajectory: Trajectory | None, species: str, whiskers: str) -> Recipe:
    from brainbench.stimuli.motion.recorded import Recorded, load_trajectory
    from brainbench.stimuli.objects.solid import PlacedObject
    from brainbench.stimuli.scenes.scene import Head, Scene
    from brainbench.stimuli.scenes.scene_files import Recipe
    from brainbench.stimuli.whiskers.array import WhiskerArray

    if trajectory is None:
        if not file:
            raise UsageError(
                f"The recipe {RECORDED!r} plays a trajectory file and needs one: '{RECORDED} FILE' "
                "(base angular velocities, rad/s at 1 kHz, one line per whisker), or trajectory=…"
            )
        trajectory = load_trajectory(Path(file))
    elif file:
        raise UsageError(f"The recipe {RECORDED!r} was given a file and a trajectory; give one of them.")
    scale = _RAT_SCALE if species == "rat" else 1.0
    array = WhiskerArray.of(species).select(whiskers)
    whisking = Recorded(trajectory, start=_RECORDED_START)

    def _enlarged(scene: Scene) -> Scene:
        def _far(place: tuple[float, ...]) -> Any:
            return tuple(scale * value for value in place)

        head = Head(_far(scene.head.position), scene.head.rotation)
        objects = tuple(
            PlacedObject(placed.solid.scaled(scale), _far(placed.position), placed.rotation) for placed in scene.objects
        )
        return dataclasses.replace(scene, array=array, objects=objects, whisking=whisking, head=head)

    scenes = tuple(_enlarged(scene) for scene in get_recipe("rodgers").scenes)
    return Recipe(RECORDED, describe_recipe(RECORDED), scenes)


def _scene_files() -> dict[str, Traversable]:
    folder = resources.files("brainbench.stimuli").joinpath("data", "recipes")
    return {item.name.removesuffix(".toml"): item for item in folder.iterdir() if item.name.endswith(".toml")}


def recipe_file(name: str) -> Traversable:
    """Return the scene file of a packaged recipe."""
    files = _scene_files()
    check_name("stimulus recipe", name, list_recipes())
    return files[name]
