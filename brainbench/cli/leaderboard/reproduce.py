"""``brainbench leaderboard reproduce``: which claims of the published study hold in a campaign of trainings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.destinations import out_folder_option
from brainbench.cli.output import JsonOption, emit, table_of


def reproduce(
    folder: Annotated[Path, typer.Argument(help="Folder with trainings.jsonl and records/.")],
    out: Annotated[Path, out_folder_option("Folder of the page.")] = Path("reproduction"),
    as_json: JsonOption = False,
) -> None:
    """Judge every claim of the published study on a campaign, and write the page with figures 3.3 to 3.8."""
    from leaderboards.reproduction.campaign import read_campaign
    from leaderboards.reproduction.page import write_page
    from leaderboards.text import number, span

    files, found = write_page(read_campaign(folder), out)
    columns = {
        "claim": "{0.claim.key}",
        "ours": lambda item: f"{number(item.effect.value)} {span(item.effect.interval)}" if item.effect else "–",
        "verdict": "{0.verdict}",
        "rule": "{0.rule}",
    }
    emit({"files": files, "judgements": found}, f"{table_of('', found, columns)}\n{files[0]}", as_json=as_json)
