"""Memory behind a data set of sweeps: mapped shards, and batches that are used again."""

from __future__ import annotations

import sys
import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from brainbench.datasets.whisking.files import Shard


class Maps:
    """The forces of shards, mapped into memory when they are asked for; the oldest maps are given up first."""

    def __init__(self, shards: Sequence[Shard], most: int | None = None) -> None:
        self._shards = shards
        self._most = most_open() if most is None else most
        self._maps: OrderedDict[int, NDArray[np.float32]] = OrderedDict()

    def __len__(self) -> int:
        return len(self._maps)

    def forces(self, index: int) -> NDArray[np.float32]:
        """Return the forces [sweep, frame, whisker, channel] of a shard (N, N·m)."""
        mapped = self._maps.get(index)
        if mapped is None:
            shard = self._shards[index]
            mapped = np.memmap(shard.path, "<f4", "r", shard.offset, (shard.sweeps, *shard.shape)).view(np.ndarray)
            self._maps[index] = mapped
            if len(self._maps) > self._most:
                self._maps.popitem(last=False)
        return mapped


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
    """Shards that may be mapped at a time: each takes one of the files that a process may open."""
    try:
        import resource
    except ImportError:
        return 512
    return max(16, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
