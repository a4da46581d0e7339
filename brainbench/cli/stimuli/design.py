"""``brainbench stimuli design``: the motion that tells objects apart in the fewest whisks."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from brainbench.cli.options import items, with_options
from brainbench.cli.output import JsonOption, emit, progress_bar, table_of
from brainbench.cli.stimuli import scenes
from brainbench.cli.stimuli.scenes import BackendOption, WhiskersOption
from brainbench.stimuli.engines import DEFAULT_ENGINE

if TYPE_CHECKING:
    from brainbench.stimuli.design import DesignOptions


@with_options("brainbench.stimuli.design:DesignOptions")
def design(
    source: Annotated[str, typer.Argument(help="A scene file (.toml) or a recipe: a scene for each object.")],
    options: DesignOptions,
    variables: Annotated[
        str, typer.Option(help="What to choose: frequency, protraction, retraction, object_x, object_y, object_z.")
    ] = "frequency,protraction,retraction",
    whiskers: WhiskersOption = "all",
    backend: BackendOption = DEFAULT_ENGINE,
    as_json: JsonOption = False,
) -> None:
    """Choose the whisking, or the place of the objects, with which base wrenches tell the objects apart soonest."""
    from brainbench.stimuli.design import VARIABLES
    from brainbench.stimuli.design import design as run

    recipe = scenes.open_recipe(source, whiskers)
    with progress_bar("searching"):
        result = run(recipe.scenes, items(variables), options=options, backend=backend)
    rows = [(name, result.start[name], value, VARIABLES[name].unit) for name, value in result.values.items()]
    pairs = [(pair, *both) for pair, both in result.distances.items()]
    text = "\n\n".join([
        table_of("", rows, {"variable": "{0[0]}", ">given": "{0[1]:.4g}", ">chosen": "{0[2]:.4g} {0[3]}"}),
        table_of("", pairs, {"objects": "{0[0]}", ">D² of a whisk, given": "{0[1]:.3g}", ">chosen": "{0[2]:.3g}"}),
        f"whisks  {result.whisks:.3g} of those of the given motion, time {result.time:.3g}\n"
        f"status  {result.status} {result.reason}".rstrip(),
    ])  # fmt: skip
    data = {name: value for name, value in vars(result).items() if name != "scenes"}
    emit({**data, "options": options}, text, as_json=as_json)
