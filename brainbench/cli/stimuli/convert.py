"""``brainbench stimuli convert``: the published study's sweeps and WHISKiT's runs into files of ours, and back."""

from __future__ import annotations

import json
import tempfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer

from brainbench.cli.output import JsonOption, emit, facts, progress_bar
from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, listing

_SET_ENDINGS = (".h5", ".hdf5", ".nc")


def convert(
    source: Annotated[
        Path,
        typer.Argument(
            help="Folder with train/, validate/ and test/ of published sweeps (.npz); one such sweep or a folder of "
            "them; a WHISKiT run or a folder of runs; or a stimulus set (.h5)."
        ),
    ],
    out: Annotated[
        Path,
        typer.Argument(help="Folder of a data set; stimulus set (.h5) for sweeps and runs; run folder for a .h5 file."),
    ],
    cleaning: Annotated[
        str | None,
        typer.Option(
            help="Of runs. mark (default): values that cannot be trusted become missing; published: they are "
            "replaced as process_raw_dataset.py does."
        ),
    ] = None,
    rate: Annotated[
        float | None, typer.Option(help="Rows of a run per second; 1000 and 110 rows are one second.")
    ] = None,
    stimulus: Annotated[str | None, typer.Option("--stimulus", "-s", help="Stimulus of a set to write.")] = None,
    dialect: Annotated[
        str | None,
        typer.Option(help="Of a written run: thesis (default), or sense-lab, where commas end lines."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Convert published sweeps to a data set, sweeps and WHISKiT runs to a stimulus set, or a stimulus set to a run.

    Numbers become N and N·m, or mN and µN·m in a run; axes and signs are alike. What cannot be trusted is counted.
    """
    from brainbench.datasets.whisking.sweep_tree import is_sweep_tree
    from brainbench.stimuli.whiskit_runs import find_runs

    if not source.exists():
        raise DataFileNotFoundError(f"There is no file or folder {str(source)!r}.")
    of_runs = {"cleaning": cleaning, "rate": rate}
    of_sets: dict[str, Any] = {"stimulus": stimulus, "dialect": dialect}
    if source.is_dir() and is_sweep_tree(source):
        _refuse("a folder of sweeps", of_runs | of_sets)
        made, text = _data_set(source, out)
    elif sweeps := [source] if source.suffix == ".npz" else sorted(source.glob("*.npz")):
        _refuse("sweeps", of_runs | of_sets)
        _check_set_name(out, source)
        made, text = _write_set(_sweep_set(sweeps), out)
    elif source.is_file():
        _refuse("a stimulus set", of_runs)
        made, text = _run(source, out, stimulus=stimulus, dialect=dialect or "thesis")
    elif runs := find_runs(source):
        _refuse("runs", of_sets)
        _check_set_name(out, source)
        from brainbench.stimuli.whiskit_runs import read_runs

        made, text = _write_set(read_runs(runs, cleaning=cleaning or "mark", rate=rate), out)  # type: ignore[arg-type]
    else:
        raise DataError(
            f"{str(source)!r} holds nothing to convert: no folders train, validate and test, no sweeps (.npz) and no "
            "WHISKiT runs (whisker_ID.csv and dynamics/)."
        )
    emit({"source": source, "out": out, **made}, text, as_json=as_json)


def _refuse(what: str, options: dict[str, Any]) -> None:
    if given := [f"--{name}" for name, value in options.items() if value is not None]:
        raise UsageError(f"{' and '.join(given)} cannot be used when {what} is converted; leave it out.")


def _check_set_name(out: Path, source: Path) -> None:
    if out.suffix not in _SET_ENDINGS:
        raise UsageError(
            f"{str(source)!r} has no folders train, validate and test and becomes a stimulus set, a file that ends in "
            f"{listing(_SET_ENDINGS)}; received {str(out)!r}."
        )


def _data_set(source: Path, out: Path) -> tuple[dict[str, Any], str]:
    from brainbench.datasets.whisking.sweep_tree import open_sweep_tree
    from brainbench.stimuli.sweeps.conversion import SweepTable, convert_sweeps

    if out.is_file() or out.suffix in _SET_ENDINGS:
        raise UsageError(f"A folder of sweeps becomes a data set, which is a folder; received {str(out)!r}.")
    tree = open_sweep_tree(source)
    table = SweepTable(
        label=tree.listed.label,
        object=tree.listed.shape,
        split=tree.split,
        conditions=tree.conditions(),
        classes=tree.classes,
        times=tree.times,
        source=f"published sweeps, {tree.rate} Hz",
        source_hash=tree.content_hash,
        read=tree.wrenches,
        notes={"left_out": tree.left_out, "faults": tree.faults},
    )
    with progress_bar() as progress:
        manifest = convert_sweeps(table, out, progress=progress)
    about = ("sweeps", "splits", "left_out", "faults", "unstable", "content_hash", "config_hash")
    made = {"kind": "data set", "rate_hz": tree.rate, **{name: manifest[name] for name in about}}
    classes = len(set(table.label.tolist()))
    rows = {
        "sweeps": ", ".join(f"{name} {split['sweeps']:,}" for name, split in manifest["splits"].items()),
        "classes": f"{classes} of {len(tree.classes)} labels have sweeps",
        "frames": f"110 from {tree.times[0] * 1e3:g} ms every {(tree.times[1] - tree.times[0]) * 1e3:.4g} ms",
        "left out": f"{manifest['left_out']:,} without a label",
        "faults": _told(manifest["faults"]),
        "unstable": f"{manifest['unstable']:,} sweeps with values that are missing or too large",
        "hash": manifest["content_hash"],
        "data set": str(out),
    }
    return made, facts(rows)


def _sweep_set(paths: list[Path]) -> Any:
    """Return a stimulus set of sweep files, which are called as the files are."""
    import numpy as np

    from brainbench.core.contracts import GRID_SHAPE
    from brainbench.datasets.whisking.sweep_files import CELLS, CONDITIONS, FRAME_TIMES, FRAMES, read_sweep
    from brainbench.stimuli import Frames
    from brainbench.stimuli.external import FRAME_STATUSES, assemble_stimulus_set

    sweeps = [read_sweep(path) for path in paths]
    if len(rates := {sweep.rate for sweep in sweeps}) > 1:
        raise DataError(f"The sweeps have {listing(map(str, sorted(rates)))} Hz; convert those of each rate apart.")
    status = np.zeros((len(sweeps), FRAMES, len(CELLS)), dtype=np.uint8)
    faults: dict[str, dict[str, int]] = {}
    for place, (path, sweep) in enumerate(zip(paths, sweeps, strict=True)):
        for name, where in sweep.faulty().items():
            status[place][where.any(axis=-1)] = FRAME_STATUSES.index(name)
            if where.any():
                faults.setdefault(path.stem, {})[name] = int(where.sum())
    first, interval = FRAME_TIMES[rates.pop()]
    return assemble_stimulus_set(
        [path.stem for path in paths],
        np.stack([sweep.wrench() for sweep in sweeps]),
        [f"R{'ABCDE'[cell // GRID_SHAPE[1]]}{cell % GRID_SHAPE[1]}" for cell in CELLS.tolist()],
        Frames(first=first, interval=interval, count=FRAMES),
        backend="whiskit",
        frame_status=status,
        sources=[
            {"shape": sweep.shape, "class": sweep.label, **dict(zip(CONDITIONS, sweep.conditions, strict=True))}
            for sweep in sweeps
        ],
        about={"faults": faults},
    )


def _write_set(dataset: Any, out: Path) -> tuple[dict[str, Any], str]:
    from brainbench.stimuli import write_stimulus_set

    write_stimulus_set(dataset, out)
    faults = json.loads(dataset.attrs["faults"])
    total = sum((Counter(counts) for counts in faults.values()), Counter())
    unstable = int((dataset["status"].values != "ok").sum())
    times = dataset["time"].values * 1e3
    made = {
        "kind": "stimulus set",
        "stimuli": [str(label) for label in dataset["stimulus"].values],
        "frames": len(times),
        "whiskers": dataset.sizes["whisker"],
        "faults": faults,
        "unstable": unstable,
        "content_hash": dataset.attrs["content_hash"],
    }
    rows = {
        "stimuli": f"{len(made['stimuli'])} of {made['whiskers']} whiskers",
        "frames": f"{len(times)} from {times[0]:g} ms to {times[-1]:.4g} ms",
        "units": "N and N·m; action of the whisker on its base, world axes",
        "faults": _told(total),
        "unstable": f"{unstable} whiskers (status and frame_status say which and when)",
        "hash": made["content_hash"],
        "stimulus set": str(out),
    }
    return made, facts(rows)


def _run(source: Path, out: Path, **options: Any) -> tuple[dict[str, Any], str]:
    from brainbench.stimuli import read_stimulus_set
    from brainbench.stimuli.whiskit import save_run

    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        raise UsageError(f"A stimulus set becomes the folder of a run; {str(out)!r} is there already: name a new one.")
    dataset = read_stimulus_set(source)
    out.parent.mkdir(parents=True, exist_ok=True)
    # A run is many files: they appear together, or not at all.
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=".run-") as temporary:
        save_run(dataset, Path(temporary) / "run", **options).rename(out)
    shape = f"{dataset.sizes['time']} rows of {dataset.sizes['whisker']} whiskers"
    units = "mN and µN·m; action of the whisker on its base, world axes"
    return {"kind": "run"}, facts({"run": shape, "units": units, "folder": str(out)})


def _told(faults: Mapping[str, int]) -> str:
    return ", ".join(f"{count:,} values {name}" for name, count in faults.items() if count) or "none"
