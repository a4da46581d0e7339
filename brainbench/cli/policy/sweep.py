"""``brainbench policy sweep``: all students of a file; count them, list them, or distil those that are missing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table
from brainbench.cli.policy.options import DeviceOption


def sweep(
    file: Annotated[Path | None, typer.Argument(help="A sweep (TOML); by default table 4.10 of the thesis.")] = None,
    subset: Annotated[str, typer.Option(help="all, types, encoders, or an observation type.")] = "all",
    count: Annotated[bool, typer.Option("--count", help="Print how many students there are, and stop.")] = False,
    names: Annotated[bool, typer.Option("--list", help="Print their names, and stop.")] = False,
    out: Annotated[Path, typer.Option(help="Folder of the runs.")] = Path("students"),
    shard: Annotated[str, typer.Option(help="Part of the students, as 0/4.")] = "0/1",
    envs: Annotated[int | None, typer.Option(help="Environments at once, in place of the file's.")] = None,
    iterations: Annotated[int | None, typer.Option(help="In place of the file's.")] = None,
    episodes: Annotated[int, typer.Option(help="Of the evaluation, per seed.")] = 100,
    device: DeviceOption = "cpu",
    as_json: JsonOption = False,
) -> None:
    """Distil every student of a sweep that is not finished yet; what was interrupted goes on."""
    from dataclasses import replace

    from robotics_bridge.policies.report import EVALUATION
    from robotics_bridge.policies.training.students import train_student
    from robotics_bridge.policies.training.sweep import PUBLISHED, read_sweep

    found = read_sweep(file or PUBLISHED)
    if count:
        numbers = found.count(subset)
        rows = [[name, str(value)] for name, value in {**numbers["entries"], **numbers["types"]}.items()]
        more = numbers["students"] - numbers["published"]
        extra = f" ({numbers['published']} without {', '.join(found.extra_types)})" if more else ""
        text = table("", ["entry or type", "students"], rows, right=(1,))
        emit(numbers, f"{text}\n\n{numbers['students']} students in {found.name}, {subset}{extra}", as_json=as_json)
        return
    part, parts = _shard(shard)
    changes: dict[str, Any] = {"num_envs": envs, "iterations": iterations}
    changes = {name: value for name, value in changes.items() if value is not None}
    students = [replace(student, **changes) for student in found.students(subset)][part::parts]
    if names:
        emit([student.name for student in students], "\n".join(student.name for student in students), as_json=as_json)
        return
    results = []
    for student in students:
        folder = out / student.name
        if (folder / EVALUATION).is_file():
            results.append({"student": student.name, "status": "there already"})
            continue
        with progress_bar() as progress:
            done = train_student(student, folder, device=device, episodes=episodes, progress=progress)
        results.append({"student": student.name, "status": done.result.status})
    emit(results, "\n".join(f"{item['student']}: {item['status']}" for item in results), as_json=as_json)


def _shard(text: str) -> tuple[int, int]:
    from brainbench.core.errors import UsageError

    part, slash, parts = text.partition("/")
    if not (slash and part.isdigit() and parts.isdigit() and 0 <= int(part) < int(parts)):
        raise UsageError(f"A shard is given as its number and their count, such as 0/4; received {text!r}.")
    return int(part), int(parts)
