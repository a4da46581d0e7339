"""Articulated-body algorithm: three passes over the chain of one thread, O(links).

Featherstone, Rigid Body Dynamics Algorithms (2008), table 7.1, in world axes about the base point: spatial vectors are
(rotation, translation at the base point), so nothing is transformed between links. Joints bend about two axes and, with
three ``hinges``, every second one (1, 3, 5 …) then twists about the mean direction of both links, as a joint of its own
behind the other; in the names below S = (s, m) is an axis and its moment, Iᴬ = (ia ib; ibᵀ ic), pᴬ = (pw, pv), U = IᴬS.

Joint springs and dampers act at the end of the step (linearly implicit), so the joint-space inertia is
D = SᵀU + h d + h² k, with stiffness k and damping d = βk, and stiffness limits no time step.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import BENT, FOLD, LARGEST_BEND, LOST, STOP

from .algebra import (
    JointInverse,
    JointVector,
    SpatialAcceleration,
    Twist,
    Wrench,
    cosine,
    first_axis,
    mat33,
    rotate,
    sine,
    symmetric_outer,
    symmetric_times,
    upper_outer,
    vec3,
    vec6,
)
from .motion import BodyMotion
from .parameters import hinges, real
from .state import (
    ChainArrays,
    ContactCandidates,
    JobArrays,
    PerLink1,
    PerLink3,
    PerLinkInt,
    PerLinkInverse,
    PerLinkJoint,
    PerNode3,
    StepOptions,
    WhiskerJob,
    WhiskerState,
    row,
)


@wp.struct
class ChainState:
    """State of the joints, and what one step keeps of each link between its passes."""

    angle: PerLinkJoint
    rate: PerLinkJoint
    axis2: PerLink3
    """Second axis of the joint."""
    node: PerNode3
    """Joints and tip, from the base point."""
    gain1_w: PerLink3
    """U D⁻¹ of each axis (``articulated_body``), rotation and translation."""
    gain1_v: PerLink3
    gain2_w: PerLink3
    gain2_v: PerLink3
    if hinges == 3:
        axis3: PerLink3
        gain3_w: PerLink3
        gain3_v: PerLink3
    acceleration: PerLinkJoint
    """D⁻¹u of the joint, then its accelerations."""


@wp.func
def hinge_direction(chain: wp.ref[ChainState], i: int) -> vec3:
    """Return the direction of the axis normal to both bending hinges of a joint, of any length."""
    if wp.static(hinges == 3):
        return row(chain.axis3, i)
    return row(chain.node, i + 1) - row(chain.node, i)


@wp.struct
class ProximityState:
    """State of each link that only contact needs; without objects a kernel leaves it out."""

    inverse_inertia: PerLinkInverse
    """Inverse inertia D⁻¹ of the joint."""
    clearance: PerLink1
    """Lower bound of the distance from all objects; at rest, the time until which nothing can come near."""
    leaf: PerLinkInt
    """Leaf of the search tree where the last search ended (+ 1)."""
    safe_until: PerLink1
    end_speed: PerLink1
    """Speed of the faster end."""


@wp.func(inline=True)
def forward_kinematics(
    chains: ChainArrays,
    job: WhiskerJob,
    pose: BodyMotion,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    state: wp.ref[WhiskerState],
) -> Twist:
    """First pass, down the chain: place links and find their velocities; return the twist of the last one."""
    zero = real(0.0)
    x = rotate(pose.turn, vec3(real(1.0), zero, zero))
    y = rotate(pose.turn, vec3(zero, real(1.0), zero))
    z = wp.cross(x, y)
    # All positions count from the base point: single precision keeps its digits however far away the head is.
    vw = pose.spin
    vv = pose.velocity
    at = vec3(zero, zero, zero)
    speed = wp.length_sq(vv)
    fastest = speed
    for i in range(job.links):
        link = chains.build[i, job.whisker]
        # Bend at rest about z, then the hinge about y, then the one about z.
        turned = x * link.bend_cosine + y * link.bend_sine
        y = y * link.bend_cosine - x * link.bend_sine
        angle = row(chain.angle, i)
        rate = row(chain.rate, i)
        ca = cosine(angle[0])
        sa = sine(angle[0])
        cb = cosine(angle[1])
        sb = sine(angle[1])
        x = turned * ca - z * sa
        z = turned * sa + z * ca
        chain.axis2[i] = z
        chain.node[i] = at
        vw = vw + y * rate[0] + z * rate[1]
        # A joint at p that turns at rate 1 about s moves the point of the body at the base with p × s.
        vv = vv + wp.cross(at, y) * rate[0] + wp.cross(at, z) * rate[1]
        turned = x * cb + y * sb
        y = y * cb - x * sb
        x = turned
        if wp.static(hinges == 3):
            chain.axis3[i] = x
            if i % 2 == 1:
                # Half of the rest bend comes before the hinges, half behind them.
                ct = cosine(angle[2])
                st = sine(angle[2])
                vw = vw + x * rate[2]
                vv = vv + wp.cross(at, x) * rate[2]
                turned = y * ct + z * st
                z = z * ct - y * st
                y = turned * link.bend_cosine - x * link.bend_sine
                x = x * link.bend_cosine + turned * link.bend_sine
        at = at + x * link.length
        # Velocity is linear along a rigid link, so its faster end is the fastest of its points.
        end_speed = wp.length_sq(vv + wp.cross(vw, at))
        proximity.end_speed[i] = wp.sqrt(wp.max(speed, end_speed))
        fastest = wp.max(fastest, end_speed)
        speed = end_speed
    chain.node[job.links] = at
    state.top_speed = wp.sqrt(fastest)
    last = Twist()
    last.angular = vw
    last.linear = vv
    return last


@wp.func(inline=True)
def articulated_inertia(
    chains: ChainArrays,
    jobs: JobArrays,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    last: Twist,
    base: SpatialAcceleration,
    now: real,
    h: real,
    candidate_count: int,
) -> Wrench:
    """Second pass, up the chain: articulated inertia Iᴬ and bias pᴬ, gains UD⁻¹ and forces D⁻¹u of each joint.

    ``last`` is the twist of the last link, ``base`` the acceleration of the base; returned is the wrench on the base.
    """
    zero = real(0.0)
    one = real(1.0)
    # A linearly implicit step of length h damps like h k by itself (``Chain.damping``): only the rest of βk is added.
    step_damping = wp.max(job.beta - h, zero)
    vw = last.angular
    vv = last.linear
    ia = vec6(zero, zero, zero, zero, zero, zero)
    ib = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
    ic = vec6(zero, zero, zero, zero, zero, zero)
    pw = vec3(zero, zero, zero)
    pv = vec3(zero, zero, zero)
    for back in range(job.links):
        i = job.links - 1 - back
        link = chains.build[i, job.whisker]
        inertia = chains.inertia[i, job.whisker]
        at = row(chain.node, i)
        xa = (row(chain.node, i + 1) - at) / link.length
        com = at + xa * inertia.centre
        # Inertia of the link about the base point: parallel axes, and a thin part along the axis xa.
        m = link.mass
        thin = inertia.axial - inertia.transverse
        common = m * wp.dot(com, com) + inertia.transverse
        mc = com * m
        ia = ia + vec6(
            common + thin * xa[0] * xa[0] - mc[0] * com[0],
            common + thin * xa[1] * xa[1] - mc[1] * com[1],
            common + thin * xa[2] * xa[2] - mc[2] * com[2],
            thin * xa[0] * xa[1] - mc[0] * com[1],
            thin * xa[0] * xa[2] - mc[0] * com[2],
            thin * xa[1] * xa[2] - mc[1] * com[2],
        )
        # The block that couples rotation and translation is m [com]×, as a matrix of the cross product.
        ib = ib + mat33(zero, -mc[2], mc[1], mc[2], zero, -mc[0], -mc[1], mc[0], zero)
        ic = ic + vec6(m, m, m, zero, zero, zero)
        # Bias force v × Iv, less what loads give.
        # Linear momentum, and angular momentum about the base point (``spin``).
        momentum = vv * m + wp.cross(vw, mc)
        spin = wp.cross(com, momentum) + vw * inertia.transverse + xa * (thin * wp.dot(xa, vw))
        pw = pw + wp.cross(vw, spin) + wp.cross(vv, momentum)
        pv = pv + wp.cross(vw, momentum)
        if job.end_load > job.first_load:
            for load in range(job.first_load, job.end_load):
                if jobs.load_link[load] == i and now < jobs.load_stop[load]:
                    pull = jobs.load_force[load]
                    pw = pw - wp.cross(at + xa * (link.length * jobs.load_share[load]), pull)
                    pv = pv - pull
        k = inertia.stiffness
        angle = row(chain.angle, i)
        rate = row(chain.rate, i)
        # Springs and dampers at the end of the step: τ = −k (q + lag q̇), D gains h k lag.
        lag = h + step_damping
        force = JointVector()
        inverse = JointInverse()
        x = xa
        if wp.static(hinges == 3):
            x = row(chain.axis3, i)
            if i % 2 == 1:
                m3 = wp.cross(at, x)
                u3w = symmetric_times(ia, x) + ib * m3
                u3v = x * ib + symmetric_times(ic, m3)
                soft3 = h * lag * inertia.torsion
                spring3 = angle[2] + lag * rate[2]
                twist = wp.abs(angle[2])
                if twist > real(wp.static(FOLD)):
                    soft3 = soft3 * real(1.0 + wp.static(STOP))
                    past = angle[2] * (one - real(wp.static(FOLD)) / twist)
                    spring3 = spring3 + real(wp.static(STOP)) * (past + lag * rate[2])
                i33 = one / (wp.dot(x, u3w) + wp.dot(m3, u3v) + soft3)
                f3 = i33 * (-inertia.torsion * spring3 - wp.dot(x, pw) - wp.dot(m3, pv))
                g3w = u3w * i33
                g3v = u3v * i33
                chain.gain3_w[i] = g3w
                chain.gain3_v[i] = g3v
                force[2] = f3
                inverse[3] = i33
                s3 = x * rate[2]
                m3 = m3 * rate[2]
                cw = wp.cross(vw, s3)
                cv = wp.cross(vw, m3) + wp.cross(vv, s3)
                vw = vw - s3
                vv = vv - m3
                ia = ia - upper_outer(u3w, g3w)
                ic = ic - upper_outer(u3v, g3v)
                ib = ib - wp.outer(u3w, g3v)
                pw = pw + symmetric_times(ia, cw) + ib * cv + u3w * f3
                pv = pv + cw * ib + symmetric_times(ic, cv) + u3v * f3
        s2 = row(chain.axis2, i)
        # First axis of the joint: the y axis of the link before the turn about the second axis.
        s1 = wp.cross(s2, x) * cosine(angle[1]) + x * sine(angle[1])
        m1 = wp.cross(at, s1)
        m2 = wp.cross(at, s2)
        # U = IᴬS of both axes.
        u1w = symmetric_times(ia, s1) + ib * m1
        u1v = s1 * ib + symmetric_times(ic, m1)
        u2w = symmetric_times(ia, s2) + ib * m2
        u2v = s2 * ib + symmetric_times(ic, m2)
        soft = h * k * lag
        spring1 = angle[0] + lag * rate[0]
        spring2 = angle[1] + lag * rate[1]
        # A joint bent beyond FOLD stiffens.
        soft1 = soft
        soft2 = soft
        bend = wp.abs(angle[0])
        if bend > real(wp.static(FOLD)):
            soft1 = soft * real(1.0 + wp.static(STOP))
            # The further spring has no force at FOLD and is implicit too: no jump, and no limit of the time step.
            past = angle[0] * (one - real(wp.static(FOLD)) / bend)
            spring1 = spring1 + real(wp.static(STOP)) * (past + lag * rate[0])
        bend = wp.abs(angle[1])
        if bend > real(wp.static(FOLD)):
            soft2 = soft * real(1.0 + wp.static(STOP))
            past = angle[1] * (one - real(wp.static(FOLD)) / bend)
            spring2 = spring2 + real(wp.static(STOP)) * (past + lag * rate[1])
        # D of the axes, its inverse, and u = τ − Sᵀpᴬ.
        d11 = wp.dot(s1, u1w) + wp.dot(m1, u1v) + soft1
        d12 = wp.dot(s1, u2w) + wp.dot(m1, u2v)
        d22 = wp.dot(s2, u2w) + wp.dot(m2, u2v) + soft2
        whole = one / (d11 * d22 - d12 * d12)
        i11 = d22 * whole
        i12 = -d12 * whole
        i22 = d11 * whole
        t1 = -k * spring1 - wp.dot(s1, pw) - wp.dot(m1, pv)
        t2 = -k * spring2 - wp.dot(s2, pw) - wp.dot(m2, pv)
        f1 = i11 * t1 + i12 * t2
        f2 = i12 * t1 + i22 * t2
        # Gains UD⁻¹. The contact solver reads them again instead of the inertias, which are not kept.
        g1w = u1w * i11 + u2w * i12
        g1v = u1v * i11 + u2v * i12
        g2w = u1w * i12 + u2w * i22
        g2v = u1v * i12 + u2v * i22
        force[0] = f1
        force[1] = f2
        chain.gain1_w[i] = g1w
        chain.gain1_v[i] = g1v
        chain.gain2_w[i] = g2w
        chain.gain2_v[i] = g2v
        chain.acceleration[i] = force
        if candidate_count > 0:
            inverse[0] = i11
            inverse[1] = i12
            inverse[2] = i22
            proximity.inverse_inertia[i] = inverse
        # Velocity-product acceleration of the joint.
        # Going up, the twist of the link before is that of this link less what the joint adds.
        jw = s1 * rate[0] + s2 * rate[1]
        jv = m1 * rate[0] + m2 * rate[1]
        vw = vw - jw
        vv = vv - jv
        both = rate[0] * rate[1]
        # c = v × S q̇ with the twist v before the joint, and the first hinge carries the axis of the second one.
        cw = wp.cross(vw, jw) + wp.cross(s1, s2) * both
        cv = wp.cross(vw, jv) + wp.cross(vv, jw) + (wp.cross(s1, m2) + wp.cross(m1, s2)) * both
        # Iᴬ − UD⁻¹Uᵀ, and pᴬ + Iᴬc + UD⁻¹u with the velocity product c.
        ia = ia - symmetric_outer(u1w, g1w, u2w, g2w)
        ic = ic - symmetric_outer(u1v, g1v, u2v, g2v)
        ib = ib - wp.outer(u1w, g1v) - wp.outer(u2w, g2v)
        pw = pw + symmetric_times(ia, cw) + ib * cv + u1w * f1 + u2w * f2
        pv = pv + cw * ib + symmetric_times(ic, cv) + u1v * f1 + u2v * f2
    # f = Iᴬa + pᴬ at the base, whose acceleration is given.
    base_wrench = Wrench()
    base_wrench.moment = symmetric_times(ia, base.angular) + ib * base.linear + pw
    base_wrench.force = base.angular * ib + symmetric_times(ic, base.linear) + pv
    return base_wrench


@wp.func(inline=True)
def integrate_joint(
    chain: wp.ref[ChainState], state: wp.ref[WhiskerState], i: int, a: JointVector, h: real, end: real, quasistatic: int
):
    """Move a joint by its accelerations to the end of the step."""
    # The new rate moves the angle: together with the implicit springs this is a backward Euler step.
    rate = row(chain.rate, i) + a * h
    angle = row(chain.angle, i) + rate * h
    # Each quasi-static step starts at rest, so nothing swings past its balance.
    if quasistatic == 1:
        rate = JointVector()
    chain.rate[i] = rate
    chain.angle[i] = angle
    bend = wp.max(wp.abs(angle[0]), wp.abs(angle[1]))
    fastest = wp.max(wp.abs(rate[0]), wp.abs(rate[1]))
    if wp.static(hinges == 3):
        bend = wp.max(bend, wp.abs(angle[2]))
        fastest = wp.max(fastest, wp.abs(rate[2]))
    # A value that is no number must not slip through a comparison.
    if not (bend < real(wp.static(LARGEST_BEND))):
        if state.status == 0:
            state.status = wp.static(BENT)
            if not (bend < real(1e30)):
                state.status = wp.static(LOST)
            state.failed_at = end
    state.largest_change = wp.max(state.largest_change, wp.max(bend, fastest))


@wp.func(inline=True)
def joint_accelerations(
    job: WhiskerJob,
    options: StepOptions,
    chain: wp.ref[ChainState],
    candidates: wp.ref[ContactCandidates],
    state: wp.ref[WhiskerState],
    moving: Twist,
    base: SpatialAcceleration,
    now: real,
    h: real,
    candidate_count: int,
) -> vec3:
    """Third pass, down the chain: joint accelerations without contact, q̈ = D⁻¹u − (UD⁻¹)ᵀa.

    Without contact candidates the joints move on at once. ``moving`` is the twist of the base, ``base`` its
    acceleration; returned is the acceleration of the tip.
    """
    aw = base.angular
    av = base.linear
    vw = moving.angular
    vv = moving.linear
    for i in range(job.links):
        at = row(chain.node, i)
        s2 = row(chain.axis2, i)
        s1 = first_axis(s2, hinge_direction(chain, i), row(chain.angle, i)[1])
        m1 = wp.cross(at, s1)
        m2 = wp.cross(at, s2)
        rate = row(chain.rate, i)
        jw = s1 * rate[0] + s2 * rate[1]
        jv = m1 * rate[0] + m2 * rate[1]
        # Velocity product c of the joint.
        both = rate[0] * rate[1]
        aw = aw + wp.cross(vw, jw) + wp.cross(s1, s2) * both
        av = av + wp.cross(vw, jv) + wp.cross(vv, jw) + (wp.cross(s1, m2) + wp.cross(m1, s2)) * both
        vw = vw + jw
        vv = vv + jv
        # q̈ = D⁻¹u − (UD⁻¹)ᵀa′ with a′ = a + c.
        f = row(chain.acceleration, i)
        a1 = f[0] - wp.dot(row(chain.gain1_w, i), aw) - wp.dot(row(chain.gain1_v, i), av)
        a2 = f[1] - wp.dot(row(chain.gain2_w, i), aw) - wp.dot(row(chain.gain2_v, i), av)
        a = JointVector()
        a[0] = a1
        a[1] = a2
        aw = aw + s1 * a1 + s2 * a2
        av = av + m1 * a1 + m2 * a2
        if wp.static(hinges == 3):
            if i % 2 == 1:
                s3 = row(chain.axis3, i)
                m3 = wp.cross(at, s3)
                aw = aw + wp.cross(vw, s3) * rate[2]
                av = av + (wp.cross(vw, m3) + wp.cross(vv, s3)) * rate[2]
                a3 = f[2] - wp.dot(row(chain.gain3_w, i), aw) - wp.dot(row(chain.gain3_v, i), av)
                aw = aw + s3 * a3
                av = av + m3 * a3
                vw = vw + s3 * rate[2]
                vv = vv + m3 * rate[2]
                a[2] = a3
        if candidate_count > 0:
            chain.acceleration[i] = a
        else:
            integrate_joint(chain, state, i, a, h, now + h, options.quasistatic)
        for j in range(candidate_count):
            if row(candidates.link, j) == i:
                # Gravity was added to the base's acceleration; it moves nothing by itself.
                candidates.free_velocity[j] = (
                    vv
                    + av * h
                    + options.gravity * h
                    + wp.cross(vw + aw * h, row(candidates.point, j))
                    - row(candidates.object_velocity, j)
                )
    return av + wp.cross(aw, row(chain.node, job.links))
