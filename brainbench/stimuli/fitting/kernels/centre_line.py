"""Change of the centre line that contacts touch, and of what bends it: ``..centre_line`` with its derivative.

Numbers are pairs (value, change), vectors matrices of two such rows; names are those of ``bent_link``.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import LARGE_BEND, STEADY

from ..algebra import Spatial, spatial, vec2, vec3, vec4
from ..articulated_body import ChainState
from ..centre_line import joint_moment, link_direction
from ..delassus import PerContact1, PerContact3
from ..delassus import row as contact_row
from ..parameters import hinges, real
from ..state import ChainArrays, PerLink1, PerLink3, WhiskerJob, cubic_weights, row
from .chain import (
    ARC,
    ARC_LENGTH,
    BEND,
    FORCE_DEFLECTION,
    FORCE_SLOPE,
    LENGTH,
    MOMENT_SLOPE,
    STIFFNESS,
    TRUST,
    PackedTangents,
    StepLinks,
    hinge_row,
)
from .contacts import StepContacts
from .recording import cubic_slopes
from .records import StepRecords

Pair3: Any = wp.types.matrix((2, 3), real)


@wp.func
def pair3(value: vec3, change: vec3) -> Pair3:
    """Return a vector and its change."""
    return wp.matrix_from_rows(value, change)


@wp.func
def product(a: vec2, b: vec2) -> vec2:
    """Return the product of two numbers."""
    return vec2(a[0] * b[0], a[0] * b[1] + a[1] * b[0])


@wp.func
def quotient(a: vec2, b: vec2) -> vec2:
    """Return a / b."""
    value = a[0] / b[0]
    return vec2(value, (a[1] - value * b[1]) / b[0])


@wp.func
def times(a: Pair3, x: vec2) -> Pair3:
    """Return a vector times a number."""
    return pair3(a[0] * x[0], a[1] * x[0] + a[0] * x[1])


@wp.func
def inner(a: Pair3, b: Pair3) -> vec2:
    """Return the scalar product of two vectors."""
    return vec2(wp.dot(a[0], b[0]), wp.dot(a[0], b[1]) + wp.dot(a[1], b[0]))


@wp.func
def size(a: Pair3) -> vec2:
    """Return the length of a vector."""
    length = wp.max(wp.length(a[0]), real(1e-12))
    return vec2(length, wp.dot(a[0], a[1]) / length)


@wp.struct
class RodBend:
    """What bends the rod in a step, and its change with a parameter."""

    chains: ChainArrays
    records: StepRecords
    tangents: PackedTangents
    job: WhiskerJob
    place: wp.int32
    """Step of the segment."""
    parameter: wp.int32
    base: Pair3
    """Direction in which the whisker leaves its base."""
    direction: PerLink3
    """Of each link."""
    direction_d: PerLink3
    moment: PerLink3
    """Of the spring of its joint, as the way in which it turns the link."""
    moment_d: PerLink3


@wp.func
def begin_rod(
    chains: ChainArrays, records: StepRecords, tangents: PackedTangents, job: WhiskerJob, chain: wp.ref[ChainState],
    base: vec3, place: int, rod: wp.ref[RodBend],
):  # fmt: skip
    """Find what bends the rod in a step."""
    rod.chains = chains
    rod.records = records
    rod.tangents = tangents
    rod.job = job
    rod.place = place
    rod.base = pair3(base, base)
    for i in range(job.links):
        rod.direction[i] = link_direction(job, chain, base, i)
        rod.moment[i] = joint_moment(chains, job, chain, i)


@wp.func
def move_rod(chain: wp.ref[ChainState], links: wp.ref[StepLinks], p: int, base_turn: vec3, rod: wp.ref[RodBend]):
    """Find its change with a parameter; ``base_turn`` is the turn of the base."""
    rod.parameter = p
    index = rod.job.index
    turn = base_turn
    rod.base = pair3(rod.base[0], wp.cross(turn, rod.base[0]))
    for i in range(rod.job.links):
        bend_d = rod.tangents.link[p, wp.static(BEND), i, index]
        angle = row(chain.angle, i)
        angle_d = rod.tangents.angle[p, i, index]
        s1 = hinge_row(links.axis, wp.static(hinges) * i)
        s2 = hinge_row(links.axis, wp.static(hinges) * i + 1)
        bent = s1 * angle[0] + s2 * angle[1]
        turn = turn + row(links.before, i) * bend_d
        bent_d = wp.cross(turn, s1) * angle[0] + s1 * angle_d[0]
        turn = turn + s1 * angle_d[0]
        bent_d = bent_d + wp.cross(turn, s2) * angle[1] + s2 * angle_d[1]
        turn = turn + s2 * angle_d[1]
        if wp.static(hinges == 3):
            if i % 2 == 1:
                turn = turn + hinge_row(links.axis, wp.static(hinges) * i + 2) * angle_d[2]
            turn = turn + row(links.behind, i) * bend_d
        along = row(rod.direction, i)
        along_d = wp.cross(turn, along)
        moment_d = wp.cross(bent_d, along) + wp.cross(bent, along_d)
        stiffness_d = rod.tangents.link[p, wp.static(STIFFNESS), i, index]
        rod.direction_d[i] = along_d
        rod.moment_d[i] = (
            moment_d * rod.chains.inertia[i, rod.job.whisker].stiffness + wp.cross(bent, along) * stiffness_d
        )


@wp.func
def direction_at(rod: wp.ref[RodBend], i: int) -> Pair3:
    """Return the direction of a link as ``..centre_line.link_direction``."""
    along = rod.base
    if i >= 0:
        last = wp.min(i, rod.job.links - 1)
        along = pair3(row(rod.direction, last), row(rod.direction_d, last))
    return along


@wp.func
def moment_at(rod: wp.ref[RodBend], i: int) -> Pair3:
    """Return the moment of a joint as ``..centre_line.joint_moment``."""
    moment = Pair3()
    if i >= 0 and i < rod.job.links:
        moment = pair3(row(rod.moment, i), row(rod.moment_d, i))
    return moment


@wp.func
def packed(rod: wp.ref[RodBend], which: int, i: int, value: real) -> vec2:
    """Return a number of a link; ``which`` is its row in :attr:`PackedTangents.link`."""
    return vec2(value, rod.tangents.link[rod.parameter, which, i, rod.job.index])


@wp.func
def move_shortening(rod: wp.ref[RodBend], shorter_d: wp.ref[PerLink1]):
    """Find the change of how much less than the chain the rod reaches along itself, up to the end of each link."""
    total = vec2()
    for i in range(rod.job.links):
        beam = rod.chains.beam[i, rod.job.whisker]
        length = packed(rod, wp.static(ARC_LENGTH), i, rod.chains.taper[i, rod.job.whisker].arc_length)
        slope = packed(rod, wp.static(FORCE_SLOPE), i, beam.force_slope[0])
        deflection = packed(rod, wp.static(FORCE_DEFLECTION), i, beam.force_deflection[0])
        half = direction_at(rod, i) - direction_at(rod, i - 1)
        turn = direction_at(rod, i + 1) - direction_at(rod, i - 1)
        moment = moment_at(rod, i)
        apart = times(moment, slope) + times(moment - moment_at(rod, i + 1), quotient(deflection, length))
        total = total + product(inner(turn, turn), length) / real(96.0) - inner(apart, half)
        shorter_d[i] = total[1]


@wp.struct
class JointTurn:
    """Turn of the chain at a joint less what beam theory makes of it; its bend, and how far that is followed."""

    rest: Pair3
    size: vec2
    share: vec2


@wp.func
def joint_turn(rod: wp.ref[RodBend], j: int) -> JointTurn:
    """Return the turn at a joint; nothing turns beyond both ends."""
    one = vec2(real(1.0), real(0.0))
    found = JointTurn()
    found.share = one
    if j >= 0 and j < rod.job.links:
        stiffness = packed(rod, wp.static(STIFFNESS), j, rod.chains.inertia[j, rod.job.whisker].stiffness)
        trust = packed(rod, wp.static(TRUST), j, rod.chains.beam[j, rod.job.whisker].trust)
        bend = times(moment_at(rod, j), quotient(one, stiffness))
        square = inner(bend, bend) * real(wp.static(LARGE_BEND**-2))
        found.share = quotient(one, one + product(square, square))
        found.size = size(bend)
        found.rest = direction_at(rod, j) - direction_at(rod, j - 1) - times(bend, product(trust, found.share))
    return found


@wp.struct
class SteadyPush:
    """Mean force across a link of a contact of the last step, and its place from the joint of the link."""

    push: Pair3
    reach: vec2


@wp.func
def steady_push(rod: wp.ref[RodBend], i: int, c: int) -> SteadyPush:
    """Return the c-th contact of the last step as link i feels it."""
    steady = rod.records.steady[rod.place, c, rod.job.index]
    push = pair3(steady.push, rod.tangents.steady[rod.parameter, c, rod.job.index])
    along = direction_at(rod, i)
    found = SteadyPush()
    found.push = push - times(along, inner(push, along))
    arc = packed(rod, wp.static(ARC), i, rod.chains.taper[i, rod.job.whisker].arc)
    found.reach = vec2(steady.arc, rod.tangents.arc[rod.parameter, c, rod.job.index]) - arc
    return found


@wp.func
def weighted(rod: wp.ref[RodBend], which: int, i: int, values: vec4, place: vec2) -> vec2:
    """Return what joints lack at a place of a link, of which four are packed from row ``which`` on."""
    weights = cubic_weights(place[0])
    total = vec2(wp.dot(weights, values), wp.dot(cubic_slopes(place[0]), values) * place[1])
    for k in range(4):
        total = total + vec2(real(0.0), weights[k] * rod.tangents.link[rod.parameter, which + k, i, rod.job.index])
    return total


@wp.struct
class LineLoads:
    """Moments of joints around a link, and loads along it, as ``..centre_line.LinkLoads``."""

    before: Pair3
    here: Pair3
    after: Pair3
    beyond: Pair3
    outer_force: Pair3
    outer_moment: Pair3
    slope: Pair3
    offset: Pair3


@wp.func
def add_inner(rod: wp.ref[RodBend], i: int, place: vec2, push: Pair3, ahead: vec2, loads: wp.ref[LineLoads]):
    """Add what the joints miss of a force on link i, as ``..centre_line.inner_error``."""
    beam = rod.chains.beam[i, rod.job.whisker]
    slope = weighted(rod, wp.static(FORCE_SLOPE), i, beam.force_slope, place)
    offset = weighted(rod, wp.static(FORCE_DEFLECTION), i, beam.force_deflection, place)
    loads.slope = loads.slope + times(push, slope)
    loads.offset = loads.offset + times(push, offset - product(slope, ahead))


@wp.func
def move_line(rod: wp.ref[RodBend], i: int, share: real) -> Spatial:
    """Return the change of the centre line beside a link at a place along it, 0 to 1: of its tangent and its offset.

    The link itself, and the place, stay.
    """
    zero = real(0.0)
    half = real(0.5)
    one = vec2(real(1.0), zero)
    held = rod.records.step[rod.place, rod.job.index].held
    beam = rod.chains.beam[i, rod.job.whisker]
    length = packed(rod, wp.static(LENGTH), i, rod.chains.build[i, rod.job.whisker].length)
    span = packed(rod, wp.static(ARC_LENGTH), i, rod.chains.taper[i, rod.job.whisker].arc_length)
    before = joint_turn(rod, i - 1)
    here = joint_turn(rod, i)
    after = joint_turn(rod, i + 1)
    if i == 0:
        here.rest = here.rest * real(2.0)
    if i == rod.job.links - 1:
        after.rest = here.rest
    loads = LineLoads()
    loads.before = moment_at(rod, i - 1)
    loads.here = moment_at(rod, i)
    loads.after = moment_at(rod, i + 1)
    loads.beyond = moment_at(rod, i + 2)
    crowd = int(0)
    crowd_moment = Pair3()
    for c in range(held):
        steady = steady_push(rod, i, c)
        push = steady.push
        reach = steady.reach
        if reach[0] >= span[0]:
            far = reach - span * real(2.0)
            if far[0] < zero:
                far = vec2()
            loads.before = loads.before - times(push, reach + span)
            loads.here = loads.here - times(push, reach)
            loads.after = loads.after - times(push, reach - span)
            loads.beyond = loads.beyond - times(push, far)
            loads.outer_force = loads.outer_force + push
            loads.outer_moment = loads.outer_moment + times(push, reach)
        elif reach[0] >= zero:
            crowd = crowd + 1
            crowd_moment = crowd_moment + times(push, reach)
        else:
            if reach[0] + span[0] > zero:
                loads.before = loads.before - times(push, reach + span)
            further = wp.max(i + int(wp.floor(reach[0] / span[0])), 0)
            place = quotient(reach, span) + one * real(i - further)
            add_inner(rod, further, place, push, reach, loads)
    if crowd > 1:
        loads.here = loads.here - crowd_moment
    if i == 0:
        loads.before = loads.here
    slope_here = loads.slope
    offset_here = loads.offset
    weights = cubic_weights(share)
    turn = Pair3()
    moved = Pair3()
    places = int(4)
    for k in range(places):
        x = real(k) / real(3.0)
        left = real(1.0) - x
        moment = loads.after + (loads.after - loads.beyond) * left
        force = times(loads.here - moment + (loads.before - loads.here) * left, quotient(one, length))
        if i == 0:
            force = force / wp.max(x, real(0.1))
        loads.slope = slope_here
        loads.offset = offset_here + times(slope_here, length * x)
        if crowd > 1:
            force = times(loads.here - loads.after, quotient(one, length))
            moment = loads.after + (loads.here - loads.after) * left
            for c in range(held):
                steady = steady_push(rod, i, c)
                if steady.reach[0] >= zero and steady.reach[0] < span[0]:
                    ahead = steady.reach - length * x
                    if ahead[0] >= zero:
                        force = force + steady.push
                        moment = moment + times(steady.push, ahead)
                    else:
                        place = quotient(steady.reach, span)
                        add_inner(rod, i, place, steady.push, ahead, loads)
        moment = moment + loads.outer_moment - times(loads.outer_force, length * x)
        force = force + loads.outer_force
        bending = packed(rod, wp.static(MOMENT_SLOPE) + k, i, beam.moment_slope[k])
        shear = packed(rod, wp.static(FORCE_SLOPE) + k, i, beam.force_slope[k])
        deflection = packed(rod, wp.static(FORCE_DEFLECTION) + k, i, beam.force_deflection[k])
        slope = times(moment, bending) + times(force, shear) + loads.slope
        offset = times(moment, shear) + times(force, deflection) + loads.offset
        part = here.share * left + after.share * x
        most = quotient((before.size + here.size + after.size) * half, size(slope))
        if most[0] < part[0]:
            part = most
        slope = times(slope, part) - here.rest * (half * left * left) + after.rest * (half * x * x)
        bow = length * (half * x * left)
        offset = times(offset, part) - times(here.rest * left + after.rest * x, bow)
        turn = turn + times(slope, length) * weights[k]
        moved = moved + offset * weights[k]
    return spatial(turn[1], moved[1])


@wp.func
def keep_contacts(contacts: wp.ref[StepContacts], rod: wp.ref[RodBend], h: real, share_d: wp.ref[PerContact1]):
    """Write the change of the mean force of each contact, and of its arc, for the next step."""
    index = rod.job.index
    p = rod.parameter
    record = rod.records.step[rod.place, index]
    weight = h / (h + real(wp.static(STEADY)))
    mean_d = PerContact3()
    for k in range(record.taken):
        contact = rod.records.contact[rod.place, k, index]
        taper = rod.chains.taper[contact.link, rod.job.whisker]
        # As ``delassus.add_contact``: it goes on with the last that is so near.
        before_d = vec3()
        for e in range(record.held):
            if wp.abs(rod.records.steady[rod.place, e, index].arc - contact.arc) < real(0.3) * taper.arc_length:
                before_d = rod.tangents.steady[p, e, index]
        change = vec3()
        if k < record.contacts:
            change = contact_row(contacts.change, k)
        mean_d[k] = before_d + (change - before_d) * weight
        span_d = rod.tangents.link[p, wp.static(ARC_LENGTH), contact.link, index] * contact.share
        arc_d = rod.tangents.link[p, wp.static(ARC), contact.link, index] + span_d
        rod.tangents.arc[p, contact.rank, index] = arc_d + taper.arc_length * contact_row(share_d, k)
    for k in range(record.taken):
        rank = rod.records.contact[rod.place, k, index].rank
        rod.tangents.steady[p, rank, index] = contact_row(mean_d, k)
