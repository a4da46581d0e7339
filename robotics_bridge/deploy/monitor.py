"""How long control ticks take and how regularly they come."""

from __future__ import annotations

import math
from collections import deque
from typing import Any

import numpy as np


class LatencyHistogram:
    """Counts durations in logarithmic buckets, 10 per decade from 10 µs to 10 s; percentiles are exact."""

    def __init__(self) -> None:
        self.edges = np.logspace(-5, 1, 61)
        """[61] (s)."""
        self.counts = np.zeros(62, dtype=np.int64)
        self._values: list[float] = []

    def add(self, seconds: float) -> None:
        """Count a duration."""
        self.counts[int(np.searchsorted(self.edges, seconds, side="right"))] += 1
        self._values.append(seconds)

    def __len__(self) -> int:
        return len(self._values)

    def percentile(self, share: float) -> float:
        """Return the duration (s) that a share (0 to 100) of ticks stays below; NaN without any."""
        return float(np.percentile(self._values, share)) if self._values else math.nan

    def summary(self) -> dict[str, Any]:
        """Return counts and percentiles in milliseconds."""
        parts = {f"p{share:g}": 1e3 * self.percentile(share) for share in (50, 90, 99, 99.9)}
        return {"ticks": len(self), **parts, "max": 1e3 * max(self._values, default=math.nan)}

    def text(self, width: int = 40) -> str:
        """Return the histogram as lines of text, without empty ends."""
        used = np.flatnonzero(self.counts)
        if not len(used):
            return "no ticks"
        lines = []
        for bucket in range(used[0], used[-1] + 1):
            top = f"{1e3 * self.edges[bucket]:8.3g} ms" if bucket < len(self.edges) else "    more    "
            bar = "█" * round(width * self.counts[bucket] / self.counts.max())
            lines.append(f"< {top} {self.counts[bucket]:6d} {bar}")
        return "\n".join(lines)


class RateMonitor:
    """The rate of ticks over a sliding window.

    Args:
        rate: Nominal [Hz].
        window: Seconds.
    """

    def __init__(self, rate: float, window: float = 1.0) -> None:
        self.rate, self.window = rate, window
        self._times: deque[float] = deque()
        self._begun: float | None = None

    def tick(self, now: float) -> float:
        """Count a tick; return the rate over the window [Hz], the nominal one until a window has passed."""
        self._begun = now if self._begun is None else self._begun
        self._times.append(now)
        while self._times and self._times[0] <= now - self.window:
            self._times.popleft()
        if now - self._begun < self.window:
            return self.rate
        return len(self._times) / self.window
