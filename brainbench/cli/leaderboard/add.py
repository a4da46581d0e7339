"""``brainbench leaderboard add``: take in records, and score models into a folder of them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.destinations import out_folder
from brainbench.cli.options import SCORE, SCORE_FLAGS, SchedulerOption, with_options
from brainbench.cli.output import Output
from brainbench.core.errors import UsageError, visible

OFFERED = (
    "benchmark", "recordings", "conditions", "select", "window", "stimuli", "fidelity", "whiskers", "metric",
    "estimator", "time",
)  # fmt: skip
"""Options of a score that have a flag here; a batch file can set the others too."""


@with_options(SCORE, OFFERED, flags=SCORE_FLAGS, given=True, help="As in brainbench score.")
def add(
    records: Annotated[list[Path] | None, typer.Argument(help="Record files or folders of them to take in.")] = None,
    to: Annotated[
        Path, typer.Option("--to", "-o", callback=out_folder, help="Folder of the leaderboard's records.")
    ] = Path("brainbench-results"),
    model: Annotated[
        list[str] | None, typer.Option("--model", "-m", help="A model to score, or a pattern such as '*-small'.")
    ] = None,
    seeds: Annotated[
        str | None, typer.Option("--seed", "--seeds", help="Seeds of untrained weights: 0 (default), 0-4 or 0,3.")
    ] = None,
    batch: Annotated[Path | None, typer.Option(help="TOML file that names many models and their seeds.")] = None,
    options: Any = None,
    keep_both: Annotated[
        bool, typer.Option("--keep-both", help="Take in a record although one there states other numbers.")
    ] = False,
    prune: Annotated[
        bool,
        typer.Option("--prune", help="Remove records that a new score of the same model, seed and settings replaces."),
    ] = False,
    workers: Annotated[int, typer.Option(min=1, help="Processes that score.")] = 1,
    scheduler: SchedulerOption = None,
) -> Output:
    """Add records to a folder: files that somebody sends, or scores computed now.

    A file is checked (layout, content hash, contradictions) and refused if it was edited, or if a record there
    states other numbers for the same computation. Scores that are there already are not computed again, so an
    interrupted batch goes on where it stopped, and a stale one is renewed.
    """
    from brainbench.cli.leaderboard.collection import command_of, given_files, score_jobs, take_in
    from brainbench.scoring.jobs import jobs_of, parse_seeds, read_batch

    if not records and not model and batch is None:
        raise UsageError("Name record files to take in, or models to score with --model or --batch.")
    if options and batch is not None:
        raise UsageError("Options of the scores stand in the batch file itself, under [options].")
    if not model and (idle := [*options, *(["seed"] if seeds else [])]):
        raise UsageError(f"Only models of --model are scored with --{idle[0]}; name one, or leave the option out.")
    if to.exists() and not to.is_dir():
        raise UsageError(f"--to is a folder; {str(to)!r} is a file.")
    jobs = []
    if model:
        jobs += jobs_of(model, parse_seeds(seeds) if seeds else None, options)
    if batch is not None:
        jobs += read_batch(batch)
    # Patterns, entries and both flags may name a model twice.
    jobs = list({command_of(job): job for job in jobs}.values())
    done = take_in(given_files(records or []), to, keep_both=keep_both)
    done += score_jobs(jobs, to, prune=prune, workers=workers, scheduler=scheduler)
    states = [item["state"] for item in done]
    summary = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states)) or "nothing to do"
    lines = [f"{item['state']:9} {visible(item['record'] or item['model'])}{item['note']}" for item in done]
    failure = typer.Exit(1) if "refused" in states else None
    return Output({"folder": to, "results": done}, "\n".join([*lines, f"{to}: {summary}"]), failure=failure)
