"""Run shards on the workers of a Dask cluster, which see the folder under the same path."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brainbench.core.errors import DataError, UsageError, missing_dependency
from brainbench.stimuli.sweeps.shards import make_shard

if TYPE_CHECKING:
    from brainbench.stimuli.sweeps.plan import ShardTask

TIMEOUT = 30
"""Seconds that the scheduler may take to answer."""
AHEAD = 4
"""Shards that wait at the scheduler for each thread of the cluster."""


def run_on_cluster(tasks: Sequence[ShardTask], folder: Path, scheduler: str, done: Callable[[int], None]) -> None:
    """Make shards on a cluster, one thread each; call ``done`` after each.

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

        for _ in range(AHEAD * threads):
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
