"""``brainbench score``: the main job."""

from __future__ import annotations

import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli import destinations
from brainbench.cli.destinations import out_folder_option
from brainbench.cli.options import SCORE, SCORE_FLAGS, typed_options, with_options
from brainbench.cli.output import Output, progress_bar
from brainbench.core.errors import UsageError

if TYPE_CHECKING:
    from brainbench.scoring.options import ScoreOptions


def _complete_model(incomplete: str) -> list[str]:
    from brainbench.models.registry import list_models
    from brainbench.models.training.checkpoints import shipped

    return [name for name in (*list_models(), *shipped()) if name.startswith(incomplete)]


@with_options(SCORE, flags=SCORE_FLAGS)
def score(
    model: Annotated[
        str,
        typer.Argument(
            help="A registry name, FILE.py:FUNCTION that returns a torch module, or an HDF5 file of activations.",
            autocompletion=_complete_model,
        ),
    ],
    options: ScoreOptions,
    out: Annotated[Path, out_folder_option("Folder of record and report.")] = Path("brainbench-results"),
    report_file: Annotated[
        Path | None,
        typer.Option(
            "--report",
            callback=destinations.report_file,
            help="Also write a report for a paper: FILE.md, FILE.html or FILE.pdf.",
        ),
    ] = None,
) -> Output:
    """Score a model against neural recordings and write a result record and an HTML report."""
    from brainbench.cli.score_text import score_text, walk_text
    from brainbench.core.files import to_plain
    from brainbench.scoring.kept_records import keep, read_kept, record_path
    from leaderboards.site.score_page import write_report
    from leaderboards.store import write_record

    if options.explain and Path(model).suffix == ".npz":
        from brainbench.core.plugins import require_optional
        from brainbench.scoring.scores import PARTS

        if options != replace(type(options)(), explain=True) or report_file is not None:
            raise UsageError("A file of stored splits is explained by itself; leave out all options but --json.")
        steps = to_plain(require_optional(PARTS, "explain_file", "part of a score")(model))
        return Output({"estimator_walk": steps}, walk_text(steps))
    command = _command()
    cached = record_path(model, options, command)
    record, note = read_kept(cached), "  (as scored before: nothing has changed since)"
    if record is None:
        from brainbench.scoring.scores import score_record

        # Beside a benchmark a default that was typed is a choice too.
        typed = {name: getattr(options, name) for name in typed_options(sys.argv) if options.benchmark is not None}
        with progress_bar() as progress:
            record, note = score_record(model, options, command=command, progress=progress, **typed), ""
        keep(record, cached)
    path = write_record(record, out)
    report = write_report(record, path.with_suffix(".html"))
    data: dict[str, Any] = {"record": record, "record_path": path, "report_path": report}
    text = f"{score_text(record)}\n\nrecord  {path}{note}\nreport  {report}"
    if report_file is not None:
        from leaderboards.report.paper import write_paper

        data["paper_paths"] = write_paper([record], report_file, title=f"{record.score.name}: brainbench score")
        text += f"\npaper   {', '.join(map(str, data['paper_paths'][:2]))}"
    return Output(data, text)


def _command() -> str:
    """Return the command as typed, without what only says where and how to print."""
    words = iter(sys.argv[1:])
    typed = []
    for word in words:
        if word in ("--out", "-o", "--report"):
            next(words, None)
        elif word not in ("--json", "-v", "--verbose") and not word.startswith(("--out=", "--report=")):
            typed.append(word)
    return shlex.join(["brainbench", *typed])
