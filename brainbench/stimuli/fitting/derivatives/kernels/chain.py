"""A recorded step as it was, and changes that are carried along its chain: down over the hinges, and solved for.

Changes have ``_d`` behind the name of what changes. A hinge has the axis s and its moment m = p × s about the base
point; hinge d of link i stands at hinges · i + d.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import FOLD, STOP

from ..algebra import JointVector, SpatialAcceleration, Wrench, first_axis, reader, vec2, vec3
from ..articulated_body import ChainState, ProximityState, articulated_inertia, forward_kinematics, hinge_direction
from ..delassus import PerContact3
from ..motion import BodyMotion, Instant, elapsed, instant, pose_at, pose_from
from ..parameters import capacity, hinges, real
from ..state import (
    ChainArrays,
    JobArrays,
    MotionArrays,
    PerLink3,
    PerLinkJoint,
    ShapeArrays,
    StepOptions,
    WhiskerJob,
    WhiskerState,
    row,
)
from .contacts import StepContacts, contact_row, set_state
from .records import StepRecords

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
class Fields:
    """Twist V and acceleration A of a link: angular, and of its point at the base point."""

    vw: vec3
    vv: vec3
    aw: vec3
    av: vec3


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
    """Base of a recorded step: at its beginning, half-way and at its end."""

    now: Instant
    middle: Instant
    later: Instant
    length: real
    reading: wp.int32
    pose: BodyMotion
    base: SpatialAcceleration


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
    axis_d: wp.ref[PerHinge3],
    moment_d: wp.ref[PerHinge3],
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
    axis_d[j] = s_d
    moment_d[j] = m_d


@wp.func
def spring_state(angle: real, rate: real, lag: real) -> vec2:
    """Return the stretch of a joint's spring, q + lag q̇, and how many times steeper than its stiffness it is there."""
    stretch = angle + lag * rate
    steepness = real(1.0)
    bend = wp.abs(angle)
    if bend > real(wp.static(FOLD)):
        # Beyond FOLD it stiffens, see ``articulated_body``.
        past = angle * (real(1.0) - real(wp.static(FOLD)) / bend)
        stretch = stretch + real(wp.static(STOP)) * (past + lag * rate)
        steepness = steepness + real(wp.static(STOP))
    return vec2(stretch, steepness)


@wp.func
def solve_chain(
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    links: wp.ref[StepLinks],
    asked: wp.ref[PerLinkJoint],
    contacts: wp.ref[StepContacts],
    pushing: int,
    acceleration_d: wp.ref[PerLinkJoint],
    at_contacts: wp.ref[PerContact3],
) -> Wrench:
    """Solve the symmetric system of the chain: two passes over the factorised chain of the step.

    ``asked`` is the right-hand side, and with ``pushing`` the change of the contacts' forces; the base stays. Found
    are the accelerations of the joints and that at each contact; returned is what the base must hold.
    """
    zero = real(0.0)
    tw = vec3(zero, zero, zero)
    tv = vec3(zero, zero, zero)
    for back in range(job.links):
        i = job.links - 1 - back
        if pushing == 1:
            for k in range(contacts.count):
                if contact_row(contacts.link, k) == i:
                    push = contact_row(contacts.change, k)
                    tv = tv + push
                    tw = tw + wp.cross(contact_row(contacts.point, k), push)
        j = wp.static(hinges) * i
        b = row(asked, i)
        found = JointVector()
        inverse = row(proximity.inverse_inertia, i)
        if wp.static(hinges == 3):
            if i % 2 == 1:
                u3 = b[2] + wp.dot(hinge_row(links.axis, j + 2), tw) + wp.dot(hinge_row(links.moment, j + 2), tv)
                found[2] = inverse[3] * u3
                tw = tw - row(chain.gain3_w, i) * u3
                tv = tv - row(chain.gain3_v, i) * u3
        u1 = b[0] + wp.dot(hinge_row(links.axis, j), tw) + wp.dot(hinge_row(links.moment, j), tv)
        u2 = b[1] + wp.dot(hinge_row(links.axis, j + 1), tw) + wp.dot(hinge_row(links.moment, j + 1), tv)
        found[0] = inverse[0] * u1 + inverse[1] * u2
        found[1] = inverse[1] * u1 + inverse[2] * u2
        tw = tw - row(chain.gain1_w, i) * u1 - row(chain.gain2_w, i) * u2
        tv = tv - row(chain.gain1_v, i) * u1 - row(chain.gain2_v, i) * u2
        acceleration_d[i] = found
    held = Wrench()
    held.moment = tw
    held.force = tv
    aw = vec3(zero, zero, zero)
    av = vec3(zero, zero, zero)
    for i in range(job.links):
        j = wp.static(hinges) * i
        found = row(acceleration_d, i)
        a1 = found[0] - wp.dot(row(chain.gain1_w, i), aw) - wp.dot(row(chain.gain1_v, i), av)
        a2 = found[1] - wp.dot(row(chain.gain2_w, i), aw) - wp.dot(row(chain.gain2_v, i), av)
        aw = aw + hinge_row(links.axis, j) * a1 + hinge_row(links.axis, j + 1) * a2
        av = av + hinge_row(links.moment, j) * a1 + hinge_row(links.moment, j + 1) * a2
        found[0] = a1
        found[1] = a2
        if wp.static(hinges == 3):
            if i % 2 == 1:
                a3 = found[2] - wp.dot(row(chain.gain3_w, i), aw) - wp.dot(row(chain.gain3_v, i), av)
                aw = aw + hinge_row(links.axis, j + 2) * a3
                av = av + hinge_row(links.moment, j + 2) * a3
                found[2] = a3
        acceleration_d[i] = found
        for k in range(contacts.count):
            if contact_row(contacts.link, k) == i:
                at_contacts[k] = av + wp.cross(aw, contact_row(contacts.point, k))
    return held


@wp.func
def restore_step(
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    jobs: JobArrays,
    options: StepOptions,
    records: StepRecords,
    job: WhiskerJob,
    place: int,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    links: wp.ref[StepLinks],
    contacts: wp.ref[StepContacts],
    on: wp.ref[Fields],
) -> StepFrame:
    """Factorise the chain of a recorded step; find its hinges and contacts, and ``on`` the fields of its last link."""
    index = job.index
    step = records.step[place, index]
    now = step.time
    h = step.length
    frame = StepFrame()
    frame.now = now
    frame.middle = instant(now.tick, now.part + real(0.5) * h)
    frame.later = instant(now.tick, now.part + h)
    frame.length = h
    frame.reading = step.reading
    pose = pose_at(motions, job.base, now)
    after = pose_at(motions, job.base, frame.later)
    frame.pose = pose
    state = WhiskerState()
    for i in range(job.links):
        chain.angle[i] = records.angle[place, i, index]
        chain.rate[i] = records.rate[place, i, index]
    base = SpatialAcceleration()
    base.angular = (after.spin - pose.spin) / h
    base.linear = (after.velocity - pose.velocity) / h - wp.cross(pose.spin, pose.velocity) - options.gravity
    frame.base = base
    tip = forward_kinematics(chains, job, pose, chain, proximity, state)
    articulated_inertia(chains, jobs, job, chain, proximity, tip, base, elapsed(now), h, 1)

    # Twists and accelerations down the chain, with those of the contacts at the end of the step.
    contacts.count = step.contacts
    on.vw = pose.spin
    on.vv = pose.velocity
    on.aw = base.angular
    on.av = base.linear
    for k in range(contacts.count):
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
        for k in range(contacts.count):
            if contact_row(contacts.link, k) == i:
                contact = records.contact[place, k, index]
                taper = chains.taper[i, job.whisker]
                radius = taper.start_radius + (taper.end_radius - taper.start_radius) * contact.share
                point = at + (row(chain.node, i + 1) - at) * contact.share - contact.normal * radius
                half = pose_from(motions, shapes.track[contact.shape], frame.middle, pose)
                velocity = (
                    on.vv
                    + (on.av + options.gravity) * h
                    + wp.cross(on.vw + on.aw * h, point)
                    - half.velocity
                    - wp.cross(half.spin, point - half.place)
                )
                contacts.point[k] = point
                set_state(contacts, k, contact, velocity)
    return frame
