"""What threads need that simulate on one GPU side by side: turns to call Warp, streams of their own, copies.

A launch of few whiskers, whose slices follow one another however idle the GPU is, then costs the others next to
nothing. Warp's streams, recordings and memory know no threads, so a thread calls Warp while it has its :func:`turn`,
and waits for the GPU without.
"""

from __future__ import annotations

import ctypes
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from numpy.typing import NDArray

from brainbench.core.devices import warp

AHEAD = 1
"""Counts that may be outstanding when the next graphs are launched, so that a GPU does not wait for the host."""
POLL = 4e-4
"""Time (s) between two looks at whether a GPU is done."""
LONG = 10_000
"""Looks after which the GPU is asked with Warp's own call, which tells of a failure."""
PIECE = 2**21
"""Numbers that are copied to the host in one turn: some 2 ms."""

_TURN = threading.RLock()
_OWN = threading.local()


def turn(device: Any) -> AbstractContextManager[Any]:
    """Return what a thread holds while it calls Warp for a device; threads on a processor need not wait."""
    return _TURN if device.is_cuda else nullcontext()


def streams_of(device: Any, side: int, priority: int) -> tuple[Any, list[Any], list[tuple[Any, Any]]]:
    """Return what the calling thread has on a GPU, made once: a stream, and ``side`` streams beside it.

    Last come :data:`AHEAD` + 1 pairs of an event and an array [3] in pinned memory, to which whiskers are counted.
    """
    wp, key = warp(), f"{device.alias} {side} {priority}"
    if not hasattr(_OWN, key):
        stream, *others = [_independent_stream(device, priority) for _ in range(1 + side)]
        counts = [wp.empty(3, dtype=wp.int32, device="cpu", pinned=True) for _ in range(AHEAD + 1)]
        setattr(_OWN, key, (stream, others, [(wp.Event(device), each) for each in counts]))
    return getattr(_OWN, key)


def _independent_stream(device: Any, priority: int) -> Any:
    """Return a stream that does not wait for the default stream, nor that for it.

    Warp gives memory back on the default stream; streams that it makes itself would all wait there for one another.
    """
    wp, handle, independent = warp(), ctypes.c_void_p(), 1
    try:
        driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
    except OSError:
        return wp.Stream(device, priority=priority)
    with wp.ScopedDevice(device):
        failed = driver.cuStreamCreateWithPriority(ctypes.byref(handle), independent, priority)
    return wp.Stream(device, priority=priority) if failed else wp.Stream(device, cuda_stream=handle.value)


def wait_for(event: Any) -> None:
    """Wait until a GPU has come to an event, without a turn; a failure of the GPU is Warp's ``RuntimeError``."""
    for _ in range(LONG):
        if event.is_complete:
            return
        time.sleep(POLL)
    with turn(event.device):
        warp().synchronize_event(event)


def download(arrays: Mapping[str, Any], stream: Any) -> dict[str, NDArray[Any]]:
    """Return arrays of a device as they are once a stream has come so far; None for those of a processor."""
    if stream is None:
        return {name: array.numpy() for name, array in arrays.items()}
    wp = warp()
    host = {name: wp.empty(array.shape, dtype=array.dtype, device="cpu") for name, array in arrays.items()}
    with turn(stream.device):
        event = stream.record_event()
    wait_for(event)
    for name, array in arrays.items():
        for first in range(0, array.size, PIECE):
            with turn(stream.device):
                wp.copy(host[name], array, first, first, min(PIECE, array.size - first), stream)
            # A lock goes to whoever asks next; others have waited longer.
            if first + PIECE < array.size:
                time.sleep(POLL)
    with turn(stream.device):
        stream.record_event(event)
    wait_for(event)
    return {name: array.numpy() for name, array in host.items()}
