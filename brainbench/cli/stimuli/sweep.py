"""``brainbench stimuli sweep``: count, list and simulate the sweeps of a published grid over some objects."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from brainbench.cli._shared import JsonOption, emit, progress_bar, table
from brainbench.cli.stimuli._options import BackendOption, FidelityOption, WhiskersOption
from brainbench.errors import UsageError, unknown_name

if TYPE_CHECKING:
    from brainbench.stimuli import Solid
    from brainbench.stimuli.sweeps import SweepScenes

_SHOWN = 8


def sweep(
    grid: Annotated[str, typer.Argument(help="thesis-low or thesis-high.")],
    objects: Annotated[
        list[str], typer.Argument(help="Shape families (torus, or torus-3 for seed 3) and mesh files (cup.obj).")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Simulate, into one stimulus-set file per object here.")
    ] = None,
    unit: Annotated[str | None, typer.Option(help="Length unit of mesh files: m, cm, mm, …")] = None,
    collision: Annotated[str | None, typer.Option(help="What whiskers touch: hull, exact, decomposition, …")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Simulate only the first sweeps of each object.")] = None,
    whiskers: WhiskersOption = "all",
    fidelity: FidelityOption = "balanced",
    backend: BackendOption = "mujoco",
    as_json: JsonOption = False,
) -> None:
    """Count the sweeps of a grid beside the published counts; with --out simulate them.

    Objects whose file is there already are left alone, so an interrupted run goes on where it stopped.
    """
    from brainbench.stimuli import get_recipe
    from brainbench.stimuli.sweeps import GRIDS, SweepScenes, counts

    if grid not in GRIDS:
        raise unknown_name("sweep grid", grid, GRIDS)
    loaders = {name: load for item in objects for name, load in [_object(item, unit, collision)]}
    if len(loaders) < len(objects):
        raise UsageError("Several objects have the same name; their files would replace one another.")
    recipe = get_recipe(grid, objects=loaders, whiskers=whiskers)
    scenes = recipe.scenes
    if not isinstance(scenes, SweepScenes):
        raise UsageError(f"{grid!r} is no grid of sweeps.")
    summary = counts(scenes)
    data = {**summary, "labels": list(scenes.labels), "files": []}
    rows = [
        ["objects", f"{summary['objects']}"],
        ["sweeps per object", f"{summary['sweeps_per_object']}"],
        [
            "scenes",
            f"{summary['scenes']:,} of {summary['whiskers']} whiskers, {summary['bytes'] / 1e6:.3g} MB of forces",
        ],
        ["published", summary["published"]],
    ]
    text = table(grid, ["", ""], rows)
    if out is None:
        first = "\n".join(scenes.labels[:_SHOWN])
        more = len(scenes) - _SHOWN
        text += f"\n\n{first}" + (f"\n… and {more:,} more (all with --json)" if more > 0 else "")
    else:
        data["files"] = _simulate(scenes, out, limit, fidelity, backend)
        text += "\n\n" + "\n".join(f"stimuli  {path}" for path in data["files"])
    emit(data, text, as_json=as_json)


def _simulate(scenes: SweepScenes, out: Path, limit: int | None, fidelity: str, backend: str) -> list[Path]:
    """Simulate object by object; return the files, those that were there already among them."""
    from brainbench.stimuli import simulate, write_stimulus_set

    size = scenes.grid.count
    paths = []
    with progress_bar() as progress:
        for index, name in enumerate(scenes.objects):
            path = out / f"{name}.h5"
            paths.append(path)
            first = index * size
            if path.exists():
                _check_same(path, scenes, scenes.labels[first : first + min(size, limit or size)], fidelity, backend)
                continue
            dataset = simulate(
                scenes[first : first + min(size, limit or size)],
                fidelity=fidelity,
                backend=backend,
                cache=False,
                progress=_named(progress, name),
            )
            write_stimulus_set(dataset, path)
    return paths


def _check_same(path: Path, scenes: SweepScenes, labels: tuple[str, ...], fidelity: str, backend: str) -> None:
    """Refuse to take a file for something that it does not hold."""
    from brainbench.files import to_json
    from brainbench.stimuli import Fidelity, read_stimulus_set

    dataset = read_stimulus_set(path)
    found = {
        "sweeps": [str(label) for label in dataset["stimulus"].values] == list(labels),
        "whiskers": [str(name) for name in dataset["whisker"].values] == list(scenes.array.names),
        "fidelity": dataset.attrs["fidelity"] == to_json(Fidelity.preset(fidelity), indent=None),
        "backend": dataset.attrs["backend"] == backend,
    }
    if other := [what for what, same in found.items() if not same]:
        raise UsageError(
            f"{str(path)!r} is there already with other {' and '.join(other)}; choose another folder, or remove it."
        )


def _named(progress: Callable[[int, int, str], None], name: str) -> Callable[[int, int, str], None]:
    return lambda done, total, what: progress(done, total, f"{name}: {what}")


def _object(text: str, unit: str | None, collision: str | None) -> tuple[str, Callable[[], Solid]]:
    """Name and loader of one object: a mesh file, or a family with or without a seed.

    Raises:
        UsageError: a mesh file has no unit, or there is no such family.
    """
    from brainbench.stimuli.objects import mesh_solid, shape_solid
    from brainbench.stimuli.shapes import describe_family, make

    if Path(text).is_file():
        if unit is None:
            raise UsageError(f"The length unit of {text!r} is not in the file; say it with --unit (m, cm, mm, …).")
        return Path(text).stem, lambda: mesh_solid(text, unit=unit, collision=collision or "hull")  # type: ignore[arg-type]
    family, seed = (found[1], int(found[2])) if (found := re.fullmatch(r"(.+)-(\d+)", text)) else (text, 0)
    describe_family(family)
    return f"{family}-{seed}", lambda: shape_solid(make(family, seed), collision=collision)
