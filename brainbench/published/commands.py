"""``brainbench stimuli convert`` and ``models import``: published sweeps, runs and weights into files of ours."""

from __future__ import annotations

import errno
import json
import math
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

from brainbench.cli.options import beside, out_folder_option, refuse
from brainbench.cli.output import Output, facts, progress_bar
from brainbench.core.contracts import GRID_SHAPE
from brainbench.core.errors import DataError, DataFileNotFoundError, UsageError, listing
from brainbench.core.files import temporary_path

if TYPE_CHECKING:
    import xarray as xr


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
        typer.Argument(
            callback=beside,
            help="Folder of a data set; stimulus set (.h5) for sweeps and runs; run folder for a .h5 file.",
        ),
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
) -> Output:
    """Convert published sweeps to a data set, sweeps and WHISKiT runs to a stimulus set, or a stimulus set to a run.

    Numbers become N and N·m, or mN and µN·m in a run; axes and signs are alike. What cannot be trusted is counted.
    """
    from brainbench.datasets.whisking.dataset import is_sweep_tree
    from brainbench.published.whiskit import find_runs, read_runs

    if not source.exists():
        raise DataFileNotFoundError(f"There is no file or folder {str(source)!r}.")
    of_runs: dict[str, Any] = {"--cleaning": cleaning, "--rate": rate}
    of_sets = {"--stimulus": stimulus}
    if source.is_dir() and is_sweep_tree(source):
        _check("a folder of sweeps", of_runs | of_sets, out, "a data set, which is a folder", not _is_set(out))
        result = _data_set(source, out)
    elif sweeps := [source] if source.suffix == ".npz" else sorted(source.glob("*.npz")):
        _check("sweeps without splits", of_runs | of_sets, out, _SET, _is_set(out))
        with progress_bar("converting the sweeps"):
            result = _write_set(_sweep_set(sweeps), out)
    elif source.is_file():
        free = not out.is_file() and not (out.is_dir() and any(out.iterdir()))
        _check("a stimulus set", of_runs, out, "a run, which is a new folder", free)
        with progress_bar("writing the run"):
            result = _run(source, out, stimulus)
    elif runs := find_runs(source):
        _check("runs", of_sets, out, _SET, _is_set(out))
        with progress_bar("converting the runs"):
            result = _write_set(read_runs(runs, cleaning=cleaning or "mark", rate=rate), out)  # type: ignore[arg-type]
    else:
        raise DataError(
            f"{str(source)!r} holds nothing to convert: no folders train, validate and test, no sweeps (.npz) and no "
            "WHISKiT runs (whisker_ID.csv and dynamics/)."
        )
    result = {"source": source, "out": out, **result}
    text = {name.replace("_", " "): _in_words(value) for name, value in result.items()}
    return Output(result, facts(text))


_SET = "a stimulus set, a file that ends in .h5, .hdf5 or .nc"


def _is_set(out: Path) -> bool:
    return out.suffix in (".h5", ".hdf5", ".nc") and not out.is_dir()


def _check(what: str, refused: Mapping[str, Any], out: Path, becomes: str, fits: bool) -> None:
    """Refuse options that belong to another conversion, and an ``out`` that cannot be what the source becomes."""
    refuse(refused, f"when {what} is converted")
    if not fits:
        raise UsageError(f"The source is {what} and becomes {becomes}; received {str(out)!r}.")


def _data_set(source: Path, out: Path) -> dict[str, Any]:
    from brainbench.published import conversion

    tree = conversion.open_sweep_tree(source)
    with progress_bar() as progress:
        manifest = conversion.convert_sweeps(tree, out, progress=progress)
    about = ("sweeps", "splits", "left_out", "faults", "unstable", "content_hash", "config_hash")
    summary = {"rate_hz": tree.rate, "classes": len(tree.classes), **_frames(tree.times)}
    return {"kind": "data set", **summary, **{name: manifest[name] for name in about}}


def _sweep_set(paths: list[Path]) -> xr.Dataset:
    """Return a stimulus set of sweep files, which are called as the files are."""
    from brainbench.published import conversion
    from brainbench.stimuli import Frames

    sweeps = [conversion.read_sweep(path) for path in paths]
    if len(rates := {sweep.rate for sweep in sweeps}) > 1:
        raise DataError(f"The sweeps have {listing(map(str, sorted(rates)))} Hz; convert those of each rate apart.")
    first, interval = conversion.FRAME_TIMES[rates.pop()]
    faults = [sweep.faulty() for sweep in sweeps]
    return conversion.assemble_stimulus_set(
        np.stack([sweep.wrench() for sweep in sweeps]),
        [f"R{'ABCDE'[cell // GRID_SHAPE[1]]}{cell % GRID_SHAPE[1]}" for cell in conversion.CELLS.tolist()],
        Frames(first=first, interval=interval, count=conversion.FRAMES),
        [
            {"label": path.stem, "shape": sweep.shape, "class": sweep.label}
            | dict(zip(conversion.CONDITIONS, sweep.conditions, strict=True))
            for path, sweep in zip(paths, sweeps, strict=True)
        ],
        {name: np.stack([found[name] for found in faults]) for name in conversion.FAULTS},
    )


def _write_set(dataset: xr.Dataset, out: Path) -> dict[str, Any]:
    from brainbench.stimuli import write_stimulus_set

    write_stimulus_set(dataset, out)
    return {
        "kind": "stimulus set",
        "stimuli": [str(label) for label in dataset["stimulus"].values],
        **_frames(dataset["time"].values),
        "whiskers": dataset.sizes["whisker"],
        "units": f"N and N·m; {dataset.attrs['frame']}",
        "faults": json.loads(dataset.attrs["faults"]),
        "unstable": int((dataset["status"].values != "ok").sum()),
        "content_hash": dataset.attrs["content_hash"],
    }


def _run(source: Path, out: Path, stimulus: str | None) -> dict[str, Any]:
    from brainbench.published.whiskit import save_run
    from brainbench.stimuli import read_stimulus_set

    dataset = read_stimulus_set(source)
    out.parent.mkdir(parents=True, exist_ok=True)
    # A run is many files: they appear together, or not at all.
    temporary = temporary_path(out.absolute())
    try:
        save_run(dataset, temporary, stimulus=stimulus, dialect="thesis").rename(out)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        raise UsageError(f"{str(out)!r} was made by another process meanwhile; choose another folder.") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    units = "mN and µN·m; action of the whisker on its base, world axes"
    frames = _frames(dataset["time"].values)
    times = f"none in a run: convert it back with --rate {1e3 / (frames['interval_ms'] or math.inf):.6g}"
    return {"kind": "run", **frames, "times": times, "whiskers": dataset.sizes["whisker"], "units": units}


def _frames(times: Any) -> dict[str, Any]:
    """Return number, first time and interval of frames."""
    first, last = 1e3 * times[0], 1e3 * times[-1]
    interval = (last - first) / max(1, len(times) - 1)
    return {"frames": len(times), "first_ms": round(first, 4), "interval_ms": round(interval, 4)}


def _in_words(value: Any) -> str:
    """Return a value for people: nested counts as ``name: count``, without zeros."""
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {_in_words(item)}" for name, item in value.items() if item) or "none"
    return ", ".join(value) if isinstance(value, list) else f"{value:,}" if isinstance(value, int) else str(value)


def import_model(
    file: Annotated[Path, typer.Argument(help="Lightning .ckpt, state dict of PyTorch, or .safetensors.")],
    architecture: Annotated[str | None, typer.Option(help="Registry name, where the file leaves a choice.")] = None,
    config: Annotated[Path | None, typer.Option(help="The run's settings: config.yaml, or its graph in JSON.")] = None,
    out: Annotated[Path | None, out_folder_option("Folder to write.")] = None,
) -> Output:
    """Turn weights of the published study into a model that can be scored; nothing in the file is executed."""
    from brainbench.published.checkpoint_import import import_checkpoint

    with progress_bar("importing the weights"):
        imported = import_checkpoint(file, architecture=architecture, config=config, out=out)
    left = ", ".join(f"{part} ({count} entries)" for part, count in imported.not_imported.items())
    summary = {
        "architecture": imported.architecture,
        "decoder": imported.decoder or "not in the file: drawn from seed 0",
        "objective": imported.objective or "not told by the file",
        "parameters in the file": f"{imported.parameters:,}",
        "not part of the network": left or "nothing",
        "score it with": f"brainbench score {imported.name}",
    }
    return Output(imported, facts(summary))
