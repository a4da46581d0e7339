"""``brainbench tradeoff``: measure accuracy against cost."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table
from brainbench.stimuli.engines import DEFAULT_ENGINE

app = typer.Typer(no_args_is_help=True, help="Measure accuracy against cost.")


@app.command("whisker")
def whisker(
    out: Annotated[Path, typer.Option("--out", "-o", help="Table (.json); points in it are kept.")] = Path(
        "whisker-tradeoff.json"
    ),
    links: Annotated[str, typer.Option(help="Links per whisker, comma-separated; the default grid if empty.")] = "",
    time_steps: Annotated[str, typer.Option(help="Time steps in ms, comma-separated; the default grid if empty.")] = "",
    backends: Annotated[str, typer.Option(help="Backends, comma-separated.")] = DEFAULT_ENGINE,
    collisions: Annotated[
        str, typer.Option(help="Collision geometries of a concave object to measure too, comma-separated, or all.")
    ] = "",
    solvers: Annotated[
        str, typer.Option(help="dynamic, quasistatic (of the backend rod), or both, comma-separated.")
    ] = "dynamic",
    csv: Annotated[Path | None, typer.Option(help="Also write the table as CSV.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Also draw error against cost (.png, .svg, .pdf).")] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure error and cost of whisker simulations over links, time step, solver, backend and collision geometry.

    The table that ships with the package (brainbench/stimuli/fidelity_table.json) is made by this command.
    """
    from brainbench.core.errors import UsageError
    from brainbench.stimuli import tradeoff

    try:
        counts = tuple(int(item) for item in links.split(",") if item.strip()) or tradeoff.LINKS
        steps = tuple((float(item) * 1e-3, None) for item in time_steps.split(",") if item.strip())
    except ValueError as error:
        raise UsageError(f"--links and --time-steps take numbers separated by commas ({error}).") from error
    names = tuple(item.strip() for item in backends.split(",") if item.strip())
    shapes = tuple(item.strip() for item in collisions.split(",") if item.strip())
    chosen = tradeoff.settings(
        links=counts,
        time_steps=steps or tradeoff.TIME_STEPS,
        backends=names,
        collisions=tradeoff.COLLISIONS if shapes == ("all",) else shapes,
        solvers=tuple(item.strip() for item in solvers.split(",") if item.strip()),
    )
    with progress_bar() as progress:
        points = tradeoff.measure_tradeoff(out, chosen, progress=progress)
    if csv is not None:
        tradeoff.write_csv(points, csv)
    if plot is not None:
        tradeoff.plot_tradeoff(points, plot)
    best = tradeoff.front(points)
    rows = [
        [
            f"{point.error:.2%}",
            f"{point.cost:.3g}",
            str(point.settings["links"]),
            f"{point.settings['time_step'] * 1e3:g}",
            str(point.settings["backend"]),
        ]
        for point in best
    ]
    text = table(
        f"{len(points)} settings measured; bench tests that no other beats in both error and cost:",
        ["error", "processor s / whisker-s", "links", "step ms", "backend"],
        rows,
        right=(0, 1, 2, 3),
    )
    still = [point for point in points if point.get("solver") == "quasistatic" and point["error"] is not None]
    if still:
        rows = [
            [
                *(f"{point[name]:.2%}" for name in ("static_error", "dynamic_error", "sliding_error", "flick_error")),
                f"{point['cost']:.3g}",
                str(point["links"]),
                f"{point['time_step'] * 1e3:g}",
            ]
            for point in still
        ]
        columns = ["pegs", "whisking", "with friction", "flicks", "processor s / whisker-s", "links", "step ms"]
        title = "without inertia (rod, quasistatic), error by test:"
        text += "\n\n" + table(title, columns, rows, right=tuple(range(7)))
    hollow = tradeoff.collision_points(points)
    if hollow:
        rows = [
            [
                f"{point['error']:.2%}" if point["error"] is not None else "—",
                f"{point['cost']:.3g}" if point["cost"] is not None else "—",
                point["collision"],
                str(point.get("pieces", "")),
                str(point["links"]),
                f"{point['time_step'] * 1e3:g}",
                point["backend"],
                point["note"],
            ]
            for point in hollow
        ]
        columns = ["error", "processor s / whisker-s", "collision", "pieces", "links", "step ms", "backend", "note"]
        text += "\n\n" + table("whisking into the hollow of a concave object:", columns, rows, right=(0, 1, 3, 4, 5))
    emit({"points": points, "front": best, "path": out}, f"{text}\n\ntable  {out}", as_json=as_json)


@app.command("score")
def score(
    animals: Annotated[int, typer.Option(help="Synthetic animals.")] = 4,
    units: Annotated[int, typer.Option(help="Units of each.")] = 40,
    trials: Annotated[int, typer.Option(help="Trials of each stimulus.")] = 20,
    repeats: Annotated[int, typer.Option(help="Seeds per setting; their spread is the error.")] = 8,
    as_json: JsonOption = False,
) -> None:
    """Measure the Monte-Carlo error of a score against its time: split halves, bootstrap draws, permutations."""
    from brainbench.metrics.tradeoff import measure_tradeoff

    with progress_bar() as progress:
        points = measure_tradeoff(animals=animals, units=units, trials=trials, repeats=repeats, progress=progress)
    rows = [
        [
            point.quantity.replace("_", " "),
            f"{point.count:,}" + ("  (default)" if point.default else ""),
            f"{point.error:.2g}",
            point.of,
            f"{point.seconds:.2f}",
        ]
        for point in points
    ]
    text = table(
        f"{animals} animals, {units} units, {trials} trials per stimulus; standard deviation over {repeats} seeds",
        ["quantity", "number", "error", "of", "s"],
        rows,
        right=(2, 4),
    )
    emit({"points": points}, text, as_json=as_json)


@app.command("model")
def model(
    name: Annotated[str, typer.Argument(help="A registry name, or local-dir:FOLDER of a trained model.")],
    precisions: Annotated[str, typer.Option(help="float32, bf16, int8, comma-separated.")] = "float32,bf16,int8",
    unrolls: Annotated[str, typer.Option(help="biological, full, comma-separated.")] = "biological",
    steps: Annotated[str, typer.Option(help="Last steps of the sweeps that are shown, comma-separated.")] = "22",
    score: Annotated[bool, typer.Option(help="Also score every setting on the demo recordings.")] = False,
    data: Annotated[Path | None, typer.Option(help="Folder of sweeps: also measure test accuracy.")] = None,
    seed: Annotated[int, typer.Option(help="Seed of untrained weights.")] = 0,
    as_json: JsonOption = False,
) -> None:
    """Measure error, latency, score and accuracy of a network over precision, unrolling and number of steps."""
    from brainbench.core.errors import UsageError
    from brainbench.models import tradeoff
    from brainbench.stimuli import load_stimuli

    try:
        counts = [int(item) for item in _items(steps)]
    except ValueError as error:
        raise UsageError(f"--steps takes whole numbers separated by commas; received {steps!r}.") from error
    chosen = tradeoff.settings(_items(precisions), _items(unrolls), counts)
    results = []
    with progress_bar() as progress:
        sweeps = load_stimuli("rodgers", whiskers="all", fidelity=None, progress=progress).input
        for done, setting in enumerate(chosen):
            point = tradeoff.measure(name, setting, sweeps, seed=seed)
            found = {"setting": setting, "error": point.error, "ms": point.cost, **point.settings}
            reduced = tradeoff.Reduced(name, setting, seed=seed)
            if score:
                import brainbench

                found["score"] = brainbench.score(reduced, normalize=False).value
            if data is not None:
                found |= _accuracy(reduced, data)
            results.append(found)
            progress(done + 1, len(chosen), "settings")
    rows = [
        [
            str(item["precision"]),
            str(item["unroll"]),
            str(item["steps"]),
            f"{item['error']:.2%}",
            f"{item['ms']:.2f}",
            f"{item['p99_ms']:.2f}",
            f"{item['stored_bytes'] / 1e6:.2f}",
            f"{item['score']:.3f}" if "score" in item else "–",
            f"{item['top1']:.3f}" if "top1" in item else "–",
        ]
        for item in results
    ]
    columns = ["precision", "unrolling", "steps", "error", "ms / sweep", "p99 ms", "MB", "score", "top-1"]
    emit(results, table(f"{name}, batch 1:", columns, rows, right=tuple(range(2, 9))), as_json=as_json)


@app.command("tactile")
def tactile(
    out: Annotated[Path, typer.Option("--out", "-o", help="Table (.json).")] = Path("tactile-tradeoff.json"),
    plot: Annotated[Path | None, typer.Option(help="Also draw error against cost (.png, .svg, .pdf).")] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure error and cost of tactile queries over backend, resolution, surface points and taxels.

    The table that ships with the package (robotics_bridge/sensors/fidelity_table.json) is made by this command.
    """
    from robotics_bridge.sensors import tradeoff

    with progress_bar() as progress:
        points = tradeoff.measure_tradeoff(out, progress=progress)
    if plot is not None:
        tradeoff.plot_tradeoff(points, plot)
    rows = []
    for point in points:
        setting = point.get("points") or point.get("taxels") or point["query"]
        detail = f"{point['resolution']} cells" if point.get("resolution") else ""
        rows.append([point["part"], str(setting), detail, f"{point['error']:.2e}", f"{point['cost']:.2f}"])
    columns = ["part", "setting", "resolution", "error", "µs / environment"]
    text = table("relative force errors against double precision", columns, rows, right=(1, 3, 4))
    emit({"points": points, "path": out}, f"{text}\n\ntable  {out}", as_json=as_json)


def _items(text: str) -> list[str]:
    return [item.strip() for item in text.split(",") if item.strip()]


def _accuracy(reduced: Any, data: Path) -> dict[str, float]:
    from brainbench.datasets import WhiskingDataset
    from brainbench.models.training.evaluation import evaluate

    found = evaluate(reduced, WhiskingDataset(data, split="test", shuffle=False))
    return {"top1": found.top1, "top5": found.top5}
