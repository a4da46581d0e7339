"""Broad phase: which links may touch something within a step, and the candidates for contact that are found there.

Each link keeps a lower bound of its distance from all objects (``clearance``). Links and objects come nearer by no more
than their speeds allow, so a link is measured again only when its bound comes near its radius. A contact takes part
before it closes (g + h vₙ ≥ 0, gap g, approach vₙ), so nothing passes through anything within a step. Of many shapes
only the nearest are looked at; a bound tells when another may have come near (``list_shapes``).

Here too: whiskers that pause or rest, which whisker a thread takes, what is kept of it, and how long nothing can come
near. Where one thread walks through a tree of triangles, or solves for the forces of eight contacts, 31 neighbours
wait. So on a GPU a whisker pauses where it needs distances or contact forces; kernels of their own find these for all.
A whisker that stands straight out of a still base, without loads, rests until an object may come near: ``clearance`` of
a link is then the time until which nothing can reach it, from its distance and the speed of the fastest object.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import (
    AFTER_CONTACTS,
    AFTER_DISTANCES,
    AFTER_OTHERS,
    AT_BASE,
    CAPSULE,
    CLOSED,
    CYLINDER,
    GOT_INSIDE,
    LARGEST_OVERLAP,
    LARGEST_START_OVERLAP,
    LISTED,
    MESH,
    NOTHING,
    STALE,
    STARTED_INSIDE,
    WARP,
    WIDEST,
)
from brainbench.stimuli.motion.jobs import MILLI

from .algebra import JointVector, Spatial, first_axis, rotate, vec3
from .articulated_body import ChainState, ProximityState, hinge_direction
from .centre_line import RodPlace, bent_link, enter_link, linearity, shortening
from .distances import segments
from .motion import BodyMotion, elapsed, instant, pose_at, pose_from
from .narrow_phase import link_shape_distance
from .parameters import against, hinges, real, recorded, sliced, smooth, yields
from .state import (
    WAIT_DISTANCES,
    WAIT_FORCES,
    WAIT_REST,
    WAIT_SLICE,
    CentreLine,
    ContactCandidates,
    ContactProblems,
    LinkDistance,
    NearShapes,
    PausedWhiskers,
    SceneArrays,
    Step,
    WhiskerJob,
    WhiskerState,
    cone,
    line_place,
    line_tangent,
    most_candidates,
    row,
)

if recorded:
    from .recorder.recording import record_candidate


@wp.struct
class SearchRange:
    """How far a step looks for contacts."""

    margin: real
    """Gap (mm) up to which a contact takes part."""
    time: real
    """Time (ms) over which links and objects may have come nearer since the last step."""
    unknown_speed: real
    """Speed (mm/ms) of whatever is not known of them."""


@wp.func(inline=True)
def search_range(scene: SceneArrays, job: WhiskerJob, state: wp.ref[WhiskerState], h: real) -> SearchRange:
    """Return how far a step of length h looks for contacts."""
    reach = SearchRange()
    # Contacts that may close within this step.
    travel = h * (state.top_speed + job.object_speed)
    # Half more than the present speeds give, because links may speed up within the step.
    reach.margin = wp.min(real(1.5) * travel + h * state.velocity_jump + real(0.001), real(wp.static(WIDEST)))
    # How far links and objects have come since the last step: its rates at the end are those now.
    reach.time = real(1.02) * wp.max(h, state.last_step)
    reach.unknown_speed = job.object_speed
    if scene.options.quasistatic == 1:
        # Quasi-static steps forget their rates, so ``end_speed`` does not contain the way of the last step.
        reach.unknown_speed = job.object_speed + state.velocity_jump
    return reach


@wp.func(inline=True)
def may_be_near(
    scene: SceneArrays, job: WhiskerJob, proximity: wp.ref[ProximityState], reach: SearchRange, i: int
) -> bool:
    """Return whether a link may be so near, for all that its bound tells."""
    taper = scene.chains.taper[i, job.whisker]
    return (
        row(proximity.clearance, i) - reach.time * (row(proximity.end_speed, i) + reach.unknown_speed)
        <= reach.margin + taper.start_radius
    )


@wp.func(inline=True)
def count_near_links(scene: SceneArrays, job: WhiskerJob, proximity: wp.ref[ProximityState], reach: SearchRange) -> int:
    """Return the number of links whose distance must be measured."""
    near_count = int(0)
    for i in range(job.links):
        if may_be_near(scene, job, proximity, reach, i):
            near_count = near_count + 1
    return near_count


@wp.func(inline=True)
def lower_clearance(job: WhiskerJob, proximity: wp.ref[ProximityState], near: wp.ref[NearShapes], reach: SearchRange):
    """Lower the bound of each link, and that of the shapes left out, by how much nearer they may have come."""
    most = real(0.0)
    for i in range(job.links):
        nearer = reach.time * (row(proximity.end_speed, i) + reach.unknown_speed)
        proximity.clearance[i] = row(proximity.clearance, i) - nearer
        most = wp.max(most, nearer)
    near.moved = near.moved + most


@wp.func
def from_segment(point: vec3, end: vec3) -> vec3:
    """Return the way from the nearest point of the segment from the origin to ``end``."""
    share = wp.clamp(wp.dot(point, end) / wp.length_sq(end), real(0.0), real(1.0))
    return point - end * share


@wp.func(inline=True)
def list_shapes(scene: SceneArrays, job: WhiskerJob, chain: wp.ref[ChainState], near: wp.ref[NearShapes], step: Step):
    """List the shapes nearest to the whisker, and how far off all others are.

    A shape counts as the ball around it, a capsule or a cylinder as the capsule around it.
    """
    near.count = 0
    near.room = real(1e20)
    near.moved = real(0.0)
    worst = int(0)
    # All of the whisker is near the chord from base to tip.
    chord = row(chain.node, job.links)
    sag = real(0.0)
    for i in range(1, job.links):
        sag = wp.max(sag, wp.length(from_segment(row(chain.node, i), chord)))
    body = BodyMotion()
    last_track = int(-1)
    for s in range(job.first_shape, job.end_shape):
        if scene.shapes.track[s] != last_track:
            last_track = scene.shapes.track[s]
            body = pose_from(scene.motions, last_track, step.now, step.pose)
        centre = body.place + rotate(body.quaternion, scene.shapes.place[s])
        round = scene.shapes.radius[s]
        full = near.count == wp.static(LISTED)
        if full:
            beyond = wp.length(from_segment(centre, chord)) - sag - round
            if beyond >= row(near.distance, worst):
                near.room = wp.min(near.room, beyond)
                continue
        along = vec3(real(0.0), real(0.0), real(0.0))
        slender = scene.shapes.kind[s] == wp.static(CAPSULE) or scene.shapes.kind[s] == wp.static(CYLINDER)
        if slender:
            round = scene.shapes.size[s][0]
            along = rotate(
                body.quaternion, rotate(scene.shapes.quaternion[s], vec3(real(0.0), real(0.0), scene.shapes.size[s][1]))
            )
        square = real(1e20)
        for i in range(job.links):
            start = row(chain.node, i)
            link = row(chain.node, i + 1) - start
            away = from_segment(centre - start, link)
            if slender:
                pair = segments(start, link, centre - along, real(2.0) * along)
                away = start + link * pair[0] - (centre + along * (real(2.0) * pair[1] - real(1.0)))
            square = wp.min(square, wp.length_sq(away))
        distance = wp.sqrt(square) - round
        if full:
            near.room = wp.min(near.room, wp.max(distance, row(near.distance, worst)))
        if not full or distance < row(near.distance, worst):
            # The one that is furthest makes room; the others keep their order.
            if full:
                for j in range(worst, wp.static(LISTED - 1)):
                    near.shape[j] = row(near.shape, j + 1)
                    near.distance[j] = row(near.distance, j + 1)
                near.count = near.count - 1
            near.shape[near.count] = s
            near.distance[near.count] = distance
            near.count = near.count + 1
            worst = int(0)
            for j in range(1, near.count):
                if row(near.distance, j) > row(near.distance, worst):
                    worst = j


@wp.func(inline=True)
def query_distances(
    scene: SceneArrays,
    problems: ContactProblems,
    paused: PausedWhiskers,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    state: wp.ref[WhiskerState],
    reach: SearchRange,
    step: Step,
    near_count: int,
) -> int:
    """Ask for the distances of these links; return what to wait for: the next slice, when there is no room for more."""
    state.first_query = wp.atomic_add(paused.next_query_count, 0, near_count)
    if state.first_query + near_count > paused.query.shape[0]:
        return WAIT_SLICE
    place = state.first_query
    base = rotate(step.pose.quaternion, vec3(real(1.0), real(0.0), real(0.0)))
    rod = RodPlace()
    for i in range(job.links):
        if wp.static(smooth):
            enter_link(scene.chains, problems, job, chain, state.contacts, i, rod)
        if may_be_near(scene, job, proximity, reach, i):
            paused.query[place].job = job.index
            paused.query[place].link = i
            paused.query[place].start = row(chain.node, i)
            paused.query[place].stop = row(chain.node, i + 1)
            if wp.static(smooth):
                bent = bent_link(scene.chains, problems, job, chain, base, state.contacts, i, rod)
                paused.query[place].line = bent.line
            nearer = reach.time * (row(proximity.end_speed, i) + reach.unknown_speed)
            paused.query[place].bound = row(proximity.clearance, i) - nearer
            place = place + 1
    paused.query_frame[job.index].time = step.now
    paused.query_frame[job.index].coarse = step.pose.coarse
    paused.query_frame[job.index].place = step.pose.place
    paused.query_margin[job.index] = reach.margin
    return WAIT_DISTANCES


@wp.func(inline=True)
def candidate_slot(
    candidates: wp.ref[ContactCandidates], count: int, point: vec3, normal: vec3, ahead: real, near: real
) -> int:
    """Return where to keep a candidate (``count``: a further one; −1: nowhere).

    The same contact may be seen from two links, or from both ends of a short gap: its places are no further apart than
    the square root of ``near``.
    """
    slot = count
    for j in range(count):
        # Normals within 32°.
        apart = wp.length_sq(row(candidates.point, j) - point)
        same = wp.dot(row(candidates.normal, j), normal) > real(0.85)
        if same and apart < near:
            slot = j
    if wp.static(recorded):
        # By how much one of two links is nearer to what both touch.
        lead = real(1e30)
        if slot < count:
            lead = wp.min(row(candidates.lead, slot), wp.abs(row(candidates.predicted_gap, slot) - ahead))
        if slot < wp.static(most_candidates):
            candidates.lead[slot] = lead
    if slot < count:
        if row(candidates.predicted_gap, slot) <= ahead:
            slot = int(-1)
    # No room: in place of the one that closes last.
    elif count >= wp.static(most_candidates):
        slot = int(0)
        for j in range(1, wp.static(most_candidates)):
            if row(candidates.predicted_gap, j) > row(candidates.predicted_gap, slot):
                slot = j
        if row(candidates.predicted_gap, slot) <= ahead:
            slot = int(-1)
    return slot


@wp.func(inline=True)
def judge_overlap(state: wp.ref[WhiskerState], deepest: real, crossing: int, base_gap: real, now: real):
    """End a whisker that lies too deep in an object, or whose base point an object reaches.

    ``crossing`` is 1 where some of its axis lies inside, which at the start no thickness excuses. ``base_gap`` is the
    gap at the base point at the end of the step: a contact there has no lever and bends nothing.
    """
    state.depth = wp.max(state.depth, deepest)
    status = int(0)
    if base_gap < real(0.0):
        status = wp.static(AT_BASE)
    if deepest > real(wp.static(LARGEST_OVERLAP * MILLI)):
        status = wp.static(GOT_INSIDE)
    if state.steps == 0 and (crossing == 1 or deepest > real(wp.static(LARGEST_START_OVERLAP * MILLI))):
        status = wp.static(STARTED_INSIDE)
    if status != 0 and state.status == 0:
        state.status = status
        state.failed_at = now


@wp.func(inline=True)
def find_candidates(
    scene: SceneArrays,
    problems: ContactProblems,
    paused: PausedWhiskers,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    near: wp.ref[NearShapes],
    candidates: wp.ref[ContactCandidates],
    state: wp.ref[WhiskerState],
    step: Step,
) -> int:
    """Find the contact candidates of all links and renew their bounds; return the number of candidates."""
    zero = real(0.0)
    pose = step.pose
    now = step.now
    h = step.length
    margin = step.margin
    # Counts that the compiler does not know keep it from writing loops out.
    sides = int(2) + wp.min(0, job.index)
    count = int(0)
    deepest = zero
    crossing = int(0)
    base_gap = zero
    query = state.first_query
    base = rotate(pose.quaternion, vec3(real(1.0), zero, zero))
    angular = pose.spin
    linear = pose.velocity
    looked_at = job.end_shape - job.first_shape
    others = real(1e20)
    enough = margin + scene.chains.taper[0, job.whisker].start_radius
    if wp.static(not sliced) and looked_at > wp.static(LISTED):
        stale = near.room - near.moved <= enough
        if near.moved > real(wp.static(STALE)):
            for place in range(near.count):
                stale = stale or row(near.distance, place) - near.moved <= enough
        if stale:
            list_shapes(scene, job, chain, near, step)
        # More of them within the margin than are listed: all are looked at.
        if near.room - near.moved > enough:
            looked_at = near.count
            others = near.room - near.moved
    shorter = real(0.0)
    end_slide = real(0.0)
    rod = RodPlace()
    for i in range(job.links):
        rate = row(chain.rate, i)
        joint = row(chain.node, i)
        link = row(chain.node, i + 1) - joint
        e2 = row(chain.axis2, i)
        # Twist of the link: what its joint adds to that of the link before.
        spun = first_axis(e2, hinge_direction(chain, i), row(chain.angle, i)[1]) * rate[0] + e2 * rate[1]
        if wp.static(hinges == 3):
            if i % 2 == 1:
                spun = spun + row(chain.axis3, i) * rate[2]
        angular = angular + spun
        linear = linear + wp.cross(joint, spun)
        start_slide = end_slide
        if wp.static(smooth):
            enter_link(scene.chains, problems, job, chain, state.contacts, i, rod)
            shorter = shorter + shortening(scene.chains, job, chain, base, i, rod)
            if state.contacts > 0:
                end_slide = (shorter - row(proximity.shorter, i)) / state.last_step
            proximity.shorter[i] = shorter
        taper = scene.chains.taper[i, job.whisker]
        if row(proximity.clearance, i) <= margin + taper.start_radius:
            link_here = cone(joint, joint + link, taper)
            if wp.static(smooth):
                link_here = bent_link(scene.chains, problems, job, chain, base, state.contacts, i, rod)
            # One shape after the other, each at two places: between the ends, and at the far end.
            closest = others
            for place in range(looked_at):
                s = job.first_shape + place
                if others < real(1e20):
                    s = row(near.shape, place)
                    away = row(near.distance, place) - near.moved
                    if away > enough:
                        closest = wp.min(closest, away)
                        continue
                # Places count from the base, where the digits are needed.
                body = pose_from(scene.motions, scene.shapes.track[s], now, pose)
                local_quaternion = scene.shapes.quaternion[s]
                found = LinkDistance()
                if wp.static(sliced):
                    found = paused.answer[query]
                    query = query + 1
                else:
                    bound = row(proximity.clearance, i)
                    leaf = row(proximity.leaf, i)
                    found = link_shape_distance(scene.shapes, s, body, link_here, margin, bound, leaf, 0, 1)
                proximity.leaf[i] = found.leaf
                closest = wp.min(closest, found.clearance)
                deepest = wp.max(deepest, found.depth)
                crossing = wp.max(crossing, found.crossing)
                if i == 0 and found.start == 1 and found.start_gap < margin:
                    way = rotate(body.quaternion, rotate(local_quaternion, found.start_normal))
                    approach = wp.dot(way, pose.velocity - body.velocity - wp.cross(body.spin, -body.place))
                    base_gap = wp.min(base_gap, found.start_gap + h * wp.min(approach, zero))
                for which in range(sides):
                    offered = found.between
                    share = found.share
                    gap = found.gap
                    way = found.normal
                    if which == 1:
                        offered = found.end
                        share = real(1.0)
                        gap = found.end_gap
                        way = found.end_normal
                    if offered == 1 and gap < margin:
                        # Across an edge the way out is longer than the depth.
                        if wp.static(not smooth) or which == 1 or found.depth == zero:
                            deepest = wp.max(deepest, -gap)
                        normal = rotate(body.quaternion, rotate(local_quaternion, way))
                        radius = taper.start_radius + (taper.end_radius - taper.start_radius) * share
                        # The force acts on the skin of the whisker: its radius is the lever of friction.
                        point = joint + link * share - normal * radius
                        if wp.static(smooth):
                            point = line_place(link_here, share) - normal * radius
                        # The object's velocity in the middle of the step.
                        middle = instant(now.tick, now.part + real(0.5) * h)
                        half = pose_from(scene.motions, scene.shapes.track[s], middle, pose)
                        object_velocity = half.velocity + wp.cross(half.spin, point - half.place)
                        heading = normal
                        # What slides along the rod past a joint comes no nearer to it.
                        if wp.static(smooth) and which == 1 and i < job.links - 1:
                            if scene.shapes.kind[s] == wp.static(MESH):
                                onward = wp.normalize(line_tangent(link_here, share))
                                heading = normal - onward * wp.dot(onward, normal)
                        approach = wp.dot(heading, linear + wp.cross(angular, point) - object_velocity)
                        # Where the gap will be: tells apart what only passes by.
                        ahead = gap + real(1.5) * h * wp.min(approach, zero)
                        if gap + real(1.5) * job.longest_step * wp.min(approach, zero) <= real(wp.static(CLOSED)):
                            state.closes = 1
                            state.closing_speed = wp.max(state.closing_speed, scene.shapes.speed[s])
                        # Within a quarter of the link.
                        near_here = real(0.0625) * wp.length_sq(link)
                        if wp.static(smooth):
                            # What touches beyond a joint that bends much holds the soft link behind it.
                            near_here = near_here * linearity(rod.near_turn)
                        slot = candidate_slot(candidates, count, point, normal, ahead, near_here)
                        if slot == count:
                            count = count + 1
                        if slot >= 0:
                            mu = scene.shapes.friction[s]
                            if mu < zero:
                                mu = scene.chains.friction[job.whisker]
                            candidates.link[slot] = i
                            candidates.gap[slot] = gap
                            candidates.predicted_gap[slot] = ahead
                            candidates.friction[slot] = mu
                            candidates.point[slot] = point
                            candidates.arc[slot] = taper.arc + taper.arc_length * share
                            if wp.static(smooth):
                                # The rod slides along itself where the chain does not.
                                slide = start_slide + (end_slide - start_slide) * share
                                object_velocity = object_velocity + wp.normalize(line_tangent(link_here, share)) * slide
                            candidates.object_velocity[slot] = object_velocity
                            candidates.normal[slot] = normal
                            if wp.static(recorded):
                                triangle = wp.where(which == 1, found.end_triangle, found.triangle)
                                record_candidate(
                                    candidates, slot, s, triangle, link_here, share, start_slide, end_slide
                                )
            proximity.clearance[i] = closest
    judge_overlap(state, deepest, crossing, base_gap, elapsed(now))
    return count


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
        if wp.static(smooth):
            proximity.shorter[i] = paused.link[i, index].shorter


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
        if wp.static(smooth):
            paused.link[i, index].shorter = row(proximity.shorter, i)


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
                    if wp.static(smooth):
                        paused.query[place].line = CentreLine()
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
                    if wp.static(smooth):
                        # So far the rest shape bows out of a link.
                        slack = slack - real(0.25) * link.length * wp.abs(link.bend_sine)
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
