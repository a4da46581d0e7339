"""Run independent jobs on a pool of processes of this machine, or on the workers of a Dask cluster."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from brainbench.core.errors import DataError, UsageError, check_number, needing

TIMEOUT = 30  # seconds that the scheduler of a cluster may take to answer
STOPPING = threading.Event()
"""Set while threads of this process should end early, because another one failed or the user interrupted."""
QUEUED = 4  # jobs that wait at the scheduler for each thread of the cluster


def run_jobs(
    function: Callable[[Any], Any],
    jobs: Sequence[Any],
    *,
    workers: int | None = None,
    scheduler: str | None = None,
    threads: int | None = 1,
) -> Iterator[tuple[int, Any]]:
    """Yield (place of a job, what the function returned for it) as jobs finish, in any order.

    Args:
        function: A function of a module, or a partial of one; with processes and clusters it is pickled.
        jobs: Its arguments, pickled too.
        workers: Processes on this machine; as many as there are usable processors when None. One: this process.
        scheduler: Address of a Dask scheduler (``tcp://host:8786``), whose workers do it instead.
        threads: As for :func:`worker_pool`.
    """
    from brainbench.core.devices import usable_processors

    if workers is not None:
        check_number("workers", workers, least=1, whole=True)
    if scheduler is not None:
        yield from run_on_cluster(function, jobs, scheduler)
        return
    processes = min(workers or usable_processors(), len(jobs))
    if processes <= 1:
        yield from ((place, function(job)) for place, job in enumerate(jobs))
        return
    try:
        with worker_pool(processes, threads=threads) as pool:
            places = {pool.submit(function, job): place for place, job in enumerate(jobs)}
            try:
                for future in as_completed(places):
                    yield places[future], future.result()
            except BaseException:
                stop_pool(pool)
                raise
    except BrokenProcessPool as error:
        raise DataError(pool_died("What is finished")) from error


def run_on_cluster(
    function: Callable[..., Any], jobs: Sequence[Any], scheduler: str, names: Sequence[str] | None = None
) -> Iterator[tuple[int, Any]]:
    """Yield (place of a job, result) from the workers of a Dask cluster; a job whose worker dies is done by another.

    Args:
        function, jobs: As in :func:`run_jobs`.
        scheduler: Its address.
        names: One per job, by which an equal job of a client that was killed is not done twice; hashes of the jobs
            by default.
    """
    with needing("distributed", extra="cluster", purpose="A --scheduler"):
        from distributed import Client, as_completed
        from distributed.scheduler import KilledWorker
    try:
        client: Any = Client(scheduler, timeout=TIMEOUT, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise UsageError(f"No Dask scheduler answers at {scheduler!r} ({error}); start one: dask scheduler.") from error
    with client:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UsageError(f"The Dask scheduler at {scheduler!r} has no workers; start one: dask worker {scheduler}.")
        waiting = iter(range(len(jobs)))
        futures = as_completed(loop=client.loop)
        running: dict[str, int] = {}

        def submit() -> None:
            """Hand the next job to the scheduler, if one is left."""
            place = next(waiting, None)
            if place is not None:
                future = client.submit(function, jobs[place], key=None if names is None else names[place])
                running[future.key] = place
                futures.add(future)

        for _ in range(QUEUED * threads):
            submit()
        for future in futures:
            place = running.pop(future.key)
            try:
                result = future.result()
            except KilledWorker as error:
                name = names[place] if names else f"job {place}"
                raise DataError(
                    f"Several workers died of {name}, perhaps for want of memory; what is finished is kept: run the "
                    "same command again with more memory per worker."
                ) from error
            yield place, result
            submit()


def worker_pool(processes: int, *, threads: int | None = None) -> ProcessPoolExecutor:
    """Return a pool of fresh processes that end with this one.

    Args:
        processes: Their number.
        threads: Threads that linear algebra takes in each; what its library chooses when None.
    """
    # Not forked: physics engines and their threads do not survive a fork.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(processes, mp_context=context, initializer=start_worker, initargs=(threads,))


def stop_pool(pool: ProcessPoolExecutor) -> None:
    """End a pool without waiting for jobs that are being done."""
    processes = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()


def pool_died(finished: str) -> str:
    """Return the sentence about a process that ended; ``finished`` names what is not lost."""
    return (
        "A process of the pool ended unexpectedly, perhaps for want of memory, or because the script that started "
        f"it works outside of: if __name__ == '__main__':. {finished} is kept: run the same again, with fewer "
        "workers if this recurs."
    )


def start_worker(threads: int | None = None) -> None:
    """Leave interrupts to the parent process, and end when it ends in whatever way."""
    if threads is not None:
        # Read by the libraries of linear algebra when they load, which is after this.
        for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
            os.environ[name] = str(threads)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()


def _end_with(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(0.2)
    os._exit(1)
