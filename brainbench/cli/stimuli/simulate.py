"""``brainbench stimuli simulate | separability``: from scenes to forces, and what can be told from them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.destinations import out_file_option
from brainbench.cli.options import items, numbers
from brainbench.cli.output import Output, progress_bar, table_of
from brainbench.cli.stimuli.scenes import BackendOption, FidelityOption, WhiskersOption
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE


def simulate(
    source: Annotated[str, typer.Argument(help="A recipe name or a scene file (.toml).")],
    out: Annotated[Path | None, out_file_option("Stimulus-set file to write (.h5).")] = None,
    whiskers: WhiskersOption = "all",
    fidelity: FidelityOption = "balanced",
    backend: BackendOption = DEFAULT_ENGINE,
    explain: Annotated[
        bool, typer.Option("--explain", help="Tell what was simulated, shared and left out, and what that saved.")
    ] = False,
    cache: Annotated[bool, typer.Option("--cache/--no-cache", help="Read kept results and keep new ones.")] = True,
) -> Output:
    """Simulate a recipe or a scene file and report which whiskers touched what, and how hard."""
    from brainbench.stimuli import write_stimulus_set
    from brainbench.stimuli.explain import Explanation
    from brainbench.stimuli.sources import load_stimulus_set

    with progress_bar() as progress:
        dataset, description = load_stimulus_set(
            source, whiskers=whiskers, fidelity=fidelity, backend=backend, progress=progress, cache=cache
        )
    explanation = Explanation.of(dataset) if explain else None
    if out is not None:
        write_stimulus_set(dataset, out)
    unstable, inexact = _whiskers(dataset, "reason"), _whiskers(dataset, "remark")
    data: dict[str, Any] = {
        "content_hash": dataset.attrs["content_hash"], "stimuli": _summary(dataset), "unstable": unstable,
        "inexact": inexact, "path": out,
    }  # fmt: skip
    whiskers_in_all = dataset.sizes["whisker"]
    columns = {
        "stimulus": "{0[stimulus]}",
        "whiskers touched": lambda row: f"{len(row['whiskers_touched'])} of {whiskers_in_all}",
        "peak force mN": "{0[peak_force_mN]:.3g}",
        "peak moment µN·m": "{0[peak_moment_uNm]:.3g}",
        "error, median": lambda row: _percent(row["error_median"]),
        "largest": lambda row: _percent(row["error_largest"]),
    }
    text = table_of(description, data["stimuli"], columns)
    for some, key, words in (
        (unstable, "reason", "cannot be trusted; their numbers are missing, and networks refuse the set"),
        (inexact, "remark", "may err by more than is promised"),
    ):
        if some:
            columns = {"stimulus": "{0[stimulus]}", "whisker": "{0[whisker]}", key: f"{{0[{key}]}}"}
            text += "\n\n" + table_of(f"{len(some)} whiskers {words}", some, columns)
    if explanation is not None:
        data["explanation"] = explanation
        text += f"\n\n{explanation}"
    return Output(data, text + ("" if out is None else f"\n\nstimuli  {out}"))


def _percent(share: float | None) -> str:
    return "not estimated" if share is None else f"{share:.1%}"


def _whiskers(dataset: Any, words: str) -> list[dict[str, str]]:
    """Return the whiskers that have words of a kind, ``reason`` or ``remark``, with them."""
    import numpy as np

    bad = dataset[words].values != "" if words in dataset else np.zeros((0, 0), bool)
    return [
        {
            "stimulus": str(dataset["stimulus"].values[i]),
            "whisker": str(dataset["whisker"].values[j]),
            words: str(dataset[words].values[i, j]),
        }
        for i, j in np.argwhere(bad)
    ]


def _summary(dataset: Any) -> list[dict[str, Any]]:
    """Return, per stimulus, who touched, the largest force and moment, and the errors of those that touched."""
    import numpy as np

    wrench = dataset["wrench"].values
    # Frames after a whisker became unstable are NaN; the rest of the set still has peaks.
    force = np.nanmax(np.linalg.norm(wrench[..., :3], axis=-1), axis=(1, 2), initial=0.0) * 1e3
    moment = np.nanmax(np.linalg.norm(wrench[..., 3:], axis=-1), axis=(1, 2), initial=0.0) * 1e6
    touching = np.asarray(dataset["contact"].values.any(axis=1))
    touched = touching.tolist()
    # Sets that were made before errors were estimated have none.
    error = dataset["error"].values if "error" in dataset else np.full(touching.shape, np.nan)
    errors = [values[hits & ~np.isnan(values)] for values, hits in zip(error, touching, strict=True)]
    names = [str(name) for name in dataset["whisker"].values]
    labels = [str(label) for label in dataset["stimulus"].values]
    return [
        {
            "stimulus": label,
            "whiskers_touched": [name for name, hit in zip(names, hits, strict=True) if hit],
            "peak_force_mN": float(peak),
            "peak_moment_uNm": float(bend),
            "error_median": float(np.median(some)) if some.size else None,
            "error_largest": float(some.max()) if some.size else None,
        }
        for label, hits, peak, bend, some in zip(labels, touched, force, moment, errors, strict=True)
    ]


def separability(
    folder: Annotated[Path, typer.Argument(help="Data set of stimuli sweep, or published sweeps.")],
    classes: Annotated[
        str | None, typer.Option(help="Classes, with commas between them. [default: the four with the most objects]")
    ] = None,
    counts: Annotated[str, typer.Option(help="How many classes at a time, with commas between them.")] = "2,3,4",
    sweeps_per_class: Annotated[int, typer.Option(min=2, help="Sweeps drawn of each class.")] = 400,
    split: Annotated[str, typer.Option(help="all, train, validation or test.")] = "all",
    seed: Annotated[int, typer.Option(help="Of the draw, the folds and the resampling.")] = 0,
) -> Output:
    """Train support vector machines on 2, 3 and 4 classes; print their accuracy on new objects against chance."""
    from brainbench.datasets.whisking.dataset import WhiskingDataset
    from brainbench.datasets.whisking.separability import separability as measure

    data = WhiskingDataset(folder, split=split, view="raw")
    chosen = {"classes": None if classes is None else items(classes), "counts": numbers(counts, "--counts")}
    with progress_bar() as progress:
        scores = measure(data, **chosen, sweeps_per_class=sweeps_per_class, seed=seed, progress=progress)
    used = dict.fromkeys(name for item in scores for choice in item.choices for name in choice)
    title = f"{', '.join(used)}: {scores[0].objects} objects, {scores[0].sweeps} sweeps"
    columns = {
        "classes": "{0.count}",
        "accuracy": "{0.accuracy:.3f}",
        "95 % interval": "[{0.interval.low:.3f}, {0.interval.high:.3f}]",
        "chance": "{0.chance:.3f}",
        "": lambda score: (
            ("above chance" if score.above_chance else "not above chance")
            + (f" ({score.status}: {score.reason})" if score.status != "ok" else "")
        ),
    }
    text = table_of(title, scores, columns)
    if data.skipped:
        text += f"\n\n{data.skipped} unstable sweeps were left out"
    result = {
        "content_hash": data.manifest["content_hash"],
        "split": split,
        "unstable": data.skipped,
        "results": [{**vars(item), "above_chance": item.above_chance} for item in scores],
    }
    return Output(result, text)
