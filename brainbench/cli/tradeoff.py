"""``brainbench tradeoff``: measure accuracy against cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli.destinations import out_file, out_file_option, picture_file
from brainbench.cli.options import items, numbers
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE

_PLOT = typer.Option(callback=picture_file, help="Also draw error against cost (.png, .svg, .pdf).")
PlotOption = Annotated[Path | None, _PLOT]

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
    csv: Annotated[Path | None, typer.Option(callback=out_file, help="Also write the table as CSV.")] = None,
    plot: PlotOption = None,
) -> Output:
    """Measure error and cost of whisker simulations over links, time step, solver, backend and collision geometry.

    The table that ships with the package (brainbench/stimuli/fidelity_table.json) is made by this command.
    """
    from brainbench.stimuli import tradeoff

    shapes = tuple(items(collisions))
    chosen = tradeoff.settings(
        links=numbers(links, "--links") or tradeoff.LINKS,
        time_steps=tuple((1e-3 * step, None) for step in numbers(time_steps, "--time-steps", float))
        or tradeoff.TIME_STEPS,
        backends=tuple(items(backends)),
        collisions=tradeoff.COLLISIONS if shapes == ("all",) else shapes,
        solvers=tuple(items(solvers)),
    )
    with progress_bar() as progress:
        points = tradeoff.measure_tradeoff(out, chosen, progress=progress)
    if csv is not None:
        tradeoff.write_csv(points, csv)
    if plot is not None:
        from brainbench.stimuli.figures.tradeoff import plot_tradeoff

        plot_tradeoff(points, plot)
    best = tradeoff.front(points)
    setting = {
        ">links": "{0[links]}",
        ">step ms": lambda point: f"{point['time_step'] * 1e3:g}",
        ">contacts to": lambda point: _known(point.get("contact_tolerance"), "g"),
    }
    cost = {">processor s / whisker-s": lambda point: _known(point["cost"], ".3g")}
    text = table_of(
        f"{len(points)} settings measured; those that no other beats in cost and error (90 % of whiskers stay below):",
        [point.settings | {"error": point.error, "cost": point.cost} for point in best],
        {">error": "{0[error]:.2%}", **cost, **setting, "backend": "{0[backend]}"},
    )
    if still := [point for point in points if point.get("solver") == "quasistatic"]:
        columns = {">error": lambda point: _known(point[tradeoff.ERROR], ".2%"), ">pegs": "{0[static_error]:.2%}"}
        text += "\n\n" + table_of("without inertia (rod, quasistatic):", still, columns | cost | setting)
    if hollow := tradeoff.collision_points(points):
        columns = {
            ">error": lambda point: _known(point[tradeoff.ERROR], ".2%"),
            **cost,
            "collision": "{0[collision]}",
            ">pieces": lambda point: point.get("pieces", ""),
            **setting,
            "backend": "{0[backend]}",
            "note": "{0[note]}",
        }
        text += "\n\n" + table_of("whisking into the hollow of concave objects:", hollow, columns)
    return Output({"points": points, "front": best, "path": out}, f"{text}\n\ntable  {out}")


@app.command("score")
def score(
    animals: Annotated[int, typer.Option(help="Synthetic animals.")] = 4,
    units: Annotated[int, typer.Option(help="Units of each.")] = 40,
    trials: Annotated[int, typer.Option(help="Trials of each stimulus.")] = 20,
    repeats: Annotated[int, typer.Option(help="Seeds per setting; their spread is the error.")] = 8,
) -> Output:
    """Measure the Monte-Carlo error of a score against its time: split halves and permutations."""
    from brainbench.metrics.tradeoff import measure_tradeoff

    with progress_bar() as progress:
        points = measure_tradeoff(animals=animals, units=units, trials=trials, repeats=repeats, progress=progress)
    text = table_of(
        f"{animals} animals, {units} units, {trials} trials per stimulus; standard deviation over {repeats} seeds",
        points,
        {
            "quantity": lambda point: point.quantity.replace("_", " "),
            "number": lambda point: f"{point.count:,}" + ("  (default)" if point.default else ""),
            ">error": "{0.error:.2g}",
            "of": "{0.of}",
            ">s": "{0.seconds:.2f}",
        },
    )
    return Output({"points": points}, text)


@app.command("model")
def model(
    name: Annotated[str, typer.Argument(help="A registry name, or local-dir:FOLDER of a trained model.")],
    precisions: Annotated[str, typer.Option(help="float32, bf16, int8, comma-separated.")] = "float32,bf16,int8",
    unrolls: Annotated[str, typer.Option(help="biological, full, comma-separated.")] = "biological",
    steps: Annotated[str, typer.Option(help="Last steps of the sweeps that are shown, comma-separated.")] = "22",
    score: Annotated[bool, typer.Option(help="Also score every setting on the demo recordings.")] = False,
    data: Annotated[Path | None, typer.Option(help="Folder of sweeps: also measure test accuracy.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of untrained weights.")] = 0,
) -> Output:
    """Measure error, latency, score and accuracy of a network over precision, unrolling and number of steps."""
    from brainbench.models import tradeoff
    from brainbench.stimuli import load_stimuli

    chosen = tradeoff.settings(items(precisions), items(unrolls), list(numbers(steps, "--steps")))
    results = []
    with progress_bar() as progress:
        sweeps = load_stimuli("rodgers", whiskers="all", fidelity=None, progress=progress).input
        for done, setting in enumerate(chosen):
            point = tradeoff.measure(name, setting, sweeps, seed=seed)
            found = {"setting": setting, "error": point.error, "ms": point.cost, **point.settings}
            reduced = tradeoff.Reduced(name, setting, seed=seed)
            if score:
                import brainbench

                found["score"] = brainbench.score(reduced).value
            if data is not None:
                from brainbench.datasets import WhiskingDataset
                from brainbench.models.training.evaluation import evaluate

                accuracy = evaluate(reduced, WhiskingDataset(data, split="test", shuffle=False))
                found |= {"top1": accuracy.top1, "top5": accuracy.top5}
            results.append(found)
            progress(done + 1, len(chosen), "settings")
    columns = {
        "precision": "{0[precision]}",
        "unrolling": "{0[unroll]}",
        ">steps": "{0[steps]}",
        ">error": "{0[error]:.2%}",
        ">ms / sweep": "{0[ms]:.2f}",
        ">p99 ms": "{0[p99_ms]:.2f}",
        ">MB": lambda item: f"{item['stored_bytes'] / 1e6:.2f}",
        ">score": lambda item: _known(item.get("score"), ".3f"),
        ">top-1": lambda item: _known(item.get("top1"), ".3f"),
    }
    return Output(results, table_of(f"{name}, batch 1:", results, columns))


@app.command("tactile")
def tactile(
    out: Annotated[Path, out_file_option("Table (.json).")] = Path("tactile-tradeoff.json"),
    plot: PlotOption = None,
) -> Output:
    """Measure error and cost of tactile queries over backend, resolution, surface points and taxels.

    The table that ships with the package (robotics_bridge/sensors/fidelity_table.json) is made by this command.
    """
    from robotics_bridge.sensors import tradeoff

    with progress_bar() as progress:
        points = tradeoff.measure_tradeoff(out, progress=progress)
    if plot is not None:
        tradeoff.plot_tradeoff(points, plot)
    columns = {
        "part": "{0[part]}",
        ">setting": lambda point: point.get("points") or point.get("taxels") or point["query"],
        "resolution": lambda point: f"{point['resolution']} cells" if point.get("resolution") else "",
        ">error": "{0[error]:.2e}",
        ">µs / environment": "{0[cost]:.2f}",
    }
    text = table_of("relative force errors against double precision", points, columns)
    return Output({"points": points, "path": out}, f"{text}\n\ntable  {out}")


def _known(value: float | None, form: str) -> str:
    return "—" if value is None else format(value, form)
