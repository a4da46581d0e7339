"""Change of the centre line that contacts touch: ``..centre_line``, walked with its derivative by a parameter.

Numbers are pairs (value, change), vectors matrices of two such rows; names are those of ``..centre_line``.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import LARGE_BEND, STEADY

from ..algebra import Spatial, spatial, vec2, vec3, vec4
from ..articulated_body import ChainState
from ..centre_line import link_direction, place_of
from ..delassus import PerContact1, PerContact3, PerContactInt
from ..delassus import row as contact_row
from ..parameters import hinges, real
from ..state import ChainArrays, PerLink3, WhiskerJob, cubic_weights, row
from .chain import (
    ARC,
    ARC_LENGTH,
    BEND,
    LENGTH,
    NEAR_DEFLECTION,
    NEAR_TURN,
    STIFFNESS,
    THERE_DEFLECTION,
    THERE_TURN,
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
def fixed(value: real) -> vec2:
    """Return a number that does not change."""
    return vec2(value, real(0.0))


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
def cross(a: Pair3, b: Pair3) -> Pair3:
    """Return the vector product of two vectors."""
    return pair3(wp.cross(a[0], b[0]), wp.cross(a[1], b[0]) + wp.cross(a[0], b[1]))


@wp.func
def size(a: Pair3) -> vec2:
    """Return the length of a vector."""
    length = wp.max(wp.length(a[0]), real(1e-12))
    return vec2(length, wp.dot(a[0], a[1]) / length)


@wp.struct
class RodWalk:
    """What bends the rod in a step, and how it lies beside a link; all with their change with a parameter."""

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
    bend: PerLink3
    """Turn of the joint of each link."""
    bend_d: PerLink3
    link: wp.int32
    """Where the walk is: a link, from its joint to its end, and how the rod lies there."""
    along: Pair3
    turn: Pair3
    offset: Pair3
    here: Pair3
    touched: wp.int32
    alone: wp.int32
    shorter: vec2
    """By how much less than the chain the rod reaches along itself, up to the end of the link."""


@wp.func
def begin_rod(
    chain: wp.ref[ChainState], links: wp.ref[StepLinks], p: int, base: vec3, base_turn: vec3, rod: wp.ref[RodWalk]
):
    """Go to the base; find what bends the rod and its change with a parameter, with which the base turns."""
    rod.parameter = p
    index = rod.job.index
    turn = base_turn
    rod.base = pair3(base, wp.cross(turn, base))
    for i in range(rod.job.links):
        rest_d = rod.tangents.link[p, wp.static(BEND), i, index]
        angle = row(chain.angle, i)
        angle_d = rod.tangents.angle[p, i, index]
        turn = turn + row(links.before, i) * rest_d
        bend = Pair3()
        for d in range(wp.static(hinges)):
            s = hinge_row(links.axis, wp.static(hinges) * i + d)
            if d < 2:
                bend = bend + pair3(s * angle[d], wp.cross(turn, s) * angle[d] + s * angle_d[d])
            turn = turn + s * angle_d[d]
        if wp.static(hinges == 3):
            turn = turn + row(links.behind, i) * rest_d
        along = link_direction(rod.job, chain, base, i)
        rod.direction[i] = along
        rod.direction_d[i] = wp.cross(turn, along)
        rod.bend[i] = bend[0]
        rod.bend_d[i] = bend[1]
    rod.turn = Pair3()
    rod.offset = Pair3()
    rod.shorter = vec2()


@wp.func
def packed(rod: wp.ref[RodWalk], which: int, i: int, value: real) -> vec2:
    """Return a number of a link; ``which`` is its row in :attr:`PackedTangents.link`."""
    return vec2(value, rod.tangents.link[rod.parameter, which, i, rod.job.index])


@wp.func
def direction_at(rod: wp.ref[RodWalk], i: int) -> Pair3:
    """Return the direction of a link as ``..centre_line.link_direction``."""
    along = rod.base
    if i >= 0:
        last = wp.min(i, rod.job.links - 1)
        along = pair3(row(rod.direction, last), row(rod.direction_d, last))
    return along


@wp.func
def bend_at(rod: wp.ref[RodWalk], j: int) -> Pair3:
    """Return the turn of a joint; nothing turns beyond both ends."""
    bend = Pair3()
    if j >= 0 and j < rod.job.links:
        bend = pair3(row(rod.bend, j), row(rod.bend_d, j))
    return bend


@wp.func
def moment_at(rod: wp.ref[RodWalk], j: int) -> Pair3:
    """Return the moment of a joint as ``..centre_line.joint_moment``."""
    last = wp.min(j, rod.job.links - 1)
    stiffness = packed(rod, wp.static(STIFFNESS), last, rod.chains.inertia[last, rod.job.whisker].stiffness)
    return times(bend_at(rod, j), stiffness)


@wp.func
def linearity(bend: Pair3) -> vec2:
    """Return how far beam theory is followed where a joint bends so much."""
    square = inner(bend, bend) * real(wp.static(LARGE_BEND**-2))
    return quotient(fixed(real(1.0)), fixed(real(1.0)) + product(square, square))


@wp.struct
class SteadyContact:
    """A contact of the last step: where along a link it was, and its mean force times the link."""

    share: vec2
    push: Pair3


@wp.func
def steady_contact(rod: wp.ref[RodWalk], c: int) -> SteadyContact:
    """Return the c-th contact of the last step as the link feels it where the walk is."""
    i = rod.link
    record = rod.records.steady[rod.place, c, rod.job.index]
    taper = rod.chains.taper[i, rod.job.whisker]
    arc = vec2(record.arc, rod.tangents.arc[rod.parameter, c, rod.job.index])
    contact = SteadyContact()
    contact.share = quotient(
        arc - packed(rod, wp.static(ARC), i, taper.arc), packed(rod, wp.static(ARC_LENGTH), i, taper.arc_length)
    )
    contact.share[0] = place_of(contact.share[0])
    contact.push = cross(rod.along, pair3(record.push, rod.tangents.steady[rod.parameter, c, rod.job.index]))
    return contact


@wp.struct
class Bend:
    """Turn and deflection, as rotation of the link, from its start to a place on it."""

    turn: Pair3
    deflection: Pair3


@wp.func
def compliance(rod: wp.ref[RodWalk], which: int, values: vec4, place: vec2) -> vec2:
    """Return a number of ``state.BeamCompliance`` at a place, of which four are packed from row ``which`` on."""
    third = int(wp.round(place[0] * real(3.0)))
    if place[0] == real(third) / real(3.0) and place[1] == real(0.0):
        return packed(rod, which + third, rod.link, values[third])
    weights = cubic_weights(place[0])
    change = wp.dot(cubic_slopes(place[0]), values) * place[1]
    for k in range(4):
        change = change + weights[k] * rod.tangents.link[rod.parameter, which + k, rod.link, rod.job.index]
    return vec2(wp.dot(weights, values), change)


@wp.func
def bend_between(rod: wp.ref[RodWalk], place: vec2, near: Pair3, there: Pair3) -> Bend:
    """Return the bend of a moment linear from the link's start to a place on it."""
    beam = rod.chains.beam[rod.link, rod.job.whisker]
    bend = Bend()
    bend.turn = times(near, compliance(rod, wp.static(NEAR_TURN), beam.near_turn, place))
    bend.turn = bend.turn + times(there, compliance(rod, wp.static(THERE_TURN), beam.there_turn, place))
    bend.deflection = times(near, compliance(rod, wp.static(NEAR_DEFLECTION), beam.near_deflection, place))
    bend.deflection = bend.deflection + times(
        there, compliance(rod, wp.static(THERE_DEFLECTION), beam.there_deflection, place)
    )
    return bend


@wp.func
def bend_of_contacts(rod: wp.ref[RodWalk], x: real) -> Bend:
    """Return the bend from the link's start to a place, with all contacts by their mean forces."""
    place = fixed(x)
    near = moment_at(rod, rod.link) - rod.here
    bend = bend_between(rod, place, near, near * (real(1.0) - x) + moment_at(rod, rod.link + 1) * x)
    if rod.touched > 0:
        for c in range(rod.records.step[rod.place, rod.job.index].held):
            contact = steady_contact(rod, c)
            share = contact.share
            if share[0] >= real(0.0) and share[0] < real(1.0):
                upto = place
                if share[0] < x:
                    upto = share
                mine = bend_between(rod, upto, times(contact.push, share), times(contact.push, share - upto))
                bend.turn = bend.turn + mine.turn
                bend.deflection = bend.deflection + mine.deflection + times(mine.turn, place - upto)
    return bend


@wp.func
def enter_link(rod: wp.ref[RodWalk], i: int):
    """Go on from the start of the link before to that of link i, the next."""
    if i > 0:
        bend = bend_of_contacts(rod, real(1.0))
        rod.offset = rod.offset + cross(rod.turn + bend.deflection, rod.along)
        rod.turn = rod.turn + bend.turn
    build = rod.chains.build[i, rod.job.whisker]
    before = direction_at(rod, i - 1)
    rod.link = i
    rod.along = times(direction_at(rod, i), packed(rod, wp.static(LENGTH), i, build.length))
    rod.turn = rod.turn - bend_at(rod, i)
    rod.here = Pair3()
    rod.touched = 0
    next_touched = int(0)
    for c in range(rod.records.step[rod.place, rod.job.index].held):
        contact = steady_contact(rod, c)
        share = contact.share[0]
        if share >= real(0.0) and share < real(1.0):
            rod.touched = rod.touched + 1
            rod.here = rod.here + times(contact.push, contact.share)
        elif share >= real(1.0) and share < real(2.0):
            next_touched = 1
    rod.alone = 0
    if rod.touched <= 1 and next_touched == 0:
        rod.alone = 1
    length = packed(rod, wp.static(ARC_LENGTH), i, rod.chains.taper[i, rod.job.whisker].arc_length)
    turn = direction_at(rod, i + 1) - before
    rod.shorter = rod.shorter + product(inner(turn, turn), length) / real(96.0)
    rod.shorter = rod.shorter - inner(rod.offset, direction_at(rod, i) - before)


@wp.func
def move_line(rod: wp.ref[RodWalk], share: real) -> Spatial:
    """Return the change of the centre line beside the link at a place along it, 0 to 1: of its tangent and its offset.

    The link itself, and the place, stay.
    """
    half = real(0.5)
    i = rod.link
    here = bend_at(rod, i)
    after = bend_at(rod, i + 1)
    most = size(bend_at(rod, i - 1)) + size(here) + size(after)
    along = direction_at(rod, i)
    first = linearity(here)
    start = along - direction_at(rod, i - 1) - times(cross(here, along), first)
    if i == 0:
        start = start * real(2.0)
    end = start
    last = fixed(real(1.0))
    if i < rod.job.links - 1:
        onward = direction_at(rod, i + 1)
        last = linearity(after)
        end = onward - along - times(cross(after, onward), last)
    length = packed(rod, wp.static(LENGTH), i, rod.chains.build[i, rod.job.whisker].length)
    near = moment_at(rod, i)
    far = moment_at(rod, i + 1)
    beyond = moment_at(rod, i + 2)
    weights = cubic_weights(share)
    turn = Pair3()
    moved = Pair3()
    places = int(4)
    for k in range(places):
        if weights[k] == real(0.0):
            continue
        x = real(k) / real(3.0)
        left = real(1.0) - x
        bend = Bend()
        if rod.alone == 1:
            bend = bend_between(rod, fixed(x), near, far + (far - beyond) * left)
        else:
            bend = bend_of_contacts(rod, x)
        slope = cross(rod.turn + bend.turn, along)
        offset = rod.offset + cross(rod.turn * x + bend.deflection, rod.along)
        held = first * left + last * x
        bound = quotient(most * half, size(slope))
        if bound[0] < held[0]:
            held = bound
        slope = times(slope, held) - start * (half * left * left) + end * (half * x * x)
        bow = length * (half * x * left)
        offset = times(offset, held) - times(start * left + end * x, bow)
        turn = turn + times(slope, length) * weights[k]
        moved = moved + offset * weights[k]
    return spatial(turn[1], moved[1])


@wp.func
def keep_contacts(contacts: wp.ref[StepContacts], rod: wp.ref[RodWalk], h: real, share_d: wp.ref[PerContact1]):
    """Write the change of the mean forces of each contact, and of its arc, for the next step."""
    index = rod.job.index
    p = rod.parameter
    record = rod.records.step[rod.place, index]
    weight = h / (h + real(wp.static(STEADY)))
    mean_d = PerContact3()
    steady_d = PerContact3()
    origin = PerContactInt()
    for k in range(record.taken):
        # As ``delassus.add_contact``: it goes on with the nearest of the last, and with others of that one.
        contact = rod.records.contact[rod.place, k, index]
        closest = real(0.3) * rod.chains.taper[contact.link, rod.job.whisker].arc_length
        origin[k] = -1
        for e in range(record.held):
            apart = wp.abs(rod.records.steady[rod.place, e, index].arc - contact.arc)
            if apart < closest:
                closest = apart
                origin[k] = e
    for k in range(record.taken):
        mean = vec3()
        steady = vec3()
        e = contact_row(origin, k)
        if e >= 0:
            heirs = real(0.0)
            for j in range(record.taken):
                if contact_row(origin, j) == e:
                    heirs = heirs + real(1.0)
            mean = rod.tangents.mean[p, e, index] / heirs
            steady = rod.tangents.steady[p, e, index] / heirs
        force = vec3()
        if k < record.contacts:
            force = contact_row(contacts.change, k)
        mean = mean + (force - mean) * weight
        mean_d[k] = mean
        steady_d[k] = steady + (mean - steady) * weight
    for k in range(record.taken):
        contact = rod.records.contact[rod.place, k, index]
        span = rod.chains.taper[contact.link, rod.job.whisker].arc_length
        span_d = rod.tangents.link[p, wp.static(ARC_LENGTH), contact.link, index] * contact.share
        arc_d = rod.tangents.link[p, wp.static(ARC), contact.link, index] + span_d
        rod.tangents.arc[p, contact.rank, index] = arc_d + span * contact_row(share_d, k)
        rod.tangents.mean[p, contact.rank, index] = contact_row(mean_d, k)
        rod.tangents.steady[p, contact.rank, index] = contact_row(steady_d, k)
