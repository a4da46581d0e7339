"""What is kept of a whisker between two slices."""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.kernels.inputs import structs
from brainbench.stimuli.engines.rod.kernels.state import memory
from brainbench.stimuli.engines.rod.limits import AFTER_GRIP, AFTER_LOOK, ANYHOW, WARP


@cache
def pauses(real: type, capacity: int) -> SimpleNamespace:
    """Return ``next_lane(paused, place)``, ``wake`` and ``sleep`` for chains of at most ``capacity`` links."""
    import warp as wp

    vec2: Any = wp.types.vector(2, real)
    vec4: Any = wp.types.vector(4, real)
    Paused, kept = structs(real).Paused, memory(real, capacity)
    Links, Watch, State, row = kept.Links, kept.Watch, kept.State, kept.row

    @wp.func(inline=True)
    def next_lane(on: Paused, place: int) -> int:
        """The whisker of a thread, −1 without. Each queue begins with a block of its own."""
        lane = int(-1)
        for which in range(3):
            if place >= 0 and lane < 0:
                many = on.size[which]
                if place < many:
                    lane = on.queue[which, place]
                place = place - ((many + wp.static(WARP - 1)) // wp.static(WARP)) * wp.static(WARP)
        return lane

    @wp.func(inline=True)
    def wake(on: Paused, lane: int, links: int, mem: wp.ref[Links], watch: wp.ref[Watch], state: wp.ref[State]):
        """Read what was kept, if the whisker had begun."""
        if on.counts[5, lane] != 0:
            state.reading = on.counts[0, lane]
            state.pending = on.counts[1, lane]
            state.held = on.counts[2, lane]
            state.near = on.counts[3, lane]
            state.resting = on.counts[4, lane]
            state.waiting = on.counts[5, lane]
            state.look_first = on.counts[6, lane]
            state.before = on.times[0, lane]
            state.left = on.times[1, lane]
            state.idle = on.times[2, lane]
            state.jump = on.times[3, lane]
            state.quickest = on.times[4, lane]
            state.h_last = on.times[8, lane]
            for i in range(links):
                both = on.joints[i, lane]
                mem.q[i] = vec2(both[0], both[1])
                mem.qd[i] = vec2(both[2], both[3])
                way = on.ways[i, lane]
                watch.clear[i] = way[0]
                watch.leaf[i] = int(way[1])

    @wp.func(inline=True)
    def sleep(
        on: Paused, lane: int, links: int, mem: wp.ref[Links], watch: wp.ref[Watch], state: wp.ref[State], wait: int
    ):
        """Keep all that the next slice needs, and queue for it."""
        on.counts[0, lane] = state.reading
        on.counts[1, lane] = state.pending
        on.counts[2, lane] = state.held
        on.counts[3, lane] = state.near
        on.counts[4, lane] = state.resting
        on.counts[5, lane] = wait
        on.counts[6, lane] = state.look_first
        on.times[0, lane] = state.before
        on.times[1, lane] = state.left
        on.times[2, lane] = state.idle
        on.times[3, lane] = state.jump
        on.times[4, lane] = state.quickest
        on.times[8, lane] = state.h_last
        for i in range(links):
            angle = row(mem.q, i)
            rate = row(mem.qd, i)
            on.joints[i, lane] = vec4(angle[0], angle[1], rate[0], rate[1])
            on.ways[i, lane] = vec2(row(watch.clear, i), real(row(watch.leaf, i)))
        after = wp.static(AFTER_LOOK)
        if wait == 3:
            after = wp.static(AFTER_GRIP)
        elif wait != 1:
            after = wp.static(ANYHOW)
        on.after[after, wp.atomic_add(on.tally, after, 1)] = lane

    return SimpleNamespace(next_lane=next_lane, wake=wake, sleep=sleep)
