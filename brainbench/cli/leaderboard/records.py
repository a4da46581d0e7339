"""``brainbench leaderboard add | verify``: take in records, score models into a folder of them, and check them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.options import SCORE, SCORE_FLAGS, with_options
from brainbench.cli.output import JsonOption, emit, progress_bar, table_of

if TYPE_CHECKING:
    from brainbench.cli.leaderboard.scoring import ScoringJob
    from brainbench.core.records import ResultRecord

OFFERED = (
    "recordings", "conditions", "select", "window", "stimuli", "fidelity", "whiskers", "metric", "estimator", "time"
)  # fmt: skip
"""Options of a score that have a flag here; a batch file can set the others too."""


@with_options(SCORE, OFFERED, flags=SCORE_FLAGS, given=True, help="As in brainbench score.")
def add(
    records: Annotated[list[Path] | None, typer.Argument(help="Record files or folders of them to take in.")] = None,
    to: Annotated[Path, typer.Option("--to", "-o", help="Folder of the leaderboard's records.")] = Path(
        "brainbench-results"
    ),
    model: Annotated[
        list[str] | None, typer.Option("--model", "-m", help="A model to score, or a pattern such as '*-small'.")
    ] = None,
    seeds: Annotated[str, typer.Option("--seed", "--seeds", help="Seeds of untrained weights: 0, 0-4 or 0,3.")] = "0",
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
    scheduler: Annotated[
        str | None, typer.Option(help="Let the workers of this Dask scheduler (tcp://host:8786) score.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Add records to a folder: files that somebody sends, or scores computed now.

    A file is checked (layout, content hash, contradictions) and refused if it was edited, or if a record there
    states other numbers for the same computation. Scores that are there already are not computed again, so an
    interrupted batch goes on where it stopped, and a stale one is renewed.
    """
    from brainbench.cli.leaderboard.scoring import jobs_of, parse_seeds, read_batch
    from brainbench.core.errors import UsageError

    jobs: list[ScoringJob] = []
    if model:
        first, *others = parse_seeds(seeds)
        # Trained weights do not depend on a seed.
        jobs = jobs_of(model, [first], options)
        jobs += [job for job in jobs_of(model, others, options) if "." not in job.model]
        if not jobs:
            raise UsageError(f"No model matches {', '.join(map(repr, model))}; see them with: brainbench models list")
    if batch is not None:
        if options:
            raise UsageError("Options of the scores stand in the batch file itself, under [options].")
        jobs += read_batch(batch)
    if not records and not model and batch is None:
        raise UsageError("Name record files to take in, or models to score with --model or --batch.")
    done = _take_in(_files(records or []), to, keep_both=keep_both)
    done += _score(jobs, to, prune=prune, workers=workers, scheduler=scheduler)
    states = [item["state"] for item in done]
    summary = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states)) or "nothing to do"
    lines = [f"{item['state']:9} {item['record'] or item['model']}{item['note']}" for item in done]
    emit({"folder": to, "results": done}, "\n".join([*lines, f"{to}: {summary}"]), as_json=as_json)
    if "refused" in states:
        raise typer.Exit(1)


def _files(sources: list[Path]) -> list[Path]:
    from brainbench.core.errors import DataFileNotFoundError

    found: list[Path] = []
    for source in sources:
        if not source.exists():
            raise DataFileNotFoundError(f"There is no record file or folder {str(source)!r}.")
        inside = (path for path in source.rglob("*.json") if not path.name.startswith("."))
        found += sorted(inside) if source.is_dir() else [source]
    return found


def _take_in(paths: list[Path], to: Path, *, keep_both: bool) -> list[dict[str, Any]]:
    """Take in files one after the other; what one brought counts for the next."""
    present: dict[str, ResultRecord] = {item.record.identity: item.record for item in _present(to)} if paths else {}
    return [_take_in_one(path, to, present, keep_both=keep_both) for path in paths]


def _take_in_one(path: Path, to: Path, present: dict[str, ResultRecord], *, keep_both: bool) -> dict[str, Any]:
    from brainbench.core.errors import DataError
    from leaderboards.audit import conflicting, remarks
    from leaderboards.store import read_records, write_record

    result: dict[str, Any] = {"state": "refused", "record": path.name, "model": None, "note": ""}
    try:
        (stored,) = read_records(path)
        if stored.record is None:
            return result | {"note": f": {stored.problem}"}
        there = stored.record.identity in present
        rivals = conflicting(stored.record, present.values())
        if rivals and not keep_both:
            return result | {
                "model": stored.record.score.name,
                "note": f": the same computation gave {rivals[0].score.value:.4f} in a record that is there "
                f"({rivals[0].identity}) and {stored.record.score.value:.4f} here; see which holds with: "
                f"brainbench leaderboard verify {path}",
            }
        written = write_record(stored.record, to)
        present[stored.record.identity] = stored.record
    except DataError as error:
        return result | {"note": f": {error}"}
    doubts = remarks([stored]).get(stored.record.identity, ())
    note = "".join(f"\n          {doubt}" for doubt in doubts)
    state = "known" if there else "added"
    return {"state": state, "record": written.name, "model": stored.record.score.name, "note": note}


def _present(to: Path) -> list[Any]:
    from leaderboards.store import read_records

    if not to.is_dir() or not any(to.rglob("*.json")):
        return []
    return [item for item in read_records(to) if item.record is not None]


def _replaces(new: ResultRecord, old: ResultRecord) -> bool:
    """Return whether two records answer the same question, the old one with what has since changed."""
    settings = ("weights_seed", "metric", "estimator", "time", "whiskers", "stimuli", "layers")

    def question(record: ResultRecord) -> tuple[Any, ...]:
        origin = record.score.provenance
        return (record.score.name, origin.recordings.get("source"), *(origin.settings.get(name) for name in settings))

    return question(new) == question(old)


def _score(
    jobs: list[ScoringJob], to: Path, *, prune: bool, workers: int, scheduler: str | None
) -> list[dict[str, Any]]:
    from brainbench.cli.leaderboard.scoring import ScoringJob, missing
    from brainbench.core.jobs import run_jobs
    from leaderboards.store import write_record

    if not jobs:
        return []
    done: list[dict[str, Any]] = []
    with progress_bar() as progress:
        present = _present(to)
        open_jobs = missing(jobs, [item.record for item in present])
        done += [
            {"state": "known", "record": None, "model": f"{job.model} seed {job.options.model_seed}", "note": ""}
            for job in jobs
            if job not in open_jobs
        ]
        scored = run_jobs(ScoringJob.run, open_jobs, workers=workers, scheduler=scheduler)
        for index, (place, record) in enumerate(scored, start=1):
            progress(index, len(open_jobs), "models scored")
            path = write_record(record, to)
            replaced = [item for item in present if prune and item.path != path and _replaces(record, item.record)]
            for item in replaced:
                item.path.unlink(missing_ok=True)
            note = "".join(f"\n          replaces {item.path.name}" for item in replaced)
            done.append({"state": "scored", "record": path.name, "model": open_jobs[place].model, "note": note})
    return done


def verify(
    records: Annotated[list[Path], typer.Argument(help="Record files or folders of them.")],
    recordings: Annotated[
        str | None, typer.Option("--recordings", "-r", help="Where the recordings are, if not 'demo'.")
    ] = None,
    score: Annotated[
        bool, typer.Option("--score/--no-score", help="Score the model again and compare; else only read the files.")
    ] = True,
    tolerance: Annotated[float, typer.Option(help="Numbers that differ by no more are equal.")] = 1e-3,
    trust_code: Annotated[
        bool, typer.Option("--trust-code", help="Also run code and weights that do not come with this package.")
    ] = False,
    held_out: Annotated[
        Path | None, typer.Option("--held-out", help="Published commitment; also score on what it holds back.")
    ] = None,
    secret: Annotated[Path, typer.Option(help="Folder of the held-out recordings.")] = Path("held-out-secret"),
    as_json: JsonOption = False,
) -> None:
    """Check records: the file against its hash, the records against one another, the numbers against a repetition.

    Only models of the registry and weights that come with the package are repeated: code that a record names could do
    anything, and could read the answer. Exit status 1 if a file was edited, a repetition gives something else or
    cannot be made; what differs is printed.
    """
    from leaderboards.audit import remarks
    from leaderboards.store import read_records

    stored = read_records(records)
    doubts = remarks(stored)
    results: list[dict[str, Any]] = []
    with progress_bar() as progress:
        for index, item in enumerate(stored):
            progress(index, len(stored), "records verified")
            result: dict[str, Any] = {"record": item.path.name, "verdict": "refused", "problem": item.problem}
            if item.record is not None:
                result |= {"verdict": "intact", "doubts": doubts.get(item.record.identity, ())}
                if score:
                    result |= _repeat(item.record, recordings, tolerance, trust_code=trust_code)
                if held_out is not None and result["verdict"] in ("intact", "confirmed"):
                    result |= _on_held_out(item.record, held_out, secret, trust_code=trust_code)
            results.append(result)
    emit(results, "\n".join(_verdict(result) for result in results), as_json=as_json)
    if any(result["verdict"] in ("refused", "differs", "not repeated") for result in results):
        raise typer.Exit(1)


def _on_held_out(record: Any, held_out: Path, secret: Path, *, trust_code: bool) -> dict[str, Any]:
    from brainbench.cli.leaderboard.held_out import score_held_out
    from brainbench.cli.leaderboard.scoring import refuse_foreign_code
    from brainbench.core.errors import UsageError

    try:
        refuse_foreign_code(record, trusted=trust_code)
    except UsageError as error:
        return {"verdict": "not repeated", "problem": str(error)}
    return score_held_out(record, held_out, secret)


def _repeat(record: Any, recordings: str | None, tolerance: float, *, trust_code: bool) -> dict[str, Any]:
    from brainbench.cli.leaderboard.scoring import score_again
    from brainbench.core.errors import BrainbenchError
    from leaderboards.changes import differences

    try:
        again = score_again(record, recordings=recordings, trust_code=trust_code)
    except BrainbenchError as error:
        return {"verdict": "not repeated", "problem": str(error)}
    found = differences(record, again, tolerance=tolerance)
    return {"verdict": "differs" if found else "confirmed", "differences": found, "value": again.score.value}


def _verdict(result: dict[str, Any]) -> str:
    words = {
        "confirmed": "confirmed: scored again with the same result",
        "intact": "intact: the file fits its hash (not scored again)",
        "differs": "differs: scored again with another result",
        "not repeated": f"not repeated: {result['problem']}",
        "refused": f"refused: {result['problem']}",
    }
    lines = [f"{result['record']}\n  {words[result['verdict']]}"]
    lines += [f"  {doubt}" for doubt in result.get("doubts", ())]
    if held := result.get("held_out"):
        columns = {name: f"{{0[{name}]}}" for name in ("score", "low", "high", "standing")}
        rows = [{"on": "public part", **result["on_public"]}, {"on": f"held-out {held}", **result["on_held_out"]}]
        lines.append(table_of("", rows, {"on": "{0[on]}", **columns}))
    if found := result.get("differences"):
        columns = {
            "what": "{0.what}",
            "record": lambda item: _short(item.before),
            "now": lambda item: _short(item.after),
        }
        lines.append(table_of("", found[:12], columns))
        lines += [f"  and {len(found) - 12} more"] if len(found) > 12 else []
    return "\n".join(lines)


def _short(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
