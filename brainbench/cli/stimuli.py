"""``brainbench stimuli``: list and simulate stimulus recipes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from brainbench.cli._shared import JsonOption, emit, progress_bar, table

app = typer.Typer(no_args_is_help=True, help="Simulate whiskers on objects.")


@app.command("list")
def list_(as_json: JsonOption = False) -> None:
    """List the stimulus recipes."""
    from brainbench.stimuli import describe_recipe, list_recipes

    recipes = {name: describe_recipe(name) for name in list_recipes()}
    emit(recipes, table("", ["recipe", ""], [[name, text] for name, text in recipes.items()]), as_json=as_json)


@app.command("simulate")
def simulate(
    source: Annotated[str, typer.Argument(help="A recipe name or a scene file (.toml).")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Stimulus-set file to write (.h5).")] = None,
    whiskers: Annotated[str, typer.Option(help="Whiskers to simulate: all, C0-C3, C2,D1, …")] = "all",
    fidelity: Annotated[str, typer.Option(help="Simulation preset: fast, balanced or accurate.")] = "balanced",
    as_json: JsonOption = False,
) -> None:
    """Simulate a recipe or a scene file and report which whiskers touched what, and how hard."""
    import numpy as np

    from brainbench.stimuli import load_stimuli, write_stimulus_set

    with progress_bar() as progress:
        stimuli = load_stimuli(source, whiskers=whiskers, fidelity=fidelity, progress=progress)
    dataset = stimuli.dataset
    if dataset is None:
        from brainbench.errors import UsageError

        raise UsageError(f"{source!r} holds arrays, not scenes; nothing is simulated.")
    if out is not None:
        write_stimulus_set(dataset, out)
    wrench = dataset["wrench"].values
    force = np.linalg.norm(wrench[..., :3], axis=-1).max(axis=(1, 2)) * 1e3
    moment = np.linalg.norm(wrench[..., 3:], axis=-1).max(axis=(1, 2)) * 1e6
    touched = np.asarray(dataset["contact"].values.any(axis=1)).tolist()
    names = [str(name) for name in dataset["whisker"].values]
    data = [
        {
            "stimulus": label,
            "whiskers_touched": [name for name, hit in zip(names, hits, strict=True) if hit],
            "peak_force_mN": float(peak),
            "peak_moment_uNm": float(bend),
        }
        for label, hits, peak, bend in zip(stimuli.labels, touched, force, moment, strict=True)
    ]
    rows = [
        [
            item["stimulus"],
            f"{len(item['whiskers_touched'])} of {len(names)}",
            f"{item['peak_force_mN']:.3g}",
            f"{item['peak_moment_uNm']:.3g}",
        ]
        for item in data
    ]
    text = table(stimuli.description, ["stimulus", "whiskers touched", "peak force mN", "peak moment µN·m"], rows)
    path = "" if out is None else f"\n\nstimuli  {out}"
    emit({"content_hash": stimuli.content_hash, "stimuli": data, "path": out}, text + path, as_json=as_json)
