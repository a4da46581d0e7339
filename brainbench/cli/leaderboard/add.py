"""``brainbench leaderboard add``: take in records, and score models into a folder of them."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.options import SCORE, SCORE_FLAGS, SchedulerOption, out_folder, score_command, with_options
from brainbench.cli.output import Output, progress_bar
from brainbench.core.errors import DataFileNotFoundError, UsageError, look_alike, visible
from brainbench.core.files import to_json
from brainbench.core.identity import ScoreIdentity
from brainbench.core.records import ResultRecord
from brainbench.core.runs.jobs import run_jobs
from brainbench.scoring.demo import DEMOS
from brainbench.scoring.jobs import ScoringJob, asked_settings, jobs_of, missing, parse_seeds, read_batch
from leaderboards.audit import conflicting, names_of, remarks
from leaderboards.store import StoredRecord, read_records, record_files, write_record


def given_files(sources: list[Path]) -> list[Path]:
    """Return the record files among files and folders; a :class:`DataFileNotFoundError` for one that is missing."""
    files: list[Path] = []
    for source in sources:
        if not source.exists():
            raise DataFileNotFoundError(f"There is no record file or folder {str(source)!r}.")
        files += record_files(source) if source.is_dir() else [source]
    return files


def take_in(paths: list[Path], to: Path, *, keep_both: bool) -> list[dict[str, Any]]:
    """Take in files one after the other; what one brought counts for the next.

    No name may read like another one that is there, or like a network of the registry.
    """
    from brainbench.models import list_models

    present: dict[ScoreIdentity, dict[str, ResultRecord]] = defaultdict(dict)
    names = {("name", look_alike(name)): name for name in list_models()}
    for record in (record for _, record in (_present(to) if paths else [])):
        present[ScoreIdentity.of(record)][record.identity] = record
        for what, name in names_of(record):
            names.setdefault((what, look_alike(name)), name)
    done = []
    for path in paths:
        (stored,) = read_records(path)
        record, state = stored.record, {}
        if record is not None and not keep_both:
            for what, name in names_of(record):
                if (rival := names.setdefault((what, look_alike(name)), name)) != name:
                    note = f": its {what} {name!a} reads like {rival!a}, which is there"
                    state = {"state": "refused", "model": record.score.name, "note": note}
        state = state or _take_in_one(stored, to, present, keep_both=keep_both)
        done.append({"record": path.name} | state)
    return done


def _take_in_one(
    stored: StoredRecord, to: Path, present: dict[ScoreIdentity, dict[str, ResultRecord]], *, keep_both: bool
) -> dict[str, Any]:
    record = stored.record
    if record is None:
        return {"state": "refused", "model": None, "note": f": {stored.problem}"}
    alike = present[ScoreIdentity.of(record)]
    rival = None if keep_both else next(conflicting(record, alike.values()), None)
    if rival is not None:
        note = (
            f": the same computation gave {rival.score.value:.4f} in a record that is there "
            f"({rival.identity}) and {record.score.value:.4f} here; see which holds with: "
            f"brainbench leaderboard verify {stored.path}"
        )
        return {"state": "refused", "model": record.score.name, "note": note}
    state = "known" if record.identity in alike else "added"
    written = write_record(record, to)
    alike[record.identity] = record
    note = "".join(f"\n          {doubt}" for doubt in remarks([stored]).get(record.identity, ()))
    return {"state": state, "record": written.name, "model": record.score.name, "note": note}


def _present(to: Path) -> list[tuple[Path, ResultRecord]]:
    """Return the records of a folder."""
    if not to.is_dir() or not record_files(to):
        return []
    return [(item.path, item.record) for item in read_records(to) if item.record is not None]


def _question(record: ResultRecord) -> str:
    """Return what two records share when they answer the same question, the old one with what has since changed."""
    origin = record.score.provenance
    # Files of one name hold other days of the same animals; a demo is known by its name, in each of its versions.
    source, title = (origin.recordings.get(name) for name in ("source", "title"))
    brain = source if record.synthetic and str(source) in DEMOS else origin.recordings_hash
    return to_json([record.score.name, title, brain, origin.pairing, asked_settings(origin.settings)])


def _run(job: ScoringJob) -> ResultRecord:
    return job.run(score_command(job.model, job.options))


def score_jobs(
    jobs: list[ScoringJob], to: Path, *, prune: bool, workers: int, scheduler: str | None
) -> list[dict[str, Any]]:
    """Score what a folder does not hold yet into it; with ``prune`` remove what a new score replaces."""
    if not jobs:
        return []
    done: list[dict[str, Any]] = []
    with progress_bar() as progress:
        present = _present(to)
        answers: dict[str, list[Path]] = defaultdict(list)
        for old, record in present if prune else ():
            answers[_question(record)].append(old)
        open_jobs = missing(jobs, [record for _, record in present])
        open_ones = {id(job) for job in open_jobs}
        done += [
            {"state": "known", "record": None, "model": f"{job.model} seed {job.options.model_seed}", "note": ""}
            for job in jobs
            if id(job) not in open_ones
        ]
        scored = run_jobs(_run, open_jobs, workers=workers, scheduler=scheduler)
        for index, (place, record) in enumerate(scored, start=1):
            progress(index, len(open_jobs), "models scored")
            path = write_record(record, to)
            replaced = [old for old in (answers[_question(record)] if prune else ()) if old != path]
            for old in replaced:
                old.unlink(missing_ok=True)
            note = "".join(f"\n          replaces {old.name}" for old in replaced)
            done.append({"state": "scored", "record": path.name, "model": open_jobs[place].model, "note": note})
    return done


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
    if not records and not model and batch is None:
        raise UsageError("Name record files to take in, or models to score with --model or --batch.")
    if options and batch is not None:
        raise UsageError("Options of the scores stand in the batch file itself, under [options].")
    if not model and (idle := [*options, *(["seed"] if seeds else [])]):
        raise UsageError(f"Only models of --model are scored with --{idle[0]}; name one, or leave the option out.")
    jobs = []
    if model:
        jobs += jobs_of(model, parse_seeds(seeds) if seeds else None, options)
    if batch is not None:
        jobs += read_batch(batch)
    # Patterns, entries and both flags may name a model twice.
    jobs = list({score_command(job.model, job.options): job for job in jobs}.values())
    done = take_in(given_files(records or []), to, keep_both=keep_both)
    done += score_jobs(jobs, to, prune=prune, workers=workers, scheduler=scheduler)
    states = [item["state"] for item in done]
    summary = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states)) or "nothing to do"
    lines = [f"{item['state']:9} {visible(item['record'] or item['model'])}{item['note']}" for item in done]
    failure = typer.Exit(1) if "refused" in states else None
    return Output({"folder": to, "results": done}, "\n".join([*lines, f"{to}: {summary}"]), failure=failure)
