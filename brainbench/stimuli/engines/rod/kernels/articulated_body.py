"""The passes over a chain within a step: where its links are, its articulated inertia, its accelerations.

World axes about the base point (Featherstone 2008, chapter 7), linearly implicit: joint springs and dampers act at the
end of the step.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.kernels.algebra import algebra
from brainbench.stimuli.engines.rod.kernels.inputs import structs
from brainbench.stimuli.engines.rod.kernels.motion import tracks
from brainbench.stimuli.engines.rod.kernels.state import memory
from brainbench.stimuli.engines.rod.limits import BENT, FOLD, LARGEST_BEND, LOST, STOP


@cache
def passes(real: type, capacity: int) -> SimpleNamespace:
    """Return ``place``, ``articulate``, ``accelerate`` and ``advance`` of chains of at most ``capacity`` links."""
    import warp as wp

    vec2: Any = wp.types.vector(2, real)
    vec3: Any = wp.types.vector(3, real)
    vec6: Any = wp.types.vector(6, real)
    mat33: Any = wp.types.matrix((3, 3), real)
    kinds, maths, kept = structs(real), algebra(real), memory(real, capacity)
    Chains, Lanes, Options, Pose = kinds.Chains, kinds.Lanes, kinds.Options, tracks(real).Pose
    sym, sym_pair, sine, cosine = maths.sym, maths.sym_pair, maths.sine, maths.cosine
    first_axis, rotate = maths.first_axis, maths.rotate
    Links, Watch, Spots, Lane, State = kept.Links, kept.Watch, kept.Spots, kept.Lane, kept.State
    Twist, row = kept.Twist, kept.row

    @wp.func(inline=True)
    def place(
        ch: Chains, me: Lane, pose: Pose, mem: wp.ref[Links], watch: wp.ref[Watch], state: wp.ref[State]
    ) -> Twist:
        """Down the chain: where the links are and how they move; returned is the motion of the last one."""
        zero = real(0.0)
        x = rotate(pose.turn, vec3(real(1.0), zero, zero))
        y = rotate(pose.turn, vec3(zero, real(1.0), zero))
        z = wp.cross(x, y)
        vw = pose.spin
        vv = pose.velocity
        at = vec3(zero, zero, zero)
        speed = wp.length_sq(vv)
        fastest = speed
        for i in range(me.links):
            b4 = ch.build[i, me.whisker]
            turned = x * b4[1] + y * b4[2]
            y = y * b4[1] - x * b4[2]
            angle = row(mem.q, i)
            rate = row(mem.qd, i)
            ca = cosine(angle[0])
            sa = sine(angle[0])
            cb = cosine(angle[1])
            sb = sine(angle[1])
            x = turned * ca - z * sa
            z = turned * sa + z * ca
            mem.e2[i] = z
            mem.node[i] = at
            vw = vw + y * rate[0] + z * rate[1]
            vv = vv + wp.cross(at, y) * rate[0] + wp.cross(at, z) * rate[1]
            turned = x * cb + y * sb
            y = y * cb - x * sb
            x = turned
            at = at + x * b4[0]
            end_speed = wp.length_sq(vv + wp.cross(vw, at))
            watch.swift[i] = wp.sqrt(wp.max(speed, end_speed))
            fastest = wp.max(fastest, end_speed)
            speed = end_speed
        mem.node[me.links] = at
        state.quickest = wp.sqrt(fastest)
        last = Twist()
        last.w = vw
        last.v = vv
        return last

    @wp.func(inline=True)
    def articulate(
        ch: Chains,
        ln: Lanes,
        me: Lane,
        mem: wp.ref[Links],
        watch: wp.ref[Watch],
        last: Twist,
        base: Twist,
        now: real,
        h: real,
        seen: int,
    ) -> Twist:
        """Up the chain: articulated inertia, bias and what each joint does with them.

        ``last`` is the motion of the last link, ``base`` the acceleration of the base; returned is what the base feels.
        """
        zero = real(0.0)
        one = real(1.0)
        step_damping = wp.max(me.beta - h, zero)
        vw = last.w
        vv = last.v
        ia = vec6(zero, zero, zero, zero, zero, zero)
        ib = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
        ic = vec6(zero, zero, zero, zero, zero, zero)
        pw = vec3(zero, zero, zero)
        pv = vec3(zero, zero, zero)
        for back in range(me.links):
            i = me.links - 1 - back
            b4 = ch.build[i, me.whisker]
            i4 = ch.inertia[i, me.whisker]
            at = row(mem.node, i)
            xa = (row(mem.node, i + 1) - at) / b4[0]
            com = at + xa * i4[0]
            m = b4[3]
            thin = i4[1] - i4[2]
            common = m * wp.dot(com, com) + i4[2]
            mc = com * m
            ia = ia + vec6(
                common + thin * xa[0] * xa[0] - mc[0] * com[0],
                common + thin * xa[1] * xa[1] - mc[1] * com[1],
                common + thin * xa[2] * xa[2] - mc[2] * com[2],
                thin * xa[0] * xa[1] - mc[0] * com[1],
                thin * xa[0] * xa[2] - mc[0] * com[2],
                thin * xa[1] * xa[2] - mc[1] * com[2],
            )
            ib = ib + mat33(zero, -mc[2], mc[1], mc[2], zero, -mc[0], -mc[1], mc[0], zero)
            ic = ic + vec6(m, m, m, zero, zero, zero)
            momentum = vv * m + wp.cross(vw, mc)
            spin = wp.cross(com, momentum) + vw * i4[2] + xa * (thin * wp.dot(xa, vw))
            pw = pw + wp.cross(vw, spin) + wp.cross(vv, momentum)
            pv = pv + wp.cross(vw, momentum)
            if me.loads_to > me.loads_from:
                for given in range(me.loads_from, me.loads_to):
                    if ln.load_link[given] == i and now < ln.load_stop[given]:
                        pull = ln.load_force[given]
                        pw = pw - wp.cross(at + xa * (b4[0] * ln.load_share[given]), pull)
                        pv = pv - pull
            angle = row(mem.q, i)
            s2 = row(mem.e2, i)
            s1 = wp.cross(s2, xa) * cosine(angle[1]) + xa * sine(angle[1])
            m1 = wp.cross(at, s1)
            m2 = wp.cross(at, s2)
            u1w = sym(ia, s1) + ib * m1
            u1v = s1 * ib + sym(ic, m1)
            u2w = sym(ia, s2) + ib * m2
            u2v = s2 * ib + sym(ic, m2)
            k = i4[3]
            lag = h + step_damping
            soft = h * k * lag
            rate = row(mem.qd, i)
            spring1 = angle[0] + lag * rate[0]
            spring2 = angle[1] + lag * rate[1]
            soft1 = soft
            soft2 = soft
            bend = wp.abs(angle[0])
            if bend > real(wp.static(FOLD)):
                soft1 = soft * real(1.0 + wp.static(STOP))
                past = angle[0] * (one - real(wp.static(FOLD)) / bend)
                spring1 = spring1 + real(wp.static(STOP)) * (past + lag * rate[0])
            bend = wp.abs(angle[1])
            if bend > real(wp.static(FOLD)):
                soft2 = soft * real(1.0 + wp.static(STOP))
                past = angle[1] * (one - real(wp.static(FOLD)) / bend)
                spring2 = spring2 + real(wp.static(STOP)) * (past + lag * rate[1])
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
            g1w = u1w * i11 + u2w * i12
            g1v = u1v * i11 + u2v * i12
            g2w = u1w * i12 + u2w * i22
            g2v = u1v * i12 + u2v * i22
            mem.k1w[i] = g1w
            mem.k1v[i] = g1v
            mem.k2w[i] = g2w
            mem.k2v[i] = g2v
            mem.push[i] = vec2(f1, f2)
            if seen > 0:
                watch.inverse[i] = vec3(i11, i12, i22)
            # Velocity-product acceleration of the joint.
            jw = s1 * rate[0] + s2 * rate[1]
            jv = m1 * rate[0] + m2 * rate[1]
            vw = vw - jw
            vv = vv - jv
            both = rate[0] * rate[1]
            cw = wp.cross(vw, jw) + wp.cross(s1, s2) * both
            cv = wp.cross(vw, jv) + wp.cross(vv, jw) + (wp.cross(s1, m2) + wp.cross(m1, s2)) * both
            ia = ia - sym_pair(u1w, g1w, u2w, g2w)
            ic = ic - sym_pair(u1v, g1v, u2v, g2v)
            ib = ib - wp.outer(u1w, g1v) - wp.outer(u2w, g2v)
            pw = pw + sym(ia, cw) + ib * cv + u1w * f1 + u2w * f2
            pv = pv + cw * ib + sym(ic, cv) + u1v * f1 + u2v * f2
        felt = Twist()
        felt.w = sym(ia, base.w) + ib * base.v + pw
        felt.v = base.w * ib + sym(ic, base.v) + pv
        return felt

    @wp.func(inline=True)
    def advance(mem: wp.ref[Links], state: wp.ref[State], i: int, a: vec2, h: real, end: real, quasistatic: int):
        """Move a joint by its accelerations to the end of the step."""
        rate = row(mem.qd, i) + a * h
        angle = row(mem.q, i) + rate * h
        if quasistatic == 1:
            rate = vec2(real(0.0), real(0.0))
        mem.qd[i] = rate
        mem.q[i] = angle
        bend = wp.max(wp.abs(angle[0]), wp.abs(angle[1]))
        # A value that is no number must not slip through a comparison.
        if not (bend < real(wp.static(LARGEST_BEND))):
            if state.status == 0:
                state.status = wp.static(BENT)
                if not (bend < real(1e30)):
                    state.status = wp.static(LOST)
                state.failed = end
        state.worst = wp.max(state.worst, wp.max(bend, wp.max(wp.abs(rate[0]), wp.abs(rate[1]))))

    @wp.func(inline=True)
    def accelerate(
        me: Lane,
        opt: Options,
        mem: wp.ref[Links],
        spots: wp.ref[Spots],
        state: wp.ref[State],
        moving: Twist,
        base: Twist,
        now: real,
        h: real,
        seen: int,
    ) -> vec3:
        """Down again: accelerations without contact; joints that can have none move on at once.

        ``moving`` is the velocity of the base, ``base`` its acceleration; returned is the acceleration of the tip.
        """
        aw = base.w
        av = base.v
        vw = moving.w
        vv = moving.v
        for i in range(me.links):
            at = row(mem.node, i)
            s2 = row(mem.e2, i)
            s1 = first_axis(s2, row(mem.node, i + 1) - at, row(mem.q, i)[1])
            m1 = wp.cross(at, s1)
            m2 = wp.cross(at, s2)
            rate = row(mem.qd, i)
            jw = s1 * rate[0] + s2 * rate[1]
            jv = m1 * rate[0] + m2 * rate[1]
            both = rate[0] * rate[1]
            aw = aw + wp.cross(vw, jw) + wp.cross(s1, s2) * both
            av = av + wp.cross(vw, jv) + wp.cross(vv, jw) + (wp.cross(s1, m2) + wp.cross(m1, s2)) * both
            vw = vw + jw
            vv = vv + jv
            f = row(mem.push, i)
            a1 = f[0] - wp.dot(row(mem.k1w, i), aw) - wp.dot(row(mem.k1v, i), av)
            a2 = f[1] - wp.dot(row(mem.k2w, i), aw) - wp.dot(row(mem.k2v, i), av)
            aw = aw + s1 * a1 + s2 * a2
            av = av + m1 * a1 + m2 * a2
            if seen > 0:
                mem.push[i] = vec2(a1, a2)
            else:
                advance(mem, state, i, vec2(a1, a2), h, now + h, opt.quasistatic)
            for j in range(seen):
                if row(spots.link, j) == i:
                    # Gravity was added to the base's acceleration; it moves nothing by itself.
                    spots.free[j] = (
                        vv + av * h + opt.gravity * h + wp.cross(vw + aw * h, row(spots.at, j)) - row(spots.move, j)
                    )
        return av + wp.cross(aw, row(mem.node, me.links))

    return SimpleNamespace(place=place, articulate=articulate, accelerate=accelerate, advance=advance)
