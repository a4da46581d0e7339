"""Whiskers at rest: straight out of a base that stands still, until an object may come near."""

from functools import cache
from typing import Any

from brainbench.stimuli.engines.rod.kernels.algebra import algebra
from brainbench.stimuli.engines.rod.kernels.inputs import structs
from brainbench.stimuli.engines.rod.kernels.motion import tracks
from brainbench.stimuli.engines.rod.kernels.narrow_phase import looks
from brainbench.stimuli.engines.rod.kernels.state import memory
from brainbench.stimuli.engines.rod.limits import NOTHING


@cache
def look_ahead_of(real: type, capacity: int, against: int, sliced: bool) -> Any:
    """Return ``look_ahead(…)``: until when can nothing come near a whisker at rest?

    It is told in ``state.idle``, and link by link in the memory: while at rest, ``clear`` keeps until when nothing can
    reach a link, later a distance again. Returned is what to wait for: 4 and 2 as in ``State.waiting``, 0 nothing.
    """
    import warp as wp

    vec2: Any = wp.types.vector(2, real)
    vec3: Any = wp.types.vector(3, real)
    kinds, track, near_by, kept = structs(real), tracks(real), looks(real, against), memory(real, capacity)
    Chains, Bodies, Paused, Tracks, pose_at = kinds.Chains, kinds.Bodies, kinds.Paused, track.Tracks, track.pose_at
    Links, Watch, Lane, State, row = kept.Links, kept.Watch, kept.Lane, kept.State, kept.row
    look_at, rotate = near_by.look_at, algebra(real).rotate

    @wp.func(inline=True)
    def ask(
        on: Paused, me: Lane, watch: wp.ref[Watch], state: wp.ref[State], fresh: int, upto: real, look: real
    ) -> int:
        """Ask for these distances like for all others; returned is what to wait for."""
        nigh = int(0)
        for i in range(me.links):
            if fresh == 1 or row(watch.clear, i) < upto:
                nigh = nigh + 1
        state.look_first = wp.atomic_add(on.tally, 6, nigh)
        if state.look_first + nigh > on.look_lane.shape[0]:
            return 2
        on.times[5, me.lane] = state.before
        on.times[6, me.lane] = -look
        return 4

    @wp.func(inline=True)
    def look_ahead(
        ch: Chains,
        tr: Tracks,
        bodies: Bodies,
        me: Lane,
        on: Paused,
        mem: wp.ref[Links],
        watch: wp.ref[Watch],
        state: wp.ref[State],
        start: real,
        upto: real,
        end: real,
    ) -> int:
        zero = real(0.0)
        one = real(1.0)
        before = state.before
        idle_before = state.idle
        state.idle = real(1e30)
        # Without objects nothing of this remains in the kernel, nor what it keeps.
        if wp.static(against > NOTHING) and (me.speed > zero or before == start):
            pose = pose_at(tr, me.base, before)
            x = rotate(pose.turn, vec3(one, zero, zero))
            y = rotate(pose.turn, vec3(zero, one, zero))
            at = pose.place
            # Nothing can come near after the last reading.
            look = me.speed * (end - before) + real(0.5)
            fresh = int(0)
            if idle_before == zero or before == start:
                fresh = 1
            wait = int(0)
            if wp.static(sliced):
                if state.waiting != 4:
                    wait = ask(on, me, watch, state, fresh, upto, look)
            place = state.look_first
            links = me.links
            if wait == 2:
                links = int(0)
            for i in range(links):
                b4 = ch.build[i, me.whisker]
                turned = x * b4[1] + y * b4[2]
                y = y * b4[1] - x * b4[2]
                x = turned
                ahead_at = at + x * b4[0]
                watch.until[i] = row(watch.clear, i)
                if fresh == 1 or row(watch.clear, i) < upto:
                    if wp.static(sliced) and wait == 4:
                        on.look_lane[place] = me.lane
                        on.look_link[place] = i
                        on.look_ends[place, 0] = at
                        on.look_ends[place, 1] = ahead_at
                    else:
                        slack = real(1e30)
                        taper = ch.taper[i, me.whisker]
                        if wp.static(sliced):
                            answer4 = on.found[place, 2]
                            slack = answer4[1]
                            watch.leaf[i] = int(answer4[3])
                        else:
                            for s in range(me.shapes_from, me.shapes_to):
                                body = pose_at(tr, bodies.track[s], before)
                                touch = look_at(bodies, s, body, at, ahead_at, taper, -look, row(watch.leaf, i), 0, 1)
                                slack = wp.min(slack, touch.clear)
                                watch.leaf[i] = touch.leaf
                        slack = slack - taper[0] - real(0.05)
                        watch.until[i] = real(1e30)
                        if slack <= zero:
                            watch.until[i] = before
                        elif me.speed > zero:
                            watch.until[i] = before + slack / (real(1.02) * me.speed)
                    place = place + 1
                state.idle = wp.min(state.idle, row(watch.until, i))
                at = ahead_at
            if wp.static(sliced):
                if wait != 0:
                    state.idle = idle_before
                    return wait
                state.waiting = 0
            for i in range(me.links):
                if upto > state.idle:
                    # Not at rest any longer: a distance again.
                    bound = zero
                    until = row(watch.until, i)
                    if until > before:
                        bound = (until - before) * real(1.02) * me.speed + ch.taper[i, me.whisker][0] + real(0.04)
                    if fresh == 1:
                        bound = wp.max(bound, row(watch.clear, i))
                    watch.until[i] = bound
                watch.clear[i] = row(watch.until, i)
        if upto <= state.idle:
            for i in range(me.links):
                mem.q[i] = vec2(zero, zero)
                mem.qd[i] = vec2(zero, zero)
        return 0

    return look_ahead
