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
    at_least: Annotated[
        int, typer.Option(help="Leave out students that learned fewer iterations, and say which.", min=0)
    ] = 0,
    as_json: JsonOption = False,
) -> None:
    """Print success and its 95 % interval per task, observation type and encoder, and the gain over no touch.

    Goals reached, rotation about the commanded axis (rad/s, while anything touched the object), seconds until the
    object dropped and the return follow. Intervals are t intervals over training seeds, with one training seed
    intervals over episodes. Of several runs of one training seed the longest counts. Agents in agents.json files,
    which brainbench policy evaluate --out writes, stand beside the students.
    """
    from robotics_bridge.policies import report as students

    results, agents = students.read_results(folders, at_least=at_least), students.read_agents(folders)
    rows = [*students.rows(results), *students.agent_rows(agents)]
    title, columns, rows = students.concise(rows)
    first = columns.index("success")
    text = table(title, columns, rows, right=tuple(range(first, len(columns))))
    if picture is not None:
        students.draw(results, picture, agents=agents)
    written = []
    if records is not None:
        from leaderboards import write_record

        written = [str(write_record(record, records)) for record in students.records(results)]
    data = [
        {
            "student": result.config.name.rpartition("_seed")[0], "success": result.value, "seeds": result.seeds,
            "interval": result.interval, "over_none": result.difference, "gain": result.gain,
            "episodes": result.episodes, "metric": result.metric, "note": result.note, "iterations": result.iterations,
            "per_seed": [
                {"seed": seed, "success": share, "iterations": learned}
                for seed, share, learned in zip(result.seeds, result.success, result.learned, strict=True)
            ],
            "left_out": [vars(item) for item in result.left_out],
            "graded": {name: {"mean": mean, "half_width": half} for name, (mean, half) in result.graded.items()},
        }
        for result in results
    ]  # fmt: skip
    lines = [text, *(f"Note: {note}." for note in students.remarks(results)), *written]
    emit({"students": data, "agents": agents, "records": written}, "\n".join(lines), as_json=as_json)
