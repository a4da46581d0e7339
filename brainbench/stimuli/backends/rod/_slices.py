"""Whiskers in slices: on a GPU a whisker pauses where it must look at a mesh, and all looks are made together.

Where one thread walks through a tree of triangles, 31 neighbours wait. Here every whisker takes steps until it needs to
know what is near; a second kernel answers all of these questions, one thread each; then the whiskers go on, those with
answers side by side. Results do not depend on the slicing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from brainbench.stimuli.backends.rod._device import warp
from brainbench.stimuli.backends.rod._limits import WARP, contacts_for

BUDGET = 8
"""Steps of a whisker in one slice."""
ROUNDS = 8
"""Slices between two looks of the host at what is left to do."""


class Slices:
    """What is kept of each whisker between its slices."""

    def __init__(self, kernels: Any, real: Any, capacity: int, lanes: int, device: Any) -> None:
        wp = warp()
        self.kernels, self.device, self.lanes = kernels, device, lanes
        self.looks = max(4 * lanes, capacity)
        on = self.struct = kernels.Paused()

        def empty(*shape: int, kind: Any = real) -> Any:
            return wp.empty(shape, dtype=kind, device=device)

        vec2, vec3, vec4 = (wp.types.vector(n, real) for n in (2, 3, 4))
        on.budget = BUDGET
        on.queue = wp.array(np.arange(lanes, dtype=np.int32), device=device)
        on.after = empty(lanes, kind=wp.int32)
        on.size = wp.array(np.array([lanes, 0, 0], dtype=np.int32), device=device)
        on.tally = wp.zeros(3, dtype=wp.int32, device=device)
        on.joints, on.ways = empty(capacity, lanes, kind=vec4), empty(capacity, lanes, kind=vec2)
        on.held = empty(contacts_for(capacity), lanes, kind=vec4)
        on.times = empty(7, lanes)
        on.counts = wp.zeros((7, lanes), dtype=wp.int32, device=device)
        on.look_lane, on.look_link = (wp.zeros(self.looks, dtype=wp.int32, device=device) for _ in range(2))
        on.look_ends = empty(self.looks, 2, kind=vec3)
        on.found = empty(self.looks, 3, kind=vec4)

    def run(self, inputs: list[Any], block: int) -> int:
        """Take all whiskers to their end; return the number of slices.

        Args:
            inputs: arguments of the kernel ``run`` but for the last.
            block: threads of a block.
        """
        wp, on, rounds = warp(), self.struct, 0
        front, back = self.lanes, 0
        while front + back:
            for _ in range(ROUNDS):
                # The host counts rarely; whiskers end meanwhile, but none are added.
                wp.launch(self.kernels.run, front + back + WARP, [*inputs, on], device=self.device, block_dim=block)
                on.queue, on.after = on.after, on.queue
                wp.launch(self.kernels.turn_over, 1, [on, self.looks], device=self.device)
                wp.launch(self.kernels.look_all, self.looks, [*inputs[:4], on], device=self.device, block_dim=block)
                rounds += 1
            front, back, _ = on.size.numpy().tolist()
        return rounds
