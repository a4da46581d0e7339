"""``brainbench leaderboard report``: methods, tables, figures and citations for a paper's supplement."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit


def report(
    records: Annotated[
        list[Path] | None, typer.Argument(help="Record files, folders of them or a built site; ./brainbench-results.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write; leaderboard-report.FORMAT.")] = None,
    format: Annotated[
        str | None, typer.Option("--format", "-f", help="md, html or pdf; by the suffix of --out, else html.")
    ] = None,
    title: Annotated[str, typer.Option(help="Heading of the report.")] = "Leaderboard report",
    as_json: JsonOption = False,
) -> None:
    """Write a report of result records as Markdown, HTML or PDF, with the citations as BibTeX beside it."""
    from leaderboards.changes import open_build
    from leaderboards.report.paper import write_paper

    stored = [item for source in records or [Path("brainbench-results")] for item in open_build(source)]
    kind = format or (out.suffix.removeprefix(".") if out is not None and out.suffix else "html")
    files = write_paper(stored, out or Path(f"leaderboard-report.{kind}"), format=kind, title=title)
    problems = [{"path": item.path, "problem": item.problem} for item in stored if item.problem]
    text = "\n".join([*map(str, files), *(f"  left out: {item['path']}: {item['problem']}" for item in problems)])
    emit({"files": files, "problems": problems}, text, as_json=as_json)
