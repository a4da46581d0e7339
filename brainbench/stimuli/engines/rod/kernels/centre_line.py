"""Centre line of the bent rod beside a straight link of its chain, which contacts touch.

A chain bends at its joints alone: a link is straight, and turns by a whole bend where a contact passes a joint. A rod
bends all along, by M/(E I) under a moment M that is linear where nothing touches. Walked from the base on, the moments
of the joints tell how rod and chain part (:class:`RodPlace`), by what lies next to each. Contacts on a link break that
line. To one that is alone the moments further out go on in a straight line, wherever it is. Otherwise, and for what it
bends further out, its force counts as averaged twice: a gap that answered to the force of the last step, or to its
simple mean, would swing where a link is light. The rest shape adds its own bends, linear as between two joints.

Where slip reverses, its speed is a small difference of large ones: the chain, which is straighter than the rod, would
reverse some tenths of a ms too early or too late (:func:`shortening`).
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import LARGE_BEND

from .algebra import Spatial, first_axis, plus, spatial, vec3
from .articulated_body import ChainState, hinge_direction
from .parameters import real
from .state import (
    BeamCompliance,
    CentreLine,
    ChainArrays,
    Cone,
    ContactProblems,
    LinkTaper,
    WhiskerJob,
    cone,
    cubic_weights,
    row,
)


@wp.func
def joint_moment(chains: ChainArrays, job: WhiskerJob, chain: wp.ref[ChainState], j: int) -> vec3:
    """Return the moment of a joint's spring (µN·m); none beyond the last."""
    moment = vec3()
    if j < job.links:
        axis2 = row(chain.axis2, j)
        angle = row(chain.angle, j)
        turn = first_axis(axis2, hinge_direction(chain, j), angle[1]) * angle[0] + axis2 * angle[1]
        moment = turn * chains.inertia[j, job.whisker].stiffness
    return moment


@wp.func
def link_direction(job: WhiskerJob, chain: wp.ref[ChainState], base: vec3, i: int) -> vec3:
    """Return the direction of a link; before the first that of the base, beyond the last its own."""
    along = base
    if i >= 0:
        last = wp.min(i, job.links - 1)
        along = wp.normalize(row(chain.node, last + 1) - row(chain.node, last))
    return along


@wp.func
def linearity(bend: vec3) -> real:
    """Return how far beam theory, which is linear, is followed where a joint bends so much: 1 to 0."""
    square = wp.length_sq(bend) / real(wp.static(LARGE_BEND**2))
    return real(1.0) / (real(1.0) + square * square)


@wp.struct
class RodPlace:
    """How the rod lies beside a link, walked from link to link from the base on."""

    turn: vec3
    """Rotation (rad) from the link to the rod's tangent at its start, and how far (mm) the rod lies from that."""
    offset: vec3
    before: vec3
    """Turn (rad) of the joint before, and those of the joints at both ends of the link."""
    near_turn: vec3
    far_turn: vec3
    near: vec3
    """Moments (µN·m) of the joints at both ends of the link, and of the next."""
    far: vec3
    beyond: vec3
    here: vec3
    """What contacts on the link add to the first of these, by their mean forces."""
    touched: wp.int32
    """Contacts on the link; 1: there is at most one, and none on the next."""
    alone: wp.int32


@wp.func
def place_of(share: real) -> real:
    """Return a place along a link (0 to 1 on it); one at a joint is on the link behind it, however arcs are rounded."""
    joint = wp.round(share)
    return wp.where(wp.abs(share - joint) < real(1e-5), joint, share)


@wp.func
def contact_share(problems: ContactProblems, job: WhiskerJob, c: int, taper: LinkTaper) -> real:
    """Return where along a link (0 to 1 on it) a contact of the last step was."""
    return place_of((problems.held[job.index, c].arc - taper.arc) / taper.arc_length)


@wp.func
def bend_between(beam: BeamCompliance, place: real, near: vec3, there: vec3) -> Spatial:
    """Return turn and deflection, as rotation of the link, of a moment linear from a link's start to a place on it."""
    weights = cubic_weights(place)
    return spatial(
        near * wp.dot(weights, beam.near_turn) + there * wp.dot(weights, beam.there_turn),
        near * wp.dot(weights, beam.near_deflection) + there * wp.dot(weights, beam.there_deflection),
    )


@wp.func(inline=True)
def bend_of_contacts(
    chains: ChainArrays,
    problems: ContactProblems,
    job: WhiskerJob,
    contacts: int,
    i: int,
    link: vec3,
    rod: RodPlace,
    place: real,
) -> Spatial:
    """Return turn and deflection from the start of link i to a place, with all contacts by their mean forces."""
    beam = chains.beam[i, job.whisker]
    near = rod.near - rod.here
    bend = bend_between(beam, place, near, near * (real(1.0) - place) + rod.far * place)
    if rod.touched > 0:
        for c in range(contacts):
            share = contact_share(problems, job, c, chains.taper[i, job.whisker])
            if share >= real(0.0) and share < real(1.0):
                push = wp.cross(link, problems.held[job.index, c].steady)
                upto = wp.min(place, share)
                mine = bend_between(beam, upto, push * share, push * (share - upto))
                mine.v = mine.v + mine.w * (place - upto)
                bend = plus(bend, mine, real(1.0))
    return bend


@wp.func
def enter_link(
    chains: ChainArrays,
    problems: ContactProblems,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    contacts: int,
    i: int,
    rod: wp.ref[RodPlace],
):
    """Go on from the start of the link before to that of link i, the next."""
    link = row(chain.node, i + 1) - row(chain.node, i)
    if i == 0:
        rod.near = joint_moment(chains, job, chain, 0)
        rod.far = joint_moment(chains, job, chain, 1)
    else:
        before = row(chain.node, i) - row(chain.node, i - 1)
        bend = bend_of_contacts(chains, problems, job, contacts, i - 1, before, rod, real(1.0))
        rod.offset = rod.offset + wp.cross(rod.turn + bend.v, before)
        rod.turn = rod.turn + bend.w
        rod.before = rod.near_turn
        rod.near = rod.far
        rod.far = rod.beyond
    rod.beyond = joint_moment(chains, job, chain, i + 2)
    rod.near_turn = rod.near / chains.inertia[i, job.whisker].stiffness
    rod.far_turn = rod.far / chains.inertia[wp.min(i + 1, job.links - 1), job.whisker].stiffness
    rod.turn = rod.turn - rod.near_turn
    rod.here = vec3()
    rod.touched = 0
    next_touched = int(0)
    for c in range(contacts):
        share = contact_share(problems, job, c, chains.taper[i, job.whisker])
        if share >= real(0.0) and share < real(1.0):
            rod.touched = rod.touched + 1
            rod.here = rod.here + wp.cross(link, problems.held[job.index, c].steady) * share
        elif share >= real(1.0) and share < real(2.0):
            next_touched = 1
    rod.alone = 0
    if rod.touched <= 1 and next_touched == 0:
        rod.alone = 1


@wp.func
def bent_link(
    chains: ChainArrays,
    problems: ContactProblems,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    base: vec3,
    contacts: int,
    i: int,
    rod: RodPlace,
) -> Cone:
    """Return a link with its centre line; ``base`` is the direction in which the whisker leaves its base."""
    half = real(0.5)
    at = row(chain.node, i)
    link = row(chain.node, i + 1) - at
    length = wp.length(link)
    along = link / length
    beam = chains.beam[i, job.whisker]
    # Bends of the joints around, and what of their turns is rest shape.
    most = wp.length(rod.before) + wp.length(rod.near_turn) + wp.length(rod.far_turn)
    first = linearity(rod.near_turn)
    start = along - link_direction(job, chain, base, i - 1) - wp.cross(rod.near_turn, along) * first
    if i == 0:
        # The tangent at the base is given; half a turn leads from there to the first link.
        start = start * real(2.0)
    end = start
    last = real(1.0)
    if i < job.links - 1:
        after = link_direction(job, chain, base, i + 1)
        last = linearity(rod.far_turn)
        end = after - along - wp.cross(rod.far_turn, after) * last
    line = CentreLine()
    places = int(4)
    for k in range(places):
        place = real(k) / real(3.0)
        left = real(1.0) - place
        bend = Spatial()
        if rod.alone == 1:
            bend = bend_between(beam, place, rod.near, rod.far + (rod.far - rod.beyond) * left)
        else:
            bend = bend_of_contacts(chains, problems, job, contacts, i, link, rod, place)
        slope = wp.cross(rod.turn + bend.w, along)
        offset = rod.offset + wp.cross(rod.turn * place + bend.v, link)
        # Beams bend little: what they say of a soft tip that is folded over is no more than part of the bends around.
        held = wp.min(first * left + last * place, half * most / wp.max(wp.length(slope), real(1e-12)))
        slope = slope * held - start * (half * left * left) + end * (half * place * place)
        offset = offset * held - (start * left + end * place) * (half * length * place * left)
        for d in range(3):
            line.turn[d, k] = slope[d] * length
            line.offset[d, k] = offset[d]
    bent = cone(at, at + link, chains.taper[i, job.whisker])
    bent.line = line
    return bent


@wp.func
def shortening(
    chains: ChainArrays, job: WhiskerJob, chain: wp.ref[ChainState], base: vec3, i: int, rod: RodPlace
) -> real:
    """Return by how much less than link i the rod beside it reaches along itself.

    An arc that turns by b from the middle of one link to that of the next is b²/24 of its length longer than its chord.
    Where the chain turns by b, and rod and chain lie apart by e across, e b of the length goes into or out of the bend.
    """
    before = link_direction(job, chain, base, i - 1)
    along = link_direction(job, chain, base, i)
    after = link_direction(job, chain, base, i + 1)
    length = chains.taper[i, job.whisker].arc_length
    return wp.length_sq(after - before) * length / real(96.0) - wp.dot(rod.offset, along - before)
