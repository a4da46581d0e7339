"""``brainbench tradeoff``: measure accuracy against cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.options import items, numbers, out_file_option
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE

app = typer.Typer(no_args_is_help=True, help="Measure accuracy against cost.")


@app.command("whisker")
def whisker(
    out: Annotated[Path, out_file_option("Table (.json); points in it are kept.")] = Path("whisker-tradeoff.json"),
    links: Annotated[str, typer.Option(help="Links per whisker, comma-separated; the default grid if empty.")] = "",
    time_steps: Annotated[str, typer.Option(help="Time steps in ms, comma-separated; the default grid if empty.")] = "",
    backends: Annotated[str, typer.Option(help="Backends, comma-separated.")] = DEFAULT_ENGINE,
    collisions: Annotated[
        str, typer.Option(help="Collision geometries of concave objects to measure too, comma-separated, or all.")
    ] = "",
    solvers: Annotated[
        str, typer.Option(help="dynamic, quasistatic (of the backend rod), or both, comma-separated.")
    ] = "dynamic",
) -> Output:
    """Measure error and cost of whisker simulations over links, time step, solver, backend and collision geometry.

    The table that ships with the package (brainbench/stimuli/fidelity_table.json) is made by this command.
    """
    from brainbench.tradeoffs import study, whiskers

    shapes = tuple(items(collisions))
    chosen = whiskers.settings(
        links=numbers(links, "--links") or whiskers.LINKS,
        time_steps=tuple((1e-3 * step, None) for step in numbers(time_steps, "--time-steps", float))
        or whiskers.TIME_STEPS,
        backends=tuple(items(backends)),
        collisions=whiskers.COLLISIONS if shapes == ("all",) else shapes,
        solvers=tuple(items(solvers)),
    )
    with progress_bar() as progress:
        rows = study.run_study(whiskers.study(chosen), out, progress=progress)
    best = whiskers.best(rows)
    setting = {
        ">links": "{0[links]}",
        ">step ms": lambda row: f"{row['time_step'] * 1e3:g}",
        ">contacts to": lambda row: _number(row.get("contact_tolerance"), "g"),
    }
    cost = {">processor s / whisker-s": lambda row: _number(row["cost"], ".3g")}
    error = {f">{name}": lambda row, key=key: _number(row.get(key), ".2%") for name, key in whiskers.TAILS.items()}
    text = table_of(
        f"{len(rows)} settings measured; those that no other beats in cost and the error that 90 % stay below:",
        [point.settings | {"cost": point.cost} for point in best],
        {**error, **cost, **setting, "backend": "{0[backend]}"},
    )
    if still := [row for row in rows if row.get("solver") == "quasistatic"]:
        columns = {**error, ">pegs": "{0[static_error]:.2%}", **cost, **setting}
        text += "\n\n" + table_of("without inertia (rod, quasistatic):", still, columns)
    if hollow := [row for row in rows if row.get("collision")]:
        pieces = {"collision": "{0[collision]}", ">pieces": lambda row: row.get("pieces", "")}
        columns = {**error, **cost, **pieces, **setting, "backend": "{0[backend]}", "note": "{0[note]}"}
        text += "\n\n" + table_of("whisking into the hollow of concave objects:", hollow, columns)
    return Output({"points": rows, "front": best, "path": out}, f"{text}\n\ntable  {out}")


@app.command("tactile")
def tactile(
    out: Annotated[Path, out_file_option("Table (.json); points in it are kept.")] = Path("tactile-tradeoff.json"),
) -> Output:
    """Measure error and cost of tactile queries over backend, resolution, surface points and taxels.

    The table that ships with the package (robotics_bridge/sensors/fidelity_table.json) is made by this command.
    """
    from brainbench.tradeoffs import sensors, study

    with progress_bar() as progress:
        rows = study.run_study(sensors.study(), out, progress=progress)
    columns = {
        "part": "{0[part]}",
        ">setting": lambda row: row.get("points") or row.get("taxels") or row["query"],
        "resolution": lambda row: f"{row['resolution']} cells" if row.get("resolution") else "",
        ">error": "{0[error]:.2e}",
        ">µs / environment": "{0[cost]:.2f}",
    }
    text = table_of("relative force errors against double precision", rows, columns)
    return Output({"points": rows, "path": out}, f"{text}\n\ntable  {out}")


def _number(value: float | None, form: str) -> str:
    return "—" if value is None else format(value, form)
