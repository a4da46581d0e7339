"""Run the shards of a data set here, on a pool, a GPU or a Dask cluster, and write the manifest of what came out."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import shutil
import time
from collections.abc import Callable, Iterable, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import SWEEPS_FORMAT, SWEEPS_SCHEMA
from brainbench.core.errors import DataError, UsageError
from brainbench.core.files import content_hash, is_temporary, lock_folder, provenance, write_json
from brainbench.core.progress import Progress
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.reading.ranges import check_number
from brainbench.core.runs.folder import begin_run
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.error_estimates import LARGEST_ERROR
from brainbench.stimuli.sweeps import running
from brainbench.stimuli.sweeps.plan import SPLITS, GenerationPlan, Plan, PlannedShard
from brainbench.stimuli.sweeps.shards import COUNTS, OK, UNUSABLE

_LOG = logging.getLogger(__name__)
MANIFEST = "manifest.json"

_COUNTS = (*COUNTS, "unstable", "unusable")


def is_complete(path: Path, task: PlannedShard) -> bool:
    """Return whether the file of a shard is there and complete; a shard of another data set is a :class:`DataError`."""
    if not path.is_file():
        return False
    try:
        with open_hdf5(path, "shard") as file:
            owner = str(file.attrs["config_hash"])
            wrench: Any = file["wrench"]
            end = wrench.id.get_offset() + wrench.size * wrench.dtype.itemsize
            whole = wrench.shape[0] == len(task) and path.stat().st_size >= end
    except DataError:
        return False
    if owner != task.config_hash:
        raise DataError(f"{str(path)!r} belongs to another data set; choose an empty folder, or remove what is there.")
    return whole


def make_manifest(plan: Plan, folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Put together the manifest of a finished data set from what its shards say.

    Equal data sets have equal manifests on one machine: there is no time in it.
    """
    objects: dict[str, dict[str, Any]] = {
        name: {"label": source.label, "source": source.source, "hash": None, "sweeps": {}, "untouched": True}
        for name, source in plan.objects.items()
    }
    errors: list[NDArray[np.float32]] = []
    shards = [_read(Path(folder) / task.name, task, objects, errors) for task in plan.shards]
    for name, entry in objects.items():
        if not entry["untouched"]:
            del entry["untouched"]
            continue
        _LOG.warning(
            "%s: no whisker touches this object in any of its %d sweeps; heights of sweeps are those of its origin, so "
            "move the mesh until its origin is in its middle.", name, sum(entry["sweeps"].values()),
        )  # fmt: skip
    totals = {name: sum(shard[name] for shard in shards) for name in _COUNTS}
    about = provenance()
    del about["time"]
    return {
        "format": SWEEPS_FORMAT, "schema": SWEEPS_SCHEMA,
        "content_hash": content_hash([[shard["name"], shard["content_hash"]] for shard in shards]),
        "config_hash": plan.config_hash, "config": plan.config, "provenance": about, "classes": list(plan.classes),
        "sweeps": plan.sweeps, **totals, **_spread(errors), **plan.notes,
        "splits": {split: _summary(item for item in shards if item["split"] == split) for split in SPLITS},
        "shards": shards, "objects": objects,
    }  # fmt: skip


def _spread(errors: Sequence[NDArray[np.float32]]) -> dict[str, Any]:
    """Return what the manifest says of the estimated errors of whiskers in contact; nothing without any.

    A number is None where the error cannot be told, since the finer simulation failed.
    """
    values = np.concatenate([*errors, []])
    if not len(values):
        return {}
    median, most, worst = (
        None if math.isinf(value) else float(value) for value in np.quantile(values, (0.5, 0.9, 1), method="higher")
    )
    beyond = int(np.count_nonzero(values > LARGEST_ERROR))
    return {"errors": {"whiskers": len(values), "median": median, "q90": most, "worst": worst, "beyond": beyond}}


def _read(
    path: Path, task: PlannedShard, objects: dict[str, dict[str, Any]], errors: list[NDArray[np.float32]]
) -> dict[str, Any]:
    """Return what the manifest says of a shard, and add what it says to its ``objects`` and to ``errors``."""
    with open_hdf5(path, "shard", "Run the same command again.") as opened:
        file: Any = opened
        # Shards of data sets that were begun before steps were counted as unsolved do not tell.
        counts = {name: int(file.attrs.get(name, 0) if name == "unsolved" else file.attrs[name]) for name in _COUNTS}
        digest = str(file.attrs["content_hash"])
        hashes = [value.decode() for value in file["object_hash"][:]]
        owner, status, reasons = file["owner"][:], file["status"][:], file["reason"][:]
        # Sweeps that failed, and converted ones whose contacts are NaN, are not known to be untouched.
        touched = ((file["contact"][:] != 0) | (status != OK)).any(axis=1)
        if "error" in file:
            error = file["error"][:]
            errors.append(error[~np.isnan(error) & (file["contact"][:] > 0)])
    for index, body in enumerate(task.objects):
        mine, entry = np.flatnonzero(owner == index), objects[body.name]
        if entry["hash"] not in (None, hashes[index]):
            raise DataError(
                f"The object {body.name!r} was not built alike in all shards (hashes {entry['hash']} and "
                f"{hashes[index]}): its file changed meanwhile, or machines differ; generate the data set again in an "
                "empty folder."
            )
        entry["hash"] = hashes[index]
        entry["sweeps"][task.split] = entry["sweeps"].get(task.split, 0) + len(mine)
        entry["untouched"] &= not touched[mine].any()
        broken = mine[(status[mine] == UNUSABLE).any(axis=1)]
        if len(broken) and (reason := reasons[broken[0]].decode()):
            entry["unusable"] = reason
    about = {"name": task.name, "split": task.split, "sweeps": len(task), "bytes": path.stat().st_size}
    return {**about, "content_hash": digest, **counts}


def _summary(shards: Iterable[dict[str, Any]]) -> dict[str, int]:
    chosen = list(shards)
    counted = {name: sum(shard[name] for shard in chosen) for name in ("sweeps", "bytes", "unstable", "unusable")}
    return {"shards": len(chosen), **counted}


_SPARE = 64e6  # bytes of disk that are left free


def generate(
    plan: GenerationPlan,
    out: str | os.PathLike[str],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the shards of a data set that are missing in a folder, then its manifest, and return the manifest.

    A run that was killed goes on when it is started again. Neither ``workers`` nor the scheduler changes a byte.
    Processes on this machine import the script that called this, so its work must stand under
    ``if __name__ == "__main__":``.

    Args:
        plan: what to make.
        out: the folder; with a scheduler, one that all workers see under this path.
        workers: processes on this machine; as many as there are usable processors when None.
        scheduler: address of a Dask scheduler (``tcp://host:8786``), whose workers make the shards instead.
        progress: called as ``progress(sweeps done, sweeps in all, what)``, without those that were there already.
    """
    if workers is not None:
        check_number("workers", workers, least=1, whole=True)
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise UsageError(
            "Data is generated by processes that import the script which asked for it, and this script asks again when "
            "it is imported; put what it does under: if __name__ == '__main__':"
        )
    get_engine(plan.settings.backend, device=plan.settings.device)

    def run(missing: Sequence[Any], folder: Path, done: Callable[[int], None]) -> None:
        if scheduler is not None:
            running.run_shards_on_cluster(missing, folder, scheduler, done)
        elif missing:
            running.run_here(missing, folder, workers, done)

    return write_data_set(plan, out, run, what="simulating sweeps", progress=progress)


def write_data_set(
    plan: Plan,
    out: str | os.PathLike[str],
    run: Callable[[Sequence[Any], Path, Callable[[int], None]], None],
    *,
    what: str,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Let ``run(missing shards, folder, done)`` write the shards that are missing, then write and return the manifest.

    ``run`` calls ``done`` with the number of sweeps of each shard that it wrote. Errors are those of :func:`generate`.
    """
    folder = Path(out).absolute()
    with lock_folder(folder, wait=False):
        begin_run(folder, plan.config, "data set", results="*.h5")
        _clean(folder)
        missing = [task for task in plan.shards if not is_complete(folder / task.name, task)]
        _check_space(missing, folder)
        report = _reporter(sum(map(len, missing)), what, progress)
        if len(missing) < len(plan.shards):
            _LOG.info("%d of %d shards are there already", len(plan.shards) - len(missing), len(plan.shards))
        run(missing, folder, report)
        _clean(folder)
        manifest = make_manifest(plan, folder)
        write_json(folder / MANIFEST, manifest)
    return manifest


def _reporter(total: int, what: str, progress: Progress | None) -> Callable[[int], None]:
    """Return what tells how far the run is: a progress bar, and the log every half minute with the time left."""
    done, started = 0, time.monotonic()
    logged = started

    def report(sweeps: int) -> None:
        nonlocal done, logged
        done += sweeps
        if progress is not None:
            progress(done, total, what)
        now = time.monotonic()
        if now - logged >= 30 or done == total:
            logged = now
            rate = done / max(now - started, 1e-9)
            rest = timedelta(seconds=round((total - done) / rate))
            _LOG.info("%d of %d sweeps, %.3g sweeps/s, about %s left", done, total, rate, rest)

    return report


def _clean(folder: Path) -> None:
    """Remove what processes that were killed left half-written."""
    for path in folder.iterdir():
        if is_temporary(path.name):
            path.unlink(missing_ok=True)


def _check_space(missing: Sequence[PlannedShard], folder: Path) -> None:
    needed = sum(task.bytes for task in missing)
    free = shutil.disk_usage(folder).free
    if needed + _SPARE > free:
        raise DataError(
            f"The {sum(map(len, missing)):,} sweeps still to be made take {needed / 1e6:,.0f} MB and {str(folder)!r} "
            f"has {free / 1e6:,.0f} MB free; choose another folder, fewer sweeps (--sample, --limit) or fewer whiskers."
        )
