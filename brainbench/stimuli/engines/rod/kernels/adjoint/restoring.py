"""A recorded step as it was: its base, its factorised chain, its hinges and its contacts, for both passes over it."""

import warp as wp

from ..algebra import SpatialAcceleration, first_axis
from ..articulated_body import ChainState, ProximityState, articulated_inertia, forward_kinematics, hinge_direction
from ..motion import BodyMotion, Instant, elapsed, instant, pose_at, pose_from
from ..parameters import hinges, real
from ..state import ChainArrays, JobArrays, MotionArrays, ShapeArrays, StepOptions, WhiskerJob, WhiskerState, row
from .contacts import AdjointContacts, contact_row, set_state
from .fields import Fields, StepLinks, add_hinge, hinge_row, hinges_of
from .records import StepRecords


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
    contacts: wp.ref[AdjointContacts],
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
            add_hinge(on, at, hinge_row(links.axis, j), rate[d], a[d], real(0.0))
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
