"""How long calls take, on a processor or on a GPU."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray


def seconds(
    work: Callable[[], object], repeats: int, *, warm: int = 1, wait: Callable[[], object] | None = None
) -> NDArray[np.float64]:
    """Return the wall time of each of several calls [s].

    Args:
        work: what is timed.
        repeats: number of calls.
        warm: calls before them, which are not timed.
        wait: returns when a device has done what it was given, such as ``torch.cuda.synchronize``.
    """
    times = []
    for _ in range(warm + repeats):
        if wait is not None:
            wait()
        start = time.perf_counter()
        work()
        if wait is not None:
            wait()
        times.append(time.perf_counter() - start)
    return np.array(times[warm:])
