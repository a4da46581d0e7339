"""Jobs spread over native threads, with progress, and without what is left when one fails."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed

from brainbench.stimuli.engines.protocol import Progress
from brainbench.stimuli.motion.jobs import Trace


def run_groups(
    groups: Sequence[Sequence[int]],
    run: Callable[[Sequence[int]], Mapping[int, Trace]],
    *,
    threads: int,
    progress: Progress | None = None,
) -> list[Trace]:
    """Run groups of jobs, ``threads`` at a time, and return all traces in the order of the jobs.

    Each job stands in one group; ``progress`` is called as ``progress(done, total)`` when one is finished.
    """
    traces: dict[int, Trace] = {}
    total = sum(map(len, groups))
    with ThreadPoolExecutor(max_workers=threads) as pool:
        try:
            for future in as_completed([pool.submit(run, group) for group in groups]):
                for index, trace in future.result().items():
                    traces[index] = trace
                    if progress is not None:
                        progress(len(traces), total)
        except BaseException:
            # Without this an interrupt or a failed job would wait for every job that is still queued.
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [traces[index] for index in range(total)]
