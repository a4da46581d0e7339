"""``brainbench leaderboard build | report | diff``: what people read of a folder of records."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.options import out_file_option, out_folder_option
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.core.errors import DataError, visible
from leaderboards.audit import compare_builds, open_build
from leaderboards.store import StoredRecord, read_records

RECORDS = Path("brainbench-results")  # folder that is read where none is named


def build(
    records: Annotated[
        list[Path] | None, typer.Argument(help="Record files or folders of them; ./brainbench-results by default.")
    ] = None,
    out: Annotated[Path, out_folder_option("Folder of the site.")] = Path("leaderboard"),
    title: Annotated[str, typer.Option(help="Title of the page.")] = "Which networks process touch like a brain?",
    show: Annotated[bool, typer.Option("--open", help="Open the site in a browser.")] = False,
) -> Output:
    """Write the static site of a leaderboard: a folder of pages that need no server and no network."""
    from leaderboards.site.build import build_leaderboard

    stored = read_records(records or [RECORDS], light=True)
    problems = _problems(stored)
    good = len(stored) - len(problems)
    if not good:
        raise DataError(f"None of these records can be read, so no board is written.{_left_out(problems)}")
    with progress_bar("building the pages"):
        page = build_leaderboard(stored, out, title=title)
    text = f"{page}  ({good} records, {len(problems)} with problems){_left_out(problems)}"
    if show and not webbrowser.open(page.resolve().as_uri()):
        typer.echo("No browser could be opened here; open the file above.", err=True)
    return Output({"page": page, "records": good, "problems": problems}, text)


def report(
    records: Annotated[
        list[Path] | None, typer.Argument(help="Record files, folders of them or a built site; ./brainbench-results.")
    ] = None,
    out: Annotated[Path | None, out_file_option("File to write; leaderboard-report.FORMAT.")] = None,
    format: Annotated[
        str | None, typer.Option("--format", "-f", help="md, html or pdf; by the suffix of --out, else html.")
    ] = None,
    title: Annotated[str, typer.Option(help="Heading of the report.")] = "Leaderboard report",
) -> Output:
    """Write a report of result records as Markdown, HTML or PDF, with the citations as BibTeX beside it."""
    from leaderboards.report.paper import write_paper

    stored = open_build(*(records or [RECORDS]))
    kind = format or (out.suffix.removeprefix(".") if out is not None and out.suffix else "html")
    with progress_bar("writing the report"):
        files = write_paper(stored, out or Path(f"leaderboard-report.{kind}"), format=kind, title=title)
    problems = _problems(stored)
    return Output({"files": files, "problems": problems}, "\n".join(map(str, files)) + _left_out(problems))


def diff(
    before: Annotated[Path, typer.Argument(help="A folder of records, a record, or a built site.")],
    after: Annotated[Path, typer.Argument(help="The same, later.")],
) -> Output:
    """Show which models were added, removed or changed, which ranks moved, and what caused it."""
    old, new = open_build(before), open_build(after)
    changes = compare_builds(old, new)
    problems = _problems([*old, *new])
    rows = [item for item in changes if item.kind != "restated"]
    columns = {
        "": "{0.kind}",
        "model": "{0.name}",
        "before": "{0.before}",
        "after": "{0.after}",
        "because": lambda change: "; ".join(change.causes),
    }
    text = table_of("", rows, columns) if rows else "No difference."
    if restated := len(changes) - len(rows):
        text += f"\n{restated} restated: other records with the same inputs and numbers."
    return Output({"changes": changes, "problems": problems}, text + _left_out(problems))


def _problems(stored: list[StoredRecord]) -> list[dict[str, Any]]:
    return [{"path": item.path, "problem": item.problem} for item in stored if item.problem]


def _left_out(problems: list[dict[str, Any]]) -> str:
    return "".join(f"\n  left out: {visible(item['path'])}: {visible(item['problem'])}" for item in problems)
