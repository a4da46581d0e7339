"""Whiskers in slices: on a GPU a whisker pauses where it needs distances from a mesh, which are found for all at once.

In a slice every whisker takes a step, by one kernel for each part of it: up to the links that may be near something,
their distances, up to the contact problem, its solution (``kernels.broad_phase`` says why). Results do not depend on
the slicing.

Threads simulate on one GPU side by side, each with streams of its own: a launch of few whiskers, whose slices follow
one another however idle the GPU is, then costs the others next to nothing. Warp's streams, recordings and memory know
no threads, so a thread calls Warp while it holds :func:`lock_of`, and waits for the GPU without.
"""

from __future__ import annotations

import ctypes
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import no_collection, warp
from brainbench.core.runs.jobs import STOPPING
from brainbench.stimuli.engines.rod import limits
from brainbench.stimuli.engines.rod.limits import AFTER_OTHERS, WARP, contacts_for

AHEAD = 1
"""Counts that may be outstanding when the next graphs are launched, so that a GPU does not wait for the host."""
POLL = 4e-4  # time (s) between two looks at whether a GPU is done
LONG = 10_000  # looks after which the GPU is asked with Warp's own call, which tells of a failure
PIECE = 2**21  # numbers that are copied to the host under one hold of the lock: some 2 ms

_LOCK = threading.RLock()
_OWN = threading.local()


def lock_of(device: Any) -> AbstractContextManager[Any]:
    """Return what a thread holds while it calls Warp for a device; threads on a processor need not wait."""
    return _LOCK if device.is_cuda else nullcontext()


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
    """Wait until a GPU has come to an event, without the lock; a failure of the GPU is Warp's ``RuntimeError``."""
    for _ in range(LONG):
        if event.is_complete:
            return
        time.sleep(POLL)
    with lock_of(event.device):
        warp().synchronize_event(event)


def download(arrays: Mapping[str, Any], stream: Any) -> dict[str, NDArray[Any]]:
    """Return arrays of a device as they are once a stream has come so far; None for those of a processor."""
    if stream is None:
        # The next launch may take the memory.
        return {name: array.numpy().copy() for name, array in arrays.items()}
    wp = warp()
    host = {name: wp.empty(array.shape, dtype=array.dtype, device="cpu") for name, array in arrays.items()}
    with lock_of(stream.device):
        event = stream.record_event()
    wait_for(event)
    for name, array in arrays.items():
        for first in range(0, array.size, PIECE):
            with lock_of(stream.device):
                wp.copy(host[name], array, first, first, min(PIECE, array.size - first), stream)
            # A lock goes to whoever asks next; others have waited longer.
            if first + PIECE < array.size:
                time.sleep(POLL)
    with lock_of(stream.device):
        stream.record_event(event)
    wait_for(event)
    return {name: array.numpy() for name, array in host.items()}


SMALL = 2**10
"""Whiskers below which a recorded graph is kept as it is: threads without a whisker cost it nothing then."""
SLICES_PER_CHECK = 4  # slices after which the host counts the whiskers that are left
MOST_THREADS = 2**19  # most threads that find distances at once: a few times as many as a GPU runs side by side
REPEATS, RARELY = (4, 64), 128
"""Least and most times that a recorded graph is launched for each count, and slices so far for one time more: the host
has many launches to look after."""


class Slices:
    """Whiskers of one launch that take turns with the kernels that work for them."""

    def __init__(
        self, kernels: Any, capacity: int, lanes: int, device: Any, recorded: bool | None = None, urgent: bool = False
    ) -> None:
        """Make room for ``lanes`` whiskers on the device.

        Args:
            kernels, capacity, lanes, device: as of the launch.
            recorded: False when a GPU is given kernel after kernel instead of CUDA graphs.
            urgent: True when these go first among all that the GPU could do.
        """
        wp = warp()
        self.kernels, self.device, self.lanes, self.capacity = kernels, device, lanes, capacity
        self.recorded = device.is_cuda if recorded is None else recorded
        # Contact forces of few and of many candidates need not wait for each other.
        self.stream: Any = None
        self.streams, self.counts = [None] * len(kernels.solve_contacts), []
        if self.recorded or device.is_cuda:
            self.stream, side, self.counts = streams_of(device, len(self.streams), -1 if urgent else 0)
            self.streams = side if self.recorded else self.streams
        # Four near links a whisker, and all links of one: who finds no room asks again in the next slice.
        self.queries = max(4 * lanes, capacity)
        queues, links = (3, lanes), (capacity, lanes)
        on = self.struct = allocate(
            kernels.structs.PausedWhiskers,
            device,
            **dict.fromkeys(("queue", "next_queue", "problem_queue"), queues),
            **dict.fromkeys(("queue_size", "problem_size", "next_queue_size", "next_problem_size"), 3),
            **dict.fromkeys(("query_count", "next_query_count"), 1),
            **dict.fromkeys(("state", "query_frame", "query_margin"), lanes),
            link=links,
            **dict.fromkeys(("query", "answer"), self.queries),
        )
        queue = np.zeros(queues, dtype=np.int32)
        # All whiskers begin in the queue that waits for nothing.
        queue[AFTER_OTHERS] = np.arange(lanes)
        size = np.zeros(3, dtype=np.int32)
        size[AFTER_OTHERS] = lanes
        on.queue, on.queue_size = (wp.array(values, device=device) for values in (queue, size))

    def run(self, scene: SceneParts, problems: Any, results: Any, block: int) -> int:
        """Take all whiskers to their end with ``block`` threads of a block; return the number of slices."""
        wp, waits, slices, left = warp(), 0, 0, self.lanes
        inputs = scene, problems, results
        graphs: list[Any] = []
        fits = 0
        while left:
            if STOPPING.is_set():
                raise KeyboardInterrupt
            # What is left is counted rarely and late; whiskers end meanwhile, but none are added.
            with lock_of(self.device):
                if waits == 0 and self.stream is not None:
                    self.stream.wait_stream(self.device.stream)
                slices += SLICES_PER_CHECK
                if not self.recorded or waits == 0:
                    self._several(inputs, left, block)
                else:
                    # A graph launches as many threads as when it was recorded; it is renewed once half of many have no
                    # whisker.
                    if not graphs or (2 * left <= fits and fits > SMALL):
                        with no_collection(), wp.ScopedCapture(stream=self.stream) as capture:
                            self._several(inputs, left, block)
                        fits = left
                        graphs.append(capture.graph)
                    repeats = min(max(REPEATS[0], slices // RARELY), REPEATS[1])
                    for _ in range(repeats):
                        wp.capture_launch(graphs[-1], stream=self.stream)
                    slices += (repeats - 1) * SLICES_PER_CHECK
                if self.stream is None:
                    left = int(self.struct.queue_size.numpy().sum())
                else:
                    event, count = self.counts[waits % len(self.counts)]
                    wp.copy(count, self.struct.queue_size, stream=self.stream)
                    self.stream.record_event(event)
            waits += 1
            if self.stream is not None and waits > AHEAD:
                event, count = self.counts[(waits - 1 - AHEAD) % len(self.counts)]
                wait_for(event)
                left = int(count.numpy().sum())
        if graphs:
            # Those that were launched after the last whisker had ended.
            wait_for(self.counts[(waits - 1) % len(self.counts)][0])
        with lock_of(self.device):
            graphs.clear()
            capture = None
        return slices

    def _several(self, inputs: tuple[Any, Any, Any], left: int, block: int) -> None:
        """Launch some slices for at most ``left`` whiskers: each takes a step in a slice."""
        wp, on, device, kernels = warp(), self.struct, self.device, self.kernels
        scene, problems, results = inputs

        def _launch(kernel: Any, threads: int, arguments: list[Any], block: int, stream: Any = self.stream) -> None:
            # Whole warps: the threads of a group speak with each other.
            threads = -(-threads // WARP) * WARP
            wp.launch(kernel, threads, arguments, device=device, stream=stream, block_dim=block)

        for _ in range(SLICES_PER_CHECK):
            for kernel in (kernels.run, kernels.go_on):
                _launch(kernel, left + 3 * WARP, [*scene, problems, on, results], block)
                # Twice a slice: both arrays are then back in place, so a recorded graph can be repeated.
                on.queue, on.next_queue = on.next_queue, on.queue
                wp.launch(kernels.swap_queues, 1, [on], device=device, stream=self.stream)
                if kernel is kernels.run:
                    many = min(self.queries, self.capacity * left) * kernels.distance_group
                    many = min(-(-many // WARP) * WARP, MOST_THREADS)
                    _launch(kernels.measure_distances, many, [*scene[:4], on, many], limits.DISTANCE_BOUNDS[0])
            for (kernel, threads), stream in zip(kernels.solve_contacts, self.streams, strict=True):
                if stream is not None:
                    stream.wait_stream(self.stream)
                _launch(kernel, left * threads, [problems, on], limits.CONTACT_BOUNDS[0], stream or self.stream)
            for stream in self.streams:
                if stream is not None:
                    self.stream.wait_stream(stream)


class SceneParts(NamedTuple):
    """A scene as kernels take it, part by part."""

    chains: Any
    motions: Any
    shapes: Any
    jobs: Any
    readings: Any
    options: Any


def allocate(kind: Any, device: Any, **shapes: int | tuple[int, ...]) -> Any:
    """Return a Warp structure with zeroed arrays of these shapes."""
    struct = kind()
    for name, shape in shapes.items():
        setattr(struct, name, warp().zeros(shape, dtype=kind.vars[name].type.dtype, device=device))
    return struct


def make_problems(kernels: Any, capacity: int, lanes: int, device: Any, iterations: tuple[float, int, int]) -> Any:
    """Return room for the contact problem of each lane, solved as :data:`limits.FEW_ITERATIONS` says."""
    held, candidates = contacts_for(capacity), contacts_for(capacity) + limits.SPARE
    problems = allocate(
        kernels.structs.ContactProblems,
        device,
        **dict.fromkeys(("given", "solution"), lanes),
        joint=lanes * capacity,
        **dict.fromkeys(("candidate", "candidate_link", "predicted_gap"), lanes * candidates),
        held=(lanes, held),
        **dict.fromkeys(("free_acceleration", "added_acceleration"), (lanes, capacity)),
    )
    problems.tolerance, problems.sweeps, problems.tries = iterations
    return problems
