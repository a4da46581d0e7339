"""``brainbench stimuli sweep``: count and list the sweeps of a published grid over some objects, or make a data set."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from brainbench.cli.destinations import out_folder_option
from brainbench.cli.options import SchedulerOption, WorkersOption, with_options
from brainbench.cli.output import Output, facts, progress_bar
from brainbench.cli.stimuli.scenes import BackendOption, FidelityOption, WhiskersOption
from brainbench.core.errors import UsageError, check_name, listing
from brainbench.stimuli.engines.fidelity import DEFAULT_ENGINE

if TYPE_CHECKING:
    from brainbench.stimuli.sweeps.plan import GenerationPlan

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
    unit: Annotated[str | None, typer.Option(help="Length unit of mesh files: m, cm, mm, …")] = None,
    collision: Annotated[str | None, typer.Option(help="What whiskers touch: hull, exact, decomposition, …")] = None,
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
