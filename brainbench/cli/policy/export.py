"""``brainbench policy export``: a student as a file for a robot, with its contract."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit


def export(
    run: Annotated[Path, typer.Argument(help="A shipped student, or a folder of brainbench policy distill.")],
    out: Annotated[
        Path | None, typer.Option(help="File to write; by default policy.onnx in the folder of the run, or here.")
    ] = None,
    format: Annotated[str, typer.Option(help="onnx or jit.")] = "onnx",
    as_json: JsonOption = False,
) -> None:
    """Write a student with normalisers, taxel grid, encoder and head in one file, and compare it step by step."""
    from robotics_bridge.policies.export import STEPS, SUFFIXES, export_policy
    from robotics_bridge.policies.training.distill import load_student

    student, described = load_student(run)
    suffix = SUFFIXES.get(format, "")
    target = out or (run / f"policy{suffix}" if run.exists() else Path(f"{run.name}{suffix}"))
    found = export_policy(student, target, format=format, deployment=described["deployment"], name=run.name)
    text = (
        f"{found.path}: {found.state_size:,} numbers of memory; {STEPS} steps with resets differ by at most "
        f"{found.difference:.1e} of the largest action\n{found.contract}"
    )
    emit(found, text, as_json=as_json)
