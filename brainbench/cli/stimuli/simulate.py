"""``brainbench stimuli simulate | separability | sweep``: from scenes to forces, and what can be told from them.

``sweep`` counts and lists the sweeps of a published grid over some objects, or makes a data set of them.
"""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from brainbench.cli.options import (
    SchedulerOption,
    WorkersOption,
    items,
    numbers,
    out_file_option,
    out_folder_option,
    with_options,
)
from brainbench.cli.output import Output, facts, progress_bar, table_of
from brainbench.cli.stimuli.scenes import BackendOption, CollisionOption, FidelityOption, UnitOption, WhiskersOption
from brainbench.core.errors import UsageError, check_name, listing
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE

if TYPE_CHECKING:
    from brainbench.stimuli.sweeps.plan import GenerationPlan


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
            text += "\n\n" + table_of(f"{len(some)} of the whiskers {words}", some, columns)
    if explanation is not None:
        data["explanation"] = explanation
        text += f"\n\n{explanation}"
    return Output(data, text + ("" if out is None else f"\n\nstimuli  {out}"))


def _percent(share: float | None) -> str:
    return "not estimated" if share is None else f"{share:.1%}"


def _whiskers(dataset: Any, words: str) -> list[dict[str, str]]:
    """Return the whiskers that have words of a kind, ``reason`` or ``remark``, with them."""
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
        str | None, typer.Option(help="Classes, with commas between them. \\[default: the four with the most objects]")
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


SETTINGS = "brainbench.stimuli.sweeps.plan:GenerationSettings"
OFFERED = ("split", "limit", "sample", "seed", "device", "shard_size", "errors", "retry")
_SHOWN = 8


@with_options(SETTINGS, OFFERED, build=False)
def sweep(
    grid: Annotated[str, typer.Argument(help="thesis-low or thesis-high.")],
    objects: Annotated[
        list[str] | None, typer.Argument(help="What moves past the whiskers; as --objects.", show_default=False)
    ] = None,
    more_objects: Annotated[
        list[str] | None,
        typer.Option(
            "--objects",
            help="A shape family (torus), one member (torus-3) or the first ones (torus:20), a collection "
            "(procedural-24:40), mesh files ('meshes/*/*.obj'), or shapenet:FOLDER[:N]. Can be repeated.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[Path | None, out_folder_option("Simulate, into shards and a manifest in this folder.")] = None,
    options: Any = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    unit: UnitOption = None,
    collision: CollisionOption = None,
    whiskers: WhiskersOption = "all",
    fidelity: FidelityOption = "balanced",
    backend: BackendOption = DEFAULT_ENGINE,
) -> Output:
    """Count the sweeps of a grid beside the published counts; with --out make a data set of them.

    A run that was interrupted or killed goes on where it stopped when the same command is given again.
    """
    from brainbench.stimuli import Fidelity
    from brainbench.stimuli.engines import get_engine
    from brainbench.stimuli.objects.collections import resolve_objects
    from brainbench.stimuli.sweeps.plan import GenerationPlan, GenerationSettings
    from brainbench.stimuli.sweeps.sweep_scenes import GRIDS, SweepScenes, counts

    check_name("sweep grid", grid, GRIDS)
    if out is None and scheduler is not None:
        raise UsageError("--scheduler simulates, and needs a folder for it: --out.")
    surfaces, names = get_engine(backend).surfaces, [*(objects or ()), *(more_objects or ())]
    bodies = resolve_objects(names, unit=unit, collision=collision, surfaces=surfaces)
    scenes = SweepScenes(GRIDS[grid], {name: item.load for name, item in bodies.items()}, whiskers=whiskers)
    settings = GenerationSettings(Fidelity.parse(fidelity), backend=backend, **options)
    plan = GenerationPlan(grid, GRIDS[grid], bodies, settings, whiskers)
    summary = counts(scenes)
    rows = {
        "objects": f"{summary['objects']} of {len(plan.classes)} classes",
        "sweeps per object": summary["sweeps_per_object"],
        "scenes": f"{summary['scenes']:,} of {summary['whiskers']} whiskers, {summary['bytes'] / 1e6:.3g} MB of forces",
        "published": summary["published"],
        "data set": _describe(plan),
    }
    data: dict[str, Any] = {**summary, "classes": len(plan.classes), "shards": len(plan.shards), "files": []}
    text = facts(rows, grid)
    if out is None:
        data["labels"] = list(scenes.labels)
        first = "\n".join(data["labels"][:_SHOWN])
        more = len(scenes) - _SHOWN
        text += f"\n\n{first}" + (f"\n… and {more:,} more (all with --json)" if more > 0 else "")
    else:
        manifest, report = _generate(plan, out, workers, scheduler)
        data |= manifest
        text += f"\n\n{report}"
    return Output(data, text)


def _describe(plan: GenerationPlan) -> str:
    """Return how many sweeps and shards a data set would have, by split."""
    sizes = Counter({task.split: 0 for task in plan.shards})
    for task in plan.shards:
        sizes[task.split] += len(task)
    parts = ", ".join(f"{split} {size:,}" for split, size in sizes.items())
    shards = f"{len(plan.shards)} shards, {sum(task.bytes for task in plan.shards) / 1e6:.3g} MB"
    return f"{plan.sweeps:,} sweeps in {shards}: {parts} (by {plan.settings.split})"


def _describe_errors(errors: dict[str, Any] | None) -> str:
    """Return the estimated errors in words; empty without any."""
    if errors is None:
        return ""
    median, most, worst = (
        "not to be told" if errors[name] is None else f"{errors[name]:.1%}" for name in ("median", "q90", "worst")
    )
    return (
        f"{median} (median), {most} (90 %), {worst} (worst), estimated of {errors['whiskers']:,} whiskers in contact; "
        f"{errors['beyond']:,} above 10 %"
    )


def _generate(
    plan: GenerationPlan, out: Path, workers: int | None, scheduler: str | None
) -> tuple[dict[str, Any], str]:
    """Make the data set; return what --json says of it and what people read."""
    from brainbench.stimuli.sweeps.generation import generate

    started = time.perf_counter()
    with progress_bar() as progress:
        manifest = generate(plan, out, workers=workers, scheduler=scheduler, progress=progress)
    seconds = time.perf_counter() - started
    unsolved = manifest["unsolved"]
    saved = 1 - manifest["steps"] / max(1, manifest["steps_in_full"])
    about = (
        "sweeps", "unstable", "unusable", "steps", "steps_in_full", "unsolved", "splits", "content_hash", "config_hash",
    )  # fmt: skip
    data = {
        **{key: manifest[key] for key in about},
        "errors": manifest.get("errors"),
        "seconds": seconds,
        "folder": out,
        "files": [out / shard["name"] for shard in manifest["shards"]],
    }
    unusable = {name: item["unusable"] for name, item in manifest["objects"].items() if "unusable" in item}
    untouched = [name for name, item in manifest["objects"].items() if "untouched" in item]
    rows = {
        "error": _describe_errors(manifest.get("errors")),
        "steps": f"{manifest['steps']:,} of {manifest['steps_in_full']:,} computed"
        + f" ({saved:.0%} saved)" * (saved >= 0),
        "not solved": f"contact forces of {unsolved:,} time steps" if unsolved else "",
        "unstable": f"{manifest['unstable']:,} of {manifest['sweeps']:,} sweeps, marked in the shards",
        "unusable": "\n".join(f"{name}: {reason}" for name, reason in unusable.items()),
        "untouched": f"in all sweeps: {listing(untouched, limit=6)}" if untouched else "",
        "hash": manifest["content_hash"],
        "time": f"{seconds:.1f} s in this run",
        "data set": f"{out} (manifest.json, {len(manifest['shards'])} shards)",
    }
    return data, facts({name: value for name, value in rows.items() if value})
