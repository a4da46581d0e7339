"""Whiskers in slices: which whisker a thread takes, and what is kept of it until the next slice.

Where one thread walks through a tree of triangles, or solves for the forces of eight contacts, 31 neighbours wait. So
on a GPU a whisker pauses where it needs distances or contact forces; kernels of their own find these for all.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import AFTER_CONTACTS, AFTER_DISTANCES, AFTER_OTHERS, WARP

from .articulated_body import ChainState, ProximityState
from .state import (
    WAIT_DISTANCES,
    WAIT_FORCES,
    PausedWhiskers,
    WhiskerState,
    row,
)


@wp.func(inline=True)
def next_job(paused: PausedWhiskers, thread: int) -> int:
    """Return the job of a thread, −1 without. Each queue begins with a block of threads of its own."""
    index = int(-1)
    place = thread
    for which in range(3):
        if place >= 0 and index < 0:
            many = paused.queue_size[which]
            if place < many:
                index = paused.queue[which, place]
            # Whole warps for each queue: threads of one warp then run the same part of the step.
            place = place - ((many + wp.static(WARP - 1)) // wp.static(WARP)) * wp.static(WARP)
    return index


@wp.func(inline=True)
def resume(
    paused: PausedWhiskers, index: int, links: int, chain: wp.ref[ChainState], proximity: wp.ref[ProximityState]
):
    """Read the joints of a whisker that paused."""
    for i in range(links):
        chain.angle[i] = paused.link[i, index].angle
        chain.rate[i] = paused.link[i, index].rate
        proximity.clearance[i] = paused.link[i, index].clearance
        proximity.leaf[i] = paused.link[i, index].leaf


@wp.func(inline=True)
def keep(
    paused: PausedWhiskers,
    index: int,
    links: int,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    state: WhiskerState,
):
    """Keep all that the next slice needs."""
    paused.state[index] = state
    for i in range(links):
        paused.link[i, index].angle = row(chain.angle, i)
        paused.link[i, index].rate = row(chain.rate, i)
        paused.link[i, index].clearance = row(proximity.clearance, i)
        paused.link[i, index].leaf = row(proximity.leaf, i)


@wp.func(inline=True)
def stand_in_queue(paused: PausedWhiskers, index: int, state: WhiskerState):
    """Queue for the next slice."""
    # Whiskers that continue at the same place of the step go into one queue.
    queue = wp.static(AFTER_DISTANCES)
    if state.waiting_for == WAIT_FORCES:
        queue = wp.static(AFTER_CONTACTS)
    elif state.waiting_for != WAIT_DISTANCES:
        queue = wp.static(AFTER_OTHERS)
    paused.next_queue[queue, wp.atomic_add(paused.next_queue_size, queue, 1)] = index


@wp.kernel(enable_backward=False, module="unique")
def swap_queues(paused: PausedWhiskers):
    """Make the next slice's queues this one's. One thread; the host exchanges the two arrays of jobs."""
    for which in range(3):
        paused.queue_size[which] = paused.next_queue_size[which]
        paused.problem_size[which] = paused.next_problem_size[which]
        paused.next_queue_size[which] = 0
        paused.next_problem_size[which] = 0
    paused.query_count[0] = paused.next_query_count[0]
    paused.next_query_count[0] = 0
