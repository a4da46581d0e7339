"""A recorded step as it was, and changes that are carried along its chain: down over the hinges, and solved for.

Changes have ``_d`` behind the name of what changes. A hinge has the axis s and its moment m = p × s about the base
point; hinge d of link i stands at hinges · i + d.
"""

from typing import Any

import warp as wp

from ..algebra import JointVector, Spatial, first_axis, minus, reader, spatial_dot, vec3
from ..articulated_body import (
    ChainState,
    ProximityState,
    acceleration_over_joint,
    articulated_inertia,
    forward_kinematics,
    hinge_direction,
    inverse_times,
    joint_record,
)
from ..delassus import PerContact3
from ..motion import Instant, elapsed, instant, pose_from
from ..parameters import capacity, hinges, real, smooth
from ..state import PerLink3, PerLinkJoint, SceneArrays, Step, WhiskerJob, WhiskerState, begin_step, row
from .contacts import StepContacts, contact_row, set_state
from .records import StepRecords

LENGTH, BEND, MASS, CENTRE, AXIAL, TRANSVERSE, STIFFNESS, TORSION, START_RADIUS, END_RADIUS = range(10)
ARC, ARC_LENGTH, NEAR_TURN, THERE_TURN, NEAR_DEFLECTION, THERE_DEFLECTION = 10, 11, 12, 16, 20, 24
"""Rows of :attr:`PackedTangents.link`; of the last four each begins with that of the first of four places."""

PerHinge3: Any = wp.types.matrix((hinges * capacity, 3), real)
hinge_row = reader((PerHinge3, vec3))


@wp.struct
class StepLinks:
    """Hinges of all links in a recorded step."""

    axis: PerHinge3
    moment: PerHinge3
    """Axis about the base point, p × s."""
    vw: PerHinge3
    """Twist of the body before the hinge."""
    vv: PerHinge3
    before: PerLink3
    """Axis z before the hinges, about which the link bends at rest."""
    behind: PerLink3
    """The same behind them, where the joint twists."""


@wp.struct
class PackedTangents:
    """Changes of the packed arrays with each parameter p, and of the state."""

    angle: wp.array3d(dtype=JointVector)
    """[p, link, job] of the state at the beginning of the next step."""
    rate: wp.array3d(dtype=JointVector)
    """[p, link, job]"""
    link: wp.array4d(dtype=real)
    """[p, row, link, job] length, angle at rest, mass, centre, axial and transverse inertia, stiffness, torsion, radius
    at start and end; for the bent rod also arc, arc length, and what ``state.BeamCompliance`` holds."""
    if smooth:
        mean: wp.array3d(dtype=vec3)
        """[p, contact, job] of the mean force of each contact of the last step, of the mean of that, and of its arc."""
        steady: wp.array3d(dtype=vec3)
        arc: wp.array3d(dtype=real)
        shorter: wp.array3d(dtype=real)
        """[p, link, job] of how much less than the chain the rod reached along itself."""
        last: wp.array(dtype=real)
        """[job] length of the last step."""
    beta: wp.array2d(dtype=real)
    """[p, job]"""
    friction: wp.array2d(dtype=real)
    """[p, job]"""
    gravity: wp.array2d(dtype=vec3)
    """[p, job]"""
    knots: wp.array3d(dtype=real)
    """[p, knot, 16] place, velocity, quaternion, angular velocity, angular acceleration."""
    load_force: wp.array2d(dtype=vec3)
    """[p, load]"""
    load_share: wp.array2d(dtype=real)
    """[p, load]"""
    shape_place: wp.array2d(dtype=vec3)
    """[p, shape] in the frame of its body."""
    shape_turn: wp.array2d(dtype=vec3)
    """[p, shape] small turn about its origin, in the frame of its body."""
    shape_size: wp.array2d(dtype=vec3)
    """[p, shape]"""
    shape_friction: wp.array2d(dtype=real)
    """[p, shape]"""


@wp.struct
class HingeTangents:
    """Change of axis and moment of each hinge."""

    axis: PerHinge3
    moment: PerHinge3


@wp.struct
class Fields:
    """Twist V and acceleration A of a link: angular, and of its point at the base point."""

    vw: vec3
    vv: vec3
    aw: vec3
    av: vec3


@wp.struct
class LinkFields:
    """Angular velocity and acceleration of each link, velocity and acceleration of its centre, and loads."""

    vw: PerLink3
    aw: PerLink3
    vc: PerLink3
    ac: PerLink3
    own: PerLink3
    """Moment of its thin part about its centre, over axial less transverse inertia."""
    moment: PerLink3
    """Moment and force on it and on all behind it."""
    force: PerLink3


@wp.struct
class FieldTangents:
    """Change of the fields of a link, of its frame by a small turn, and of a joint's place."""

    vw: vec3
    vv: vec3
    aw: vec3
    av: vec3
    turn: vec3
    at: vec3


@wp.struct
class StepFrame:
    """A recorded step: its beginning, its middle and its end, and the result that it wrote."""

    step: Step
    middle: Instant
    later: Instant
    reading: wp.int32


@wp.func
def hinges_of(i: int) -> int:
    """Return how many hinges the joint of a link has."""
    if wp.static(hinges == 3) and i % 2 == 1:
        return 3
    return 2


@wp.func
def add_hinge(on: wp.ref[Fields], at: vec3, s: vec3, rate: real, acceleration: real):
    """Go from the body before a hinge to that behind it."""
    m = wp.cross(at, s)
    on.aw = on.aw + wp.cross(on.vw, s) * rate + s * acceleration
    on.av = on.av + (wp.cross(on.vw, m) + wp.cross(on.vv, s)) * rate + m * acceleration
    on.vw = on.vw + s * rate
    on.vv = on.vv + m * rate


@wp.func
def move_hinge(
    links: wp.ref[StepLinks],
    j: int,
    moved: wp.ref[FieldTangents],
    at: vec3,
    rate: real,
    acceleration: real,
    angle_d: real,
    rate_d: real,
    hinges_d: wp.ref[HingeTangents],
):
    """Take the change of the fields over hinge j, at a fixed acceleration; write those of its axis and moment."""
    s = hinge_row(links.axis, j)
    m = hinge_row(links.moment, j)
    vw = hinge_row(links.vw, j)
    vv = hinge_row(links.vv, j)
    s_d = wp.cross(moved.turn, s)
    m_d = wp.cross(moved.at, s) + wp.cross(at, s_d)
    # Of vw × s and vw × m + vv × s, each times the rate.
    turning_d = wp.cross(moved.vw * rate + vw * rate_d, s) + wp.cross(vw, s_d * rate)
    moving_d = wp.cross(moved.vw * rate + vw * rate_d, m) + wp.cross(vw, m_d * rate)
    moving_d = moving_d + wp.cross(moved.vv * rate + vv * rate_d, s) + wp.cross(vv, s_d * rate)
    moved.aw = moved.aw + turning_d + s_d * acceleration
    moved.av = moved.av + moving_d + m_d * acceleration
    moved.vw = moved.vw + s_d * rate + s * rate_d
    moved.vv = moved.vv + m_d * rate + m * rate_d
    moved.turn = moved.turn + s * angle_d
    hinges_d.axis[j] = s_d
    hinges_d.moment[j] = m_d


@wp.func
def solve_chain(
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    asked: wp.ref[PerLinkJoint],
    contacts: wp.ref[StepContacts],
    pushing: int,
    acceleration_d: wp.ref[PerLinkJoint],
    at_contacts: wp.ref[PerContact3],
) -> Spatial:
    """Solve the symmetric system of the chain: two passes over the factorised chain of the step.

    ``asked`` is the right-hand side, and with ``pushing`` the change of the contacts' forces; the base stays. Found
    are the accelerations of the joints and that at each contact; returned is what the base must hold.
    """
    held = Spatial()
    for back in range(job.links):
        i = job.links - 1 - back
        if pushing == 1:
            for k in range(contacts.count):
                if contact_row(contacts.link, k) == i:
                    push = contact_row(contacts.change, k)
                    held.v = held.v + push
                    held.w = held.w + wp.cross(contact_row(contacts.point, k), push)
        # A moment asked of a joint is felt by it beside the force.
        joint = joint_record(chain, proximity, i)
        due = row(asked, i)
        felt = JointVector()
        if wp.static(hinges == 3):
            if i % 2 == 1:
                felt[2] = due[2] + spatial_dot(joint.motion3, held)
                held = minus(held, joint.gain3, felt[2])
        felt[0] = due[0] + spatial_dot(joint.motion1, held)
        felt[1] = due[1] + spatial_dot(joint.motion2, held)
        held = minus(minus(held, joint.gain1, felt[0]), joint.gain2, felt[1])
        acceleration_d[i] = inverse_times(joint.inverse_inertia, felt)
    a = Spatial()
    for i in range(job.links):
        joint = joint_record(chain, proximity, i)
        acceleration_d[i] = acceleration_over_joint(joint, i, row(acceleration_d, i), a)
        for k in range(contacts.count):
            if contact_row(contacts.link, k) == i:
                at_contacts[k] = a.v + wp.cross(a.w, contact_row(contacts.point, k))
    return held


@wp.func
def restore_step(
    scene: SceneArrays,
    records: StepRecords,
    job: WhiskerJob,
    place: int,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    links: wp.ref[StepLinks],
    contacts: wp.ref[StepContacts],
    fields: wp.ref[LinkFields],
) -> StepFrame:
    """Factorise the chain of a recorded step; find its hinges and contacts, and the fields and load of each link."""
    index = job.index
    record = records.step[place, index]
    now = record.time
    h = record.length
    frame = StepFrame()
    frame.step = begin_step(scene, job, now, h)
    frame.middle = instant(now.tick, now.part + real(0.5) * h)
    frame.later = instant(now.tick, now.part + h)
    frame.reading = record.reading
    pose = frame.step.pose
    state = WhiskerState()
    for i in range(job.links):
        chain.angle[i] = records.angle[place, i, index]
        chain.rate[i] = records.rate[place, i, index]
    last = forward_kinematics(scene.chains, job, pose, chain, proximity, state)
    articulated_inertia(scene, job, chain, proximity, frame.step, last, 1)

    # Twists and accelerations down the chain, with those of the contacts at the end of the step.
    contacts.count = record.contacts
    taken = record.contacts
    if wp.static(smooth):
        taken = record.taken
    on = Fields()
    on.vw = pose.spin
    on.vv = pose.velocity
    on.aw = frame.step.base.w
    on.av = frame.step.base.v
    for k in range(taken):
        contacts.link[k] = records.contact[place, k, index].link
    for i in range(job.links):
        at = row(chain.node, i)
        rate = row(chain.rate, i)
        a = records.acceleration[place, i, index]
        angle = row(chain.angle, i)
        s2 = row(chain.axis2, i)
        s1 = first_axis(s2, hinge_direction(chain, i), angle[1])
        links.before[i] = s2 * wp.cos(angle[0]) - wp.cross(s1, s2) * wp.sin(angle[0])
        links.axis[wp.static(hinges) * i] = s1
        links.axis[wp.static(hinges) * i + 1] = s2
        if wp.static(hinges == 3):
            if i % 2 == 1:
                s3 = row(chain.axis3, i)
                links.axis[wp.static(hinges) * i + 2] = s3
                # Half of the rest bend comes behind the twist, about the axis that is then z.
                links.behind[i] = s2 * wp.cos(angle[2]) - wp.cross(s2, s3) * wp.sin(angle[2])
        for d in range(hinges_of(i)):
            j = wp.static(hinges) * i + d
            links.vw[j] = on.vw
            links.vv[j] = on.vv
            links.moment[j] = wp.cross(at, hinge_row(links.axis, j))
            add_hinge(on, at, hinge_row(links.axis, j), rate[d], a[d])
        build = scene.chains.build[i, job.whisker]
        inertia = scene.chains.inertia[i, job.whisker]
        span = row(chain.node, i + 1) - at
        x = span / build.length
        com = at + x * inertia.centre
        vc = on.vv + wp.cross(on.vw, com)
        ac = on.av + wp.cross(on.aw, com) + wp.cross(on.vw, vc)
        own = x * wp.dot(x, on.aw) + wp.cross(on.vw, x) * wp.dot(x, on.vw)
        f = ac * build.mass
        m = wp.cross(com, f) + on.aw * inertia.transverse + own * (inertia.axial - inertia.transverse)
        for load in range(job.first_load, job.end_load):
            if scene.jobs.load_link[load] == i and elapsed(now) < scene.jobs.load_stop[load]:
                pull = scene.jobs.load_force[load]
                f = f - pull
                m = m - wp.cross(at + span * scene.jobs.load_share[load], pull)
        for k in range(contacts.count):
            if contact_row(contacts.link, k) == i:
                contact = records.contact[place, k, index]
                point = contact.point
                f = f - contact.force
                m = m - wp.cross(point, contact.force)
                half = pose_from(scene.motions, scene.shapes.track[contact.shape], frame.middle, pose)
                velocity = (
                    on.vv
                    + (on.av + scene.options.gravity) * h
                    + wp.cross(on.vw + on.aw * h, point)
                    - half.velocity
                    - wp.cross(half.spin, point - half.place)
                )
                if wp.static(smooth):
                    slide = contact.start_slide + (contact.end_slide - contact.start_slide) * contact.share
                    velocity = velocity - wp.normalize(contact.tangent) * slide
                contacts.point[k] = point
                set_state(contacts, k, contact, velocity)
        fields.vw[i] = on.vw
        fields.aw[i] = on.aw
        fields.vc[i] = vc
        fields.ac[i] = ac
        fields.own[i] = own
        fields.force[i] = f
        fields.moment[i] = m
    return frame
