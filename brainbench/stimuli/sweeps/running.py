"""Run shards: on a pool of processes, through a GPU, or on the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed, wait
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import connection
from multiprocessing.process import BaseProcess
from pathlib import Path

from brainbench.core.devices import gpus, pick_device, usable_processors
from brainbench.core.errors import BrainbenchError, DataError
from brainbench.core.runs.jobs import (
    STOPPING,
    pool_died,
    run_jobs,
    run_on_cluster,
    start_worker,
    stop_pool,
    worker_pool,
)
from brainbench.stimuli.sweeps.plan import ShardTask
from brainbench.stimuli.sweeps.shards import (
    BuiltObject,
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

    def make(task: ShardTask, objects: Sequence[BuiltObject]) -> int:
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
                    making.add(threads.submit(make, task, objects))
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
