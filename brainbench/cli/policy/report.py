"""``brainbench policy report``: compare students, with intervals over seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli._shared import JsonOption, emit, table


def report(
    folders: Annotated[list[Path], typer.Argument(help="Folders with evaluated students.")],
    picture: Annotated[Path | None, typer.Option(help="Draw the comparison into a PNG.")] = None,
    records: Annotated[
        Path | None, typer.Option(help="Write records for brainbench leaderboard into a folder.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print success and its 95 % interval per task, observation type and encoder, and the gain over no touch."""
    from robotics_bridge.policies import report as students

    results = students.read_results(folders)
    notes = list(dict.fromkeys(result.note for result in results if result.note))
    text = table("", list(students.COLUMNS), students.rows(results), right=(7,))
    if picture is not None:
        students.draw(results, picture)
    written = []
    if records is not None:
        from leaderboards import write_record

        written = [str(write_record(record, records)) for record in students.records(results)]
    data = [
        {
            "student": result.config.name.rpartition("_seed")[0], "success": result.value, "seeds": result.seeds,
            "interval": result.interval, "over_none": result.difference, "episodes": result.episodes,
            "metric": result.metric, "note": result.note,
        }
        for result in results
    ]  # fmt: skip
    lines = [text, *(f"Note: {note}." for note in notes), *written]
    emit({"students": data, "records": written}, "\n".join(lines), as_json=as_json)
