"""Kernel that finds the contact forces of paused whiskers.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import GRIP_BOUNDS, WARP

from .contact_solver import solve_contacts
from .parameters import group_size, module_options, queue
from .state import ContactProblems, PausedWhiskers


@wp.kernel(enable_backward=False, module="unique", module_options=module_options(), launch_bounds=GRIP_BOUNDS)
def solve_queue(problems: ContactProblems, paused: PausedWhiskers):
    thread = wp.tid()
    count = paused.size[wp.static(3 + queue)]
    which = thread // wp.static(group_size)
    # All threads of a warp go paused, or none.
    if (thread // wp.static(WARP)) * wp.static(WARP // group_size) < count:
        live = int(0)
        if which < count:
            live = int(1)
        index = paused.problems[wp.static(queue), wp.min(which, count - 1)]
        solve_contacts(problems, index, thread % wp.static(group_size), live)
