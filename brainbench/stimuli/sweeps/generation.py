"""Run the shards of a data set here, on a pool, a GPU or a Dask cluster, and write the manifest of what came out."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import shutil
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed, wait
from concurrent.futures.process import BrokenProcessPool
from datetime import timedelta
from functools import partial
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import SWEEPS_FORMAT, SWEEPS_SCHEMA
from brainbench.core.devices import gpus, pick_device, usable_processors
from brainbench.core.errors import BrainbenchError, DataError, UsageError, check_number
from brainbench.core.files import content_hash, is_temporary, lock_folder, provenance, write_json
from brainbench.core.progress import Progress
from brainbench.core.reading.hdf5 import open_hdf5
from brainbench.core.runs.folder import begin_run
from brainbench.core.runs.jobs import (
    STOPPING,
    pool_died,
    run_jobs,
    run_on_cluster,
    start_worker,
    stop_pool,
    worker_pool,
)
from brainbench.stimuli.engines import get_engine
from brainbench.stimuli.engines.error_estimates import LARGEST_ERROR
from brainbench.stimuli.objects.collections import NamedObject
from brainbench.stimuli.sweeps.plan import (
    COUNTS,
    OK,
    SPLITS,
    UNUSABLE,
    BuiltObject,
    GenerationPlan,
    PlannedShard,
    ShardTask,
    build_object,
    make_shard,
    simulate_shard,
    warm_up,
    write_shard,
)

Done = Callable[[int], None]  # called with the number of sweeps of a shard that is written

SIDE_BY_SIDE = 16
"""Most shards that are simulated on one GPU at the same time. Whiskers that are simulated again are few and take many
steps one after the other, however idle the GPU is, which meanwhile computes those of other shards."""
WHISKER_BYTES = 10_000, 32
"""Room on a GPU for a whisker of a sweep, and for each of its frames more: state, contacts and results."""
WRITERS = 4  # shards behind a GPU that may be hashed and written meanwhile: one thread hashes about 1 GB/s
AHEAD = 4
"""Shards at least whose objects are built ahead of the simulation; more if a process would have nothing to do."""
STARTING = 8  # objects that take about as long to build as a process to start


def run_here(tasks: Sequence[ShardTask], folder: Path, workers: int | None, done: Done) -> None:
    """Make shards on a pool of processes, or on all GPUs that are visible; call ``done`` after each.

    A process that died is a :class:`DataError`.
    """
    count = workers or usable_processors()
    if tasks[0].settings.device == "cpu":
        processes = min(count, len(tasks))
        make = partial(make_shard, folder=str(folder), workers=max(1, count // processes))
        for _, sweeps in run_jobs(make, tasks, workers=processes, threads=None):
            done(sweeps)
        return
    try:
        run_on_gpus(tasks, folder, count, done)
    except BrokenProcessPool as error:
        raise DataError(pool_died("Every finished shard")) from error


def run_shards_on_cluster(tasks: Sequence[ShardTask], folder: Path, scheduler: str, done: Done) -> None:
    """Make shards on a cluster, whose workers see the folder under the same path, one thread each.

    A shard whose worker dies is made by another one: nothing is there before it is complete.
    """
    names = [f"{folder / task.name}-{task.config_hash}" for task in tasks]
    make = partial(make_shard, folder=str(folder), workers=1)
    for place, sweeps in run_on_cluster(make, tasks, scheduler, names):
        name = tasks[place].name
        if not (folder / name).is_file():
            raise DataError(
                f"A worker wrote {name}, but not here: {str(folder)!r} must be a folder that this machine and all "
                "workers share."
            )
        done(sweeps)


def run_on_gpus(tasks: Sequence[ShardTask], folder: Path, workers: int, done: Done) -> None:
    """Make shards on all GPUs that are visible, each of several by a process of its own; call ``done`` after each."""
    # So that kernels of one thread never queue behind those of another; read when the GPU is first used.
    os.environ.setdefault("CUDA_DEVICE_MAX_CONNECTIONS", "32")
    names = gpus()[: len(tasks)]
    if len(names) == 1:
        run_pipelined(tasks, folder, workers, done)
        return
    context = multiprocessing.get_context("spawn")
    heard: dict[connection.Connection, BaseProcess] = {}
    try:
        for place, name in enumerate(names):
            mine, theirs = context.Pipe(duplex=False)
            share = tasks[place :: len(names)], folder, max(1, workers // len(names))
            heard[mine] = context.Process(target=_run_share, args=(name, theirs, *share))
            heard[mine].start()
            # Only the process holds its end now, so that the pipe closes when it ends.
            theirs.close()
        while heard:
            ready = connection.wait(list(heard))
            for pipe in [pipe for pipe in heard if pipe in ready]:
                try:
                    message = pipe.recv()
                except EOFError:
                    raise DataError(pool_died("Every finished shard")) from None
                if isinstance(message, str):
                    raise DataError(message)
                if message is None:
                    heard.pop(pipe).join()
                else:
                    done(message)
    finally:
        for process in heard.values():
            process.terminate()


def _run_share(gpu: str, pipe: connection.Connection, tasks: Sequence[ShardTask], folder: Path, workers: int) -> None:
    """Make shards on one GPU; send the sweeps of each, then None, or what went wrong."""
    start_worker()
    os.environ["CUDA_VISIBLE_DEVICES"] = gpu
    try:
        run_pipelined(tasks, folder, workers, pipe.send)
        pipe.send(None)
    except BrainbenchError as error:
        pipe.send(str(error))


def run_pipelined(tasks: Sequence[ShardTask], folder: Path, workers: int, done: Done) -> None:
    """Make shards in threads of this process, some at the same time, while other processes build objects.

    The objects of some shards ahead (:data:`AHEAD`) and the forces of at most :data:`SIDE_BY_SIDE` + :data:`WRITERS`
    shards are in memory.
    """
    at_once = _shards_at_once(tasks[0])
    free = threading.Semaphore(at_once)

    def _make(task: ShardTask, objects: Sequence[BuiltObject]) -> int:
        with free:
            content = simulate_shard(task, objects, workers)
        return write_shard(content, folder)

    most = min(at_once + WRITERS, len(tasks))
    making: set[Future[int]] = set()
    processes = min(workers, max(len(tasks), sum(len(task.objects) for task in tasks) // STARTING))
    try:
        with worker_pool(processes) as builders, ThreadPoolExecutor(most) as threads:
            try:
                # Fails where the first shard will fail, which tells of it.
                threads.submit(warm_up, tasks[0])
                for task, objects in _built_ahead(tasks, builders, processes):
                    making.add(threads.submit(_make, task, objects))
                    del objects
                    if len(making) == most:
                        ended, making = wait(making, return_when=FIRST_COMPLETED)
                        for shard in ended:
                            done(shard.result())
                for shard in as_completed(making):
                    done(shard.result())
            except BaseException:
                STOPPING.set()
                stop_pool(builders)
                threads.shutdown(wait=False, cancel_futures=True)
                raise
    finally:
        STOPPING.clear()


def _shards_at_once(task: ShardTask) -> int:
    """Return how many shards like this one are simulated at the same time: as many as the memory of a GPU takes."""
    if task.settings.device == "cpu":
        return SIDE_BY_SIDE
    fixed, each = WHISKER_BYTES
    needed = len(task) * len(task.config["whiskers"]["names"]) * (fixed + each * task.frames)
    return max(1, min(SIDE_BY_SIDE, pick_device(task.settings.device).free_memory // needed))


def _built_ahead(
    tasks: Sequence[ShardTask], builders: ProcessPoolExecutor, processes: int
) -> Iterator[tuple[ShardTask, list[BuiltObject]]]:
    """Yield shards in order while the objects of the next ones are built, each by any of the processes."""
    coming: deque[list[Future[BuiltObject]]] = deque()
    waiting = iter(tasks)
    for task in tasks:
        while len(coming) <= AHEAD or sum(map(len, coming)) < 2 * processes:
            if (later := next(waiting, None)) is None:
                break
            build = partial(build_object, settings=later.settings, grid=later.grid)
            coming.append([builders.submit(build, item) for item in later.objects])
        yield task, [one.result() for one in coming.popleft()]


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


def make_manifest(
    tasks: Sequence[PlannedShard],
    sources: Mapping[str, NamedObject],
    folder: str | os.PathLike[str],
    notes: Mapping[str, Any],
) -> dict[str, Any]:
    """Put together the manifest of a finished data set from what its shards say.

    Equal data sets have equal manifests on one machine: there is no time in it.
    """
    objects: dict[str, dict[str, Any]] = {
        name: {"label": source.label, "source": source.source, "hash": None, "sweeps": {}, "untouched": True}
        for name, source in sources.items()
    }
    errors: list[NDArray[np.float32]] = []
    shards = [_read(Path(folder) / task.name, task, objects, errors) for task in tasks]
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
        "config_hash": tasks[0].config_hash, "config": tasks[0].config, "provenance": about,
        "classes": list(tasks[0].classes), "sweeps": sum(map(len, tasks)), **totals, **_spread(errors), **notes,
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
        counts = {name: int(file.attrs[name]) for name in _COUNTS}
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

    def _run(missing: Sequence[Any], folder: Path, done: Callable[[int], None]) -> None:
        if scheduler is not None:
            run_shards_on_cluster(missing, folder, scheduler, done)
        elif missing:
            run_here(missing, folder, workers, done)

    return write_data_set(plan.shards, plan.objects, out, _run, what="simulating sweeps", progress=progress)


def write_data_set(
    shards: Sequence[PlannedShard],
    objects: Mapping[str, NamedObject],
    out: str | os.PathLike[str],
    run: Callable[[Sequence[Any], Path, Callable[[int], None]], None],
    *,
    what: str,
    notes: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Let ``run(missing shards, folder, done)`` write the shards that are missing, then write and return the manifest.

    ``run`` calls ``done`` with the number of sweeps of each shard that it wrote; ``shards`` are those of training
    first, past ``objects`` by name, and ``notes`` further entries of the manifest. Errors are those of
    :func:`generate`.
    """
    folder = Path(out).absolute()
    with lock_folder(folder, wait=False):
        begin_run(folder, shards[0].config, "data set", results="*.h5")
        _clean(folder)
        missing = [task for task in shards if not is_complete(folder / task.name, task)]
        needed, free = sum(task.bytes for task in missing), shutil.disk_usage(folder).free
        sweeps = sum(map(len, missing))
        if needed + _SPARE > free:
            raise DataError(
                f"The {sweeps:,} sweeps still to be made take {needed / 1e6:,.0f} MB and {str(folder)!r} has "
                f"{free / 1e6:,.0f} MB free; choose another folder, fewer sweeps (--sample, --limit) or fewer whiskers."
            )
        report = _reporter(sweeps, what, progress)
        if len(missing) < len(shards):
            _LOG.info("%d of %d shards are there already", len(shards) - len(missing), len(shards))
        run(missing, folder, report)
        _clean(folder)
        manifest = make_manifest(shards, objects, folder, notes or {})
        write_json(folder / MANIFEST, manifest)
    return manifest


def _reporter(total: int, what: str, progress: Progress | None) -> Callable[[int], None]:
    """Return what tells how far the run is: a progress bar, and the log every half minute with the time left."""
    done, started = 0, time.monotonic()
    logged = started

    def _report(sweeps: int) -> None:
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

    return _report


def _clean(folder: Path) -> None:
    """Remove what processes that were killed left half-written."""
    for path in folder.iterdir():
        if is_temporary(path.name):
            path.unlink(missing_ok=True)
