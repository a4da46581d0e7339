"""What the commands on stimuli share: options, and what a SOURCE names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from brainbench.core.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from brainbench.stimuli import Recipe, Scene

WhiskersOption = Annotated[str, typer.Option(help="Whiskers to simulate: all, C0-C3, C2,D1, …")]
FidelityOption = Annotated[
    str,
    typer.Option(
        help="Simulation preset: fast, balanced or accurate; single values may follow, as in "
        "fast,links=12,time_step=5e-4,solver=quasistatic."
    ),
]
BackendOption = Annotated[str, typer.Option(help="Physics engine: rod (our own), mujoco, or bullet.")]
StimulusOption = Annotated[
    str | None, typer.Option("--stimulus", "-s", help="Label of the stimulus; needed where there are several.")
]


def open_recipe(source: str, whiskers: str) -> Recipe:
    """Return the scenes that a recipe name or a scene file holds.

    Raises:
        UsageError: there is no such recipe, or the file holds finished forces.
    """
    from brainbench.stimuli import get_recipe, list_recipes, load_scene

    suffix = Path(source).suffix
    if suffix == ".toml":
        return load_scene(source, whiskers=whiskers)
    if suffix in (".h5", ".hdf5", ".nc"):
        raise UsageError(
            f"{source!r} is a file of forces, in which objects and whiskers have no shape; give the recipe or the "
            "scene file (.toml) that it was made from."
        )
    if Path(source).is_file():
        raise UsageError(
            f"{source!r} is no scene file; scene files end in .toml. Recipes: {', '.join(list_recipes())}."
        )
    return get_recipe(source, whiskers=whiskers)


def choose_scene(recipe: Recipe, stimulus: str | None) -> Scene:
    """Return the scene of a recipe that ``stimulus`` names, or its only one.

    Raises:
        UsageError: there is no such scene, or there are several and none was named.
    """
    if stimulus is None:
        if len(recipe.scenes) == 1:
            return recipe.scenes[0]
        raise UsageError(
            f"{recipe.name!r} has {len(recipe.scenes)} scenes and one is drawn at a time; choose with --stimulus "
            f"({', '.join(recipe.labels[:8])}{', …' if len(recipe.labels) > 8 else ''})."
        )
    if stimulus not in recipe.labels:
        raise unknown_name("stimulus", stimulus, recipe.labels)
    return recipe.scenes[recipe.labels.index(stimulus)]


def numbers(text: str, count: int, what: str) -> tuple[float, ...]:
    """Return ``count`` numbers written with commas or × between them.

    Raises:
        UsageError: it is something else.
    """
    try:
        values = tuple(float(item) for item in re.split(r"[,x×]", text))
    except ValueError:
        values = ()
    if len(values) != count:
        raise UsageError(f"{what} takes {count} numbers joined by commas; received {text!r}.")
    return values


def whole_numbers(text: str, what: str) -> tuple[int, ...]:
    """Return whole numbers written with commas between them.

    Raises:
        UsageError: it is something else.
    """
    try:
        return tuple(int(item) for item in text.split(","))
    except ValueError as error:
        raise UsageError(f"{what} takes whole numbers joined by commas; received {text!r}.") from error
