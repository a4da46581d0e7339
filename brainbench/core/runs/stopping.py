"""When a run ends before its end: after a time, at a count, or when its scheduler says so."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

from brainbench.core.reading.ranges import check_number
from brainbench.core.writing.locks import lock_folder


class Stop:
    """Says when to stop: ``seconds`` after it was made, at a ``count`` of what is ``counted``, or on SIGTERM."""

    def __init__(self, seconds: float | None = None, count: int | None = None, counted: str = "steps") -> None:
        if seconds is not None:
            check_number("stop_after", seconds, least=0)
        self.seconds, self.count, self.counted = seconds, count, counted
        self.terminated = False
        self._start = time.monotonic()

    @property
    def elapsed(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._start

    def reason(self, done: int = 0) -> str:
        """Return why the run stops here, where ``done`` are counted; empty while it goes on."""
        if self.terminated:
            cause = "it received SIGTERM"
        elif self.seconds is not None and self.elapsed > self.seconds:
            cause = f"the {self.seconds:g} s allowed are over"
        elif self.count is not None and done >= self.count:
            cause = f"{self.count} {self.counted} are done, as many as were allowed"
        else:
            return ""
        return f"{cause}; start it again to go on"


@contextmanager
def occupied(folder: Path, stop: Stop, *, lock: bool = True) -> Iterator[None]:
    """Hold a run's folder, in which no other process may write meanwhile, and let SIGTERM ask the run to stop.

    Schedulers send that signal before they end a job: the run then saves its state first. Without ``lock``, as in all
    processes of a run but one, the folder is not held.
    """

    def terminate(number: int, frame: object) -> None:
        stop.terminated = True

    # Python delivers signals to the main thread alone, and lets no other one ask for them.
    listens = threading.current_thread() is threading.main_thread()
    with lock_folder(folder, wait=False) if lock else nullcontext():
        before = signal.signal(signal.SIGTERM, terminate) if listens else None
        try:
            yield
        finally:
            if listens:
                signal.signal(signal.SIGTERM, before)
