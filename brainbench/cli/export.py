"""``brainbench export``: write a model's streaming step for other runtimes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.output import JsonOption, emit


def export(
    model: Annotated[str, typer.Argument(help="A registry name, or local-dir:FOLDER of a trained model.")],
    format: Annotated[str, typer.Option(help="onnx, or torch (an exported program).")] = "onnx",
    out: Annotated[Path | None, typer.Option("--out", "-o", help="File to write.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of untrained weights.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Export one step, obs and h_in to features and h_out, with its contract, and check the written file."""
    from brainbench.models.export import SUFFIXES, export_model
    from brainbench.models.registry import load_model
    from brainbench.models.training.checkpoints import PREFIXES, find_folder

    loaded = load_model(model, seed=seed)
    name = find_folder(model).resolve().name if model.startswith(PREFIXES) else model
    made = export_model(loaded, out or Path(f"{name}{SUFFIXES.get(format, '')}"), format=format, name=model)
    text = (
        f"{model}: {made.features} features, {made.state_size:,} numbers of state; the file agrees with the network "
        f"to {made.difference:.1e}\n\nfile      {made.path}\ncontract  {made.contract}"
    )
    emit(made, text, as_json=as_json)
