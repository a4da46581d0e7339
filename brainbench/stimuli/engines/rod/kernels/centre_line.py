"""Centre line of the bent rod beside a straight link of its chain, which contacts touch.

A chain bends at its joints alone: a link is straight, and turns by a whole bend where a contact passes a joint. Beam
theory tells what the rod does in between. A force F on the whisker at s bends it by F (s − x)/(E I) at x < s, so what
the joints before a place miss of its slope and deflection is linear in the moment and in the force across that are
carried there (:class:`.state.BeamErrors`). A force is what bends a link further in than the moment of its end tells; a
contact on this link makes the same force wherever along it the contact is, so the moments of four joints tell it
without knowing the place. Forces on other links are known from the last steps; without what they do to these moments
two contacts could not be told from one. The rest shape adds its own bends, linear along the link as between two joints.

Where slip reverses, its speed is a small difference of large ones: the chain, which is straighter than the rod, would
reverse some tenths of a ms too early or too late (:func:`shortening`).
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import LARGE_BEND

from .algebra import Spatial, first_axis, spatial, vec3
from .articulated_body import ChainState, hinge_direction
from .parameters import real
from .state import (
    BeamErrors,
    CentreLine,
    ChainArrays,
    Cone,
    ContactProblems,
    WhiskerJob,
    cone,
    cubic_weights,
    row,
)


@wp.func
def joint_moment(chains: ChainArrays, job: WhiskerJob, chain: wp.ref[ChainState], j: int) -> vec3:
    """Return the moment of a joint's spring (µN·m), as the way in which it turns the link; none beyond both ends."""
    moment = vec3()
    if j >= 0 and j < job.links:
        axis2 = row(chain.axis2, j)
        angle = row(chain.angle, j)
        turn = first_axis(axis2, hinge_direction(chain, j), angle[1]) * angle[0] + axis2 * angle[1]
        moment = wp.cross(turn, link_direction(job, chain, vec3(), j)) * chains.inertia[j, job.whisker].stiffness
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
class LinkLoads:
    """Moments of joints around a link, as one contact on it would make them, and what other contacts do along it."""

    before: vec3
    here: vec3
    after: vec3
    beyond: vec3
    outer_force: vec3
    """Force across, and moment at the link's joint, of contacts further out."""
    outer_moment: vec3
    inner_slope: vec3
    """Slope and deflection at the link's joint that chain and rod differ by because of contacts further in."""
    inner_offset: vec3
    crowd: wp.int32
    """Contacts on the link itself, and their moment at its joint."""
    crowd_moment: vec3


@wp.func
def steady_push(problems: ContactProblems, job: WhiskerJob, c: int, along: vec3) -> vec3:
    """Return the force across a link by which a contact of the last steps bends the whisker."""
    push = problems.held[job.index, c].steady
    return push - along * wp.dot(push, along)


@wp.func
def inner_error(beam: BeamErrors, place: real, push: vec3, ahead: real) -> Spatial:
    """Return the slope and the deflection that joints miss of a force further in, ``ahead`` (mm, negative) of here."""
    weights = cubic_weights(place)
    slope = push * wp.dot(weights, beam.force_slope)
    return spatial(slope, push * wp.dot(weights, beam.force_deflection) - slope * ahead)


@wp.func
def take_off_contacts(
    chains: ChainArrays,
    problems: ContactProblems,
    job: WhiskerJob,
    contacts: int,
    i: int,
    along: vec3,
    loads: wp.ref[LinkLoads],
):
    """Take what contacts of the last step on other links do off the moments around a link of direction ``along``."""
    taper = chains.taper[i, job.whisker]
    span = taper.arc_length
    for c in range(contacts):
        reach = problems.held[job.index, c].arc - taper.arc
        push = steady_push(problems, job, c, along)
        if reach >= real(0.0) and reach < span:
            loads.crowd = loads.crowd + 1
            loads.crowd_moment = loads.crowd_moment + push * reach
        if reach >= span:
            loads.before = loads.before - push * (reach + span)
            loads.here = loads.here - push * reach
            loads.after = loads.after - push * (reach - span)
            loads.beyond = loads.beyond - push * wp.max(reach - real(2.0) * span, real(0.0))
            loads.outer_force = loads.outer_force + push
            loads.outer_moment = loads.outer_moment + push * reach
        elif reach < real(0.0):
            loads.before = loads.before - push * wp.max(reach + span, real(0.0))
            inner = wp.max(i + int(wp.floor(reach / span)), 0)
            place = (reach + span * real(i - inner)) / span
            error = inner_error(chains.beam[inner, job.whisker], place, push, reach)
            loads.inner_slope = loads.inner_slope + error.w
            loads.inner_offset = loads.inner_offset + error.v


@wp.func
def bent_link(
    chains: ChainArrays,
    problems: ContactProblems,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    base: vec3,
    contacts: int,
    i: int,
) -> Cone:
    """Return a link with its centre line; ``base`` is the direction in which the whisker leaves its base."""
    zero = real(0.0)
    half = real(0.5)
    at = row(chain.node, i)
    link = row(chain.node, i + 1) - at
    length = wp.length(link)
    along = link / length
    loads = LinkLoads()
    loads.before = joint_moment(chains, job, chain, i - 1)
    loads.here = joint_moment(chains, job, chain, i)
    loads.after = joint_moment(chains, job, chain, i + 1)
    loads.beyond = joint_moment(chains, job, chain, i + 2)
    # Bends of the joints at both ends, and what of their turns is rest shape.
    beam = chains.beam[i, job.whisker]
    bend = loads.here / chains.inertia[i, job.whisker].stiffness
    most = wp.length(bend)
    first = linearity(bend)
    last = real(1.0)
    start = along - link_direction(job, chain, base, i - 1) - bend * (beam.trust * first)
    if i == 0:
        # The tangent at the base is given; half a turn leads from there to the first link.
        start = start * real(2.0)
    else:
        bend = loads.before / chains.inertia[i - 1, job.whisker].stiffness
        most = most + wp.length(bend)
    end = start
    if i < job.links - 1:
        bend = loads.after / chains.inertia[i + 1, job.whisker].stiffness
        last = linearity(bend)
        end = link_direction(job, chain, base, i + 1) - along - bend * (chains.beam[i + 1, job.whisker].trust * last)
        most = most + wp.length(bend)
    take_off_contacts(chains, problems, job, contacts, i, along, loads)
    taper = chains.taper[i, job.whisker]
    line = CentreLine()
    places = int(4)
    for k in range(places):
        place = real(k) / real(3.0)
        left = real(1.0) - place
        # The moment at this place goes on from further out, and the force is by what it grows further in.
        moment = loads.after + (loads.after - loads.beyond) * left
        force = (loads.here - moment + (loads.before - loads.here) * left) / length
        if i == 0:
            force = (loads.here - moment) / (length * wp.max(place, real(0.1)))
        inner_slope = loads.inner_slope
        inner_offset = loads.inner_offset + loads.inner_slope * (length * place)
        if loads.crowd > 1:
            # Joints do not tell contacts of one link apart: the forces of all are those of the last steps.
            here = loads.here - loads.crowd_moment
            force = (here - loads.after) / length
            moment = loads.after + (here - loads.after) * left
            for c in range(contacts):
                reach = problems.held[job.index, c].arc - taper.arc
                if reach >= zero and reach < taper.arc_length:
                    push = steady_push(problems, job, c, along)
                    ahead = reach - length * place
                    if ahead >= zero:
                        force = force + push
                        moment = moment + push * ahead
                    else:
                        error = inner_error(beam, reach / taper.arc_length, push, ahead)
                        inner_slope = inner_slope + error.w
                        inner_offset = inner_offset + error.v
        moment = moment + loads.outer_moment - loads.outer_force * (length * place)
        force = force + loads.outer_force
        slope = moment * beam.moment_slope[k] + force * beam.force_slope[k] + inner_slope
        offset = moment * beam.force_slope[k] + force * beam.force_deflection[k] + inner_offset
        # Beams bend little: what they say of a soft tip that is folded over is no more than part of the bends around.
        held = wp.min(first * left + last * place, half * most / wp.max(wp.length(slope), real(1e-12)))
        slope = slope * held - start * (half * left * left) + end * (half * place * place)
        offset = offset * held - (start * left + end * place) * (half * length * place * left)
        for d in range(3):
            line.turn[d, k] = slope[d] * length
            line.offset[d, k] = offset[d]
    bent = cone(at, at + link, taper)
    bent.line = line
    return bent


@wp.func
def shortening(chains: ChainArrays, job: WhiskerJob, chain: wp.ref[ChainState], base: vec3, i: int) -> real:
    """Return by how much less than link i the rod beside it reaches along itself.

    An arc that turns by b from the middle of one link to that of the next is b²/24 of its length longer than its chord.
    Where the chain turns by b, and rod and chain lie apart by e across, e b of the length goes into or out of the bend.
    """
    before = link_direction(job, chain, base, i - 1)
    along = link_direction(job, chain, base, i)
    after = link_direction(job, chain, base, i + 1)
    beam = chains.beam[i, job.whisker]
    length = chains.taper[i, job.whisker].arc_length
    moment = joint_moment(chains, job, chain, i)
    push = (moment - joint_moment(chains, job, chain, i + 1)) / length
    apart = moment * beam.force_slope[0] + push * beam.force_deflection[0]
    return wp.length_sq(after - before) * length / real(96.0) - wp.dot(apart, along - before)
