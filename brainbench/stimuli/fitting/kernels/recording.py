"""Steps of whiskers as they are written down: state, length and pressing contacts of each.

A run that is recorded pauses after some steps (``PausedWhiskers.budget``), so that the host keeps its state there as a
checkpoint; from a checkpoint the same steps are taken again and written down. Recorded steps are the ordinary ones, to
the digit.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import CAPSULE, CYLINDER, MESH, SPHERE

from ..algebra import rotate, symmetric_outer, unrotate, vec3, vec4, vec6
from ..articulated_body import ChainState
from ..distances import triangle_corners, triangle_feature, triangle_place
from ..motion import BodyMotion, pose_from
from ..parameters import real, smooth
from ..state import (
    Cone,
    ContactCandidates,
    ContactProblems,
    Instant,
    PausedWhiskers,
    SceneArrays,
    ShapeArrays,
    Step,
    WhiskerJob,
    WhiskerState,
    line_tangent,
    most_candidates,
    row,
)
from .records import ContactRecord, StepRecord


@wp.struct
class PrincipalCurvature:
    """Principal curvatures of the surface that lies at the distance of a point, in the frame of the shape."""

    along: real
    """Along ``direction``."""
    across: real
    """Across it; in all directions where there is none."""
    direction: vec3


@wp.func
def primitive_curvature(kind: int, size: vec3, x: vec3) -> PrincipalCurvature:
    """Return the curvatures of the distance from a primitive at a point; the cases of ``distances.primitive``."""
    zero = real(0.0)
    one = real(1.0)
    found = PrincipalCurvature()
    axis = vec3(zero, zero, one)
    radial = wp.sqrt(x[0] * x[0] + x[1] * x[1])
    if kind == wp.static(SPHERE):
        found.across = one / wp.length(x)
    elif kind == wp.static(CAPSULE):
        z = x[2] - wp.clamp(x[2], -size[1], size[1])
        found.across = one / wp.sqrt(radial * radial + z * z)
        if z == zero:
            found.direction = axis
    elif kind == wp.static(CYLINDER):
        side = radial - size[0]
        end = wp.abs(x[2]) - size[1]
        if side > zero and end > zero:
            # The rim: a circle, so that the surface around it is a torus.
            far = wp.sqrt(side * side + end * end)
            found.direction = vec3(-x[1] / radial, x[0] / radial, zero)
            found.along = side / (far * radial)
            found.across = one / far
        elif side > end:
            found.direction = axis
            found.across = one / radial
    else:
        beyond = vec3()
        count = int(0)
        for d in range(3):
            beyond[d] = wp.max(wp.abs(x[d]) - size[d], zero)
            count = count + int(beyond[d] > zero)
        if count >= 2:
            found.across = one / wp.length(beyond)
        if count == 2:
            for d in range(3):
                if beyond[d] == zero:
                    found.direction[d] = one
    return found


@wp.func
def triangle_curvature(shapes: ShapeArrays, face: int, x: vec3, distance: real) -> PrincipalCurvature:
    """Return the curvatures of the distance from a triangle at a point: from the corner, edge or face nearest to it."""
    found = PrincipalCurvature()
    rows = triangle_corners(shapes.corners, face)
    at = triangle_place(x, rows[0], rows[1], rows[2])
    feature = triangle_feature(at[0], at[1], real(1e-12))
    if feature > 0:
        found.across = real(1.0) / distance
    if feature == 4:
        found.direction = wp.normalize(rows[2] - rows[1])
    elif feature == 5:
        found.direction = wp.normalize(rows[2] - rows[0])
    elif feature == 6:
        found.direction = wp.normalize(rows[1] - rows[0])
    return found


@wp.func
def curvature_at(
    shapes: ShapeArrays, s: int, triangle: int, body: BodyMotion, x: vec3, normal: vec3, gap: real, radius: real
) -> vec6:
    """Return the second derivatives of the distance from a shape at a place x on the axis of a link, in world axes.

    ``normal`` is its gradient there; places count from the base. A surface is its ``triangle``.
    """
    local_quaternion = shapes.quaternion[s]
    scale = shapes.scale[s]
    local = unrotate(local_quaternion, unrotate(body.quaternion, x - body.place) - shapes.place[s]) / scale
    found = PrincipalCurvature()
    if shapes.kind[s] != wp.static(MESH):
        found = primitive_curvature(shapes.kind[s], shapes.size[s] / scale, local)
    # So near a surface the normal is fixed, see ``distances.way_out``.
    elif wp.abs(gap + radius) >= real(1e-3) * radius:
        found = triangle_curvature(shapes, triangle, local, (gap + radius) / scale)
    direction = rotate(body.quaternion, rotate(local_quaternion, found.direction))
    across = found.across / scale
    more = found.along / scale - across
    whole = vec6(across, across, across, real(0.0), real(0.0), real(0.0))
    return whole + symmetric_outer(normal * -across, normal, direction * more, direction)


@wp.func
def cubic_slopes(place: real) -> vec4:
    """Return the derivatives of ``state.cubic_weights``."""
    rest = real(1.0) - place
    ends = real(1.0) + real(4.5) * place * (place - real(1.0))
    tilt = real(4.5) * (place - rest)
    middle = real(4.5) * place * rest
    return vec4(
        tilt * rest - ends,
        -tilt * (real(2.0) - real(3.0) * place) - real(3.0) * middle,
        -tilt * (real(3.0) * place - real(1.0)) + real(3.0) * middle,
        tilt * place + ends,
    )


@wp.func
def record_candidate(
    candidates: wp.ref[ContactCandidates],
    slot: int,
    shape: int,
    triangle: int,
    link: Cone,
    share: real,
    start_slide: real,
    end_slide: real,
):
    """Note what a candidate would touch and where, and how the centre line runs there."""
    candidates.shape[slot] = shape
    candidates.triangle[slot] = triangle
    candidates.share[slot] = share
    if wp.static(smooth):
        slopes = cubic_slopes(share)
        candidates.along[slot] = link.b - link.a + link.line.offset * slopes
        candidates.bending[slot] = link.line.turn * slopes
        candidates.tangent[slot] = line_tangent(link, share)
        candidates.start_slide[slot] = start_slide
        candidates.end_slide[slot] = end_slide


@wp.func
def record_state(
    paused: PausedWhiskers,
    problems: ContactProblems,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    state: wp.ref[WhiskerState],
    place: int,
    now: Instant,
    h: real,
):
    """Write a step's beginning as the ``place``-th of the segment."""
    record = StepRecord()
    record.time = now
    record.length = h
    record.reading = state.pending_reading
    record.open_gap = real(1e30)
    record.lead = real(1e30)
    if wp.static(smooth):
        record.held = state.contacts
        for k in range(state.contacts):
            paused.records.steady[place, k, job.index].arc = problems.held[job.index, k].arc
            paused.records.steady[place, k, job.index].push = problems.held[job.index, k].steady
    for i in range(job.links):
        paused.records.angle[place, i, job.index] = row(chain.angle, i)
        paused.records.rate[place, i, job.index] = row(chain.rate, i)
    paused.records.step[place, job.index] = record
    paused.records.count[job.index] = place + 1


@wp.func
def record_contacts(
    scene: SceneArrays,
    paused: PausedWhiskers,
    problems: ContactProblems,
    job: WhiskerJob,
    candidates: wp.ref[ContactCandidates],
    step: Step,
    place: int,
    solved: int,
):
    """Write the contacts of the step, those that press first, and how far the others are from closing."""
    index = job.index
    first = index * wp.static(most_candidates)
    pressing = int(0)
    resting = int(0)
    taken = int(0)
    lead = real(1e30)
    if solved == 1:
        paused.records.step[place, index].inexact = problems.solution[index].inexact
        for k in range(problems.solution[index].contacts):
            held = problems.held[index, k]
            taken = taken + (1 << held.slot)
            given = problems.candidate[first + held.slot]
            shape = row(candidates.shape, held.slot)
            share = row(candidates.share, held.slot)
            i = problems.candidate_link[first + held.slot]
            taper = scene.chains.taper[i, job.whisker]
            radius = taper.start_radius + (taper.end_radius - taper.start_radius) * share
            record = ContactRecord()
            record.link = i
            record.shape = shape
            record.triangle = row(candidates.triangle, held.slot)
            record.share = share
            record.gap = given.gap
            record.friction = given.friction
            record.point = given.point
            record.normal = given.normal
            record.force = held.force
            body = pose_from(scene.motions, scene.shapes.track[shape], step.now, step.pose)
            x = given.point + given.normal * radius
            record.curvature = curvature_at(
                scene.shapes, shape, record.triangle, body, x, given.normal, given.gap, radius
            )
            if wp.static(smooth):
                record.rank = k
                record.arc = given.arc
                record.along = row(candidates.along, held.slot)
                record.bending = row(candidates.bending, held.slot)
                record.tangent = row(candidates.tangent, held.slot)
                record.start_slide = row(candidates.start_slide, held.slot)
                record.end_slide = row(candidates.end_slide, held.slot)
            slot = pressing
            if wp.dot(held.force, given.normal) > real(0.0):
                lead = wp.min(lead, row(candidates.lead, held.slot))
                pressing = pressing + 1
            else:
                resting = resting + 1
                slot = problems.solution[index].contacts - resting
            paused.records.contact[place, slot, index] = record
    least = real(1e30)
    for j in range(candidates.count):
        if (taken >> j) % 2 == 0:
            ahead = row(candidates.predicted_gap, j)
            if solved == 1:
                ahead = problems.predicted_gap[first + j]
            least = wp.min(least, ahead)
    paused.records.step[place, index].contacts = pressing
    if wp.static(smooth):
        paused.records.step[place, index].taken = pressing + resting
    paused.records.step[place, index].open_gap = least
    paused.records.step[place, index].lead = lead


@wp.func
def record_accelerations(paused: PausedWhiskers, job: WhiskerJob, chain: wp.ref[ChainState], place: int, h: real):
    """Write the accelerations that took the joints from the step's beginning to where they are now."""
    for i in range(job.links):
        before = paused.records.angle[place, i, job.index]
        rate = (row(chain.angle, i) - before) / h
        paused.records.acceleration[place, i, job.index] = (rate - paused.records.rate[place, i, job.index]) / h
