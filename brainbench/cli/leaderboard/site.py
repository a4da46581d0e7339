"""``brainbench leaderboard build | report | serve | diff``: what people read of a folder of records."""

from __future__ import annotations

import contextlib
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, table_of

RECORDS = Path("brainbench-results")
"""Folder that is read where none is named."""


def build(
    records: Annotated[
        list[Path] | None, typer.Argument(help="Record files or folders of them; ./brainbench-results by default.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the site.")] = Path("leaderboard"),
    title: Annotated[str, typer.Option(help="Title of the page.")] = "Which networks process touch like a brain?",
    as_json: JsonOption = False,
) -> None:
    """Write the static site of a leaderboard: a folder of pages that need no server and no network."""
    from leaderboards.site.build import build_leaderboard
    from leaderboards.store import read_records

    sources = records or [RECORDS]
    for source in sources:
        _require(source)
    stored = read_records(sources)
    page = build_leaderboard(stored, out, title=title)
    good = [item for item in stored if not item.problem]
    bad = _problems(stored)
    text = f"{page}  ({len(good)} records, {len(bad)} with problems)"
    text += "".join(f"\n  {item['path']}: {item['problem']}" for item in bad)
    emit({"page": page, "records": len(good), "problems": bad}, text, as_json=as_json)


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

    stored = [item for source in records or [RECORDS] for item in open_build(source)]
    kind = format or (out.suffix.removeprefix(".") if out is not None and out.suffix else "html")
    files = write_paper(stored, out or Path(f"leaderboard-report.{kind}"), format=kind, title=title)
    problems = _problems(stored)
    text = "\n".join([*map(str, files), *(f"  left out: {item['path']}: {item['problem']}" for item in problems)])
    emit({"files": files, "problems": problems}, text, as_json=as_json)


def serve(
    source: Annotated[Path, typer.Argument(help="A built site, or a folder of records to build one from.")] = RECORDS,
    host: Annotated[str, typer.Option(help="Address to listen on; the default is seen by this machine alone.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(help="Port; 0 takes a free one.")] = 8000,
    as_json: JsonOption = False,
) -> None:
    """Serve a leaderboard for local reading, without writing anything; stop it with Ctrl-C."""
    from leaderboards.site.build import build_leaderboard
    from leaderboards.site.serve import LOOPBACK, make_server
    from leaderboards.store import read_records

    _require(source)
    with tempfile.TemporaryDirectory() as folder:
        built = (source / "index.html").is_file() and (source / "data").is_dir()
        site = source if built else build_leaderboard(read_records(source), Path(folder) / "site").parent
        server = make_server(site, host=host, port=port)
        shown = f"[{host}]" if ":" in host else host
        address = f"http://{shown}:{server.server_address[1]}/"
        everyone = "" if host in LOOPBACK else "\nOther machines can read this."
        emit({"address": address, "site": site}, f"{address}  (Ctrl-C ends){everyone}", as_json=as_json)
        sys.stdout.flush()
        with server, contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


def diff(
    before: Annotated[Path, typer.Argument(help="A folder of records, a record, or a built site.")],
    after: Annotated[Path, typer.Argument(help="The same, later.")],
    as_json: JsonOption = False,
) -> None:
    """Show which models were added, removed or changed, which ranks moved, and what caused it."""
    from leaderboards.changes import compare_builds, open_build

    old, new = open_build(before), open_build(after)
    changes = compare_builds(old, new)
    problems = _problems([*old, *new])
    told = [item for item in changes if item.kind != "restated"]
    columns = {
        "": "{0.kind}",
        "model": "{0.name}",
        "before": "{0.before}",
        "after": "{0.after}",
        "because": lambda item: "; ".join(item.causes),
    }
    text = table_of("", told, columns) if told else "No difference."
    if restated := len(changes) - len(told):
        text += f"\n{restated} restated: other records with the same inputs and numbers."
    text += "".join(f"\nleft out: {item['path']}: {item['problem']}" for item in problems)
    emit({"changes": changes, "problems": problems}, text, as_json=as_json)


def _require(source: Path) -> None:
    from brainbench.core.errors import DataFileNotFoundError

    if not source.exists():
        raise DataFileNotFoundError(
            f"There is no file or folder {str(source)!r} to read result records from; "
            "make one first, for example with: brainbench score zhuang-intersection-ln"
        )


def _problems(stored: Any) -> list[dict[str, Any]]:
    return [{"path": item.path, "problem": item.problem} for item in stored if item.problem]
