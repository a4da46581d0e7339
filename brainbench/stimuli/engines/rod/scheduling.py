"""Whiskers in slices: on a GPU a whisker pauses where it needs distances from a mesh, which are found for all at once.

Every whisker takes steps until it needs to know what is near, or what its contacts do; further kernels answer these
questions (``kernels.scheduling`` says why); then the whiskers go on, those with like answers side by side. Results do
not depend on the slicing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from brainbench.core.devices import warp
from brainbench.core.jobs import STOPPING
from brainbench.stimuli.engines.rod import limits
from brainbench.stimuli.engines.rod.limits import AFTER_OTHERS, WARP, contacts_for
from brainbench.stimuli.engines.rod.streams import AHEAD, streams_of, turn, wait_for

BUDGET = 4
"""Steps that a whisker begins in one slice."""
FEW = 2**14
"""Whiskers below which one step begins in a slice: a kernel then takes as long as its slowest thread, and whiskers in
contact, which need two slices a step, would wait for others' four."""
SMALL = 2**10
"""Whiskers below which a recorded graph is kept as it is: threads without a whisker cost it nothing then."""
SLICES_PER_CHECK = 8
"""Slices (an even number) after which the host counts the whiskers that are left."""
MOST_THREADS = 2**19
"""Most threads that find distances at once: a few times as many as a GPU runs side by side."""
REPEATS, RARELY = (4, 64), 256
"""Least and most times that a recorded graph is launched for each count, and slices so far for one time more: the host
has many launches to look after."""


class Slices:
    """Whiskers of one launch that take turns with the kernels that work for them."""

    def __init__(
        self,
        kernels: Any,
        capacity: int,
        lanes: int,
        device: Any,
        budget: int | None = None,
        recorded: bool | None = None,
        urgent: bool = False,
    ) -> None:
        """Make room for ``lanes`` whiskers on the device.

        Args:
            kernels, capacity, lanes, device: as of the launch.
            budget: steps that a whisker begins in one slice; by the number of whiskers that are left when None.
            recorded: False when a GPU is given kernel after kernel instead of CUDA graphs.
            urgent: True when these go first among all that the GPU could do.
        """
        wp = warp()
        self.kernels, self.device, self.lanes, self.capacity = kernels, device, lanes, capacity
        self.budget = budget
        self.recorded = device.is_cuda if recorded is None else recorded
        # Distances and contact forces of a slice need not wait for each other.
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

    def run(self, inputs: list[Any], block: int) -> int:
        """Take all whiskers to their end; return the number of slices.

        ``inputs`` are the arguments of the kernel ``run`` but for the last, ``block`` the threads of a block.
        """
        wp, asked, slices, left = warp(), 0, 0, self.lanes
        graphs: list[Any] = []
        capture, fits = None, 0
        while left:
            if STOPPING.is_set():
                raise KeyboardInterrupt
            # What is left is counted rarely and late; whiskers end meanwhile, but none are added.
            with turn(self.device):
                if asked == 0 and self.stream is not None:
                    self.stream.wait_stream(self.device.stream)
                slices += SLICES_PER_CHECK
                if not self.recorded or asked == 0:
                    self._several(inputs, left, block)
                else:
                    # A graph launches as many threads as when it was recorded; it is renewed once half of many have no
                    # whisker.
                    if not graphs or (2 * left <= fits and fits > SMALL):
                        with wp.ScopedCapture(stream=self.stream) as capture:
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
                    event, count = self.counts[asked % len(self.counts)]
                    wp.copy(count, self.struct.queue_size, stream=self.stream)
                    self.stream.record_event(event)
            asked += 1
            if self.stream is not None and asked > AHEAD:
                event, count = self.counts[(asked - 1 - AHEAD) % len(self.counts)]
                wait_for(event)
                left = int(count.numpy().sum())
        if graphs:
            # Those that were launched after the last whisker had ended.
            wait_for(self.counts[(asked - 1) % len(self.counts)][0])
        with turn(self.device):
            graphs.clear()
            capture = None
        return slices

    def _several(self, inputs: list[Any], left: int, block: int) -> None:
        """Launch some slices for at most ``left`` whiskers."""
        wp, on, device, kernels = warp(), self.struct, self.device, self.kernels
        on.budget = self.budget or (1 if left < FEW else BUDGET)
        for _ in range(SLICES_PER_CHECK):
            wp.launch(kernels.run, left + 3 * WARP, [*inputs, on], device=device, stream=self.stream, block_dim=block)
            # After an even number of slices both arrays are back in place, so a recorded graph can be repeated.
            on.queue, on.next_queue = on.next_queue, on.queue
            wp.launch(kernels.swap_queues, 1, [on], device=device, stream=self.stream)
            for (kernel, threads), stream in zip(kernels.solve_contacts, self.streams, strict=True):
                # Whole warps: the threads of a group speak with each other.
                many = -(-left * threads // WARP) * WARP
                if stream is not None:
                    stream.wait_stream(self.stream)
                wp.launch(
                    kernel,
                    many,
                    [inputs[-1], on],
                    device=device,
                    stream=stream or self.stream,
                    block_dim=limits.CONTACT_BOUNDS[0],
                )
            many = min(self.queries, self.capacity * left) * kernels.distance_group
            many = min(-(-many // WARP) * WARP, MOST_THREADS)
            wp.launch(
                kernels.measure_distances,
                many,
                [*inputs[:4], on, many],
                device=device,
                stream=self.stream,
                block_dim=limits.DISTANCE_BOUNDS[0],
            )
            for stream in self.streams:
                if stream is not None:
                    self.stream.wait_stream(stream)


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
