"""``brainbench stimuli simulate``: from scenes to a file of forces."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, progress_bar, table
from brainbench.cli.stimuli.options import BackendOption, FidelityOption, WhiskersOption
from brainbench.core.errors import UsageError
from brainbench.stimuli.engines import DEFAULT_ENGINE


def simulate(
    source: Annotated[str, typer.Argument(help="A recipe name or a scene file (.toml).")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Stimulus-set file to write (.h5).")] = None,
    whiskers: WhiskersOption = "all",
    fidelity: FidelityOption = "balanced",
    backend: BackendOption = DEFAULT_ENGINE,
    explain: Annotated[
        bool, typer.Option("--explain", help="Tell what was simulated, shared and left out, and what that saved.")
    ] = False,
    cache: Annotated[bool, typer.Option("--cache/--no-cache", help="Read and keep results in the cache.")] = True,
    as_json: JsonOption = False,
) -> None:
    """Simulate a recipe or a scene file and report which whiskers touched what, and how hard."""
    from brainbench.stimuli import load_stimuli, write_stimulus_set
    from brainbench.stimuli.explain import Explanation

    with progress_bar() as progress:
        stimuli = load_stimuli(
            source, whiskers=whiskers, fidelity=fidelity, backend=backend, progress=progress, cache=cache
        )
    dataset = stimuli.dataset
    if dataset is None:
        raise UsageError(f"{source!r} holds arrays, not scenes; nothing is simulated.")
    told = Explanation.of(dataset) if explain else None
    if out is not None:
        write_stimulus_set(dataset, out)
    data: dict[str, Any] = {"content_hash": stimuli.content_hash, "stimuli": _summary(dataset), "path": out}
    whiskers_in_all = dataset.sizes["whisker"]
    rows = [
        [
            item["stimulus"],
            f"{len(item['whiskers_touched'])} of {whiskers_in_all}",
            f"{item['peak_force_mN']:.3g}",
            f"{item['peak_moment_uNm']:.3g}",
        ]
        for item in data["stimuli"]
    ]
    text = table(stimuli.description, ["stimulus", "whiskers touched", "peak force mN", "peak moment µN·m"], rows)
    if told is not None:
        data["explanation"] = told
        text += f"\n\n{told}"
    emit(data, text + ("" if out is None else f"\n\nstimuli  {out}"), as_json=as_json)


def _summary(dataset: Any) -> list[dict[str, Any]]:
    """Return, per stimulus, who touched and the largest force and moment."""
    import numpy as np

    wrench = dataset["wrench"].values
    # Frames after a whisker became unstable are NaN; the rest of the set still has peaks.
    force = np.nanmax(np.linalg.norm(wrench[..., :3], axis=-1), axis=(1, 2), initial=0.0) * 1e3
    moment = np.nanmax(np.linalg.norm(wrench[..., 3:], axis=-1), axis=(1, 2), initial=0.0) * 1e6
    touched = np.asarray(dataset["contact"].values.any(axis=1)).tolist()
    names = [str(name) for name in dataset["whisker"].values]
    labels = [str(label) for label in dataset["stimulus"].values]
    return [
        {
            "stimulus": label,
            "whiskers_touched": [name for name, hit in zip(names, hits, strict=True) if hit],
            "peak_force_mN": float(peak),
            "peak_moment_uNm": float(bend),
        }
        for label, hits, peak, bend in zip(labels, touched, force, moment, strict=True)
    ]
