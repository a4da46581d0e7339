"""Callback by which long jobs report their progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import count
from typing import TypeVar

Progress = Callable[[int, int, str], None]  # called with the steps done, the steps in all, and what is being done

PREPARATION = "brainbench-prepare"
"""Name of threads that make ready what a job will wait for, such as a compiler; nothing is lost when they end."""

Item = TypeVar("Item")


def track(items: Sequence[Item], what: str, progress: Progress | None) -> Iterator[Item]:
    """Yield items and report how many of them are done."""
    for done, value in enumerate(items):
        if progress is not None:
            progress(done, len(items), what)
        yield value
    if progress is not None:
        progress(len(items), len(items), what)


def stages(total: int, what: str, progress: Progress | None) -> Callable[[], None]:
    """Return a function to be called after each stage of a job; the beginning is reported at once."""
    done = count()

    def stage_done() -> None:
        """Report one more stage as done."""
        if progress is not None:
            progress(next(done), total, what)

    stage_done()
    return stage_done
