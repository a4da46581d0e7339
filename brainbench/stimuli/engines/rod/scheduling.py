"""Whiskers in slices: on a GPU a whisker pauses where it must look at a mesh, and all looks are made together.

Where one thread walks through a tree of triangles, or solves for the forces of eight contacts, 31 neighbours wait. Here
every whisker takes steps until it needs to know what is near, or what its contacts do; further kernels answer all of
these questions, one thread each and a group of threads each; then the whiskers go on, those with like answers side by
side. Results do not depend on the slicing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from brainbench.core.devices import warp
from brainbench.stimuli.engines.rod.limits import ANYHOW, GRIP_BOUNDS, LOOK_BOUNDS, SPARE, WARP, contacts_for

BUDGET = 4
"""Steps of a whisker in one slice."""
FEW = 2**14
"""Whiskers below which it is one step: each kernel of a slice then takes as long as its slowest thread, and whiskers in
contact, which need two slices a step, would wait for others' four."""
ROUNDS = 8
"""Slices (an even number) between two looks of the host at what is left to do."""

LOOKING = 2**19
"""Most threads that look at once: a few times as many as a GPU runs side by side."""


class Slices:
    """What is kept of each whisker between its slices."""

    def __init__(
        self,
        kernels: Any,
        real: Any,
        capacity: int,
        lanes: int,
        device: Any,
        budget: int | None = None,
        recorded: bool | None = None,
    ) -> None:
        wp = warp()
        self.kernels, self.device, self.lanes, self.capacity = kernels, device, lanes, capacity
        self.recorded = device.is_cuda if recorded is None else recorded
        # Looks and contact forces of a slice need not wait for each other.
        self.streams = [wp.Stream(device) if self.recorded else None for _ in kernels.solve_contacts]
        self.looks = max(4 * lanes, capacity)
        on = self.struct = kernels.structs.PausedWhiskers()

        def empty(*shape: int, kind: Any = real) -> Any:
            return wp.empty(shape, dtype=kind, device=device)

        vec2, vec3, vec4 = (wp.types.vector(n, real) for n in (2, 3, 4))
        on.budget = budget or (1 if lanes < FEW else BUDGET)
        queue = np.zeros((3, lanes), dtype=np.int32)
        queue[ANYHOW] = np.arange(lanes)
        on.queue = wp.array(queue, device=device)
        on.after, on.grips = (empty(3, lanes, kind=wp.int32) for _ in range(2))
        size = np.zeros(7, dtype=np.int32)
        size[ANYHOW] = lanes
        on.size = wp.array(size, device=device)
        on.tally = wp.zeros(7, dtype=wp.int32, device=device)
        on.joints, on.ways = empty(capacity, lanes, kind=vec4), empty(capacity, lanes, kind=vec2)
        on.times = empty(9, lanes)
        on.counts = wp.zeros((8, lanes), dtype=wp.int32, device=device)
        on.look_lane, on.look_link = (wp.zeros(self.looks, dtype=wp.int32, device=device) for _ in range(2))
        on.look_ends = empty(self.looks, 2, kind=vec3)
        on.found = empty(self.looks, 3, kind=vec4)

    def run(self, inputs: list[Any], block: int) -> int:
        """Take all whiskers to their end; return the number of slices.

        Args:
            inputs: arguments of the kernel ``run`` but for the last.
            block: threads of a block.
        """
        wp, rounds, left = warp(), 0, self.lanes
        graph, fits = None, 0
        while left:
            # What is left is counted rarely; whiskers end meanwhile, but none are added.
            if not self.recorded or rounds == 0:
                self._several(inputs, left, block)
            else:
                if 2 * left <= fits or graph is None:
                    with wp.ScopedCapture(device=self.device) as capture:
                        self._several(inputs, left, block)
                    graph, fits = capture.graph, left
                wp.capture_launch(graph)
            rounds += ROUNDS
            left = int(self.struct.size.numpy()[:3].sum())
        return rounds

    def _several(self, inputs: list[Any], left: int, block: int) -> None:
        wp, on, device, kernels = warp(), self.struct, self.device, self.kernels
        for _ in range(ROUNDS):
            wp.launch(kernels.run, left + 3 * WARP, [*inputs, on], device=device, block_dim=block)
            on.queue, on.after = on.after, on.queue
            wp.launch(kernels.swap_queues, 1, [on], device=device)
            for (kernel, threads), stream in zip(kernels.solve_contacts, self.streams, strict=True):
                # Whole warps: the threads of a group speak with each other.
                many = -(-left * threads // WARP) * WARP
                if stream is not None:
                    stream.wait_stream(device.stream)
                wp.launch(kernel, many, [inputs[-1], on], device=device, stream=stream, block_dim=GRIP_BOUNDS[0])
            looks = min(self.looks, self.capacity * left) * kernels.distance_group
            looks = min(-(-looks // WARP) * WARP, LOOKING)
            wp.launch(kernels.measure_distances, looks, [*inputs[:4], on, looks], device=device, block_dim=LOOK_BOUNDS[0])
            for stream in self.streams:
                if stream is not None:
                    device.stream.wait_stream(stream)


def make_grips(kernels: Any, real: Any, capacity: int, lanes: int, device: Any) -> Any:
    """Room for the contact problem of each lane."""
    wp = warp()
    held, seen = contacts_for(capacity), contacts_for(capacity) + SPARE
    vec2, vec3, vec4 = (wp.types.vector(n, real) for n in (2, 3, 4))
    gp = kernels.structs.ContactProblems()

    def empty(*shape: int, kind: Any = real) -> Any:
        return wp.empty(shape, dtype=kind, device=device)

    gp.counts = empty(lanes, 5, kind=wp.int32)
    gp.plan = empty(lanes, kind=vec4)
    gp.chain = empty(lanes * capacity, 9, kind=vec3)
    gp.spot_link = empty(lanes * seen, kind=wp.int32)
    gp.spot_size = empty(lanes * seen, kind=vec4)
    gp.spot = empty(lanes * seen, 4, kind=vec3)
    gp.ahead = empty(lanes * seen)
    gp.held = empty(lanes, held, kind=vec4)
    gp.push, gp.mend = (empty(lanes, capacity, kind=vec2) for _ in range(2))
    gp.answer = empty(lanes, 7, kind=vec3)
    return gp
