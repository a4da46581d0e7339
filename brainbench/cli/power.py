"""``brainbench power``: how often an experiment would find a model that is truly alike."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from brainbench.cli.options import option_fields, with_options
from brainbench.cli.output import JsonOption, emit, progress_bar, table_of

_EFFECTS = (0.0, 0.3, 0.5, 0.7)


DESIGN = "brainbench.metrics.inference.power:ExperimentDesign"


@with_options(DESIGN, [name for name in option_fields(DESIGN) if name != "effect"], build=False)
def power(
    options: dict[str, Any],
    effect: Annotated[
        float | None, typer.Option(help="True noise-corrected score of the model; several are shown without it.")
    ] = None,
    target: Annotated[float, typer.Option(help="Power that is wanted.")] = 0.8,
    simulations: Annotated[int, typer.Option(help="Simulated experiments per number.")] = 500,
    seed: Annotated[int, typer.Option(help="Seed of the experiments.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Say how often a true effect would be found, and how many stimuli or animals are needed.

    Correlation, consistency and reliability of your own recordings: 'brainbench score' and
    'brainbench recordings rdm'.
    """
    from brainbench.core.files import to_plain
    from brainbench.metrics.inference import power as experiments

    effects = _EFFECTS if effect is None else (effect,)
    designs = [experiments.ExperimentDesign(effect=one, **options) for one in effects]
    found = []
    with progress_bar() as progress:
        for index, design in enumerate(designs):
            progress(index, len(designs), "simulating experiments")
            enough = {
                vary: experiments.needed(design, vary, target=target, simulations=simulations, seed=seed)
                if design.effect > 0
                else None
                for vary in ("stimuli", "animals")
            }
            found.append((experiments.power(design, simulations=max(simulations, 1000), seed=seed), enough))
        progress(len(designs), len(designs), "simulating experiments")

    def told(item: Any, vary: str) -> str:
        return str(item[1][vary] or "none tried") if item[0].design.effect > 0 else ""

    def span(item: Any) -> str:
        interval = item[0].interval
        return f"[{interval.low:.2f}, {interval.high:.2f}]" if interval else item[0].reason

    one = designs[0]
    title = (
        f"{one.stimuli} stimuli, {one.animals} animals, consistency {one.consistency:g}, reliability "
        f"{one.reliability:g}, {one.layers} layer{'s' if one.layers > 1 else ''}, α {one.alpha:g}; "
        f"smallest possible p {found[0][0].p_smallest:.2g}"
    )
    columns = {
        ">true score": "{0[0].design.effect:g}",
        "power": lambda item: f"{item[0].power:.2f} {span(item)}",
        f">stimuli for {target:.0%}": lambda item: told(item, "stimuli"),
        f">animals for {target:.0%}": lambda item: told(item, "animals"),
    }
    note = "True score 0 is the rate of false alarms. Animals needed are for the given stimuli, and the reverse."
    data = {"results": [{**to_plain(result), "needed": enough, "target": target} for result, enough in found]}
    emit(data, f"{title}\n\n{table_of('', found, columns)}\n\n{note}", as_json=as_json)
