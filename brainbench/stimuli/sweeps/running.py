"""Run shards: on a pool of processes, through a GPU, or on the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from pathlib import Path
from typing import Any

from brainbench.core.devices import usable_processors
from brainbench.core.errors import DataError, UsageError, missing_dependency
from brainbench.stimuli.sweeps.plan import ShardTask
from brainbench.stimuli.sweeps.shards import PreparedShard, make_shard, prepare_shard, simulate_shard, write_shard

Done = Callable[[int], None]
"""Called with the number of sweeps of a shard that is written."""

WRITERS = 4
"""Threads that write shards behind a GPU: one hashes about 1 GB/s."""
AHEAD = 4
"""Shards at least that are prepared ahead of the simulation; as many as there are processes to do it, if more."""
TIMEOUT = 30
"""Seconds that the scheduler of a cluster may take to answer."""
QUEUED = 4
"""Shards that wait at the scheduler for each thread of the cluster."""


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
        raise DataError(
            "A process of the pool ended unexpectedly, perhaps for want of memory, or because the script that started "
            "it works outside of: if __name__ == '__main__':. The finished shards are kept: run the same again, with "
            "fewer workers if this recurs."
        ) from error


def run_on_cluster(tasks: Sequence[ShardTask], folder: Path, scheduler: str, done: Done) -> None:
    """Make shards on a cluster, whose workers see the folder under the same path, one thread each.

    A shard whose worker dies is made by another one: nothing is there before it is complete.

    Raises:
        MissingDependencyError: Dask is not installed.
        UsageError: no scheduler answers at this address, or it has no workers.
        DataError: a shard failed, or the workers write to a disk of their own.
    """
    try:
        from distributed import Client, as_completed
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        raise missing_dependency("distributed", extra="cluster", purpose="A --scheduler") from error
    try:
        client: Any = Client(scheduler, timeout=TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise UsageError(f"No Dask scheduler answers at {scheduler!r} ({error}); start one: dask scheduler.") from error
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UsageError(
                f"The Dask scheduler at {scheduler!r} has no workers; start some: dask worker {scheduler}."
            )
        waiting = iter(tasks)
        futures = as_completed(loop=client.loop)
        running: dict[str, ShardTask] = {}

        def submit() -> None:
            task = next(waiting, None)
            if task is not None:
                # Named by what it makes: an equal task of a client that was killed is not made twice.
                key = f"{folder / task.name}-{task.config_hash}"
                future = client.submit(make_shard, task, str(folder), 1, key=key)
                running[future.key] = task
                futures.add(future)

        for _ in range(QUEUED * threads):
            submit()
        for future in futures:
            task = running.pop(future.key)
            try:
                sweeps = future.result()
            except KilledWorker as error:
                raise DataError(
                    f"Several workers died while they made {task.name}, perhaps for want of memory; the finished "
                    "shards are kept: run the same command again with more memory per worker."
                ) from error
            if not (folder / task.name).is_file():
                raise DataError(
                    f"A worker wrote {task.name}, but not here: {str(folder)!r} must be a folder that this machine and "
                    "all workers share."
                )
            done(sweeps)
            submit()


def _run_pool(tasks: Sequence[ShardTask], folder: Path, workers: int, done: Done) -> None:
    processes = min(workers, len(tasks))
    with _pool(processes) as pool:
        futures = [pool.submit(make_shard, task, str(folder), max(1, workers // processes)) for task in tasks]
        try:
            for future in as_completed(futures):
                done(future.result())
        except BaseException:
            _stop(pool)
            raise


def run_pipelined(tasks: Sequence[ShardTask], folder: Path, workers: int, done: Done) -> None:
    """Make shards one after the other in this process while others build objects and threads hash and write.

    The objects of as many shards as there are workers and the forces of :data:`WRITERS` + 1 shards are in memory.
    """
    with _pool(min(workers, len(tasks))) as builders, ThreadPoolExecutor(WRITERS) as writers:
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
            _stop(builders)
            raise


def _built_ahead(
    tasks: Sequence[ShardTask], builders: ProcessPoolExecutor, ahead: int
) -> Iterator[tuple[ShardTask, PreparedShard]]:
    coming: deque[Future[PreparedShard]] = deque()
    waiting = iter(tasks)
    for task in tasks:
        coming.extend(builders.submit(prepare_shard, later) for later in islice(waiting, ahead + 1 - len(coming)))
        yield task, coming.popleft().result()


def _pool(processes: int) -> ProcessPoolExecutor:
    # Not forked: physics engines and their threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(processes, mp_context=context, initializer=_start_worker)


def _stop(pool: ProcessPoolExecutor) -> None:
    """End a pool without waiting for shards that are being made: nothing is there before it is complete."""
    processes = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()


def _start_worker() -> None:
    """Leave interrupts to the parent process, and end when it ends in whatever way."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)
