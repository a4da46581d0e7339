"""Whiskers that pause or rest: which whisker a thread takes, what is kept of it, and how long nothing can come near.

Where one thread walks through a tree of triangles, or solves for the forces of eight contacts, 31 neighbours wait. So
on a GPU a whisker pauses where it needs distances or contact forces; kernels of their own find these for all.

A whisker that stands straight out of a still base, without loads, rests until an object may come near: ``clearance`` of
a link is then the time until which nothing can reach it, from its distance and the speed of the fastest object.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import AFTER_CONTACTS, AFTER_DISTANCES, AFTER_OTHERS, NOTHING, WARP

from .algebra import JointVector, Spatial, rotate, vec3
from .articulated_body import ChainState, ProximityState
from .motion import BodyMotion, elapsed, pose_at, pose_from
from .narrow_phase import link_shape_distance
from .parameters import against, hinges, real, sliced, yields
from .state import (
    WAIT_DISTANCES,
    WAIT_FORCES,
    WAIT_REST,
    WAIT_SLICE,
    PausedWhiskers,
    SceneArrays,
    WhiskerJob,
    WhiskerState,
    cone,
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
    scene: SceneArrays,
    paused: PausedWhiskers,
    job: WhiskerJob,
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
        pose = pose_at(scene.motions, job.base, state.reading_time)
        x = rotate(pose.quaternion, vec3(one, zero, zero))
        y = rotate(pose.quaternion, vec3(zero, one, zero))
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
            link = scene.chains.build[i, job.whisker]
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
                    taper = scene.chains.taper[i, job.whisker]
                    if wp.static(sliced):
                        slack = paused.answer[place].clearance
                        proximity.leaf[i] = paused.answer[place].leaf
                    else:
                        for s in range(job.first_shape, job.end_shape):
                            body = pose_from(scene.motions, scene.shapes.track[s], state.reading_time, pose)
                            link_here = cone(at, end_at, taper)
                            leaf = row(proximity.leaf, i)
                            found = link_shape_distance(scene.shapes, s, body, link_here, -far, bound, leaf, 0, 1)
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
                        + scene.chains.taper[i, job.whisker].start_radius
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
        if wp.static(yields):
            state.slide = Spatial()
            state.rate = Spatial()
    return 0
