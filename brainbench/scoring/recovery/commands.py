"""``brainbench recovery``: could a design tell these networks apart?"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import (
    SCORE,
    PlanOption,
    Requirement,
    SchedulerOption,
    WorkersOption,
    needs,
    option,
    out_folder_option,
    with_options,
)
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.core.errors import UsageError, check_number
from brainbench.core.files import provenance, to_plain, write_json
from brainbench.core.identity import SealedPlan

if TYPE_CHECKING:
    from brainbench.scoring.recovery import Candidate, Recovery, RecoveryDesign

POPULATION = "brainbench.datasets.synthetic.populations:PopulationDesign"
_CLUSTER = Requirement(("distributed",), "cluster", "A --scheduler", lambda values: values.get("scheduler") is not None)
_PICTURE = Requirement(("matplotlib",), "report", "Drawing pictures", lambda values: values.get("out") is not None)
_NOISE = ("animals", "units", "rate", "window", "modulation", "individual", "emphasis", "dispersion", "shared_gain")
_DESIGN = "brainbench.scoring.recovery.boards:RecoveryDesign"


@needs(_CLUSTER, _PICTURE, cache=True)
@with_options(POPULATION, _NOISE, build=False)
@with_options(_DESIGN, ("stimuli", "layer"), parameter="board", flags={"stimuli": ("--show",)}, build=False)
def recovery(
    options: dict[str, Any],
    board: dict[str, Any],
    models: Annotated[
        list[str] | None,
        typer.Argument(
            help="Registry names or patterns, FILE.py:FUNCTION, or HDF5 files of activations. \\[default: all shipped "
            "trained networks]",
            show_default=False,
        ),
    ] = None,
    stimuli: Annotated[
        str, typer.Option("--stimuli", "-s", help="A recipe, a scene file, a stimulus-set file, or an HDF5 array.")
    ] = "objects",
    trials: Annotated[str, typer.Option(help="Trials of each stimulus: 18, or the fewest and the most.")] = "16-20",
    metric: Annotated[str, option(SCORE, "metric")] = "rsa",
    boards: Annotated[int, typer.Option(help="Boards of each network.")] = 10,
    want: Annotated[
        float | None,
        typer.Option(help="Also name the cheapest design whose true network comes first this often, such as 0.8."),
    ] = None,
    pool: Annotated[
        str | None, typer.Option(help="Stimuli to choose from, in place of --stimuli; with --keep.")
    ] = None,
    keep: Annotated[int | None, typer.Option(help="Pick this many stimuli that separate the networks best.")] = None,
    whiskers: Annotated[str, option(SCORE, "whiskers")] = "all",
    fidelity: Annotated[str, option(SCORE, "fidelity")] = "balanced",
    seed: Annotated[int, typer.Option(help="Seed of the animals, and of untrained weights.")] = 0,
    out: Annotated[
        Path | None, out_folder_option("Folder for result and picture, and for going on after an interruption.")
    ] = None,
    plan: PlanOption = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
) -> Output:
    """Say whether an experiment could tell networks apart: each network in turn makes the animals.

    Animals are drawn from each network, and all networks are scored on them. Run again with the same --out, an
    interrupted recovery goes on where it stopped.
    """
    from brainbench.datasets.synthetic import PopulationDesign
    from brainbench.scoring.options import ScoreOptions
    from brainbench.scoring.recovery import RecoveryDesign, find_cheapest, open_candidates, plot_confusion, recover
    from brainbench.scoring.recovery.boards import parse_trials
    from brainbench.stimuli.sources import stated_labels

    if any("{trial}" in label for label in stated_labels(pool or stimuli) or ()):
        raise UsageError(
            f"The scenes of {pool or stimuli!r} are single trials, and a recovery shows each stimulus in many; give "
            "--stimuli with a scene for each label, such as the whisking of one trial of it."
        )
    if (pool is None) is not (keep is None):
        raise UsageError("Stimuli are picked with both --pool STIMULI and --keep NUMBER; received one of them.")
    if keep is not None and board["stimuli"] is not None:
        raise UsageError("All stimuli that --keep picks are shown; leave out --show.")
    if want is not None:
        check_number("--want", want, above=0, below=1)
    started = time.perf_counter()
    population = PopulationDesign(**options, trials=parse_trials(trials))
    design = RecoveryDesign(population, **board, metric=metric, seed=seed)
    chosen = ScoreOptions(stimuli=pool or stimuli, whiskers=whiskers, fidelity=fidelity, metric=metric, seed=seed)
    where: dict[str, Any] = {"workers": workers, "scheduler": scheduler}
    with progress_bar() as progress:
        candidates, origin = open_candidates(_find(models), chosen, progress=progress)
        data: dict[str, Any] = {}
        picked = ""
        if keep is not None:
            picked, data["selection"], candidates = _pick(
                candidates, keep, design, boards, where | {"progress": progress}
            )
            design = replace(design, stimuli=None)
        folder = None if out is None else out / "boards"
        result = recover(candidates, design, boards=boards, folder=folder, **where, progress=progress)
        if want is not None and not result.alike:
            # About sixty boards of each design, however few the candidates.
            each = max(5, 60 // len(candidates))
            best, tried = find_cheapest(candidates, design, want, boards=each, **where, progress=progress)
            data["cheapest"] = {"wanted": want, "design": best, "tried": tried}
    data |= _facts(result, want)
    data["provenance"] = provenance(
        stimuli=origin,
        weights={item.name: item.weights for item in candidates},
        settings={"design": to_plain(design), "boards": boards, **chosen.settings},
        command=shlex.join(["brainbench", *sys.argv[1:]]),
        seconds=round(time.perf_counter() - started, 1),
    )
    text = f"{_text(result, want, data.get('cheapest'))}{picked}"
    if out is not None:
        text += f"\n\nresult   {write_json(out / 'recovery.json', data)}"
        text += f"\npicture  {plot_confusion(result, out / 'recovery.png')}"
    if plan is not None:
        sealed = _plan(result, candidates)
        data["plan"] = {"path": sealed.write(plan), "hash": sealed.hash}
        text += f"\n\nplan  {plan}\nhash  {sealed.hash}"
    return Output(data, text)


def _plan(recovery: Recovery, candidates: Sequence[Candidate]) -> SealedPlan:
    """Return what a score of the planned experiment is held to; stimuli drawn anew for each board have no names."""
    design = recovery.design
    names = recovery.names
    return SealedPlan(
        "recovery",
        recovery.stimuli,
        design.population.animals,
        metric=design.metric,
        names=candidates[0].stimuli if recovery.stimuli == len(candidates[0].stimuli) else (),
        models=names,
        units=design.population.units,
        trials=design.population.trial_range[0],
        expected={name: float(recovery.firsts[row, row] / recovery.counts[row]) for row, name in enumerate(names)},
        command=shlex.join(["brainbench", *sys.argv[1:]]),
    )


def _find(patterns: Sequence[str] | None) -> list[str]:
    """Return the models that names and patterns mean; the shipped ones without any."""
    from brainbench.models.training.checkpoints import shipped
    from brainbench.scoring.jobs import find_models

    if not patterns:
        return list(shipped())
    models: dict[str, None] = {}
    for pattern in patterns:
        file = Path(pattern).suffix.lower() in (".h5", ".hdf5")
        models |= dict.fromkeys([pattern] if file else find_models([pattern]))
    return list(models)


def _pick(
    candidates: tuple[Candidate, ...], keep: int, design: RecoveryDesign, boards: int, where: dict[str, Any]
) -> tuple[str, dict[str, Any], tuple[Candidate, ...]]:
    """Choose stimuli, and measure random choices of as many and of twice as many beside them on other boards."""
    from brainbench.scoring.recovery import recover, select_stimuli
    from brainbench.scoring.recovery.selection import keep_stimuli

    chosen = select_stimuli(candidates, keep, design, progress=where["progress"])
    pool = len(candidates[0].stimuli)
    rates = {}
    for size in (keep, 2 * keep):
        if size <= pool:
            random = recover(candidates, replace(design, stimuli=size), boards=boards, **where)
            rates[size] = {"win_rate": random.win_rate, "interval": random.wins()}
    said = "; ".join(f"{size} at random {item['win_rate']:.0%}" for size, item in rates.items())
    text = f"\n\nPicked {keep} of {pool} stimuli ({said}):\n{', '.join(chosen.stimuli)}"
    return text, {**asdict(chosen), "random": rates}, keep_stimuli(candidates, chosen.rows)


def _facts(recovery: Recovery, want: float | None) -> dict[str, Any]:
    """Return what --json and the file say of a recovery."""
    names = ("win_rate", "outcomes", "reliability", "stimuli", "names", "firsts", "lost", "alike", "notes")
    return {name: getattr(recovery, name) for name in names} | {
        "answer": recovery.answer(*([] if want is None else [want])),
        "interval": recovery.wins(),
        "made": recovery.counts,
        "told_apart": recovery.won,
        "boards": [
            {("told" if name == "verdicts" else name): value for name, value in vars(board).items()}
            for board in recovery.boards
        ],
        "intervals": {name: recovery.wins(place) for place, name in enumerate(recovery.names)},
        "hardest": recovery.hardest(10),
    }


def _text(recovery: Recovery, want: float | None, cheapest: dict[str, Any] | None) -> str:
    """Return what people read, the answer first."""
    lines = [recovery.answer(*([] if want is None else [want]))]
    if cheapest is not None:
        best = cheapest["design"]
        lines.append(
            f"No design of the {len(cheapest['tried'])} that were tried reaches {want:.0%}."
            if best is None
            else f"Cheapest design that reaches {want:.0%}: {best.animals} animals of {best.units} units, "
            f"{best.stimuli} stimuli, {best.trials} trials of each ({best.win_rate:.0%} of its boards "
            f"[{best.interval.low:.0%}, {best.interval.high:.0%}])."
        )
    population = recovery.design.population
    low, high = population.trial_range
    lines.append(
        f"Design: {recovery.stimuli} stimuli, {population.animals} animals of {population.units} units, "
        f"{low if low == high else f'{low}–{high}'} trials; reliability {recovery.reliability:.2f}; metric "
        f"{recovery.design.metric}."
    )
    shares = recovery.outcomes
    lines.append(
        f"Pairs with the true network, tested over animals and stimuli: {shares['win']:.0%} won, {shares['tie']:.0%} "
        f"tied, {shares['loss']:.0%} lost."
    )
    lines += recovery.notes

    def mistaken(place: int) -> str:
        """Return the network that came first most often in a true one's place, and how often."""
        firsts = zip(recovery.firsts[place], recovery.names, strict=True)
        count, rival = max((int(count), name) for count, name in firsts if name != recovery.names[place])
        return f"{rival} ({count})" if count else ""

    columns = {
        "true network": lambda place: recovery.names[place],
        "first": lambda place: f"{recovery.firsts[place, place]} of {recovery.counts[place]}",
        "interval": lambda place: "[{0.low:.0%}, {0.high:.0%}]".format(recovery.wins(place)),
        "most often mistaken for": mistaken,
    }
    return "\n".join(lines) + "\n\n" + table_of("", range(len(recovery.names)), columns)
