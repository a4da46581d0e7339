"""Broad phase: which links may touch something within a step, and the candidates for contact that are found there.

Each link keeps a lower bound of its distance from all objects (``clearance``). Links and objects come nearer by no more
than their speeds allow, so a link is measured again only when its bound comes near its radius. A contact takes part
before it closes (g + h vₙ ≥ 0, gap g, approach vₙ), so nothing passes through anything within a step.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import (
    AT_BASE,
    GOT_INSIDE,
    LARGEST_OVERLAP,
    LARGEST_START_OVERLAP,
    STARTED_INSIDE,
    WIDEST,
)
from brainbench.stimuli.engines.units import MILLI

from .algebra import first_axis, rotate, vec3
from .articulated_body import ChainState, ProximityState, hinge_direction
from .motion import BodyMotion, pose_at
from .narrow_phase import link_shape_distance
from .parameters import hinges, real, sliced
from .state import (
    WAIT_DISTANCES,
    WAIT_SLICE,
    ChainArrays,
    ContactCandidates,
    LinkDistance,
    MotionArrays,
    PausedWhiskers,
    ShapeArrays,
    StepOptions,
    WhiskerJob,
    WhiskerState,
    most_candidates,
    row,
)


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
def search_range(job: WhiskerJob, options: StepOptions, state: wp.ref[WhiskerState], h: real) -> SearchRange:
    """Return how far a step of length h looks for contacts."""
    reach = SearchRange()
    # Contacts that may close within this step.
    travel = h * (state.top_speed + job.object_speed)
    # Half more than the present speeds give, because links may speed up within the step.
    reach.margin = wp.min(real(1.5) * travel + h * state.velocity_jump + real(0.001), real(wp.static(WIDEST)))
    # How far links and objects have come since the last step: its rates at the end are those now.
    reach.time = real(1.02) * wp.max(h, state.last_step)
    reach.unknown_speed = job.object_speed
    if options.quasistatic == 1:
        # Quasi-static steps forget their rates, so ``end_speed`` does not contain the way of the last step.
        reach.unknown_speed = job.object_speed + state.velocity_jump
    return reach


@wp.func(inline=True)
def may_be_near(
    chains: ChainArrays, job: WhiskerJob, proximity: wp.ref[ProximityState], reach: SearchRange, i: int
) -> bool:
    """Return whether a link may be so near, for all that its bound tells."""
    taper = chains.taper[i, job.whisker]
    return (
        row(proximity.clearance, i) - reach.time * (row(proximity.end_speed, i) + reach.unknown_speed)
        <= reach.margin + taper.start_radius
    )


@wp.func(inline=True)
def count_near_links(
    chains: ChainArrays, job: WhiskerJob, proximity: wp.ref[ProximityState], reach: SearchRange
) -> int:
    """Return the number of links whose distance must be measured."""
    near_count = int(0)
    for i in range(job.links):
        if may_be_near(chains, job, proximity, reach, i):
            near_count = near_count + 1
    return near_count


@wp.func(inline=True)
def lower_clearance(job: WhiskerJob, proximity: wp.ref[ProximityState], reach: SearchRange):
    """Lower the bound of each link by how much nearer it may have come."""
    for i in range(job.links):
        nearer = reach.time * (row(proximity.end_speed, i) + reach.unknown_speed)
        proximity.clearance[i] = row(proximity.clearance, i) - nearer


@wp.func(inline=True)
def query_distances(
    chains: ChainArrays,
    job: WhiskerJob,
    paused: PausedWhiskers,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    state: wp.ref[WhiskerState],
    reach: SearchRange,
    origin: vec3,
    now: real,
    near_count: int,
) -> int:
    """Ask for the distances of these links; return what to wait for: the next slice, when there is no room for more."""
    state.first_query = wp.atomic_add(paused.next_query_count, 0, near_count)
    if state.first_query + near_count > paused.query.shape[0]:
        return WAIT_SLICE
    place = state.first_query
    for i in range(job.links):
        if may_be_near(chains, job, proximity, reach, i):
            paused.query[place].job = job.index
            paused.query[place].link = i
            paused.query[place].start = row(chain.node, i) + origin
            paused.query[place].stop = row(chain.node, i + 1) + origin
            nearer = reach.time * (row(proximity.end_speed, i) + reach.unknown_speed)
            paused.query[place].bound = row(proximity.clearance, i) - nearer
            place = place + 1
    paused.query_time[job.index] = now
    paused.query_margin[job.index] = reach.margin
    return WAIT_DISTANCES


@wp.func(inline=True)
def candidate_slot(
    candidates: wp.ref[ContactCandidates], count: int, point: vec3, normal: vec3, ahead: real, link: vec3
) -> int:
    """Return where to keep a candidate (``count``: a further one; −1: nowhere)."""
    slot = count
    # The same contact seen from two links, or from both ends of a short gap.
    for j in range(count):
        # Normals within 32° and places within a quarter of the link.
        apart = wp.length_sq(row(candidates.point, j) - point)
        same = wp.dot(row(candidates.normal, j), normal) > real(0.85)
        if same and apart < real(0.0625) * wp.length_sq(link):
            slot = j
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
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    job: WhiskerJob,
    paused: PausedWhiskers,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    candidates: wp.ref[ContactCandidates],
    state: wp.ref[WhiskerState],
    pose: BodyMotion,
    margin: real,
    now: real,
    h: real,
) -> int:
    """Find the contact candidates of all links and renew their bounds; return the number of candidates."""
    zero = real(0.0)
    # Counts that the compiler does not know keep it from writing loops out.
    sides = int(2) + wp.min(0, job.index)
    origin = pose.place
    count = int(0)
    deepest = zero
    crossing = int(0)
    base_gap = zero
    query = state.first_query
    angular = pose.spin
    linear = pose.velocity
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
        taper = chains.taper[i, job.whisker]
        if row(proximity.clearance, i) <= margin + taper.start_radius:
            # One shape after the other, each at two places: between the ends, and at the far end.
            closest = real(1e20)
            for s in range(job.first_shape, job.end_shape):
                body = pose_at(motions, shapes.track[s], now)
                turn_s = shapes.turn[s]
                found = LinkDistance()
                if wp.static(sliced):
                    found = paused.answer[query]
                    query = query + 1
                else:
                    a = joint + origin
                    b = row(chain.node, i + 1) + origin
                    bound = row(proximity.clearance, i)
                    leaf = row(proximity.leaf, i)
                    found = link_shape_distance(shapes, s, body, a, b, taper, margin, bound, leaf, 0, 1)
                proximity.leaf[i] = found.leaf
                closest = wp.min(closest, found.clearance)
                deepest = wp.max(deepest, found.depth)
                crossing = wp.max(crossing, found.crossing)
                if i == 0 and found.start == 1 and found.start_gap < margin:
                    way = rotate(body.turn, rotate(turn_s, found.start_normal))
                    approach = wp.dot(way, pose.velocity - body.velocity - wp.cross(body.spin, origin - body.place))
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
                        deepest = wp.max(deepest, -gap)
                        normal = rotate(body.turn, rotate(turn_s, way))
                        radius = taper.start_radius + (taper.end_radius - taper.start_radius) * share
                        # The force acts on the skin of the whisker: its radius is the lever of friction.
                        point = joint + link * share - normal * radius
                        # The object's velocity in the middle of the step.
                        half = pose_at(motions, shapes.track[s], now + real(0.5) * h)
                        object_velocity = half.velocity + wp.cross(half.spin, point + origin - half.place)
                        approach = wp.dot(normal, linear + wp.cross(angular, point) - object_velocity)
                        # Where the gap will be: tells apart what only passes by.
                        ahead = gap + real(1.5) * h * wp.min(approach, zero)
                        slot = candidate_slot(candidates, count, point, normal, ahead, link)
                        if slot == count:
                            count = count + 1
                        if slot >= 0:
                            mu = shapes.friction[s]
                            if mu < zero:
                                mu = chains.friction[job.whisker]
                            candidates.link[slot] = i
                            candidates.gap[slot] = gap
                            candidates.predicted_gap[slot] = ahead
                            candidates.friction[slot] = mu
                            candidates.point[slot] = point
                            candidates.arc[slot] = taper.arc + taper.arc_length * share
                            candidates.object_velocity[slot] = object_velocity
                            candidates.normal[slot] = normal
            proximity.clearance[i] = closest
    judge_overlap(state, deepest, crossing, base_gap, now)
    return count
