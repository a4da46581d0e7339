"""``brainbench models``: what can be scored by name."""

from __future__ import annotations

from typing import Annotated

import typer

from brainbench.cli._shared import JsonOption, emit, table

app = typer.Typer(no_args_is_help=True, help="List and describe the registered models.")


@app.command("list")
def list_(
    pattern: Annotated[str, typer.Argument(help="Shell pattern, e.g. '*-ln*'.")] = "*", as_json: JsonOption = False
) -> None:
    """List the registered models with their sizes."""
    from brainbench.models.registry import describe_model, list_models

    records = [describe_model(name) for name in list_models(pattern)]
    rows = [[item.name, f"{item.parameters:,}", _millions(item.multiply_adds), item.family] for item in records]
    columns = ["model", "parameters", "multiply-adds/step", "family"]
    emit(records, table("", columns, rows, right=(1, 2)), as_json=as_json)


@app.command("show")
def show(name: Annotated[str, typer.Argument(help="A registry name.")], as_json: JsonOption = False) -> None:
    """Describe one model: size, layers, input and citation."""
    from brainbench.files import to_plain
    from brainbench.models.registry import describe_model

    record = describe_model(name)
    rows = [[key.replace("_", " "), _text(value)] for key, value in to_plain(record).items()]
    emit(record, table("", ["", ""], rows), as_json=as_json)


def _millions(value: int | None) -> str:
    return "–" if value is None else f"{value / 1e6:,.0f} M"


def _text(value: object) -> str:
    if isinstance(value, int) and not isinstance(value, bool):
        return f"{value:,}"
    if isinstance(value, list):
        return ", ".join(map(str, value))
    if isinstance(value, dict):
        return "; ".join(f"{key}: {_text(item)}" for key, item in value.items())
    return str(value)
