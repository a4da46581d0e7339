"""``brainbench leaderboard diff``: what changed between two builds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit, table


def diff(
    before: Annotated[Path, typer.Argument(help="A folder of records, a record, or a built site.")],
    after: Annotated[Path, typer.Argument(help="The same, later.")],
    as_json: JsonOption = False,
) -> None:
    """Show which models were added, removed or changed, which ranks moved, and what caused it."""
    from leaderboards.changes import compare_builds, open_build

    old, new = open_build(before), open_build(after)
    changes = compare_builds(old, new)
    problems = [{"path": item.path, "problem": item.problem} for item in (*old, *new) if item.problem]
    told = [item for item in changes if item.kind != "restated"]
    rows = [[item.kind, item.name, item.before, item.after, "; ".join(item.causes)] for item in told]
    text = table("", ["", "model", "before", "after", "because"], rows) if rows else "No difference."
    if restated := len(changes) - len(told):
        text += f"\n{restated} restated: other records with the same inputs and numbers."
    text += "".join(f"\nleft out: {item['path']}: {item['problem']}" for item in problems)
    emit({"changes": changes, "problems": problems}, text, as_json=as_json)
