"""Kernel that finds the contact forces of paused whiskers."""

import warp as wp

from brainbench.stimuli.engines.rod.limits import CONTACT_BOUNDS, WARP

from .contact_solver import solve_contacts
from .parameters import group_size, module_options, queue
from .state import ContactProblems, PausedWhiskers


@wp.kernel(enable_backward=False, module="unique", module_options=module_options(), launch_bounds=CONTACT_BOUNDS)
def solve_queue(problems: ContactProblems, paused: PausedWhiskers):
    """Solve the problems of one queue in place: ``group_size`` threads take one problem."""
    thread = wp.tid()
    count = paused.problem_size[wp.static(queue)]
    which = thread // wp.static(group_size)
    # All threads of a warp go on, or none.
    if (thread // wp.static(WARP)) * wp.static(WARP // group_size) < count:
        live = int(0)
        if which < count:
            live = int(1)
        index = paused.problem_queue[wp.static(queue), wp.min(which, count - 1)]
        solve_contacts(problems, index, thread % wp.static(group_size), live)
