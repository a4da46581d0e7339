"""The contact problem of a step between the passes and :mod:`._contacts`: stated, queued, and its answer taken."""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.kernels.algebra import algebra
from brainbench.stimuli.engines.rod.kernels.inputs import structs
from brainbench.stimuli.engines.rod.kernels.state import memory
from brainbench.stimuli.engines.rod.limits import GROUPS, SPARE, contacts_for


@cache
def problems(real: type, capacity: int, classes: int) -> SimpleNamespace:
    """Return ``closing``, ``state_problem``, ``queue_problem`` and ``take_answer``.

    Args:
        real: ``warp.float32`` or ``warp.float64``.
        capacity: links that fit.
        classes: queues of problems, by their size.
    """
    import warp as wp

    vec3: Any = wp.types.vector(3, real)
    vec4: Any = wp.types.vector(4, real)
    kinds, kept, first_axis = structs(real), memory(real, capacity), algebra(real).first_axis
    Chains, Grips, Paused = kinds.Chains, kinds.Grips, kinds.Paused
    Links, Watch, Spots, Lane, State = kept.Links, kept.Watch, kept.Spots, kept.Lane, kept.State
    Twist, row = kept.Twist, kept.row
    most_seen = contacts_for(capacity) + SPARE

    @wp.func(inline=True)
    def closing(spots: wp.ref[Spots], seen: int, h: real) -> int:
        """Whether the whisker would close a gap if it moved freely."""
        any_one = int(0)
        for j in range(seen):
            ahead = row(spots.gap, j) + h * wp.dot(row(spots.normal, j), row(spots.free, j))
            spots.ahead[j] = ahead
            if ahead < real(0.0):
                any_one = 1
        return any_one

    @wp.func(inline=True)
    def state_problem(
        gp: Grips,
        ch: Chains,
        me: Lane,
        mem: wp.ref[Links],
        watch: wp.ref[Watch],
        spots: wp.ref[Spots],
        state: wp.ref[State],
        felt: Twist,
        tip_push: vec3,
        h: real,
        seen: int,
    ):
        lane = me.lane
        tip = row(mem.node, me.links)
        gp.counts[lane, 0] = me.links
        gp.counts[lane, 1] = seen
        gp.counts[lane, 2] = state.held
        gp.plan[lane] = vec4(h, tip[0], tip[1], tip[2])
        gp.answer[lane, 0] = felt.w
        gp.answer[lane, 1] = felt.v
        gp.answer[lane, 2] = tip_push
        for i in range(me.links):
            at = row(mem.node, i)
            s2 = row(mem.e2, i)
            s1 = first_axis(s2, row(mem.node, i + 1) - at, row(mem.q, i)[1])
            link_row = lane * wp.static(capacity) + i
            gp.chain[link_row, 0] = s1
            gp.chain[link_row, 1] = s2
            gp.chain[link_row, 2] = wp.cross(at, s1)
            gp.chain[link_row, 3] = wp.cross(at, s2)
            gp.chain[link_row, 4] = row(mem.k1w, i)
            gp.chain[link_row, 5] = row(mem.k1v, i)
            gp.chain[link_row, 6] = row(mem.k2w, i)
            gp.chain[link_row, 7] = row(mem.k2v, i)
            gp.chain[link_row, 8] = row(watch.inverse, i)
            gp.push[lane, i] = row(mem.push, i)
        for j in range(seen):
            i = row(spots.link, j)
            spot = lane * wp.static(most_seen) + j
            gp.spot_link[spot] = i
            taper = ch.taper[i, me.whisker]
            gp.spot_size[spot] = vec4(row(spots.gap, j), row(spots.arc, j), row(spots.mu, j), taper[3])
            gp.spot[spot, 0] = row(spots.at, j)
            gp.spot[spot, 1] = row(spots.normal, j)
            gp.spot[spot, 2] = row(spots.free, j)
            gp.spot[spot, 3] = row(mem.node, i + 1) - row(mem.node, i)
            gp.ahead[spot] = row(spots.ahead, j)

    @wp.func(inline=True)
    def queue_problem(on: Paused, lane: int, seen: int):
        """Queue it with those of like size."""
        sort = int(0)
        if wp.static(classes > 1):
            if seen > wp.static(GROUPS[1][0]):
                sort = int(2)
            elif seen > wp.static(GROUPS[0][0]):
                sort = int(1)
        on.grips[sort, wp.atomic_add(on.tally, 3 + sort, 1)] = lane

    @wp.func(inline=True)
    def take_answer(gp: Grips, me: Lane, mem: wp.ref[Links], state: wp.ref[State]):
        """What the contact forces do to the joints, and how well they were found."""
        lane = me.lane
        state.held = gp.counts[lane, 2]
        state.crowded = state.crowded + gp.counts[lane, 3]
        state.unsolved = state.unsolved + gp.counts[lane, 4]
        missed = gp.answer[lane, 3]
        state.miss = state.miss + missed[0]
        state.load = state.load + missed[1]
        for i in range(me.links):
            mem.push[i] = gp.push[lane, i] + gp.mend[lane, i]

    return SimpleNamespace(
        closing=closing, state_problem=state_problem, queue_problem=queue_problem, take_answer=take_answer
    )
