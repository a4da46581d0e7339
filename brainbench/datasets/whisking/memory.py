"""Memory behind a data set of sweeps: batches that are used again, and the limit of files mapped at a time."""

from __future__ import annotations

import sys
import threading
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


class Buffers:
    """Memory for batches, used again once nobody holds it: fresh memory is slower than copying into it."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._held: list[NDArray[np.float32]] = [np.empty(0, np.float32)]
        self._lock = threading.Lock()
        # Every tensor or view on an array holds a reference more than this.
        self._free = self._references(0)

    def __len__(self) -> int:
        return len(self._held)

    def take(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        """Return an array of ``shape`` with any content that no tensor or view refers to."""
        with self._lock:
            for index in range(len(self._held)):
                if self._held[index].shape == shape and self._references(index) == self._free:
                    return self._held[index]
            made = np.empty(shape, np.float32)
            self._held = [*self._held[1 - self._most :], made]
            return made

    def _references(self, index: int) -> int:
        return sys.getrefcount(self._held[index])


def most_open() -> int:
    """Return how many shards may be mapped at a time: each takes one of the files that a process may open."""
    try:
        import resource
    except ImportError:
        return 512
    return max(16, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
