"""Whiskers at rest: straight out of a base that stands still, without loads, until an object may come near.

While a whisker rests, ``clearance`` of a link is the time until which nothing can reach it, from its distance and the
speed of the fastest object; no step is computed until the first such time is over.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import NOTHING

from .algebra import JointVector, rotate, vec3
from .articulated_body import ChainState, ProximityState
from .motion import BodyMotion, elapsed, pose_at, pose_from
from .narrow_phase import link_shape_distance
from .parameters import against, hinges, real, sliced
from .state import (
    WAIT_REST,
    WAIT_SLICE,
    ChainArrays,
    MotionArrays,
    PausedWhiskers,
    ShapeArrays,
    WhiskerJob,
    WhiskerState,
    row,
)


@wp.func(inline=True)
def query_rest_distances(
    paused: PausedWhiskers,
    job: WhiskerJob,
    proximity: wp.ref[ProximityState],
    state: wp.ref[WhiskerState],
    fresh: int,
    upto: real,
    far: real,
    pose: BodyMotion,
) -> int:
    """Ask for the distances of links whose time is over, or of all (``fresh``); return what to wait for."""
    near_count = int(0)
    for i in range(job.links):
        if fresh == 1 or row(proximity.clearance, i) < upto:
            near_count = near_count + 1
    state.first_query = wp.atomic_add(paused.next_query_count, 0, near_count)
    if state.first_query + near_count > paused.query.shape[0]:
        return WAIT_SLICE
    paused.query_frame[job.index].time = state.reading_time
    paused.query_frame[job.index].coarse = pose.coarse
    paused.query_frame[job.index].place = pose.place
    paused.query_margin[job.index] = -far
    return WAIT_REST


@wp.func(inline=True)
def check_rest(
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    job: WhiskerJob,
    paused: PausedWhiskers,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    state: wp.ref[WhiskerState],
    upto: real,
    end: real,
) -> int:
    """Find in ``state.safe_until`` the time until which nothing can come near; return what to wait for, 0 nothing.

    ``end`` is the end of the launch, ``upto`` the time of the next reading.
    """
    zero = real(0.0)
    one = real(1.0)
    before = elapsed(state.reading_time)
    idle_before = state.safe_until
    state.safe_until = real(1e30)
    # Without objects nothing of this remains in the kernel, nor what it keeps.
    # Objects that never move need to be looked at only once.
    if wp.static(against > NOTHING) and (job.object_speed > zero or before == zero):
        pose = pose_at(motions, job.base, state.reading_time)
        x = rotate(pose.turn, vec3(one, zero, zero))
        y = rotate(pose.turn, vec3(zero, one, zero))
        at = vec3(zero, zero, zero)
        # Nothing can come near after the last reading.
        far = job.object_speed * (end - before) + real(0.5)
        fresh = int(0)
        if idle_before == zero or before == zero:
            fresh = 1
        wait = int(0)
        if wp.static(sliced):
            if state.waiting_for != WAIT_REST:
                wait = query_rest_distances(paused, job, proximity, state, fresh, upto, far, pose)
        place = state.first_query
        links = job.links
        if wait == WAIT_SLICE:
            links = int(0)
        # Time in which the fastest object covers the distance of each link; a distance stays a bound while it rests.
        for i in range(links):
            link = chains.build[i, job.whisker]
            # At rest only the bends of the rest shape are left.
            turned = x * link.bend_cosine + y * link.bend_sine
            y = y * link.bend_cosine - x * link.bend_sine
            x = turned
            if wp.static(hinges == 3):
                if i % 2 == 1:
                    turned = x * link.bend_cosine + y * link.bend_sine
                    y = y * link.bend_cosine - x * link.bend_sine
                    x = turned
            end_at = at + x * link.length
            proximity.safe_until[i] = row(proximity.clearance, i)
            if fresh == 1 or row(proximity.clearance, i) < upto:
                # At rest it is a time: the link was outside when that was found.
                bound = one
                if fresh == 1:
                    bound = row(proximity.clearance, i)
                if wp.static(sliced) and wait == WAIT_REST:
                    paused.query[place].job = job.index
                    paused.query[place].link = i
                    paused.query[place].start = at
                    paused.query[place].stop = end_at
                    paused.query[place].bound = bound
                else:
                    slack = real(1e30)
                    taper = chains.taper[i, job.whisker]
                    if wp.static(sliced):
                        slack = paused.answer[place].clearance
                        proximity.leaf[i] = paused.answer[place].leaf
                    else:
                        for s in range(job.first_shape, job.end_shape):
                            body = pose_from(motions, shapes.track[s], state.reading_time, pose)
                            found = link_shape_distance(
                                shapes, s, body, at, end_at, taper, -far, bound, row(proximity.leaf, i), 0, 1
                            )
                            slack = wp.min(slack, found.clearance)
                            proximity.leaf[i] = found.leaf
                    # A little is kept off here and less than that given back below, so that rounding never raises the
                    # bound.
                    slack = slack - taper.start_radius - real(0.05)
                    proximity.safe_until[i] = real(1e30)
                    if slack <= zero:
                        proximity.safe_until[i] = before
                    elif job.object_speed > zero:
                        proximity.safe_until[i] = before + slack / (real(1.02) * job.object_speed)
                place = place + 1
            state.safe_until = wp.min(state.safe_until, row(proximity.safe_until, i))
            at = end_at
        if wp.static(sliced):
            if wait != 0:
                state.safe_until = idle_before
                return wait
            state.waiting_for = 0
        for i in range(job.links):
            if upto > state.safe_until:
                # Not at rest any longer: a distance again.
                bound = zero
                until = row(proximity.safe_until, i)
                if until > before:
                    bound = (
                        (until - before) * real(1.02) * job.object_speed
                        + chains.taper[i, job.whisker].start_radius
                        + real(0.04)
                    )
                if fresh == 1:
                    bound = wp.max(bound, row(proximity.clearance, i))
                proximity.safe_until[i] = bound
            proximity.clearance[i] = row(proximity.safe_until, i)
    # What is left of a bend (below REST) is dropped, so that rest does not drift.
    if upto <= state.safe_until:
        for i in range(job.links):
            chain.angle[i] = JointVector()
            chain.rate[i] = JointVector()
    return 0
