"""``brainbench power``: how often an experiment would find a model that is truly alike."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from brainbench.cli.options import SCORE, PlanOption, needs, option, option_fields, with_options
from brainbench.cli.output import Output, progress_bar, table_of, tracked
from brainbench.core.errors import UsageError
from brainbench.core.files import to_plain
from brainbench.core.identity import SealedPlan
from brainbench.core.provenance import Provenance

if TYPE_CHECKING:
    from brainbench.scoring.neural_responses import NeuralResponses

_EFFECTS = (0.0, 0.3, 0.5, 0.7)
DESIGN = "brainbench.scoring.power.experiments:ExperimentDesign"


@needs(cache=True)
@with_options(DESIGN, [name for name in option_fields(DESIGN) if name not in ("effect", "dimensions")], build=False)
def power(
    options: dict[str, Any],
    effect: Annotated[
        float | None,
        typer.Option(help="True score between chance (0) and all that is reliable (1); several are shown without it."),
    ] = None,
    dimensions: Annotated[
        str, typer.Option(help="Dimensions of the representations: a number, or 'auto' to estimate them.")
    ] = "auto",
    recordings: Annotated[
        str | None, typer.Option("--recordings", "-r", help="Pilot recordings from which 'auto' estimates them.")
    ] = None,
    conditions: Annotated[str | None, option(SCORE, "conditions")] = None,
    model: Annotated[
        str | None, typer.Option(help="Model whose layers 'auto' estimates them from (median), without recordings.")
    ] = None,
    target: Annotated[float, typer.Option(help="Power that is wanted.")] = 0.8,
    simulations: Annotated[int, typer.Option(help="Simulated experiments per number.")] = 500,
    seed: Annotated[int, typer.Option(help="Seed of the experiments.")] = 0,
    layer: Annotated[str | None, option("brainbench.core.identity:SealedPlan", "layer")] = None,
    plan: PlanOption = None,
) -> Output:
    """Say how often a true effect would be found, and how many stimuli or animals are needed.

    Correlation, consistency and reliability of your own recordings: 'brainbench score' and
    'brainbench recordings rdm'.
    """
    from brainbench.metrics.reliability.noise_correction import RELIABILITY_GATE
    from brainbench.scoring.power import experiments

    if layer is not None and (plan is None or options["layers"] != 1):
        raise UsageError("--layer is what a --plan of one layer commits to; give --plan FILE, and leave out --layers.")
    # Whatever is wrong with the design is told before recordings are opened; animals bound what is shown by default.
    effects = [value for value in _EFFECTS if not value or value**2 <= options["consistency"]]
    designs = [experiments.ExperimentDesign(effect=one, **options) for one in (effects if effect is None else [effect])]
    number, origin, pilot = _dimensions(dimensions, recordings, conditions, model)
    designs = [replace(design, dimensions=number) for design in designs]
    rows = []
    for design in tracked(designs, "simulating experiments"):
        enough = {
            vary: experiments.needed(design, vary, target=target, simulations=simulations, seed=seed)
            if design.effect > 0
            else None
            for vary in ("stimuli", "animals")
        }
        rows.append((experiments.power(design, simulations=max(simulations, 1000), seed=seed), enough))

    def enough_text(row: Any, vary: str) -> str:
        """Return in print the fewest stimuli or animals that reach the wanted power."""
        return str(row[1][vary] or "none tried") if row[0].design.effect > 0 else ""

    def span(row: Any) -> str:
        """Return the interval of a power in print, or why there is none."""
        interval = row[0].interval
        return f"[{interval.low:.2f}, {interval.high:.2f}]" if interval else row[0].reason

    first = designs[0]
    title = (
        f"{first.stimuli} stimuli, {first.animals} animals, consistency {first.consistency:g}, reliability "
        f"{first.reliability:g}, {first.layers} layer{'s' if first.layers > 1 else ''}, α {first.alpha:g}, "
        f"{number} dimension{'s' if number > 1 else ''} ({origin}); smallest possible p {rows[0][0].p_smallest:.2g}"
    )
    columns = {
        ">true score": "{0[0].design.effect:g}",
        "power": lambda row: f"{row[0].power:.2f} {span(row)}",
        f">stimuli for {target:.0%}": lambda row: enough_text(row, "stimuli"),
        f">animals for {target:.0%}": lambda row: enough_text(row, "animals"),
    }
    note = "True score 0 is the rate of false alarms. Animals needed are for the given stimuli, and the reverse."
    note += "" if pilot is None else " The pilot gives dimensions alone: state its own --reliability and --consistency."
    if first.reliability < RELIABILITY_GATE:
        note += f" Scores of animals of a reliability below {RELIABILITY_GATE:g} are unreliable, whatever their p."
    data = {
        "dimensions": {"number": number, "origin": origin},
        "note": note,
        "results": [{**to_plain(result), "needed": enough, "target": target} for result, enough in rows],
    }
    text = f"{title}\n\n{table_of('', rows, columns)}\n\n{note}"
    if plan is not None:
        names = () if pilot is None or len(pilot.vocabulary) != first.stimuli else pilot.vocabulary
        sealed = SealedPlan(
            "power",
            first.stimuli,
            first.animals,
            layer=layer,
            layers=first.layers,
            names=tuple(names),
            pilot=None if pilot is None else Provenance.of({"recordings": pilot.origin}).recordings_hash,
            expected={f"true score {row[0].design.effect:g}": row[0].power for row in rows},
            command=shlex.join(["brainbench", *sys.argv[1:]]),
        )
        data["plan"] = {"path": sealed.write(plan), "hash": sealed.hash}
        text += f"\n\nplan  {plan}\nhash  {sealed.hash}"
    return Output(data, text)


def _dimensions(
    dimensions: str, recordings: str | None, conditions: str | None, model: str | None
) -> tuple[int, str, NeuralResponses | None]:
    """Return the number of dimensions, where it comes from in words, and the pilot recordings."""
    from brainbench.scoring.power.experiments import DIMENSIONS

    if conditions is not None and recordings is None:
        raise UsageError("--conditions labels the trials of --recordings; name those too.")
    sources = [name for name, given in (("--recordings", recordings), ("--model", model)) if given is not None]
    if dimensions != "auto":
        if not dimensions.isdecimal() or int(dimensions) < 1:
            raise UsageError(f"--dimensions is a whole number of at least 1 or 'auto'; received {dimensions!r}.")
        if sources:
            raise UsageError(
                f"--dimensions {dimensions} is given, so {sources[0]} has nothing to estimate; leave one out."
            )
        return int(dimensions), "given", None
    if len(sources) > 1:
        raise UsageError("Dimensions are estimated from --recordings or from --model, not both.")
    if recordings is not None:
        return _of_recordings(recordings, conditions)
    if model is not None:
        return (*_of_model(model), None)
    return DIMENSIONS, "assumed; --recordings or --model estimates them", None


def _of_recordings(recordings: str, conditions: str | None) -> tuple[int, str, NeuralResponses]:
    from brainbench.datasets.trials.session_trials import trials_by_subject
    from brainbench.scoring.neural_responses import open_neural_responses
    from brainbench.scoring.power.experiments import signal_dimensions

    with progress_bar() as progress:
        brain = open_neural_responses(recordings, progress=progress, conditions=conditions)
    estimate = signal_dimensions(trials_by_subject(brain.dataset).values(), len(brain.vocabulary))
    return round(estimate), f"{estimate:.1f} estimated from {brain.source}", brain


def _of_model(model: str) -> tuple[int, str]:
    from brainbench.scoring.model_responses import resolve_model
    from brainbench.scoring.options import ScoreOptions
    from brainbench.scoring.power.experiments import pattern_dimensions

    with progress_bar() as progress:
        responses = resolve_model(model).respond(ScoreOptions(), progress=progress)
    layers = responses.features(list(range(len(responses.labels)))).values()
    varied = [layer for layer in layers if np.isfinite(layer).all() and np.ptp(layer, axis=0).any()]
    estimate = float(np.median([pattern_dimensions(layer) for layer in varied]))
    return round(estimate), f"{estimate:.1f} estimated from {len(varied)} layers of {model}"
