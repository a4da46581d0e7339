"""``brainbench leaderboard add``: take in records, and score models into a folder of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.destinations import out_folder
from brainbench.cli.leaderboard.scoring import ScoringJob, full_settings, jobs_of, missing, parse_seeds, read_batch
from brainbench.cli.options import SCORE, SCORE_FLAGS, SchedulerOption, with_options
from brainbench.cli.output import JsonOption, emit, progress_bar
from brainbench.core.errors import DataFileNotFoundError, UsageError
from brainbench.core.files import to_json
from brainbench.core.records import ResultRecord
from brainbench.core.writing.locks import lock_folder
from leaderboards.audit import computation, conflicting, remarks
from leaderboards.store import StoredRecord, read_records, write_record
from leaderboards.writing import in_one_sentence, sweep

OFFERED = (
    "recordings", "conditions", "select", "window", "stimuli", "fidelity", "whiskers", "metric", "estimator", "time"
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
    as_json: JsonOption = False,
) -> None:
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
    if to.exists() and not to.is_dir():
        raise UsageError(f"--to is a folder; {str(to)!r} is a file.")
    jobs: list[ScoringJob] = []
    if model:
        first, *others = parse_seeds(seeds or "0")
        # Trained weights do not depend on a seed.
        jobs = jobs_of(model, [first], options)
        jobs += [job for job in jobs_of(model, others, options) if "." not in job.model]
        if not jobs:
            raise UsageError(f"No model matches {', '.join(map(repr, model))}; see them with: brainbench models list")
    if batch is not None:
        jobs += read_batch(batch)
    done = _take_in(_files(records or []), to, keep_both=keep_both)
    done += _score(jobs, to, prune=prune, workers=workers, scheduler=scheduler)
    states = [item["state"] for item in done]
    summary = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states)) or "nothing to do"
    lines = [f"{item['state']:9} {item['record'] or item['model']}{item['note']}" for item in done]
    emit({"folder": to, "results": done}, "\n".join([*lines, f"{to}: {summary}"]), as_json=as_json)
    if "refused" in states:
        raise typer.Exit(1)


def _files(sources: list[Path]) -> list[Path]:
    found: list[Path] = []
    for source in sources:
        if not source.exists():
            raise DataFileNotFoundError(f"There is no record file or folder {str(source)!r}.")
        inside = (path for path in source.rglob("*.json") if not path.name.startswith("."))
        found += sorted(inside) if source.is_dir() else [source]
    return found


def _take_in(paths: list[Path], to: Path, *, keep_both: bool) -> list[dict[str, Any]]:
    """Take in files one after the other; what one brought counts for the next."""
    present: dict[Hashable, dict[str, ResultRecord]] = defaultdict(dict)
    for record in (record for _, record in (_present(to) if paths else [])):
        present[computation(record)][record.identity] = record
    done = []
    for path in paths:
        (stored,) = read_records(path)
        done.append({"record": path.name} | _take_in_one(stored, to, present, keep_both=keep_both))
    return done


def _take_in_one(
    stored: StoredRecord, to: Path, present: dict[Hashable, dict[str, ResultRecord]], *, keep_both: bool
) -> dict[str, Any]:
    record = stored.record
    if record is None:
        return {"state": "refused", "model": None, "note": f": {stored.problem}"}
    alike = present[computation(record)]
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
    """Return the records of a folder; what killed writers left there is removed."""
    if not to.is_dir():
        return []
    with in_one_sentence(to), lock_folder(to) as alone:
        if alone:
            sweep(to, lambda name: name.endswith(".json"))
    if not any(to.rglob("*.json")):
        return []
    return [(item.path, item.record) for item in read_records(to) if item.record is not None]


def _question(record: ResultRecord) -> str:
    """Return what two records share when they answer the same question, the old one with what has since changed."""
    origin = record.score.provenance
    return to_json([record.score.name, origin.recordings.get("source"), full_settings(origin.settings)])


def _score(
    jobs: list[ScoringJob], to: Path, *, prune: bool, workers: int, scheduler: str | None
) -> list[dict[str, Any]]:
    from brainbench.core.jobs import run_jobs

    if not jobs:
        return []
    done: list[dict[str, Any]] = []
    with progress_bar() as progress:
        present = _present(to)
        asked: dict[str, list[Path]] = defaultdict(list)
        for old, record in present if prune else ():
            asked[_question(record)].append(old)
        open_jobs = missing(jobs, [record for _, record in present])
        open_ones = {id(job) for job in open_jobs}
        done += [
            {"state": "known", "record": None, "model": f"{job.model} seed {job.options.model_seed}", "note": ""}
            for job in jobs
            if id(job) not in open_ones
        ]
        scored = run_jobs(ScoringJob.run, open_jobs, workers=workers, scheduler=scheduler)
        for index, (place, record) in enumerate(scored, start=1):
            progress(index, len(open_jobs), "models scored")
            path = write_record(record, to)
            replaced = [old for old in (asked[_question(record)] if prune else ()) if old != path]
            for old in replaced:
                old.unlink(missing_ok=True)
            note = "".join(f"\n          replaces {old.name}" for old in replaced)
            done.append({"state": "scored", "record": path.name, "model": open_jobs[place].model, "note": note})
    return done
