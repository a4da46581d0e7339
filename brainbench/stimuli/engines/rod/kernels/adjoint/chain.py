"""Adjoint of recorded steps: one thread takes one whisker backwards through a segment.

The equations are those of :mod:`brainbench.stimuli.engines.rod.adjoint`. A step solves R(a, f) = 0 for the joint
accelerations a and the contact forces f. Its multipliers are a virtual motion of the chain (rates μ of the joints, W of
the links) and a virtual velocity ν of each contact; they obey the transposed system, whose chain part is symmetric, so
the factorised chain of the step serves it (``articulated_body``). The gradient is that of the virtual power

    Φ = Σ links W·(I A + V × I V) − Σ loads and contacts f·w + Σ joints μ k (q + lag (q̇ + h a)) + Σ contacts ν·c,

a sum down the chain, whose derivatives one pass up the chain collects. Bars name derivatives. All hinges are alike:
axis s and its moment m = p × s about the base point. Units as in ``step``.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import FOLD, STOP

from ..algebra import JointVector, Wrench, vec2, vec3
from ..articulated_body import ChainState, ProximityState
from ..delassus import PerContact3
from ..motion import elapsed
from ..parameters import hinges, module_options, real
from ..state import (
    ChainArrays,
    JobArrays,
    MotionArrays,
    PerLinkJoint,
    ShapeArrays,
    StepOptions,
    WhiskerJob,
    row,
)
from ..step import load_job
from .contacts import (
    AdjointContacts,
    ContactSummary,
    ContactSystem,
    build_system,
    contact_row,
    solve_system,
    summarize,
    velocity_block,
)
from .dense import DenseSystem
from .fields import FieldCotangents, Fields, StepLinks, hinge_row, hinges_of, reverse_hinge
from .pose import PoseCotangent, spread_pose
from .records import StepRecords
from .restoring import restore_step
from .surfaces import ShapeGradients, reverse_contact


@wp.struct
class OutputCotangents:
    """Derivatives of what is differentiated with respect to what the steps wrote, in the units of the kernels."""

    wrench: wp.array3d(dtype=vec3)
    """[reading, 2, job] with respect to moment and force of the base on the whisker."""
    points: wp.array3d(dtype=vec3)
    """[reading, node, job] joints and tip, from the base point."""
    contact: wp.array3d(dtype=vec3)
    """[reading, 2, job] force and moment about the base point of all contacts."""


@wp.struct
class PackedGradients:
    """Derivatives with respect to the state and to the packed arrays; threads add to them."""

    angle: wp.array2d(dtype=JointVector)
    """[link, job] of the state at the end of the steps that are still to come."""
    rate: wp.array2d(dtype=JointVector)
    """[link, job]"""
    link: wp.array3d(dtype=real)
    """[10, link, job] length, angle at rest, mass, centre, axial and transverse inertia, stiffness, torsion, radius at
    start and end; see :data:`LENGTH`."""
    beta: wp.array(dtype=real)
    """[job]"""
    friction: wp.array(dtype=real)
    """[job] of the whisker."""
    knots: wp.array2d(dtype=real)
    """[knot, 16] place, velocity, quaternion, angular velocity, angular acceleration."""
    shape: ShapeGradients
    load_force: wp.array(dtype=vec3)
    """[load]"""
    load_share: wp.array(dtype=real)
    """[load]"""
    gravity: wp.array(dtype=vec3)
    """[job]"""
    contacts: wp.array(dtype=ContactSummary)
    """[job]"""
    reading: wp.array(dtype=wp.int32)
    """[job] the last reading that was gone back over (+ 1); 0 before the first."""


LENGTH, BEND, MASS, CENTRE, AXIAL, TRANSVERSE, STIFFNESS, TORSION, START_RADIUS, END_RADIUS = range(10)
"""Rows of :attr:`PackedGradients.link`."""


@wp.func
def virtual_motion(
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    links: wp.ref[StepLinks],
    asked: wp.ref[PerLinkJoint],
    base_angular: vec3,
    base_linear: vec3,
    contacts: wp.ref[AdjointContacts],
    pushing: int,
    virtual: wp.ref[PerLinkJoint],
    at_contacts: wp.ref[PerContact3],
) -> Wrench:
    """Solve the symmetric system of the chain: two passes over the factorised chain of the step.

    ``asked`` is the right-hand side, and with ``pushing`` the contacts' forces; the base moves as given. Found are the
    rates of the joints and the velocity at each contact; returned is what no joint takes up and the base must hold.
    """
    zero = real(0.0)
    tw = vec3(zero, zero, zero)
    tv = vec3(zero, zero, zero)
    for back in range(job.links):
        i = job.links - 1 - back
        if pushing == 1:
            for k in range(contacts.count):
                if contact_row(contacts.link, k) == i:
                    push = contact_row(contacts.push, k)
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
        virtual[i] = found
    held = Wrench()
    held.moment = tw
    held.force = tv
    aw = base_angular
    av = base_linear
    for i in range(job.links):
        j = wp.static(hinges) * i
        found = row(virtual, i)
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
        virtual[i] = found
        for k in range(contacts.count):
            if contact_row(contacts.link, k) == i:
                at_contacts[k] = av + wp.cross(aw, contact_row(contacts.point, k))
    return held


@wp.func
def add(gradients: PackedGradients, which: int, i: int, index: int, value: real):
    """Add to the derivative of a link's number."""
    gradients.link[which, i, index] = gradients.link[which, i, index] + value


@wp.func
def reverse_inertia(
    gradients: PackedGradients,
    on: Fields,
    bar: wp.ref[FieldCotangents],
    at: vec3,
    x: vec3,
    mass: real,
    centre: real,
    axial: real,
    transverse: real,
    i: int,
    index: int,
) -> vec3:
    """Add the power of a link's inertia, m a·w + W·(I A + ω × I ω); return the derivative by the link's direction."""
    com = at + x * centre
    vc = on.vv + wp.cross(on.vw, com)
    ac = on.av + wp.cross(on.aw, com) + wp.cross(on.vw, vc)
    wc = on.wv + wp.cross(on.ww, com)
    thin = axial - transverse
    xa = wp.dot(x, on.aw)
    xw = wp.dot(x, on.ww)
    xv = wp.dot(x, on.vw)
    whirl = wp.dot(on.ww, wp.cross(on.vw, x))
    thin_bar = xa * xw + xv * whirl
    add(gradients, MASS, i, index, wp.dot(ac, wc))
    add(gradients, AXIAL, i, index, thin_bar)
    add(gradients, TRANSVERSE, i, index, wp.dot(on.ww, on.aw) - thin_bar)
    ac_bar = wc * mass
    wc_bar = ac * mass
    vc_bar = wp.cross(ac_bar, on.vw)
    com_bar = wp.cross(ac_bar, on.aw) + wp.cross(vc_bar, on.vw) + wp.cross(wc_bar, on.ww)
    bar.av = bar.av + ac_bar
    bar.aw = bar.aw + wp.cross(com, ac_bar) + on.ww * transverse + x * (thin * xw)
    bar.vv = bar.vv + vc_bar
    bar.vw = bar.vw + wp.cross(vc, ac_bar) + wp.cross(com, vc_bar) + (x * whirl + wp.cross(x, on.ww) * xv) * thin
    bar.wv = bar.wv + wc_bar
    bar.ww = bar.ww + wp.cross(com, wc_bar) + on.aw * transverse + (x * xa + wp.cross(on.vw, x) * xv) * thin
    bar.at = bar.at + com_bar
    add(gradients, CENTRE, i, index, wp.dot(x, com_bar))
    return com_bar * centre + (on.aw * xw + on.ww * xa + on.vw * whirl + wp.cross(on.ww, on.vw) * xv) * thin


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
def spring(
    gradients: PackedGradients, which: int, i: int, index: int, stiffness: real, angle: real, rate: real, lag: real,
    virtual: real
) -> real:  # fmt: skip
    """Add the power of a joint's spring, μ k (q + lag q̇) with the rate at the end of the step, by its stiffness.

    ``which`` is the row of that. Returned is μ k of the joint as it is now: the derivative by the angle; that by the
    rate is lag times as much, and that by the lag the rate times as much.
    """
    state = spring_state(angle, rate, lag)
    add(gradients, which, i, index, virtual * state[0])
    return virtual * stiffness * state[1]


@wp.func
def reverse_step(
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    jobs: JobArrays,
    options: StepOptions,
    records: StepRecords,
    outputs: OutputCotangents,
    system: ContactSystem,
    gradients: PackedGradients,
    job: WhiskerJob,
    place: int,
):
    """Go back over one step."""
    zero = real(0.0)
    none = vec3(zero, zero, zero)
    index = job.index
    chain = ChainState()
    proximity = ProximityState()
    links = StepLinks()
    contacts = AdjointContacts()
    on = Fields()
    frame = restore_step(
        chains, motions, shapes, jobs, options, records, job, place, chain, proximity, links, contacts, on
    )  # fmt: skip
    now = frame.now
    later = frame.later
    h = frame.length
    pose = frame.pose

    # Derivatives of what follows by the accelerations: q⁺ = q + h q̇⁺, q̇⁺ = q̇ + h a.
    asked = PerLinkJoint()
    for i in range(job.links):
        if options.quasistatic == 1:
            gradients.rate[i, index] = JointVector()
        gradients.rate[i, index] = gradients.rate[i, index] + gradients.angle[i, index] * h
        asked[i] = gradients.rate[i, index] * (-h)
    wrench_bar_w = none
    wrench_bar_v = none
    force_bar = none
    moment_bar = none
    reading = frame.reading
    if reading >= 0:
        # A quasi-static step that turns out too long writes its reading with its first part, then again with its last.
        if reading + 1 == gradients.reading[index]:
            reading = int(-1)
        else:
            gradients.reading[index] = reading + 1
    if reading >= 0:
        wrench_bar_w = outputs.wrench[reading, 0, index]
        wrench_bar_v = outputs.wrench[reading, 1, index]
        force_bar = outputs.contact[reading, 0, index]
        moment_bar = outputs.contact[reading, 1, index]

    summary = gradients.contacts[index]
    summarize(summary, contacts, records.step[place, index])
    gradients.contacts[index] = summary

    # Multipliers: the virtual motion without contacts, then with what the contacts' own multipliers push.
    virtual = PerLinkJoint()
    there = PerContact3()
    virtual_motion(job, chain, proximity, links, asked, wrench_bar_w, wrench_bar_v, contacts, 0, virtual, there)
    if contacts.count > 0:
        for k in range(contacts.count):
            force_bar_k = force_bar + wp.cross(moment_bar, contact_row(contacts.point, k))
            there[k] = contact_row(there, k) - force_bar_k
        matrix = DenseSystem()
        build_system(job, chain, proximity, contacts, system, h, 0, matrix)
        degenerate = solve_system(contacts, matrix, there)
        gradients.contacts[index].degenerate = gradients.contacts[index].degenerate + degenerate
        for k in range(contacts.count):
            contacts.push[k] = velocity_block(contacts, k) * contact_row(contacts.multiplier, k) * (-h)
        virtual_motion(job, chain, proximity, links, asked, wrench_bar_w, wrench_bar_v, contacts, 1, virtual, there)
    on.ww = wrench_bar_w
    on.wv = wrench_bar_v
    for i in range(job.links):
        mu = row(virtual, i)
        for d in range(hinges_of(i)):
            on.ww = on.ww + hinge_row(links.axis, wp.static(hinges) * i + d) * mu[d]
            on.wv = on.wv + hinge_row(links.moment, wp.static(hinges) * i + d) * mu[d]

    # Up the chain.
    lag = wp.max(h, job.beta)
    bar = FieldCotangents()
    base_bar = PoseCotangent()
    if reading >= 0:
        bar.at = outputs.points[reading, job.links, index]
    for back in range(job.links):
        i = job.links - 1 - back
        build = chains.build[i, job.whisker]
        inertia = chains.inertia[i, job.whisker]
        at = row(chain.node, i)
        x = (row(chain.node, i + 1) - at) / build.length
        # The derivative by the link's far end is in bar.at.
        x_bar = bar.at * build.length
        add(gradients, LENGTH, i, index, wp.dot(x, bar.at))
        for k in range(contacts.count):
            if contact_row(contacts.link, k) == i:
                contact = records.contact[place, k, index]
                taper = chains.taper[i, job.whisker]
                taper_bar = reverse_contact(
                    motions, shapes, gradients.shape, gradients.knots, contacts, k, contact, on, bar, base_bar, pose,
                    moment_bar, at, x * build.length, taper.start_radius, taper.end_radius, now, frame.middle, h
                )  # fmt: skip
                add(gradients, START_RADIUS, i, index, taper_bar.start_radius)
                add(gradients, END_RADIUS, i, index, taper_bar.end_radius)
                add(gradients, LENGTH, i, index, wp.dot(x, taper_bar.link))
                x_bar = x_bar + taper_bar.link * build.length
                gradients.gravity[index] = gradients.gravity[index] + taper_bar.velocity * h
                if shapes.friction[contact.shape] < zero:
                    gradients.friction[index] = gradients.friction[index] + taper_bar.friction
                else:
                    wp.atomic_add(gradients.shape.friction, contact.shape, taper_bar.friction)
        x_bar = x_bar + reverse_inertia(
            gradients, on, bar, at, x, build.mass, inertia.centre, inertia.axial, inertia.transverse, i, index
        )
        for load in range(job.first_load, job.end_load):
            if jobs.load_link[load] == i and elapsed(now) < jobs.load_stop[load]:
                pull = jobs.load_force[load]
                share = jobs.load_share[load]
                arm = at + x * (build.length * share)
                bar.wv = bar.wv - pull
                bar.ww = bar.ww - wp.cross(arm, pull)
                arm_bar = wp.cross(on.ww, pull)
                bar.at = bar.at + arm_bar
                x_bar = x_bar + arm_bar * (build.length * share)
                along = wp.dot(x, arm_bar)
                add(gradients, LENGTH, i, index, along * share)
                gradients.load_share[load] = gradients.load_share[load] + along * build.length
                gradients.load_force[load] = gradients.load_force[load] - on.wv - wp.cross(on.ww, arm)
        bar.turn = bar.turn + wp.cross(x, x_bar)

        angle = row(chain.angle, i)
        rate = row(chain.rate, i)
        a = records.acceleration[place, i, index]
        mu = row(virtual, i)
        angle_bar = gradients.angle[i, index]
        rate_bar = gradients.rate[i, index]
        lag_bar = zero
        s1 = hinge_row(links.axis, wp.static(hinges) * i)
        s2 = hinge_row(links.axis, wp.static(hinges) * i + 1)
        if wp.static(hinges == 3):
            if i % 2 == 1:
                s3 = hinge_row(links.axis, wp.static(hinges) * i + 2)
                add(gradients, BEND, i, index, wp.dot(row(links.behind, i), bar.turn))
                pulled = spring(gradients, TORSION, i, index, inertia.torsion, angle[2], rate[2] + h * a[2], lag, mu[2])
                angle_bar[2] = angle_bar[2] + wp.dot(s3, bar.turn) + pulled
                rate_bar[2] = rate_bar[2] + lag * pulled
                lag_bar = lag_bar + pulled * (rate[2] + h * a[2])
                rate_bar[2] = rate_bar[2] + reverse_hinge(on, bar, at, s3, rate[2], a[2], mu[2])
        pulled2 = spring(gradients, STIFFNESS, i, index, inertia.stiffness, angle[1], rate[1] + h * a[1], lag, mu[1])
        angle_bar[1] = angle_bar[1] + wp.dot(s2, bar.turn) + pulled2
        rate_bar[1] = rate_bar[1] + lag * pulled2
        rate_bar[1] = rate_bar[1] + reverse_hinge(on, bar, at, s2, rate[1], a[1], mu[1])
        pulled1 = spring(gradients, STIFFNESS, i, index, inertia.stiffness, angle[0], rate[0] + h * a[0], lag, mu[0])
        angle_bar[0] = angle_bar[0] + wp.dot(s1, bar.turn) + pulled1
        rate_bar[0] = rate_bar[0] + lag * pulled1
        rate_bar[0] = rate_bar[0] + reverse_hinge(on, bar, at, s1, rate[0], a[0], mu[0])
        lag_bar = lag_bar + pulled1 * (rate[0] + h * a[0]) + pulled2 * (rate[1] + h * a[1])
        if job.beta > h:
            gradients.beta[index] = gradients.beta[index] + lag_bar
        add(gradients, BEND, i, index, wp.dot(row(links.before, i), bar.turn))
        gradients.angle[i, index] = angle_bar
        gradients.rate[i, index] = rate_bar
        if reading >= 0:
            bar.at = bar.at + outputs.points[reading, i, index]

    # The base: A = (ω⁺ − ω)/h and (v⁺ − v)/h − ω × v − gravity.
    base_bar.turn = base_bar.turn + bar.turn
    base_bar.spin = base_bar.spin + bar.vw - bar.aw / h - wp.cross(pose.velocity, bar.av)
    base_bar.velocity = base_bar.velocity + bar.vv - bar.av / h - wp.cross(bar.av, pose.spin)
    spread_pose(motions, gradients.knots, job.base, now, base_bar)
    ahead = PoseCotangent()
    ahead.spin = bar.aw / h
    ahead.velocity = bar.av / h
    spread_pose(motions, gradients.knots, job.base, later, ahead)
    gradients.gravity[index] = gradients.gravity[index] - bar.av


@wp.kernel(enable_backward=False, module="unique", module_options=module_options())
def reverse_segment(
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    jobs: JobArrays,
    options: StepOptions,
    records: StepRecords,
    outputs: OutputCotangents,
    system: ContactSystem,
    gradients: PackedGradients,
):
    """Go back over the recorded steps of each whisker."""
    index = wp.tid()
    job = load_job(chains, motions, shapes, jobs, options, index)
    count = records.count[index]
    for back in range(count):
        reverse_step(
            chains, motions, shapes, jobs, options, records, outputs, system, gradients, job, count - 1 - back
        )  # fmt: skip
