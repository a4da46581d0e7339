"""Which whiskers are simulated with finer steps before it is known that they need it.

Few whiskers take a GPU as long as the one with most steps. With steps over 2, 5, 10 and 20 one after the other these
waits add up to 38 times that of the first simulation; with 2 and 5, then 10 and 20 at the same time to 26. But half of
the tries that are simulated ahead are not needed: where other whiskers would have the GPU meanwhile, they cost more
time than they save (benchmarks/RESULTS.md, "Sweeps on a GPU, by the public command").
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from brainbench.stimuli.engines.trust import ONE_BY_ONE, Ahead

ON_AN_IDLE_GPU: Ahead = (1,), (2, 4)
"""Tries at the same time where nothing else waits for the GPU."""

_FIRST: Counter[str] = Counter()
"""First simulations that threads of this process have under way, by device."""
_LOCK = threading.Lock()


@contextmanager
def first_simulation(device: Any) -> Iterator[None]:
    """Tell other threads that all whiskers of some sweeps are simulated on a device, which fills a GPU."""
    with _LOCK:
        _FIRST[device.alias] += 1
    try:
        yield
    finally:
        with _LOCK:
            _FIRST[device.alias] -= 1


def tries_ahead(device: Any) -> Ahead:
    """Return the tries ahead (:func:`brainbench.stimuli.engines.trust.run_with_retries`) as the device is busy now.

    One by one on a processor, and on a GPU while any thread simulates sweeps for the first time: as long as shards
    queue, one of those that run does.
    """
    return ON_AN_IDLE_GPU if device.is_cuda and not _FIRST[device.alias] else ONE_BY_ONE
