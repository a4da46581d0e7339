"""Time of the control loop: ahead of other work of the computer, how long ticks take, how regularly they come."""

from __future__ import annotations

import contextlib
import gc
import math
import os
from collections import deque
from collections.abc import Iterator
from typing import Any

import numpy as np

from brainbench.core.errors import UsageError

PRIORITY = 20
"""Priority under SCHED_FIFO (1–99); above ordinary threads, below the kernel's own (50)."""


@contextlib.contextmanager
def realtime() -> Iterator[None]:
    """Run the calling thread ahead of all ordinary ones (SCHED_FIFO) and without garbage collection, until it leaves.

    Processes that it starts meanwhile are ordinary. A loop that never sleeps would keep a processor to itself.
    """
    if not hasattr(os, "SCHED_FIFO"):
        raise UsageError("Real-time scheduling is Linux's; leave realtime out on this system.")
    before, parameters, collecting = os.sched_getscheduler(0), os.sched_getparam(0), gc.isenabled()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(PRIORITY))
    except PermissionError as error:
        raise UsageError(
            f"This user may not run threads at real-time priority {PRIORITY}; allow it with the line "
            f"'{os.environ.get('USER', 'USER')} - rtprio {PRIORITY}' in /etc/security/limits.conf, or leave realtime "
            "out."
        ) from error
    gc.disable()
    try:
        yield
    finally:
        os.sched_setscheduler(0, before, parameters)
        if collecting:
            gc.enable()


class LatencyHistogram(list[float]):
    """Durations of ticks (s) in logarithmic buckets, 10 per decade from 10 µs to 10 s. Percentiles are exact."""

    EDGES = np.logspace(-5, 1, 61)
    """[61] (s)."""

    def summary(self) -> dict[str, Any]:
        """Return the number of ticks, percentiles and the longest in milliseconds; NaN without any."""
        parts = {f"p{share:g}": 1e3 * float(np.percentile(self or [math.nan], share)) for share in (50, 90, 99, 99.9)}
        return {"ticks": len(self), **parts, "max": 1e3 * max(self, default=math.nan)}

    def text(self, width: int = 40) -> str:
        """Return the histogram as lines of text, without empty ends."""
        # Durations below each edge, and beyond the last.
        counts = np.bincount(np.searchsorted(self.EDGES, self, side="right"), minlength=len(self.EDGES) + 1)
        used = np.flatnonzero(counts)
        if not len(used):
            return "no ticks"
        lines = []
        for bucket in range(used[0], used[-1] + 1):
            top = f"{1e3 * self.EDGES[bucket]:8.3g} ms" if bucket < len(self.EDGES) else "    more    "
            bar = "█" * round(width * counts[bucket] / counts.max())
            lines.append(f"< {top} {counts[bucket]:6d} {bar}")
        return "\n".join(lines)


class RateMonitor:
    """The rate of ticks [Hz] over a sliding window (s), beside a nominal one."""

    def __init__(self, rate: float, window: float = 1.0) -> None:
        self.rate, self.window = rate, window
        self._times: deque[float] = deque()
        self._begun: float | None = None

    def tick(self, now: float) -> float:
        """Count a tick; return the rate over the window [Hz], the nominal one until a window has passed."""
        # A window that is not full yet would count too few ticks and stop every session at its beginning.
        self._begun = now if self._begun is None else self._begun
        self._times.append(now)
        while self._times and self._times[0] <= now - self.window:
            self._times.popleft()
        if now - self._begun < self.window:
            return self.rate
        return len(self._times) / self.window
