"""``brainbench policy report``: compare students, with intervals over seeds."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.destinations import out_folder, picture_file
from brainbench.cli.output import Output, table, table_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotics_bridge.policies.report.results import StudentResult


def report(
    folders: Annotated[list[Path], typer.Argument(help="Folders with evaluated students.")],
    picture: Annotated[
        Path | None, typer.Option(callback=picture_file, help="Draw the comparison (.png, .svg, .pdf).")
    ] = None,
    records: Annotated[
        Path | None, typer.Option(callback=out_folder, help="Write records for brainbench leaderboard into a folder.")
    ] = None,
    at_least: Annotated[
        int, typer.Option(help="Leave out students that learned fewer iterations, and say which.", min=0)
    ] = 0,
    differences: Annotated[
        bool, typer.Option("--differences", help="Test every pair of students of a task and hand against each other.")
    ] = False,
) -> Output:
    """Print success and its 95 % interval per task, observation type and encoder, and the gain over no touch.

    Goals reached, rotation about the commanded axis (rad/s, while anything touched the object), seconds until the
    object dropped and the return follow. Intervals are t intervals over training seeds, with one training seed
    intervals over episodes. Of several runs of one training seed the longest counts. Agents in agents.json files,
    which brainbench policy evaluate --out writes, stand beside the students. Differences are those of a mixed model of
    all students of a task and hand, with draws of encoders and training seeds as random factors; p is corrected for the
    pairs (Holm).
    """
    from robotics_bridge.policies.report import records as student_records
    from robotics_bridge.policies.report import tables
    from robotics_bridge.policies.report.results import read_agents, read_results

    results, agents = read_results(folders, at_least=at_least), read_agents(folders)
    title, columns, rows = tables.concise([*tables.rows(results), *tables.agent_rows(agents)])
    first = columns.index("success")
    text = table(title, columns, rows, right=tuple(range(first, len(columns))))
    if picture is not None:
        from robotics_bridge.policies.report.figure import draw

        draw(results, picture, agents=agents)
    written = []
    if records is not None:
        from leaderboards import write_record

        written = [str(write_record(record, records)) for record in student_records.records(results)]
    data = [
        {
            "student": result.name, "success": result.value, "seeds": result.seeds,
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
    pairs = _pairs(results) if differences else []
    lines = [text, *(f"Note: {note}." for note in tables.remarks(results))]
    if differences:
        shown = {
            "first": "{0[first]}",
            "second": "{0[second]}",
            ">success": "{0[difference]:+.3f}",
            ">95 % interval": lambda item: "–" if (i := item["interval"]) is None else f"[{i[0]:+.3f}, {i[1]:+.3f}]",
            ">p (Holm)": "{0[p]:.2g}",
        }
        lines.append("\n" + table_of("First less second", pairs, shown))
    data = {"students": data, "agents": agents, "records": written, "differences": pairs}
    return Output(data, "\n".join([*lines, *written]))


def _pairs(results: Sequence[StudentResult]) -> list[dict[str, Any]]:
    """Return the differences of all pairs of each task and hand, best students first."""
    from itertools import combinations, groupby

    from brainbench.metrics.inference.multiple import adjust
    from robotics_bridge.policies.report.results import mixed_model

    found = []
    for place, members in groupby(results, key=lambda result: result.world):
        group = list(members)
        model, pairs = mixed_model(group), list(combinations(group, 2))
        tested = [model.contrast(one.name, other.name) for one, other in pairs]
        for (one, other), item, p in zip(pairs, tested, adjust([item.p for item in tested], "holm"), strict=True):
            names = [result.name.removeprefix("_".join(place[:2]) + "_") for result in (one, other)]
            interval = None if item.interval is None else (item.interval.low, item.interval.high)
            found.append(
                {
                    "task": place[0], "hand": place[1], "contacts": place[2], "first": names[0], "second": names[1],
                    "difference": item.difference, "interval": interval, "p": float(p), "spread": model.spread,
                    "degrees_of_freedom": item.freedom,
                }
            )  # fmt: skip
    return found
