"""``brainbench power``: how often an experiment would find a model that is truly alike."""

from __future__ import annotations

from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table

_EFFECTS = (0.0, 0.3, 0.5, 0.7)


def power(
    stimuli: Annotated[int, typer.Option(help="Number of stimuli.")] = 6,
    animals: Annotated[int, typer.Option(help="Number of animals.")] = 11,
    effect: Annotated[
        float | None, typer.Option(help="True noise-corrected score of the model; several are shown without it.")
    ] = None,
    consistency: Annotated[float, typer.Option(help="Correlation of two animals' noiseless RDMs.")] = 0.8,
    reliability: Annotated[float, typer.Option(help="Reliability of one animal's RDM.")] = 0.8,
    layers: Annotated[int, typer.Option(help="Layers among which one is chosen; one of them has the effect.")] = 1,
    alpha: Annotated[float, typer.Option(help="Level of the test.")] = 0.05,
    target: Annotated[float, typer.Option(help="Power that is wanted.")] = 0.8,
    simulations: Annotated[int, typer.Option(help="Simulated experiments per number.")] = 500,
    seed: Annotated[int, typer.Option(help="Seed of the experiments.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Say how often a true effect would be found, and how many stimuli or animals are needed.

    Correlation, consistency and reliability of your own recordings: 'brainbench score' and
    'brainbench recordings rdm'.
    """
    from brainbench.metrics.inference.power import ExperimentDesign, needed
    from brainbench.metrics.inference.power import power as power_of

    effects = _EFFECTS if effect is None else (effect,)
    designs = [ExperimentDesign(stimuli, animals, item, consistency, reliability, layers, alpha) for item in effects]
    found = []
    with progress_bar() as progress:
        for index, design in enumerate(designs):
            progress(index, len(designs), "simulating experiments")
            enough = {
                vary: needed(design, vary, target=target, simulations=simulations, seed=seed)
                if design.effect > 0
                else None
                for vary in ("stimuli", "animals")
            }
            found.append((power_of(design, simulations=max(simulations, 1000), seed=seed), enough))
        progress(len(designs), len(designs), "simulating experiments")
    rows = []
    for result, enough in found:
        span = f"[{result.interval.low:.2f}, {result.interval.high:.2f}]" if result.interval else result.reason
        told = [
            str(enough[vary] or "none tried") if result.design.effect > 0 else "" for vary in ("stimuli", "animals")
        ]
        rows.append([f"{result.design.effect:g}", f"{result.power:.2f} {span}", *told])
    title = (
        f"{stimuli} stimuli, {animals} animals, consistency {consistency:g}, reliability {reliability:g}, "
        f"{layers} layer{'s' if layers > 1 else ''}, α {alpha:g}; smallest possible p {found[0][0].p_smallest:.2g}"
    )
    columns = ["true score", "power", f"stimuli for {target:.0%}", f"animals for {target:.0%}"]
    note = "True score 0 is the rate of false alarms. Animals needed are for the given stimuli, and the reverse."
    data = {"results": [{**_plain(result), "needed": enough, "target": target} for result, enough in found]}
    emit(data, f"{title}\n\n{table('', columns, rows, right=(0, 2, 3))}\n\n{note}", as_json=as_json)


def _plain(result: object) -> dict[str, object]:
    from brainbench.core.files import to_plain

    return to_plain(result)
