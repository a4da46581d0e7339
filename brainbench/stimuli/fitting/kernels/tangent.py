"""Forward derivatives of recorded steps: one thread takes one whisker, with the changes of all parameters.

A step solves R(a, f; q, q̇, θ) = 0; with a change of state and packed numbers, those of a and f solve

    H δa − Jᵀ δf = −δR,        h A J δa + B δf = −δc,

where δR and δc are the changes at fixed a and f: the factorised chain and the contacts' system of the step. One step
costs one solution for each parameter, where a difference costs two simulations. Rates of change have the letter p of
their parameter; ``_d`` marks the change of a number. Units as in ``step``.
The knots of a track move the pose of its body (``move_pose``, the derivative of ``motion.pose_at``).
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import CAPSULE, CREVICE, CYLINDER, MESH, SPHERE, UNDONE

from ..algebra import JointVector, Spatial, rotate, symmetric_times, unrotate, vec3, vec4
from ..articulated_body import ChainState, ProximityState, spring_state
from ..delassus import PerContact1, PerContact3
from ..motion import Instant, MotionArrays, elapsed, piece_at, pose_from, quaternion_rate, raw_turn
from ..parameters import hinges, module_options, real, smooth
from ..state import PerLink1, PerLink3, PerLinkJoint, SceneArrays, WhiskerJob, row
from ..step import load_job
from .centre_line import RodWalk, begin_rod, enter_link, keep_contacts, move_line
from .chain import (
    AXIAL,
    BEND,
    CENTRE,
    END_RADIUS,
    LENGTH,
    MASS,
    START_RADIUS,
    STIFFNESS,
    TORSION,
    TRANSVERSE,
    FieldTangents,
    HingeTangents,
    LinkFields,
    PackedTangents,
    StepFrame,
    StepLinks,
    hinge_row,
    hinges_of,
    move_hinge,
    restore_step,
    solve_chain,
)
from .contacts import (
    ContactSummary,
    ContactSystem,
    StepContacts,
    build_system,
    contact_row,
    solve_system,
    summarize,
    velocity_block,
)
from .newton import DenseSystem
from .records import ContactRecord, StepRecords


@wp.struct
class PoseTangent:
    """Change of the pose of a body at one time."""

    place: vec3
    velocity: vec3
    turn: vec3
    """Small turn about its place, world axes."""
    spin: vec3


@wp.func
def knot_vector(knots: wp.array3d(dtype=real), p: int, knot: int, first: int) -> vec3:
    """Return the change of three numbers of a knot."""
    return vec3(knots[p, knot, first], knots[p, knot, first + 1], knots[p, knot, first + 2])


@wp.func
def knot_quaternion(knots: wp.array3d(dtype=real), p: int, knot: int) -> vec4:
    """Return the change of the quaternion of a knot."""
    return vec4(knots[p, knot, 6], knots[p, knot, 7], knots[p, knot, 8], knots[p, knot, 9])


@wp.func
def turn_between(q: vec4, change: vec4) -> vec3:
    """Return the small turn that changes a unit quaternion so: twice the vector part of change times conjugate."""
    v = vec3(q[1], q[2], q[3])
    c = vec3(change[1], change[2], change[3])
    return (c * q[0] - v * change[0] - wp.cross(c, v)) * real(2.0)


@wp.func
def move_pose(motions: MotionArrays, knots: wp.array3d(dtype=real), p: int, index: int, when: Instant) -> PoseTangent:
    """Return the change of a track's pose at a time with that of its knots [p, knot, 16]."""
    first = motions.first[index]
    count = motions.count[index]
    found = PoseTangent()
    if count == 1:
        found.velocity = knot_vector(knots, p, first, 3)
        found.place = knot_vector(knots, p, first, 0) + found.velocity * elapsed(when)
        found.turn = turn_between(motions.quaternion[first], knot_quaternion(knots, p, first))
        return found
    piece = piece_at(motions, first, count, when)
    a = piece.first
    b = a + 1
    way = knot_vector(knots, p, b, 0) - knot_vector(knots, p, a, 0)
    speed_a = knot_vector(knots, p, a, 3)
    speed_b = knot_vector(knots, p, b, 3)
    found.place = knot_vector(knots, p, a, 0) + way * piece.v1 + speed_a * piece.s0 + speed_b * piece.s1
    found.velocity = speed_a * piece.ds0 + speed_b * piece.ds1 - way * piece.dv
    spin_a = knot_vector(knots, p, a, 10)
    spin_b = knot_vector(knots, p, b, 10)
    found.spin = (
        spin_a * piece.v0
        + knot_vector(knots, p, a, 13) * piece.s0
        + spin_b * piece.v1
        + knot_vector(knots, p, b, 13) * piece.s1
    )
    turn_a = knot_quaternion(knots, p, a)
    turn_b = knot_quaternion(knots, p, b)
    change = (
        turn_a * piece.v0
        + (quaternion_rate(turn_a, motions.spin[a]) + quaternion_rate(motions.quaternion[a], spin_a)) * piece.s0
        + turn_b * piece.v1
        + (quaternion_rate(turn_b, motions.spin[b]) + quaternion_rate(motions.quaternion[b], spin_b)) * piece.s1
    )
    turn = raw_turn(motions, piece)
    size = wp.length(turn)
    found.turn = turn_between(turn / size, change / size)
    return found


@wp.struct
class OutputTangents:
    """Changes of what the steps wrote with each parameter, in the units of the kernels."""

    wrench: wp.array4d(dtype=vec3)
    """[p, reading, 2, job] moment and force of the base on the whisker."""
    points: wp.array4d(dtype=vec3)
    """[p, reading, node, job] joints and tip, from the base point."""
    contact: wp.array4d(dtype=vec3)
    """[p, reading, 2, job] force and moment about the base point of all contacts."""
    contacts: wp.array(dtype=ContactSummary)
    """[job]"""


@wp.struct
class MovingLink:
    """A link with a contact in a step, and its change with a parameter."""

    span: vec3
    """From its joint to its far end."""
    span_d: vec3
    turning: vec3
    """Its angular velocity at the end of the step."""
    base_place: vec3
    """Change of the base's place."""
    fields: FieldTangents
    if smooth:
        line: Spatial
        """Change of the centre line at the contact, beside that of the link: of its tangent, and of its place."""
        start_slide: real
        """Change of how fast the rod slides along itself at both ends."""
        end_slide: real


@wp.struct
class ContactTangent:
    """Change of a contact at fixed accelerations and forces."""

    share: real
    point: vec3
    condition: vec3


@wp.func
def grow(kind: int, size: vec3, x: vec3, size_d: vec3) -> vec4:
    """Return how a primitive's sizes shift what is nearest to x, and the change of the gap there besides.

    All in the frame of the shape. A size moves the feature that is nearest, or makes a round one thicker.
    """
    zero = real(0.0)
    moved = vec4(zero, zero, zero, zero)
    if kind == wp.static(SPHERE):
        moved[3] = -size_d[0]
    elif kind == wp.static(CAPSULE):
        moved[3] = -size_d[0]
        if wp.abs(x[2]) > size[1]:
            moved[2] = wp.sign(x[2]) * size_d[1]
    elif kind == wp.static(CYLINDER):
        radial = wp.sqrt(x[0] * x[0] + x[1] * x[1])
        side = radial - size[0]
        end = wp.abs(x[2]) - size[1]
        if end > side or (side > zero and end > zero):
            moved[2] = wp.sign(x[2]) * size_d[1]
        if side > zero and end > zero:
            moved[0] = x[0] * size_d[0] / radial
            moved[1] = x[1] * size_d[0] / radial
        elif side > end:
            moved[3] = -size_d[0]
    else:
        over = vec3(wp.abs(x[0]) - size[0], wp.abs(x[1]) - size[1], wp.abs(x[2]) - size[2])
        most = wp.max(over[0], wp.max(over[1], over[2]))
        for d in range(3):
            if over[d] > zero or (most <= zero and over[d] == most):
                moved[d] = wp.sign(x[d]) * size_d[d]
    return moved


@wp.func
def move_contact(
    scene: SceneArrays,
    tangents: PackedTangents,
    contacts: wp.ref[StepContacts],
    k: int,
    contact: ContactRecord,
    frame: StepFrame,
    p: int,
    job: WhiskerJob,
    moving: MovingLink,
) -> ContactTangent:
    """Return the change of a contact's point and of its condition c."""
    zero = real(0.0)
    motions = scene.motions
    shapes = scene.shapes
    index = job.index
    h = frame.step.length
    link = moving.span
    link_d = moving.span_d
    along = link
    tangent = link
    tangent_d = link_d
    moved = moving.fields
    base_place = moving.base_place
    taper = scene.chains.taper[contact.link, job.whisker]
    slope_r = taper.end_radius - taper.start_radius
    start_d = tangents.link[p, wp.static(START_RADIUS), contact.link, index]
    end_d = tangents.link[p, wp.static(END_RADIUS), contact.link, index]
    shape = contact.shape
    n = contact.normal
    f = contact.force
    s = contact.share
    radius = taper.start_radius + slope_r * s
    place_d = moving.fields.at + link_d * s
    if wp.static(smooth):
        along = contact.along
        tangent = contact.tangent
        tangent_d = link_d + moving.line.w
        place_d = place_d + moving.line.v
    # The object: its shift at the place x of the axis, and its turn.
    body = pose_from(motions, shapes.track[shape], frame.step.now, frame.step.pose)
    body_d = move_pose(motions, tangents.knots, p, shapes.track[shape], frame.step.now)
    x = contact.point + n * radius
    origin = body.place + rotate(body.quaternion, shapes.place[shape])
    turn_in = rotate(body.quaternion, tangents.shape_turn[p, shape])
    turned = body_d.turn + turn_in
    shift = body_d.place - base_place + wp.cross(body_d.turn, x - body.place)
    shift = shift + rotate(body.quaternion, tangents.shape_place[p, shape]) + wp.cross(turn_in, x - origin)
    gap_d = zero
    if shapes.kind[shape] != wp.static(MESH):
        inside = unrotate(shapes.quaternion[shape], unrotate(body.quaternion, x - origin))
        size_d = tangents.shape_size[p, shape]
        grown = grow(shapes.kind[shape], shapes.size[shape], inside, size_d)
        gap_d = grown[3]
        shift = shift + rotate(body.quaternion, rotate(shapes.quaternion[shape], vec3(grown[0], grown[1], grown[2])))

    # The place on the axis, gap and normal there.
    away = place_d - shift
    n_d = symmetric_times(contact.curvature, away) + wp.cross(turned, n)
    bent = symmetric_times(contact.curvature, along)
    curved = wp.dot(tangent, bent)
    if wp.static(smooth):
        curved = curved + wp.dot(n, contact.bending)
    share_d = zero
    if s < real(1.0) and curved > real(1e-9) * wp.length_sq(link):
        slope = wp.dot(n, tangent_d) + wp.dot(n_d, tangent)
        if wp.static(smooth) or shapes.kind[shape] != wp.static(MESH):
            slope = slope - (end_d - start_d)
        share_d = -slope / curved
    n_d = n_d + bent * share_d
    radius_d = start_d * (real(1.0) - s) + end_d * s + slope_r * share_d
    gap_d = gap_d + wp.dot(n, away + along * share_d) - radius_d
    found = ContactTangent()
    found.share = share_d
    found.point = place_d + along * share_d - n_d * radius - n * radius_d

    # The velocity against the object at the end of the step.
    point = contact_row(contacts.point, k)
    half = pose_from(motions, shapes.track[shape], frame.middle, frame.step.pose)
    half_d = move_pose(motions, tangents.knots, p, shapes.track[shape], frame.middle)
    v = contact_row(contacts.velocity, k)
    v_d = moved.vv + (moved.av + tangents.gravity[p, index]) * h
    v_d = v_d + wp.cross(moved.vw + moved.aw * h, point) + wp.cross(moving.turning, found.point)
    v_d = v_d - half_d.velocity - wp.cross(half_d.spin, point - half.place)
    v_d = v_d - wp.cross(half.spin, found.point - (half_d.place - base_place))
    if wp.static(smooth):
        # Along the rod, which slides along itself where the chain does not.
        slid = contact.end_slide - contact.start_slide
        slide = contact.start_slide + slid * s
        slide_d = moving.start_slide + (moving.end_slide - moving.start_slide) * s + slid * share_d
        size = wp.length(tangent)
        onward = tangent / size
        tangent_d = tangent_d + contact.bending * share_d
        v_d = v_d - onward * slide_d - (tangent_d - onward * wp.dot(onward, tangent_d)) * (slide / size)

    closing_d = zero
    most = real(wp.static(CREVICE[smooth]))
    if wp.static(smooth):
        most = wp.min(most, real(wp.static(UNDONE)) * h)
    if -contact.gap < most:
        closing_d = -gap_d / h
    found.condition = velocity_block(contacts, k) * v_d - n * closing_d
    if contact_row(contacts.slides, k) == 0:
        closing = wp.min(-contact.gap, most) / h
        found.condition = found.condition - n_d * closing
        return found
    friction_d = tangents.shape_friction[p, shape]
    if shapes.friction[shape] < zero:
        friction_d = tangents.friction[p, index]
    u = contact_row(contacts.slip, k)
    scale = contact_row(contacts.scale, k)
    pressed = wp.dot(n, f)
    pressed_d = wp.dot(n_d, f)
    across = n_d * wp.dot(n, v) + n * wp.dot(n_d, v)
    across = (across - u * wp.dot(u, across)) * contact_row(contacts.friction, k)
    sliding = u * (contact.friction * pressed_d + friction_d * pressed) - n_d * pressed - n * pressed_d - across
    found.condition = found.condition + n * wp.dot(n_d, v) + sliding * scale
    return found


@wp.func
def tangent_step(
    scene: SceneArrays,
    records: StepRecords,
    system: ContactSystem,
    tangents: PackedTangents,
    outputs: OutputTangents,
    job: WhiskerJob,
    place: int,
):
    """Take the changes of all parameters over one step."""
    zero = real(0.0)
    chains = scene.chains
    motions = scene.motions
    jobs = scene.jobs
    index = job.index
    chain = ChainState()
    proximity = ProximityState()
    links = StepLinks()
    contacts = StepContacts()
    fields = LinkFields()
    frame = restore_step(scene, records, job, place, chain, proximity, links, contacts, fields)
    h = frame.step.length
    pose = frame.step.pose
    matrix = DenseSystem()
    if contacts.count > 0:
        build_system(job, chain, proximity, contacts, system, h, matrix)
    summary = outputs.contacts[index]
    summarize(summary, contacts, records, place, index)
    lag = wp.max(h, job.beta)
    # Loads on each link and on all behind it.
    for back in range(1, job.links):
        i = job.links - 1 - back
        fields.force[i] = row(fields.force, i) + row(fields.force, i + 1)
        fields.moment[i] = row(fields.moment, i) + row(fields.moment, i + 1)
    hinges_d = HingeTangents()
    moment_d = PerLink3()
    force_d = PerLink3()
    asked = PerLinkJoint()
    acceleration_d = PerLinkJoint()
    point_d = PerContact3()
    share_d = PerContact1()
    rod = RodWalk()
    shorter_d = PerLink1()
    taken = contacts.count
    if wp.static(smooth):
        taken = records.step[place, index].taken
        rod.chains = chains
        rod.records = records
        rod.tangents = tangents
        rod.job = job
        rod.place = place
    missed = PerContact3()
    there = PerContact3()
    for p in range(tangents.angle.shape[0]):
        pose_d = move_pose(motions, tangents.knots, p, job.base, frame.step.now)
        after_d = move_pose(motions, tangents.knots, p, job.base, frame.later)
        lag_d = zero
        if job.beta > h:
            lag_d = tangents.beta[p, index]
        moved = FieldTangents()
        moved.turn = pose_d.turn
        moved.vw = pose_d.spin
        moved.vv = pose_d.velocity
        moved.aw = (after_d.spin - pose_d.spin) / h
        moved.av = (after_d.velocity - pose_d.velocity) / h - tangents.gravity[p, index]
        moved.av = moved.av - wp.cross(pose_d.spin, pose.velocity) - wp.cross(pose.spin, pose_d.velocity)
        if wp.static(smooth):
            if taken > 0:
                base = rotate(pose.quaternion, vec3(real(1.0), zero, zero))
                begin_rod(chain, links, p, base, pose_d.turn, rod)

        # Down the chain: fields, and the load on each link.
        for i in range(job.links):
            build = chains.build[i, job.whisker]
            inertia = chains.inertia[i, job.whisker]
            at = row(chain.node, i)
            span = row(chain.node, i + 1) - at
            x = span / build.length
            rate = row(chain.rate, i)
            a = records.acceleration[place, i, index]
            angle_d = tangents.angle[p, i, index]
            rate_d = tangents.rate[p, i, index]
            bend_d = tangents.link[p, wp.static(BEND), i, index]
            moved.turn = moved.turn + row(links.before, i) * bend_d
            for d in range(hinges_of(i)):
                j = wp.static(hinges) * i + d
                move_hinge(links, j, moved, at, rate[d], a[d], angle_d[d], rate_d[d], hinges_d)
            if wp.static(hinges == 3):
                moved.turn = moved.turn + row(links.behind, i) * bend_d
            x_d = wp.cross(moved.turn, x)
            length_d = tangents.link[p, wp.static(LENGTH), i, index]
            span_d = x_d * build.length + x * length_d
            transverse_d = tangents.link[p, wp.static(TRANSVERSE), i, index]
            thin = inertia.axial - inertia.transverse
            thin_d = tangents.link[p, wp.static(AXIAL), i, index] - transverse_d
            vw = row(fields.vw, i)
            aw = row(fields.aw, i)
            ac = row(fields.ac, i)
            com = at + x * inertia.centre
            com_d = moved.at + x_d * inertia.centre + x * tangents.link[p, wp.static(CENTRE), i, index]
            vc_d = moved.vv + wp.cross(moved.vw, com) + wp.cross(vw, com_d)
            ac_d = moved.av + wp.cross(moved.aw, com) + wp.cross(aw, com_d)
            ac_d = ac_d + wp.cross(moved.vw, row(fields.vc, i)) + wp.cross(vw, vc_d)
            own_d = x_d * wp.dot(x, aw) + x * (wp.dot(x_d, aw) + wp.dot(x, moved.aw))
            own_d = own_d + (wp.cross(moved.vw, x) + wp.cross(vw, x_d)) * wp.dot(x, vw)
            own_d = own_d + wp.cross(vw, x) * (wp.dot(x_d, vw) + wp.dot(x, moved.vw))
            f_d = ac_d * build.mass + ac * tangents.link[p, wp.static(MASS), i, index]
            m_d = wp.cross(com_d, ac * build.mass) + wp.cross(com, f_d) + row(fields.own, i) * thin_d + own_d * thin
            m_d = m_d + aw * transverse_d + moved.aw * inertia.transverse
            for load in range(job.first_load, job.end_load):
                if jobs.load_link[load] == i and elapsed(frame.step.now) < jobs.load_stop[load]:
                    pull = jobs.load_force[load]
                    pull_d = tangents.load_force[p, load]
                    share = jobs.load_share[load]
                    reach_d = moved.at + span_d * share + span * tangents.load_share[p, load]
                    f_d = f_d - pull_d
                    m_d = m_d - wp.cross(at + span * share, pull_d) - wp.cross(reach_d, pull)
            if wp.static(smooth):
                if taken > 0:
                    enter_link(rod, i)
                    shorter_d[i] = rod.shorter[1]
            for k in range(taken):
                if contact_row(contacts.link, k) == i:
                    contact = records.contact[place, k, index]
                    moving = MovingLink()
                    moving.span = span
                    moving.span_d = span_d
                    moving.turning = vw + aw * h
                    moving.base_place = pose_d.place
                    moving.fields = moved
                    if wp.static(smooth):
                        moving.line = move_line(rod, contact.share)
                        # A step that was taken again, shorter, has no slide.
                        last = tangents.last[index]
                        if contact.end_slide != zero:
                            moving.end_slide = (row(shorter_d, i) - tangents.shorter[p, i, index]) / last
                        if contact.start_slide != zero:
                            moving.start_slide = (row(shorter_d, i - 1) - tangents.shorter[p, i - 1, index]) / last
                    changed = move_contact(scene, tangents, contacts, k, contact, frame, p, job, moving)
                    point_d[k] = changed.point
                    share_d[k] = changed.share
                    missed[k] = changed.condition
                    if k < contacts.count:
                        m_d = m_d - wp.cross(changed.point, contact.force)
            moment_d[i] = m_d
            force_d[i] = f_d
            moved.at = moved.at + span_d
            if frame.reading >= 0:
                outputs.points[p, frame.reading, i + 1, index] = moved.at

        # Up the chain: what the joints miss.
        total_d = Spatial()
        for back in range(job.links):
            i = job.links - 1 - back
            inertia = chains.inertia[i, job.whisker]
            total_d.w = total_d.w + row(moment_d, i)
            total_d.v = total_d.v + row(force_d, i)
            angle = row(chain.angle, i)
            rate = row(chain.rate, i) + records.acceleration[place, i, index] * h
            angle_d = tangents.angle[p, i, index]
            rate_d = tangents.rate[p, i, index]
            due = JointVector()
            for d in range(hinges_of(i)):
                j = wp.static(hinges) * i + d
                stiffness = inertia.stiffness
                stiffness_d = tangents.link[p, wp.static(STIFFNESS), i, index]
                if wp.static(hinges == 3):
                    if d == 2:
                        stiffness = inertia.torsion
                        stiffness_d = tangents.link[p, wp.static(TORSION), i, index]
                # The change of the spring's moment; rates are those at the end of the step.
                spring = spring_state(angle[d], rate[d], lag)
                ahead_d = angle_d[d] + lag * rate_d[d] + lag_d * rate[d]
                due[d] = -(stiffness_d * spring[0] + stiffness * spring[1] * ahead_d) - (
                    wp.dot(hinge_row(hinges_d.axis, j), row(fields.moment, i))
                    + wp.dot(hinge_row(links.axis, j), total_d.w)
                    + wp.dot(hinge_row(hinges_d.moment, j), row(fields.force, i))
                    + wp.dot(hinge_row(links.moment, j), total_d.v)
                )
            asked[i] = due

        # Accelerations without a change of contact forces, then with it.
        held = solve_chain(job, chain, proximity, asked, contacts, 0, acceleration_d, there)
        contact_d = Spatial()
        if contacts.count > 0:
            for k in range(contacts.count):
                there[k] = -contact_row(missed, k) - velocity_block(contacts, k) * contact_row(there, k) * h
            work = DenseSystem()
            work = matrix
            degenerate = solve_system(contacts, work, there)
            if p == 0:
                summary.degenerate = summary.degenerate + degenerate
            for k in range(contacts.count):
                push = contact_row(contacts.change, k)
                contact_d.v = contact_d.v + push
                contact_d.w = contact_d.w + wp.cross(contact_row(contacts.point, k), push)
                contact_d.w = contact_d.w + wp.cross(contact_row(point_d, k), contact_row(contacts.force, k))
            held = solve_chain(job, chain, proximity, asked, contacts, 1, acceleration_d, there)
        if frame.reading >= 0:
            outputs.wrench[p, frame.reading, 0, index] = total_d.w - held.w
            outputs.wrench[p, frame.reading, 1, index] = total_d.v - held.v
            outputs.contact[p, frame.reading, 0, index] = contact_d.v
            outputs.contact[p, frame.reading, 1, index] = contact_d.w
        if wp.static(smooth):
            if taken > 0:
                keep_contacts(contacts, rod, h, share_d)
                for i in range(job.links):
                    tangents.shorter[p, i, index] = row(shorter_d, i)
        for i in range(job.links):
            rate_d = tangents.rate[p, i, index] + row(acceleration_d, i) * h
            tangents.angle[p, i, index] = tangents.angle[p, i, index] + rate_d * h
            if scene.options.quasistatic == 1:
                rate_d = JointVector()
            tangents.rate[p, i, index] = rate_d
    if wp.static(smooth):
        tangents.last[index] = h
    outputs.contacts[index] = summary


@wp.kernel(enable_backward=False, module="unique", module_options=module_options())
def tangent_segment(
    # Model:
    scene: SceneArrays,
    records: StepRecords,
    # Data in and out:
    system: ContactSystem,
    tangents: PackedTangents,
    # Data out:
    outputs: OutputTangents,
):
    """Take the changes of each whisker over the recorded steps."""
    index = wp.tid()
    job = load_job(scene, index)
    for place in range(records.count[index]):
        tangent_step(scene, records, system, tangents, outputs, job, place)
