"""Articulated-body algorithm: three passes over the chain of one thread, O(links).

Featherstone, Rigid Body Dynamics Algorithms (2008), table 7.1, in world axes about the base point: spatial vectors are
(rotation, translation at the base point), so nothing is transformed between links. Joints bend about two axes and, with
three ``hinges``, every second one (1, 3, 5 …) then twists about the mean direction of both links, as a joint of its own
behind the other; in the names below S = (s, m) is an axis and its moment, Iᴬ = (ia ib; ibᵀ ic), pᴬ = (pw, pv), U = IᴬS.

Joint springs and dampers act at the end of the step (linearly implicit), so the joint-space inertia is
D = SᵀU + h d + h² k, with stiffness k and damping d = βk, and stiffness limits no time step.
"""

import warp as wp

from brainbench.stimuli.engines.air import DENSITY, VISCOSITY
from brainbench.stimuli.engines.rod.limits import BENT, FOLD, GAVE_WAY, LARGEST_BEND, LARGEST_SLIDE, LOST, STOP

from .algebra import (
    JointInverse,
    JointVector,
    Spatial,
    SpatialInertia,
    combined,
    cosine,
    cross_motion,
    first_axis,
    hinge_motion,
    inertia_times,
    mat33,
    minus,
    minus_dot,
    plus,
    plus_cross,
    plus_inertia_times,
    quaternion_of,
    quaternion_product,
    rotate,
    rotation_vector,
    scaled,
    sine,
    spatial,
    spatial_dot,
    symmetric_outer,
    upper_outer,
    vec2,
    vec3,
    vec6,
)
from .motion import BodyMotion, elapsed
from .parameters import flows, hinges, real, rolls, smooth, yields
from .state import (
    ChainArrays,
    ContactCandidates,
    JointRecord,
    PerLink1,
    PerLink3,
    PerLinkInt,
    PerLinkInverse,
    PerLinkJoint,
    PerNode3,
    SceneArrays,
    Step,
    WhiskerJob,
    WhiskerState,
    row,
)


@wp.struct
class HingeGains:
    """U D⁻¹ of one hinge of each joint."""

    w: PerLink3
    v: PerLink3


@wp.struct
class ChainState:
    """State of the joints, and what one step keeps of each link between its passes."""

    angle: PerLinkJoint
    rate: PerLinkJoint
    axis2: PerLink3
    """Second axis of the joint."""
    node: PerNode3
    """Joints and tip, from the base point."""
    gain1: HingeGains
    gain2: HingeGains
    if hinges == 3:
        axis3: PerLink3
        gain3: HingeGains
    acceleration: PerLinkJoint
    """D⁻¹u of the joint, then its accelerations."""
    if yields:
        axes: mat33
        inertia: SpatialInertia
        compliance: SpatialInertia
        yielding: Spatial
        """As in :class:`ContactProblem`."""


@wp.func
def gain_at(gains: wp.ref[HingeGains], i: int) -> Spatial:
    """Return U D⁻¹ of a hinge of joint i."""
    return spatial(row(gains.w, i), row(gains.v, i))


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
    if smooth:
        shorter: PerLink1
        """By how much (mm) less than the chain the rod reached along itself to the far end (``centre_line``)."""


@wp.func(inline=True)
def joint_record(chain: wp.ref[ChainState], proximity: wp.ref[ProximityState], i: int) -> JointRecord:
    """Return a joint after the pass of the articulated inertia."""
    joint = JointRecord()
    at = row(chain.node, i)
    axis2 = row(chain.axis2, i)
    joint.motion1 = hinge_motion(at, first_axis(axis2, hinge_direction(chain, i), row(chain.angle, i)[1]))
    joint.motion2 = hinge_motion(at, axis2)
    joint.gain1 = gain_at(chain.gain1, i)
    joint.gain2 = gain_at(chain.gain2, i)
    if wp.static(hinges == 3):
        if i % 2 == 1:
            joint.motion3 = hinge_motion(at, row(chain.axis3, i))
            joint.gain3 = gain_at(chain.gain3, i)
    joint.inverse_inertia = row(proximity.inverse_inertia, i)
    return joint


@wp.func
def force_over_joint(joint: JointRecord, i: int, force: wp.ref[Spatial]) -> JointVector:
    """Return what joint i feels of a force behind it, u = Sᵀf, and leave what goes on, f − UD⁻¹u."""
    felt = JointVector()
    passed = spatial(force.w, force.v)
    if wp.static(hinges == 3):
        if i % 2 == 1:
            felt[2] = spatial_dot(joint.motion3, passed)
            passed = minus(passed, joint.gain3, felt[2])
    felt[0] = spatial_dot(joint.motion1, passed)
    felt[1] = spatial_dot(joint.motion2, passed)
    passed = minus(minus(passed, joint.gain1, felt[0]), joint.gain2, felt[1])
    force.w = passed.w
    force.v = passed.v
    return felt


@wp.func
def inverse_times(inverse: JointInverse, u: JointVector) -> JointVector:
    """Return D⁻¹u."""
    moved = JointVector()
    moved[0] = inverse[0] * u[0] + inverse[1] * u[1]
    moved[1] = inverse[1] * u[0] + inverse[2] * u[1]
    if wp.static(hinges == 3):
        moved[2] = inverse[3] * u[2]
    return moved


@wp.func
def acceleration_over_joint(joint: JointRecord, i: int, given: JointVector, a: wp.ref[Spatial]) -> JointVector:
    """Return the accelerations of joint i, D⁻¹u − (UD⁻¹)ᵀa, and leave the acceleration a of the link behind it.

    ``given`` is D⁻¹u, ``a`` the acceleration of the link before.
    """
    moved = given
    before = spatial(a.w, a.v)
    moved[0] = minus_dot(given[0], joint.gain1, before)
    moved[1] = minus_dot(given[1], joint.gain2, before)
    behind = plus(plus(before, joint.motion1, moved[0]), joint.motion2, moved[1])
    if wp.static(hinges == 3):
        if i % 2 == 1:
            moved[2] = minus_dot(given[2], joint.gain3, behind)
            behind = plus(behind, joint.motion3, moved[2])
    a.w = behind.w
    a.v = behind.v
    return moved


@wp.func(inline=True)
def forward_kinematics(
    chains: ChainArrays,
    job: WhiskerJob,
    pose: BodyMotion,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    state: wp.ref[WhiskerState],
) -> Spatial:
    """First pass, down the chain: place links and find their velocities; return the twist of the last one."""
    zero = real(0.0)
    x = rotate(pose.quaternion, vec3(real(1.0), zero, zero))
    y = rotate(pose.quaternion, vec3(zero, real(1.0), zero))
    z = wp.cross(x, y)
    # All positions count from the base point: single precision keeps its digits however far away the head is.
    vw = pose.spin
    vv = pose.velocity
    at = vec3(zero, zero, zero)
    speed = wp.length_sq(vv)
    fastest = speed
    for i in range(job.links):
        link = chains.build[i, job.whisker]
        if wp.static(rolls):
            rolled = y * link.roll_cosine + z * link.roll_sine
            z = z * link.roll_cosine - y * link.roll_sine
            y = rolled
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
    return spatial(vw, vv)


@wp.struct
class ArticulatedBody:
    """Articulated inertia Iᴬ and bias force pᴬ of a link and all behind it, and the twist V of the body before it."""

    inertia: SpatialInertia
    bias: Spatial
    twist: Spatial


@wp.func
def spring_state(angle: real, rate: real, lag: real) -> vec2:
    """Return the stretch of a joint's spring, q + lag q̇, and how many times steeper than its stiffness it is there."""
    stretch = angle + lag * rate
    steepness = real(1.0)
    bend = wp.abs(angle)
    # A joint bent beyond FOLD stiffens.
    if bend > real(wp.static(FOLD)):
        steepness = real(1.0 + wp.static(STOP))
        # The further spring has no force at FOLD and is implicit too: no jump, and no limit of the time step.
        past = angle * (real(1.0) - real(wp.static(FOLD)) / bend)
        stretch = stretch + real(wp.static(STOP)) * (past + lag * rate)
    return vec2(stretch, steepness)


@wp.func(inline=True)
def add_link(
    scene: SceneArrays, job: WhiskerJob, chain: wp.ref[ChainState], body: wp.ref[ArticulatedBody], i: int, now: real
) -> vec3:
    """Add the inertia of a link, its bias force v × Iv, and what loads on it take from that; return its direction."""
    zero = real(0.0)
    link = scene.chains.build[i, job.whisker]
    inertia = scene.chains.inertia[i, job.whisker]
    at = row(chain.node, i)
    xa = (row(chain.node, i + 1) - at) / link.length
    com = at + xa * inertia.centre
    # Inertia of the link about the base point: parallel axes, and a thin part along the axis xa.
    m = link.mass
    thin = inertia.axial - inertia.transverse
    common = m * wp.dot(com, com) + inertia.transverse
    mc = com * m
    body.inertia.a = body.inertia.a + vec6(
        common + thin * xa[0] * xa[0] - mc[0] * com[0],
        common + thin * xa[1] * xa[1] - mc[1] * com[1],
        common + thin * xa[2] * xa[2] - mc[2] * com[2],
        thin * xa[0] * xa[1] - mc[0] * com[1],
        thin * xa[0] * xa[2] - mc[0] * com[2],
        thin * xa[1] * xa[2] - mc[1] * com[2],
    )
    # The block that couples rotation and translation is m [com]×, as a matrix of the cross product.
    body.inertia.b = body.inertia.b + mat33(zero, -mc[2], mc[1], mc[2], zero, -mc[0], -mc[1], mc[0], zero)
    body.inertia.c = body.inertia.c + vec6(m, m, m, zero, zero, zero)
    # Linear momentum, and angular momentum about the base point (``spin``).
    vw = body.twist.w
    vv = body.twist.v
    momentum = vv * m + wp.cross(vw, mc)
    spin = wp.cross(com, momentum) + vw * inertia.transverse + xa * (thin * wp.dot(xa, vw))
    pw = body.bias.w + wp.cross(vw, spin) + wp.cross(vv, momentum)
    pv = body.bias.v + wp.cross(vw, momentum)
    if job.end_load > job.first_load:
        for load in range(job.first_load, job.end_load):
            if scene.jobs.load_link[load] == i and now < scene.jobs.load_stop[load]:
                pull = scene.jobs.load_force[load]
                pw = pw - wp.cross(at + xa * (link.length * scene.jobs.load_share[load]), pull)
                pv = pv - pull
    body.bias = spatial(pw, pv)
    return xa


@wp.func
def turned_symmetric(axes: mat33, a: mat33) -> vec6:
    """Return the symmetric matrix a in turned axes."""
    b = axes * a * wp.transpose(axes)
    return vec6(b[0, 0], b[1, 1], b[2, 2], b[0, 1], b[0, 2], b[1, 2])


@wp.func
def add_drag(
    scene: SceneArrays, job: WhiskerJob, chain: wp.ref[ChainState], body: wp.ref[ArticulatedBody], i: int, h: real
):
    """Add the drag of the air on a link (:mod:`brainbench.stimuli.engines.air`), as at its middle.

    The force c (u − v) acts at the end of the step as springs do: h c joins the inertia of the link, across it.
    """
    taper = scene.chains.taper[i, job.whisker]
    at = row(chain.node, i)
    end = row(chain.node, i + 1)
    x = wp.normalize(end - at)
    middle = (at + end) * real(0.5)
    across = wp.identity(n=3, dtype=real) - wp.outer(x, x)
    wind = across * (scene.options.air_flow - body.twist.v - wp.cross(body.twist.w, middle))
    # Diameter times speed over ν; in mm, ms and mg the viscosity has the same number, and densities a thousandth.
    number = (taper.start_radius + taper.end_radius) * wp.length(wind)
    number = number * real(wp.static(1e-3 * DENSITY / VISCOSITY))
    # Drag over speed, ½ ρ C_d d u = ½ μ C_d Re.
    drag = real(1.18) * number + real(6.8) * wp.pow(number, real(0.11)) + real(1.96) * wp.sqrt(number)
    drag = drag - real(0.0004) * number * number / (real(1.0) + real(3.64e-7) * number * number)
    drag = drag * real(wp.static(VISCOSITY / 2)) * taper.arc_length
    # Gravity was added to the base's acceleration; it moves nothing by itself.
    push = wind * drag - across * scene.options.gravity * (h * drag)
    body.bias.w = body.bias.w - wp.cross(middle, push)
    body.bias.v = body.bias.v - push
    held = across * (h * drag)
    lever = wp.skew(middle)
    body.inertia.a = body.inertia.a + turned_symmetric(lever, held)
    body.inertia.b = body.inertia.b + lever * held
    body.inertia.c = body.inertia.c + vec6(held[0, 0], held[1, 1], held[2, 2], held[0, 1], held[0, 2], held[1, 2])


@wp.func
def full(a: vec6) -> mat33:
    """Return a symmetric matrix with all its elements."""
    return mat33(a[0], a[3], a[4], a[3], a[1], a[5], a[4], a[5], a[2])


@wp.func
def spring_pull(stiffness: vec3, damping: vec3, h: real, stretch: vec3, rate: vec3) -> vec3:
    """Return the pull of springs and dampers at the end of a step at whose beginning they move at a rate."""
    # As in a joint: the step of length h damps like h k by itself.
    pull = vec3()
    for d in range(3):
        pull[d] = -stiffness[d] * stretch[d] - wp.max(h * stiffness[d], damping[d]) * rate[d]
    return pull


@wp.func
def yield_base(job: WhiskerJob, state: WhiskerState, start: Step) -> Step:
    """Return a step whose base is moved by the follicle; its acceleration is that without one of the follicle."""
    step = start
    zero = real(0.0)
    x = rotate(start.pose.quaternion, vec3(real(1.0), zero, zero))
    y = rotate(start.pose.quaternion, vec3(zero, real(1.0), zero))
    z = wp.cross(x, y)
    step.axes = mat33(x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2])
    step.slide = state.slide
    step.rate = state.rate
    spin = start.pose.spin
    arm = step.axes * state.slide.v
    turning = step.axes * state.rate.w
    sliding = step.axes * state.rate.v
    carried = start.base.v + wp.cross(spin, start.pose.velocity) + wp.cross(start.base.w, arm)
    carried = carried + wp.cross(spin, wp.cross(spin, arm) + real(2.0) * sliding)
    step.pose.quaternion = quaternion_product(start.pose.quaternion, quaternion_of(state.slide.w))
    step.pose.place = start.pose.place + arm
    step.pose.velocity = start.pose.velocity + wp.cross(spin, arm) + sliding
    step.pose.spin = spin + turning
    step.base.w = start.base.w + wp.cross(spin, turning)
    step.base.v = carried - wp.cross(step.pose.spin, step.pose.velocity)
    return step


@wp.func
def yield_follicle(
    chains: ChainArrays, job: WhiskerJob, chain: wp.ref[ChainState], step: Step, body: ArticulatedBody
) -> Spatial:
    """Solve for the acceleration of the follicle, (Iᴬ + h d + h² k) a = its pull − the wrench without it, and return
    the wrench on the base."""
    h = step.length
    springs = chains.follicle[job.whisker]
    to_world = step.axes
    to_follicle = wp.transpose(to_world)
    wrench = plus(inertia_times(body.inertia, step.base), body.bias, real(1.0))
    a = to_follicle * full(body.inertia.a) * to_world
    b = to_follicle * body.inertia.b * to_world
    c = to_follicle * full(body.inertia.c) * to_world
    for d in range(3):
        turn = springs.turn_stiffness[d]
        slide = springs.slide_stiffness[d]
        a[d, d] = a[d, d] + h * wp.max(h * turn, springs.turn_damping[d])
        c[d, d] = c[d, d] + h * wp.max(h * slide, springs.slide_damping[d])
        # A rigid axis takes no part.
        for e in range(3):
            if turn <= real(0.0):
                a[d, e] = real(0.0)
                a[e, d] = real(0.0)
                b[d, e] = real(0.0)
            if slide <= real(0.0):
                c[d, e] = real(0.0)
                c[e, d] = real(0.0)
                b[e, d] = real(0.0)
        if turn <= real(0.0):
            a[d, d] = real(1.0)
        if slide <= real(0.0):
            c[d, d] = real(1.0)
    # Inverse of (a b; bᵀ c) by its blocks.
    bottom = wp.inverse(c)
    beside = b * bottom
    top = wp.inverse(a - beside * wp.transpose(b))
    corner = top * beside
    bottom = bottom + wp.transpose(beside) * corner
    for d in range(3):
        if springs.turn_stiffness[d] <= real(0.0):
            top[d, d] = real(0.0)
        if springs.slide_stiffness[d] <= real(0.0):
            bottom[d, d] = real(0.0)
    chain.axes = to_world
    chain.inertia = body.inertia
    chain.compliance.a = turned_symmetric(to_world, top)
    chain.compliance.b = to_world * corner * to_follicle * real(-1.0)
    chain.compliance.c = turned_symmetric(to_world, bottom)
    pull = spatial(
        to_world * spring_pull(springs.turn_stiffness, springs.turn_damping, h, step.slide.w, step.rate.w),
        to_world * spring_pull(springs.slide_stiffness, springs.slide_damping, h, step.slide.v, step.rate.v),
    )
    moved = inertia_times(chain.compliance, minus(pull, wrench, real(1.0)))
    chain.yielding = spatial(to_follicle * moved.w, to_follicle * moved.v)
    return plus(wrench, inertia_times(body.inertia, moved), real(1.0))


@wp.func
def integrate_follicle(
    chains: ChainArrays, job: WhiskerJob, chain: wp.ref[ChainState], state: wp.ref[WhiskerState], h: real, end: real,
    quasistatic: int,
):  # fmt: skip
    """Move the follicle by its acceleration to the end of the step."""
    turning = state.rate.w + chain.yielding.w * h
    sliding = state.rate.v + chain.yielding.v * h
    turn = rotation_vector(quaternion_product(quaternion_of(turning * h), quaternion_of(state.slide.w)))
    for d in range(3):
        # Turns about two axes add up to a small one about the third, which a rigid axis does not let grow.
        if chains.follicle[job.whisker].turn_stiffness[d] <= real(0.0):
            turn[d] = real(0.0)
    slide = state.slide.v + sliding * h
    state.slide = spatial(turn, slide)
    state.rate = spatial(turning, sliding)
    if quasistatic == 1:
        state.rate = Spatial()
    size = wp.max(wp.length(turn), wp.length(slide))
    if not (
        wp.length(turn) < real(wp.static(LARGEST_BEND))
        and wp.length(slide) < real(wp.static(LARGEST_SLIDE)) * chains.length[job.whisker]
    ):
        if state.status == 0:
            state.status = wp.static(GAVE_WAY)
            if not (size < real(1e30)):
                state.status = wp.static(LOST)
            state.failed_at = end
    state.largest_change = wp.max(state.largest_change, wp.max(size, wp.max(wp.length(turning), wp.length(sliding))))


@wp.func(inline=True)
def articulated_inertia(
    scene: SceneArrays,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    step: Step,
    last: Spatial,
    candidate_count: int,
) -> Spatial:
    """Second pass, up the chain: articulated inertia Iᴬ and bias pᴬ, gains UD⁻¹ and forces D⁻¹u of each joint.

    ``last`` is the twist of the last link; returned is the wrench on the base.
    """
    zero = real(0.0)
    one = real(1.0)
    h = step.length
    # Springs and dampers act at the end of the step: τ = −k (q + lag q̇), D gains h k lag. A linearly implicit step of
    # length h damps like h k by itself (``Chain.damping``): only the rest of βk is added.
    lag = h + wp.max(job.beta - h, zero)
    body = ArticulatedBody()
    body.twist = last
    for back in range(job.links):
        i = job.links - 1 - back
        x = add_link(scene, job, chain, body, i, elapsed(step.now))
        if wp.static(flows):
            add_drag(scene, job, chain, body, i, h)
        inertia = scene.chains.inertia[i, job.whisker]
        at = row(chain.node, i)
        angle = row(chain.angle, i)
        rate = row(chain.rate, i)
        force = JointVector()
        inverse = JointInverse()
        if wp.static(hinges == 3):
            x = row(chain.axis3, i)
            if i % 2 == 1:
                s3 = hinge_motion(at, x)
                u3 = inertia_times(body.inertia, s3)
                spring3 = spring_state(angle[2], rate[2], lag)
                i33 = one / (spatial_dot(s3, u3) + h * lag * inertia.torsion * spring3[1])
                f3 = i33 * minus_dot(-inertia.torsion * spring3[0], s3, body.bias)
                g3 = scaled(u3, i33)
                chain.gain3.w[i] = g3.w
                chain.gain3.v[i] = g3.v
                force[2] = f3
                inverse[3] = i33
                turned = scaled(s3, rate[2])
                c3 = cross_motion(body.twist, turned)
                body.twist = minus(body.twist, turned, one)
                body.inertia.a = body.inertia.a - upper_outer(u3.w, g3.w)
                body.inertia.c = body.inertia.c - upper_outer(u3.v, g3.v)
                body.inertia.b = body.inertia.b - wp.outer(u3.w, g3.v)
                body.bias = plus(plus_inertia_times(body.bias, body.inertia, c3), u3, f3)
        axis2 = row(chain.axis2, i)
        # First axis of the joint: the y axis of the link before the turn about the second axis.
        s1 = hinge_motion(at, wp.cross(axis2, x) * cosine(angle[1]) + x * sine(angle[1]))
        s2 = hinge_motion(at, axis2)
        # U = IᴬS of both axes.
        u1 = inertia_times(body.inertia, s1)
        u2 = inertia_times(body.inertia, s2)
        k = inertia.stiffness
        soft = h * k * lag
        spring1 = spring_state(angle[0], rate[0], lag)
        spring2 = spring_state(angle[1], rate[1], lag)
        # D of the axes, its inverse, and u = τ − Sᵀpᴬ.
        d11 = spatial_dot(s1, u1) + soft * spring1[1]
        d12 = spatial_dot(s1, u2)
        d22 = spatial_dot(s2, u2) + soft * spring2[1]
        whole = one / (d11 * d22 - d12 * d12)
        i11 = d22 * whole
        i12 = -d12 * whole
        i22 = d11 * whole
        t1 = minus_dot(-k * spring1[0], s1, body.bias)
        t2 = minus_dot(-k * spring2[0], s2, body.bias)
        f1 = i11 * t1 + i12 * t2
        f2 = i12 * t1 + i22 * t2
        # Gains UD⁻¹. The contact solver reads them again instead of the inertias, which are not kept.
        g1 = combined(u1, i11, u2, i12)
        g2 = combined(u1, i12, u2, i22)
        force[0] = f1
        force[1] = f2
        chain.gain1.w[i] = g1.w
        chain.gain1.v[i] = g1.v
        chain.gain2.w[i] = g2.w
        chain.gain2.v[i] = g2.v
        chain.acceleration[i] = force
        if candidate_count > 0:
            inverse[0] = i11
            inverse[1] = i12
            inverse[2] = i22
            proximity.inverse_inertia[i] = inverse
        # Going up, the twist of the link before is that of this link less what the joint adds.
        added = combined(s1, rate[0], s2, rate[1])
        body.twist = minus(body.twist, added, one)
        # c = v × S q̇ with the twist v before the joint, and the first hinge carries the axis of the second one.
        c = plus(cross_motion(body.twist, added), cross_motion(s1, s2), rate[0] * rate[1])
        # Iᴬ − UD⁻¹Uᵀ, and pᴬ + Iᴬc + UD⁻¹u with the velocity product c.
        body.inertia.a = body.inertia.a - symmetric_outer(u1.w, g1.w, u2.w, g2.w)
        body.inertia.c = body.inertia.c - symmetric_outer(u1.v, g1.v, u2.v, g2.v)
        body.inertia.b = body.inertia.b - wp.outer(u1.w, g1.v) - wp.outer(u2.w, g2.v)
        body.bias = plus(plus(plus_inertia_times(body.bias, body.inertia, c), u1, f1), u2, f2)
    if wp.static(yields):
        return yield_follicle(scene.chains, job, chain, step, body)
    # f = Iᴬa + pᴬ at the base, whose acceleration is given.
    return plus(inertia_times(body.inertia, step.base), body.bias, one)


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
    scene: SceneArrays,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    candidates: wp.ref[ContactCandidates],
    state: wp.ref[WhiskerState],
    step: Step,
    candidate_count: int,
) -> vec3:
    """Third pass, down the chain: joint accelerations without contact, q̈ = D⁻¹u − (UD⁻¹)ᵀa.

    Without contact candidates the joints move on at once. Returned is the acceleration of the tip.
    """
    h = step.length
    a = step.base
    if wp.static(yields):
        a = spatial(a.w + step.axes * chain.yielding.w, a.v + step.axes * chain.yielding.v)
    v = spatial(step.pose.spin, step.pose.velocity)
    for i in range(job.links):
        at = row(chain.node, i)
        axis2 = row(chain.axis2, i)
        s1 = hinge_motion(at, first_axis(axis2, hinge_direction(chain, i), row(chain.angle, i)[1]))
        s2 = hinge_motion(at, axis2)
        rate = row(chain.rate, i)
        added = combined(s1, rate[0], s2, rate[1])
        # a′ = a + c with the velocity product c of the joint.
        a = plus(plus_cross(a, v, added), cross_motion(s1, s2), rate[0] * rate[1])
        v = plus(v, added, real(1.0))
        # q̈ = D⁻¹u − (UD⁻¹)ᵀa′.
        found = row(chain.acceleration, i)
        found[0] = minus_dot(found[0], gain_at(chain.gain1, i), a)
        found[1] = minus_dot(found[1], gain_at(chain.gain2, i), a)
        a = plus(plus(a, s1, found[0]), s2, found[1])
        if wp.static(hinges == 3):
            if i % 2 == 1:
                s3 = hinge_motion(at, row(chain.axis3, i))
                a = plus(a, cross_motion(v, s3), rate[2])
                found[2] = minus_dot(found[2], gain_at(chain.gain3, i), a)
                a = plus(a, s3, found[2])
                v = plus(v, s3, rate[2])
        if candidate_count > 0:
            chain.acceleration[i] = found
        else:
            integrate_joint(chain, state, i, found, h, elapsed(step.now) + h, scene.options.quasistatic)
        for j in range(candidate_count):
            if row(candidates.link, j) == i:
                # Gravity was added to the base's acceleration; it moves nothing by itself.
                candidates.free_velocity[j] = (
                    v.v
                    + a.v * h
                    + scene.options.gravity * h
                    + wp.cross(v.w + a.w * h, row(candidates.point, j))
                    - row(candidates.object_velocity, j)
                )
    return a.v + wp.cross(a.w, row(chain.node, job.links))
