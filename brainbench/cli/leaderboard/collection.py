"""A folder of records grows: files are taken in, and models are scored into it."""

from __future__ import annotations

import shlex
from collections import defaultdict
from pathlib import Path
from typing import Any

from brainbench.cli.options import SCORE, SCORE_FLAGS, as_flags
from brainbench.cli.output import progress_bar
from brainbench.core.errors import DataFileNotFoundError, look_alike
from brainbench.core.files import to_json
from brainbench.core.identity import ScoreIdentity
from brainbench.core.records import ResultRecord
from brainbench.scoring.jobs import ScoringJob, asked_settings, missing
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
    titles = [origin.recordings.get(name) for name in ("source", "title")]
    # The source is the last part of a path: folders of one name are told apart by their animals.
    animals = sorted(item.subject for item in record.score.subjects)
    return to_json([record.score.name, *titles, animals, origin.pairing, asked_settings(origin.settings)])


def command_of(job: ScoringJob) -> str:
    """Return the command line that makes a job's score by itself."""
    return shlex.join(["brainbench", "score", job.model, *as_flags(SCORE, job.options, SCORE_FLAGS)])


def _run(job: ScoringJob) -> ResultRecord:
    return job.run(command_of(job))


def score_jobs(
    jobs: list[ScoringJob], to: Path, *, prune: bool, workers: int, scheduler: str | None
) -> list[dict[str, Any]]:
    """Score what a folder does not hold yet into it; with ``prune`` remove what a new score replaces."""
    from brainbench.core.runs.jobs import run_jobs

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
