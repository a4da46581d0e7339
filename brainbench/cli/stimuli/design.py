"""``brainbench stimuli design``: the motion that tells objects, or networks, apart best."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from brainbench.cli.options import items, with_options
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.cli.stimuli import scenes
from brainbench.cli.stimuli.scenes import BackendOption, WhiskersOption
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE

if TYPE_CHECKING:
    from brainbench.scoring.recovery.motion import NetworkDesign
    from brainbench.stimuli.design import DesignOptions, DesignResult


@with_options("brainbench.stimuli.design:DesignOptions")
def design(
    source: Annotated[str, typer.Argument(help="A scene file (.toml) or a recipe: a scene for each object.")],
    options: DesignOptions,
    variables: Annotated[
        str, typer.Option(help="What to choose: frequency, protraction, retraction, object_x, object_y, object_z.")
    ] = "frequency,protraction,retraction",
    networks: Annotated[
        str,
        typer.Option(
            help="Two networks, such as zhuang-small.simclr,resnet18-small.supervised: tell them apart in place of the "
            "objects. The noise is then that of animals, as in 'brainbench recovery'."
        ),
    ] = "",
    whiskers: WhiskersOption = "all",
    backend: BackendOption = DEFAULT_ENGINE,
) -> Output:
    """Choose the whisking, or the place of the objects, that tells the objects, or two networks, apart best."""
    from brainbench.stimuli.design import design as run
    from brainbench.stimuli.design_variables import VARIABLES

    recipe = scenes.open_recipe(source, whiskers)
    with progress_bar("searching"):
        result: DesignResult | NetworkDesign
        how = {"options": options, "backend": backend}
        if networks:
            from brainbench.scoring.recovery import design_for_networks

            result = design_for_networks(recipe.scenes, items(networks), items(variables), **how)
            told = _of_networks(result)
        else:
            result = run(recipe.scenes, items(variables), **how)
            told = _of_objects(result)
    rows = [(name, result.start[name], value, VARIABLES[name].unit) for name, value in result.values.items()]
    chosen = table_of("", rows, {"variable": "{0[0]}", ">given": "{0[1]:.4g}", ">chosen": "{0[2]:.4g} {0[3]}"})
    status = f"status  {result.status} {result.reason}".rstrip()
    data = {name: value for name, value in vars(result).items() if name != "scenes"}
    return Output({**data, "options": options}, f"{chosen}\n\n{told}\n{status}")


def _of_objects(result: DesignResult) -> str:
    """Return how far objects are apart, in words."""
    pairs = [(pair, *both) for pair, both in result.distances.items()]
    table = table_of("", pairs, {"objects": "{0[0]}", ">D² of a whisk, given": "{0[1]:.3g}", ">chosen": "{0[2]:.3g}"})
    return f"{table}\n\nwhisks  {result.whisks:.3g} of those of the given motion, time {result.time:.3g}"


def _of_networks(result: NetworkDesign) -> str:
    """Return how well networks are told apart, in words."""
    rows = [
        ("1 − similarity of responses, objects of the search", *result.contrast),
        ("the same, held-out objects", *result.held_out),
        ("lead of the true network, held-out objects (score)", *result.leads),
        ("boards that it wins", *result.won),
    ]
    table = table_of("", rows, {"networks": "{0[0]}", ">given": "{0[1]:.3g}", ">chosen": "{0[2]:.3g}"})
    layers = ", ".join(f"{layer} of {name}" for name, layer in result.layers.items())
    gain = f"[{result.gain.low:.3g}, {result.gain.high:.3g}]" if result.gain else "none"
    return f"{table}\n\ngain    {result.leads[1] - result.leads[0]:.3g} {gain}, by {result.search}\nlayers  {layers}"
