"""Whiskers between two slices.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import AFTER_GRIP, AFTER_LOOK, ANYHOW, WARP

from .algebra import vec2, vec4
from .parameters import real
from .state import ChainState, PausedWhiskers, ProximityState, WhiskerState, row


@wp.func(inline=True)
def next_job(paused: PausedWhiskers, place: int) -> int:
    """The whisker of a thread, −1 without. Each queue begins with a block of its own."""
    index = int(-1)
    for which in range(3):
        if place >= 0 and index < 0:
            many = paused.size[which]
            if place < many:
                index = paused.queue[which, place]
            place = place - ((many + wp.static(WARP - 1)) // wp.static(WARP)) * wp.static(WARP)
    return index


@wp.func(inline=True)
def resume(paused: PausedWhiskers, index: int, links: int, chain: wp.ref[ChainState], proximity: wp.ref[ProximityState], state: wp.ref[WhiskerState]):
    """Read what was kept, if the whisker had begun."""
    if paused.counts[5, index] != 0:
        state.reading = paused.counts[0, index]
        state.pending_reading = paused.counts[1, index]
        state.contacts = paused.counts[2, index]
        state.is_near = paused.counts[3, index]
        state.at_rest = paused.counts[4, index]
        state.waiting_for = paused.counts[5, index]
        state.first_query = paused.counts[6, index]
        state.reading_time = paused.times[0, index]
        state.time_left = paused.times[1, index]
        state.safe_until = paused.times[2, index]
        state.velocity_jump = paused.times[3, index]
        state.top_speed = paused.times[4, index]
        state.last_step = paused.times[8, index]
        for i in range(links):
            both = paused.joints[i, index]
            chain.angle[i] = vec2(both[0], both[1])
            chain.rate[i] = vec2(both[2], both[3])
            way = paused.ways[i, index]
            proximity.clearance[i] = way[0]
            proximity.leaf[i] = int(way[1])


@wp.func(inline=True)
def pause(
    paused: PausedWhiskers, index: int, links: int, chain: wp.ref[ChainState], proximity: wp.ref[ProximityState], state: wp.ref[WhiskerState], wait: int
):
    """Keep all that the next slice needs, and queue for it."""
    paused.counts[0, index] = state.reading
    paused.counts[1, index] = state.pending_reading
    paused.counts[2, index] = state.contacts
    paused.counts[3, index] = state.is_near
    paused.counts[4, index] = state.at_rest
    paused.counts[5, index] = wait
    paused.counts[6, index] = state.first_query
    paused.times[0, index] = state.reading_time
    paused.times[1, index] = state.time_left
    paused.times[2, index] = state.safe_until
    paused.times[3, index] = state.velocity_jump
    paused.times[4, index] = state.top_speed
    paused.times[8, index] = state.last_step
    for i in range(links):
        angle = row(chain.angle, i)
        rate = row(chain.rate, i)
        paused.joints[i, index] = vec4(angle[0], angle[1], rate[0], rate[1])
        paused.ways[i, index] = vec2(row(proximity.clearance, i), real(row(proximity.leaf, i)))
    after = wp.static(AFTER_LOOK)
    if wait == 3:
        after = wp.static(AFTER_GRIP)
    elif wait != 1:
        after = wp.static(ANYHOW)
    paused.after[after, wp.atomic_add(paused.tally, after, 1)] = index


@wp.kernel(enable_backward=False, module="unique")
def swap_queues(paused: PausedWhiskers):
    for d in range(7):
        paused.size[d] = paused.tally[d]
        paused.tally[d] = 0
