"""``brainbench leaderboard``: from result records to a page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit


def build(
    records: Annotated[
        list[Path] | None, typer.Argument(help="Record files or folders of them; ./brainbench-results by default.")
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the site.")] = Path("leaderboard"),
    title: Annotated[str, typer.Option(help="Title of the page.")] = "Which networks process touch like a brain?",
    as_json: JsonOption = False,
) -> None:
    """Write the static site of a leaderboard: a folder of pages that need no server and no network."""
    from brainbench.core.errors import DataFileNotFoundError
    from leaderboards.site.site import build_leaderboard
    from leaderboards.store import read_records

    sources = records or [Path("brainbench-results")]
    for source in sources:
        if not source.exists():
            raise DataFileNotFoundError(
                f"There is no file or folder {str(source)!r} to read result records from; "
                "make one first, for example with: brainbench score zhuang-intersection-ln"
            )
    stored = read_records(sources)
    page = build_leaderboard(stored, out, title=title)
    good = [item for item in stored if not item.problem]
    bad = [{"path": item.path, "problem": item.problem} for item in stored if item.problem]
    text = f"{page}  ({len(good)} records, {len(bad)} with problems)"
    for item in bad:
        text += f"\n  {item['path']}: {item['problem']}"
    emit({"page": page, "records": len(good), "problems": bad}, text, as_json=as_json)
