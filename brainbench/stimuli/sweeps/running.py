"""Run shards: on a pool of processes, through a GPU, or on the workers of a Dask cluster."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from itertools import islice
from pathlib import Path

from brainbench.core.devices import usable_processors
from brainbench.core.errors import DataError
from brainbench.core.jobs import pool_died, run_on_cluster, stop_pool, worker_pool
from brainbench.stimuli.sweeps.plan import ShardTask
from brainbench.stimuli.sweeps.shards import PreparedShard, make_shard, prepare_shard, simulate_shard, write_shard

Done = Callable[[int], None]
"""Called with the number of sweeps of a shard that is written."""

WRITERS = 4
"""Threads that write shards behind a GPU: one hashes about 1 GB/s."""
AHEAD = 4
"""Shards at least that are prepared ahead of the simulation; as many as there are processes to do it, if more."""


def run_here(tasks: Sequence[ShardTask], folder: Path, workers: int | None, done: Done) -> None:
    """Make shards on a pool of processes, or one after the other through a GPU; call ``done`` after each.

    A process that died is a :class:`DataError`.
    """
    count = workers or usable_processors()
    try:
        if tasks[0].settings.device != "cpu":
            run_pipelined(tasks, folder, count, done)
        elif min(count, len(tasks)) == 1:
            for task in tasks:
                done(make_shard(task, str(folder), count))
        else:
            _run_pool(tasks, folder, count, done)
    except BrokenProcessPool as error:
        raise DataError(pool_died("Every finished shard")) from error


def run_shards_on_cluster(tasks: Sequence[ShardTask], folder: Path, scheduler: str, done: Done) -> None:
    """Make shards on a cluster, whose workers see the folder under the same path, one thread each.

    A shard whose worker dies is made by another one: nothing is there before it is complete.

    Raises:
        MissingDependencyError: Dask is not installed.
        UsageError: no scheduler answers at this address, or it has no workers.
        DataError: a shard failed, or the workers write to a disk of their own.
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


def _run_pool(tasks: Sequence[ShardTask], folder: Path, workers: int, done: Done) -> None:
    processes = min(workers, len(tasks))
    with worker_pool(processes) as pool:
        futures = [pool.submit(make_shard, task, str(folder), max(1, workers // processes)) for task in tasks]
        try:
            for future in as_completed(futures):
                done(future.result())
        except BaseException:
            stop_pool(pool)
            raise


def run_pipelined(tasks: Sequence[ShardTask], folder: Path, workers: int, done: Done) -> None:
    """Make shards one after the other in this process while others build objects and threads hash and write.

    The objects of as many shards as there are workers and the forces of :data:`WRITERS` + 1 shards are in memory.
    """
    with worker_pool(min(workers, len(tasks))) as builders, ThreadPoolExecutor(WRITERS) as writers:
        writing: deque[Future[int]] = deque()
        try:
            for task, prepared in _built_ahead(tasks, builders, max(AHEAD, workers)):
                content = simulate_shard(task, prepared, workers)
                if len(writing) == WRITERS:
                    done(writing.popleft().result())
                writing.append(writers.submit(write_shard, content, folder))
                del content
            while writing:
                done(writing.popleft().result())
        except BaseException:
            stop_pool(builders)
            raise


def _built_ahead(
    tasks: Sequence[ShardTask], builders: ProcessPoolExecutor, ahead: int
) -> Iterator[tuple[ShardTask, PreparedShard]]:
    coming: deque[Future[PreparedShard]] = deque()
    waiting = iter(tasks)
    for task in tasks:
        coming.extend(builders.submit(prepare_shard, later) for later in islice(waiting, ahead + 1 - len(coming)))
        yield task, coming.popleft().result()
