"""The whisker kernel: one thread takes one whisker from its first reading to its last.

A step is the articulated-body algorithm (Featherstone 2008, chapter 7) in world axes about the base point, made
linearly implicit: joint springs and dampers act at the end of the step, so the joint-space inertia is
D = SᵀAS + h d + h² k and stiffness limits no time step. Contacts are rigid and unilateral: the factorised chain gives
their exact compliance (Delassus) matrix in one more pass, a small Coulomb problem is solved for their forces, and one
pass applies them. A contact takes part before it closes (g + h vₙ ≥ 0, gap g, approach vₙ), so nothing passes through
anything within a step. Everything is O(links). Units: mg, mm, ms, mN, µN·m.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.backends.rod._algebra import algebra
from brainbench.stimuli.backends.rod._limits import (
    BENT,
    CLOSED,
    CREVICE,
    FINEST,
    FOLD,
    LARGEST_BEND,
    LOST,
    MESHES,
    NOTHING,
    REST,
    ROUNDS,
    SPARE,
    STOP,
    SWEEPS,
    TRAVEL,
    WARP,
    WIDEST,
    contacts_for,
)
from brainbench.stimuli.backends.rod._looks import looks
from brainbench.stimuli.backends.rod._shapes import MESH, distances
from brainbench.stimuli.backends.rod._structs import structs
from brainbench.stimuli.backends.rod._tracks import tracks


@cache
def solver(
    real: type, capacity: int, against: int = MESHES, bounds: tuple[int, int] | None = None, sliced: bool = False
) -> SimpleNamespace:
    """Return the structures and the kernel for chains of at most ``capacity`` links in one precision.

    Args:
        real: ``warp.float32`` or ``warp.float64``.
        capacity: links that fit; a module is compiled for each.
        against: what there is to touch, :data:`NOTHING`, :data:`PRIMITIVES` or :data:`MESHES`.
        bounds: threads per block and blocks per multiprocessor that the CUDA compiler aims at.
        sliced: whether a whisker pauses wherever it must look at a mesh, so that all such looks of all whiskers are
            made by a kernel of their own and the threads of a block do alike work; results are the same. One shape a
            scene.
    """
    import warp as wp

    vec2: Any = wp.types.vector(2, real)
    vec3: Any = wp.types.vector(3, real)
    vec4: Any = wp.types.vector(4, real)
    vec6: Any = wp.types.vector(6, real)
    mat33: Any = wp.types.matrix((3, 3), real)
    primitive = distances(real).primitive
    kinds, maths, near_by, track = structs(real), algebra(real), looks(real, against), tracks(real)
    Chains, Bodies, Lanes, Options = kinds.Chains, kinds.Bodies, kinds.Lanes, kinds.Options
    Results, Paused = kinds.Results, kinds.Paused
    sym, sym_pair, sine, cosine = maths.sym, maths.sym_pair, maths.sine, maths.cosine
    first_axis, rotate, unrotate = maths.first_axis, maths.rotate, maths.unrotate
    Touch, far_mesh, look_at = near_by.Touch, near_by.far_mesh, near_by.look_at
    Tracks, pose_at = track.Tracks, track.pose_at
    most_held = contacts_for(capacity)
    most_seen = most_held + SPARE
    rows = 3 * most_held
    # Memory of a thread. Vectors and matrices, because arrays in a kernel carry addresses that the compiler loses.
    Links2: Any = wp.types.matrix((capacity, 2), real)
    Links3: Any = wp.types.matrix((capacity, 3), real)
    Nodes3: Any = wp.types.matrix((capacity + 1, 3), real)
    Links: Any = wp.types.vector(capacity, real)
    LinksWhole: Any = wp.types.vector(capacity, wp.int32)
    SeenWhole: Any = wp.types.vector(most_seen, wp.int32)
    Seen: Any = wp.types.vector(most_seen, real)
    Seen3: Any = wp.types.matrix((most_seen, 3), real)
    HeldWhole: Any = wp.types.vector(most_held, wp.int32)
    Held: Any = wp.types.vector(most_held, real)
    Held3: Any = wp.types.matrix((most_held, 3), real)
    Rows3: Any = wp.types.matrix((rows, 3), real)
    Rows2: Any = wp.types.matrix((rows, 2), real)
    Rows: Any = wp.types.vector(rows, real)
    Pairs: Any = wp.types.vector(2 * most_held, real)
    Square: Any = wp.types.vector(most_held * most_held, real)
    Table: Any = wp.types.vector(rows * rows, real)

    @wp.kernel(enable_backward=False, module="unique")
    def turn_over(on: Paused, looks: int):
        for d in range(3):
            on.size[d] = on.tally[d]
            on.tally[d] = 0
        on.size[2] = wp.min(on.size[2], looks)

    @wp.kernel(enable_backward=False, module="unique")
    def look_all(ch: Chains, tr: Tracks, bodies: Bodies, ln: Lanes, on: Paused):
        """Answer the looks of all waiting whiskers, one each."""
        which = wp.tid()
        if which < on.size[2]:
            lane = on.look_lane[which]
            i = on.look_link[which]
            s = bodies.first[ln.scene[lane]]
            now = on.times[5, lane]
            margin = on.times[6, lane]
            body = pose_at(tr, bodies.track[s], now)
            touch = look_at(
                bodies,
                s,
                body,
                on.look_ends[which, 0],
                on.look_ends[which, 1],
                ch.taper[i, ln.whisker[lane]],
                margin,
                int(on.ways[i, lane][1]),
            )
            on.found[which, 0] = vec4(touch.normal[0], touch.normal[1], touch.normal[2], touch.gap)
            on.found[which, 1] = vec4(touch.end_normal[0], touch.end_normal[1], touch.end_normal[2], touch.end_gap)
            on.found[which, 2] = vec4(touch.share, touch.clear, real(touch.between + 2 * touch.end), real(touch.close))

    @wp.kernel(enable_backward=False, module="unique", launch_bounds=bounds)
    def run(
        ch: Chains,
        tr: Tracks,
        bodies: Bodies,
        ln: Lanes,
        opt: Options,
        readings: wp.array(dtype=real),
        out: Results,
        on: Paused,
    ):
        lane = wp.tid()
        if wp.static(sliced):
            # Those at the back begin with a block of their own.
            front = on.size[0]
            back_from = ((front + wp.static(WARP - 1)) // wp.static(WARP)) * wp.static(WARP)
            if lane < front:
                lane = on.queue[lane]
            elif lane >= back_from and lane - back_from < on.size[1]:
                lane = on.queue[on.queue.shape[0] - 1 - (lane - back_from)]
            else:
                return
        zero = real(0.0)
        one = real(1.0)
        none = vec3(zero, zero, zero)
        who = ln.whisker[lane]
        scene = ln.scene[lane]
        row = ln.row[lane]
        column = ln.column[lane]
        base = ln.base[lane]
        links = ch.links[who]
        beta = ch.beta[who]
        longest = ln.step[lane]
        shapes_from = bodies.first[scene]
        shapes_to = shapes_from + (bodies.first[scene + 1] - shapes_from) * wp.static(min(against, 1))
        loads_from = ln.load_first[lane]
        loads_to = ln.load_first[lane + 1]
        still_base = int(0)
        if tr.count[base] == 1 and wp.length_sq(tr.velocity[tr.first[base]]) == zero:
            still_base = 1
        may_rest = int(0)
        if still_base == 1 and loads_from == loads_to and wp.length_sq(opt.gravity) == zero and opt.shape == 0:
            may_rest = 1

        # State of the joints, and what one step keeps of each link between its passes.
        q = Links2()
        qd = Links2()
        e2 = Links3()
        node = Nodes3()
        k1w = Links3()
        k1v = Links3()
        k2w = Links3()
        k2v = Links3()
        push = Links2()
        inverse = Links3()
        clear = Links()
        close = LinksWhole()
        lift = Links2()
        mend = Links2()
        # Where contact is possible within one step.
        k_link = SeenWhole()
        k_arc = Seen()
        k_ahead = Seen()
        k_gap = Seen()
        k_mu = Seen()
        k_at = Seen3()
        k_move = Seen3()
        k_normal = Seen3()
        k_free = Seen3()
        k_taken = SeenWhole()
        # Contacts whose forces are solved for.
        c_link = HeldWhole()
        c_arc = Held()
        c_gap = Held()
        c_mu = Held()
        c_at = Held3()
        axis = Rows3()
        fw = Rows3()
        fv = Rows3()
        ju = Rows2()
        free = Rows()
        force = Rows()
        held_arc = Held()
        held_force = Held3()
        held_count = int(0)
        stance = HeldWhole()
        ratio = Pairs()
        asked = Held()
        load_n = Held()
        square = Square()
        work = Square()
        comply = Table()

        near = int(0)
        quickest = zero
        # Counts that the compiler does not know keep it from writing loops out.
        slip_tries = int(8) + wp.min(0, lane)
        guess_tries = int(10) + wp.min(0, lane)
        rounds_most = int(wp.static(ROUNDS)) + wp.min(0, lane)
        sweeps_most = int(wp.static(SWEEPS)) + wp.min(0, lane)
        contacts_most = int(wp.static(most_held)) + wp.min(0, lane)
        sides = int(2) + wp.min(0, lane)
        object_speed = zero
        for s in range(shapes_from, shapes_to):
            object_speed = wp.max(object_speed, bodies.speed[s])
        jump = zero
        deepest = out.depth[lane]
        steps = out.steps[lane]
        touching = out.touching[lane]
        crowded = out.crowded[lane]
        unsolved = out.unsolved[lane]
        miss = out.miss[lane]
        load = out.load[lane]
        status = int(0)
        failed = zero
        before = opt.start
        resting = may_rest
        idle = opt.start
        # A reading takes the wrench of the step that begins at its time, so one more step follows the last.
        pending = int(-1)
        first_reading = int(0)
        rest_of_frame = zero
        waiting = int(0)
        look_first = int(0)
        used = int(0)
        if wp.static(sliced) and on.counts[5, lane] != 0:
            first_reading = on.counts[0, lane]
            pending = on.counts[1, lane]
            held_count = on.counts[2, lane]
            near = on.counts[3, lane]
            resting = on.counts[4, lane]
            waiting = on.counts[5, lane]
            look_first = on.counts[6, lane]
            before = on.times[0, lane]
            rest_of_frame = on.times[1, lane]
            idle = on.times[2, lane]
            jump = on.times[3, lane]
            quickest = on.times[4, lane]
            for i in range(links):
                both4 = on.joints[i, lane]
                q[i] = vec2(both4[0], both4[1])
                qd[i] = vec2(both4[2], both4[3])
                way2 = on.ways[i, lane]
                clear[i] = way2[0]
                close[i] = int(way2[1])
            for c in range(held_count):
                grip = on.held[c, lane]
                held_arc[c] = grip[0]
                held_force[c] = vec3(grip[1], grip[2], grip[3])
        paused = int(0)
        for reading in range(first_reading, readings.shape[0] + 1):
            upto = before + longest
            if reading < readings.shape[0]:
                upto = readings[reading]
            span = upto - before
            if span <= zero:
                # A reading at the very start.
                pending = reading
                continue
            if resting == 1 and upto > idle and rest_of_frame == zero:
                # When may an object come near at the earliest? The whisker stands straight out of its base.
                idle = real(1e30)
                if object_speed > zero or before == opt.start:
                    pose0 = pose_at(tr, base, before)
                    x = rotate(pose0.turn, vec3(one, zero, zero))
                    y = rotate(pose0.turn, vec3(zero, one, zero))
                    at = pose0.place
                    # Nothing can come near after the last reading.
                    look = object_speed * (readings[readings.shape[0] - 1] - before) + real(0.5)
                    for i in range(links):
                        b4 = ch.build[i, who]
                        turned = x * b4[1] + y * b4[2]
                        y = y * b4[1] - x * b4[2]
                        x = turned
                        ahead_at = at + x * b4[0]
                        for s in range(shapes_from, shapes_to):
                            body = pose_at(tr, bodies.track[s], before)
                            turn_s = bodies.turn[s]
                            scale = bodies.scale[s]
                            local = unrotate(body.turn, at - body.place) - bodies.place[s]
                            a = unrotate(turn_s, local) / scale
                            local = unrotate(body.turn, ahead_at - body.place) - bodies.place[s]
                            b = unrotate(turn_s, local) / scale
                            slack = zero
                            if bodies.kind[s] == wp.static(MESH):
                                touch = far_mesh(bodies, s, a, b, zero, zero, look / scale)
                                slack = touch.clear * scale
                            else:
                                tip = primitive(bodies.kind[s], bodies.size[s] / scale, real(0.5) * (a + b))
                                slack = tip[3] * scale - real(0.5) * b4[0]
                            slack = slack - ch.taper[i, who][0] - real(0.05)
                            if slack <= zero:
                                idle = before
                            elif object_speed > zero:
                                idle = wp.min(idle, before + slack / (real(1.02) * object_speed))
                        at = ahead_at
            if resting == 1 and upto <= idle and rest_of_frame == zero:
                # At rest, and nothing can have come near: the wrench stays zero.
                for i in range(links):
                    clear[i] = zero
                    close[i] = 0
                    q[i] = vec2(zero, zero)
                    qd[i] = vec2(zero, zero)
                before = upto
                pending = int(-1)
                continue
            left = span
            if rest_of_frame > zero:
                left = rest_of_frame
                rest_of_frame = zero
            last = int(0)
            while last == 0:
                if wp.static(sliced):
                    rest_of_frame = left
                    if used >= on.budget:
                        paused = 2
                        break
                    used = used + 1
                now = upto - left
                # Where something is near, a step moves no point of the whisker further than a contact search looks.
                wanted = longest
                if near == 1 and (quickest + object_speed) * longest > real(wp.static(TRAVEL)):
                    wanted = wp.max(
                        longest / real(wp.static(FINEST)), real(wp.static(TRAVEL)) / (quickest + object_speed)
                    )
                count = wp.max(1, int(wp.ceil(left / wanted - real(1e-3))))
                h = left / real(count)
                left = left - h
                if count == 1:
                    last = 1
                    if opt.quasistatic == 1 and reading < readings.shape[0]:
                        pending = reading
                step_damping = wp.max(beta - h, zero)
                pose0 = pose_at(tr, base, now)
                pose1 = pose_at(tr, base, now + h)
                origin = pose0.place
                bw = pose0.spin
                bv = pose0.velocity
                baw = (pose1.spin - bw) / h
                bav = (pose1.velocity - bv) / h - wp.cross(bw, bv) - opt.gravity
                qt = pose0.turn
                x = rotate(qt, vec3(one, zero, zero))
                y = rotate(qt, vec3(zero, one, zero))
                z = wp.cross(x, y)
                # Down the chain: where the links are and how they move.
                vw = bw
                vv = bv
                at = none
                fastest = wp.length_sq(bv)
                for i in range(links):
                    b4 = ch.build[i, who]
                    turned = x * b4[1] + y * b4[2]
                    y = y * b4[1] - x * b4[2]
                    angle = q[i]
                    rate = qd[i]
                    ca = cosine(angle[0])
                    sa = sine(angle[0])
                    cb = cosine(angle[1])
                    sb = sine(angle[1])
                    x = turned * ca - z * sa
                    z = turned * sa + z * ca
                    e2[i] = z
                    node[i] = at
                    vw = vw + y * rate[0] + z * rate[1]
                    vv = vv + wp.cross(at, y) * rate[0] + wp.cross(at, z) * rate[1]
                    turned = x * cb + y * sb
                    y = y * cb - x * sb
                    x = turned
                    at = at + x * b4[0]
                    fastest = wp.max(fastest, wp.length_sq(vv + wp.cross(vw, at)))
                node[links] = at
                was_quickest = quickest
                quickest = wp.sqrt(fastest)
                # Contacts that may close within this step.
                contacts = int(0)
                seen = int(0)
                travel = h * (quickest + object_speed)
                margin = wp.min(real(1.5) * travel + h * jump + real(0.001), real(wp.static(WIDEST)))
                was_near = near
                near = int(0)
                nigh = int(0)
                if wp.static(against > NOTHING):
                    for i in range(links):
                        if clear[i] - real(1.02) * travel <= margin + ch.taper[i, who][0]:
                            near = 1
                            nigh = nigh + 1
                if wp.static(sliced):
                    if near == 1 and waiting != 1:
                        # Ask for looks, and wait; when there is no room for more, try again.
                        paused = 2
                        look_first = wp.atomic_add(on.tally, 2, nigh)
                        if look_first + nigh <= on.look_lane.shape[0]:
                            paused = 1
                            asked_for = look_first
                            for i in range(links):
                                if clear[i] - real(1.02) * travel <= margin + ch.taper[i, who][0]:
                                    on.look_lane[asked_for] = lane
                                    on.look_link[asked_for] = i
                                    on.look_ends[asked_for, 0] = node[i] + origin
                                    on.look_ends[asked_for, 1] = node[i + 1] + origin
                                    asked_for = asked_for + 1
                            on.times[5, lane] = now
                            on.times[6, lane] = margin
                        near = was_near
                        quickest = was_quickest
                        break
                    waiting = 0
                    rest_of_frame = zero
                if wp.static(against > NOTHING):
                    for i in range(links):
                        clear[i] = clear[i] - real(1.02) * travel
                if wp.static(against > NOTHING) and near == 1:
                    answer = look_first
                    cvw = bw
                    cvv = bv
                    for i in range(links):
                        rate = qd[i]
                        spun = first_axis(e2[i], node[i + 1] - node[i], q[i][1]) * rate[0] + e2[i] * rate[1]
                        cvw = cvw + spun
                        cvv = cvv + wp.cross(node[i], spun)
                        taper = ch.taper[i, who]
                        if clear[i] <= margin + taper[0]:
                            closest = real(1e20)
                            for s in range(shapes_from, shapes_to):
                                body = pose_at(tr, bodies.track[s], now)
                                turn_s = bodies.turn[s]
                                touch = Touch()
                                if wp.static(sliced):
                                    f0 = on.found[answer, 0]
                                    f1_ = on.found[answer, 1]
                                    f2_ = on.found[answer, 2]
                                    answer = answer + 1
                                    what = int(f2_[2])
                                    touch.normal = vec3(f0[0], f0[1], f0[2])
                                    touch.gap = f0[3]
                                    touch.end_normal = vec3(f1_[0], f1_[1], f1_[2])
                                    touch.end_gap = f1_[3]
                                    touch.share = f2_[0]
                                    touch.clear = f2_[1]
                                    touch.between = what % 2
                                    touch.end = what // 2
                                    touch.close = int(f2_[3])
                                else:
                                    touch = look_at(
                                        bodies, s, body, node[i] + origin, node[i + 1] + origin, taper, margin, close[i]
                                    )
                                close[i] = touch.close
                                closest = wp.min(closest, touch.clear)
                                for which in range(sides):
                                    offered = touch.between
                                    share = touch.share
                                    gap = touch.gap
                                    way = touch.normal
                                    if which == 1:
                                        offered = touch.end
                                        share = one
                                        gap = touch.end_gap
                                        way = touch.end_normal
                                    if offered == 1 and gap < margin:
                                        deepest = wp.max(deepest, -gap)
                                        normal = rotate(body.turn, rotate(turn_s, way))
                                        radius = taper[0] + (taper[1] - taper[0]) * share
                                        point = node[i] + (node[i + 1] - node[i]) * share - normal * radius
                                        half = pose_at(tr, bodies.track[s], now + real(0.5) * h)
                                        carried = half.velocity + wp.cross(half.spin, point + origin - half.place)
                                        approach = wp.dot(normal, cvv + wp.cross(cvw, point) - carried)
                                        # Where the gap will be: tells apart what only passes by.
                                        ahead = gap + real(1.5) * h * wp.min(approach, zero)
                                        slot = seen
                                        # The same contact seen from two links, or from both ends of a short gap.
                                        for j in range(seen):
                                            apart = wp.length_sq(k_at[j] - point)
                                            same = wp.dot(k_normal[j], normal) > real(0.85)
                                            if same and apart < real(0.0625) * wp.length_sq(node[i + 1] - node[i]):
                                                slot = j
                                        if slot < seen:
                                            if k_ahead[slot] <= ahead:
                                                slot = int(-1)
                                        elif seen < wp.static(most_seen):
                                            seen = seen + 1
                                        else:
                                            slot = int(0)
                                            for j in range(1, wp.static(most_seen)):
                                                if k_ahead[j] > k_ahead[slot]:
                                                    slot = j
                                            if k_ahead[slot] <= ahead:
                                                slot = int(-1)
                                        if slot >= 0:
                                            mu = bodies.friction[s]
                                            if mu < zero:
                                                mu = ch.friction[who]
                                            k_link[slot] = i
                                            k_gap[slot] = gap
                                            k_ahead[slot] = ahead
                                            k_mu[slot] = mu
                                            k_at[slot] = point
                                            k_arc[slot] = taper[2] + taper[3] * share
                                            k_move[slot] = carried
                                            k_normal[slot] = normal
                            clear[i] = closest

                # Up the chain: articulated inertia, bias and what each joint does with them.
                ia = vec6(zero, zero, zero, zero, zero, zero)
                ib = mat33(zero, zero, zero, zero, zero, zero, zero, zero, zero)
                ic = vec6(zero, zero, zero, zero, zero, zero)
                pw = none
                pv = none
                for back in range(links):
                    i = links - 1 - back
                    b4 = ch.build[i, who]
                    i4 = ch.inertia[i, who]
                    at = node[i]
                    xa = (node[i + 1] - at) / b4[0]
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
                    if loads_to > loads_from:
                        for given in range(loads_from, loads_to):
                            if ln.load_link[given] == i and now < ln.load_stop[given]:
                                pull = ln.load_force[given]
                                pw = pw - wp.cross(at + xa * (b4[0] * ln.load_share[given]), pull)
                                pv = pv - pull
                    angle = q[i]
                    s2 = e2[i]
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
                    rate = qd[i]
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
                    k1w[i] = g1w
                    k1v[i] = g1v
                    k2w[i] = g2w
                    k2v[i] = g2v
                    push[i] = vec2(f1, f2)
                    if seen > 0:
                        inverse[i] = vec3(i11, i12, i22)
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
                reaction_w = sym(ia, baw) + ib * bav + pw
                reaction_v = baw * ib + sym(ic, bav) + pv
                # Down again: accelerations without contact.
                worst = zero
                aw = baw
                av = bav
                vw = bw
                vv = bv
                for i in range(links):
                    s1 = first_axis(e2[i], node[i + 1] - node[i], q[i][1])
                    s2 = e2[i]
                    at = node[i]
                    m1 = wp.cross(at, s1)
                    m2 = wp.cross(at, s2)
                    rate = qd[i]
                    jw = s1 * rate[0] + s2 * rate[1]
                    jv = m1 * rate[0] + m2 * rate[1]
                    both = rate[0] * rate[1]
                    aw = aw + wp.cross(vw, jw) + wp.cross(s1, s2) * both
                    av = av + wp.cross(vw, jv) + wp.cross(vv, jw) + (wp.cross(s1, m2) + wp.cross(m1, s2)) * both
                    vw = vw + jw
                    vv = vv + jv
                    f = push[i]
                    a1 = f[0] - wp.dot(k1w[i], aw) - wp.dot(k1v[i], av)
                    a2 = f[1] - wp.dot(k2w[i], aw) - wp.dot(k2v[i], av)
                    aw = aw + s1 * a1 + s2 * a2
                    av = av + m1 * a1 + m2 * a2
                    if seen > 0:
                        push[i] = vec2(a1, a2)
                    else:
                        rate = rate + vec2(a1, a2) * h
                        angle = q[i] + rate * h
                        if opt.quasistatic == 1:
                            rate = vec2(zero, zero)
                        qd[i] = rate
                        q[i] = angle
                        bend = wp.max(wp.abs(angle[0]), wp.abs(angle[1]))
                        # A value that is no number must not slip through a comparison.
                        if not (bend < real(wp.static(LARGEST_BEND))):
                            if status == 0:
                                status = wp.static(BENT)
                                if not (bend < real(1e30)):
                                    status = wp.static(LOST)
                                failed = now + h
                        worst = wp.max(worst, wp.max(bend, wp.max(wp.abs(rate[0]), wp.abs(rate[1]))))
                    for j in range(seen):
                        if k_link[j] == i:
                            # Gravity was added to the base's acceleration; it moves nothing by itself.
                            k_free[j] = vv + av * h + opt.gravity * h + wp.cross(vw + aw * h, k_at[j]) - k_move[j]
                tip_push = av + wp.cross(aw, node[links])

                # Contact where the whisker would close a gap if it moved freely, or was held in the last step; then
                # wherever these contacts press it onto something else.
                more = int(0)
                solved = int(0)
                for j in range(seen):
                    k_taken[j] = int(0)
                    k_ahead[j] = k_gap[j] + h * wp.dot(k_normal[j], k_free[j])
                    if k_ahead[j] < zero:
                        more = int(1)
                for round_ in range(rounds_most):
                    if more == 1:
                        for _ in range(contacts_most):
                            if contacts < wp.static(most_held):
                                slot = int(-1)
                                lowest = zero
                                for j in range(seen):
                                    if k_taken[j] == 0 and k_ahead[j] < lowest:
                                        lowest = k_ahead[j]
                                        slot = j
                                if slot >= 0:
                                    k_taken[slot] = int(1)
                                    i = k_link[slot]
                                    normal = k_normal[slot]
                                    # One tangent along the whisker, where it tends to slide.
                                    along = node[i + 1] - node[i]
                                    tangent = along - normal * wp.dot(along, normal)
                                    if wp.length_sq(tangent) < real(1e-8) * wp.length_sq(along):
                                        tangent = e2[i] - normal * wp.dot(e2[i], normal)
                                    tangent = wp.normalize(tangent)
                                    c_link[contacts] = i
                                    c_arc[contacts] = k_arc[slot]
                                    c_at[contacts] = k_at[slot]
                                    c_mu[contacts] = k_mu[slot]
                                    # A deep overlap is undone over several steps.
                                    c_gap[contacts] = wp.min(-k_gap[slot], real(wp.static(CREVICE))) / h
                                    axis[3 * contacts] = normal
                                    axis[3 * contacts + 1] = tangent
                                    axis[3 * contacts + 2] = wp.cross(normal, tangent)
                                    for d in range(3):
                                        free[3 * contacts + d] = wp.dot(axis[3 * contacts + d], k_free[slot])
                                    contacts = contacts + 1
                        top = int(0)
                        begun = solved
                        solved = contacts
                        for c in range(contacts):
                            top = wp.max(top, c_link[c])
                        rows_used = 3 * contacts
                        # The forces of the last step, then of the last round, are a good first guess.
                        for c in range(begun, contacts):
                            guess = none
                            for e in range(held_count):
                                apart = wp.abs(held_arc[e] - c_arc[c])
                                if apart < real(0.3) * ch.taper[c_link[c], who][3]:
                                    guess = held_force[e]
                            force[3 * c] = wp.max(zero, wp.dot(guess, axis[3 * c]))
                            force[3 * c + 1] = wp.dot(guess, axis[3 * c + 1])
                            force[3 * c + 2] = wp.dot(guess, axis[3 * c + 2])
                        for r in range(rows_used):
                            for e in range(rows_used):
                                comply[r * wp.static(rows) + e] = zero
                        for back in range(top + 1):
                            i = top - back
                            s1 = first_axis(e2[i], node[i + 1] - node[i], q[i][1])
                            s2 = e2[i]
                            m1 = wp.cross(node[i], s1)
                            m2 = wp.cross(node[i], s2)
                            g1w = k1w[i]
                            g1v = k1v[i]
                            g2w = k2w[i]
                            g2v = k2v[i]
                            inv = inverse[i]
                            for r in range(rows_used):
                                link = c_link[r // 3]
                                if link >= i:
                                    if link == i:
                                        fv[r] = axis[r]
                                        fw[r] = wp.cross(c_at[r // 3], axis[r])
                                    u1 = wp.dot(s1, fw[r]) + wp.dot(m1, fv[r])
                                    u2 = wp.dot(s2, fw[r]) + wp.dot(m2, fv[r])
                                    ju[r] = vec2(u1, u2)
                                    w1 = h * (inv[0] * u1 + inv[1] * u2)
                                    w2 = h * (inv[1] * u1 + inv[2] * u2)
                                    for e in range(r + 1):
                                        if c_link[e // 3] >= i:
                                            other = ju[e]
                                            comply[r * wp.static(rows) + e] = (
                                                comply[r * wp.static(rows) + e] + w1 * other[0] + w2 * other[1]
                                            )
                                    fw[r] = fw[r] - g1w * u1 - g2w * u2
                                    fv[r] = fv[r] - g1v * u1 - g2v * u2
                        for r in range(rows_used):
                            for e in range(r):
                                comply[e * wp.static(rows) + r] = comply[r * wp.static(rows) + e]
                        # Forces of rigid contacts with Coulomb friction: projected Gauss-Seidel, one contact at a time.
                        settled = int(0)
                        change = zero
                        moved_force = zero
                        whole_force = zero
                        for sweep in range(sweeps_most):
                            if settled == 0:
                                change = zero
                                moved_force = zero
                                whole_force = zero
                                for c in range(contacts):
                                    r = 3 * c
                                    n0 = force[r]
                                    p0 = force[r + 1]
                                    q0 = force[r + 2]
                                    bn = free[r] - c_gap[c]
                                    b1 = free[r + 1]
                                    b2 = free[r + 2]
                                    for e in range(rows_used):
                                        if e // 3 != c:
                                            bn += comply[r * wp.static(rows) + e] * force[e]
                                            b1 += comply[(r + 1) * wp.static(rows) + e] * force[e]
                                            b2 += comply[(r + 2) * wp.static(rows) + e] * force[e]
                                    nn = comply[r * wp.static(rows) + r]
                                    n1 = comply[r * wp.static(rows) + r + 1]
                                    n2 = comply[r * wp.static(rows) + r + 2]
                                    c11 = comply[(r + 1) * wp.static(rows) + r + 1]
                                    c12 = comply[(r + 1) * wp.static(rows) + r + 2]
                                    c22 = comply[(r + 2) * wp.static(rows) + r + 2]
                                    mu = c_mu[c]
                                    fn = zero
                                    f1 = zero
                                    f2 = zero
                                    if bn < zero:
                                        fn = -bn / nn
                                        if mu > zero:
                                            # Sticking: solve for all three, tangents eliminated first.
                                            det = c11 * c22 - c12 * c12
                                            stuck = int(0)
                                            if det > real(1e-9) * c11 * c22:
                                                tb1 = -(c22 * b1 - c12 * b2) / det
                                                tb2 = -(c11 * b2 - c12 * b1) / det
                                                ta1 = -(c22 * n1 - c12 * n2) / det
                                                ta2 = -(c11 * n2 - c12 * n1) / det
                                                stiff = nn + n1 * ta1 + n2 * ta2
                                                if stiff > real(1e-6) * nn:
                                                    tn = -(bn + n1 * tb1 + n2 * tb2) / stiff
                                                    tf1 = tb1 + ta1 * tn
                                                    tf2 = tb2 + ta2 * tn
                                                    if tn >= zero and tf1 * tf1 + tf2 * tf2 <= mu * mu * tn * tn:
                                                        fn = tn
                                                        f1 = tf1
                                                        f2 = tf2
                                                        stuck = 1
                                            if stuck == 0:
                                                # Sliding: find the direction of slip by a fixed point.
                                                f1 = p0
                                                f2 = q0
                                                pace = one / (c11 + c22)
                                                for _ in range(slip_tries):
                                                    fn = wp.max(zero, -(bn + n1 * f1 + n2 * f2) / nn)
                                                    s1_ = f1 - pace * (b1 + n1 * fn + c11 * f1 + c12 * f2)
                                                    s2_ = f2 - pace * (b2 + n2 * fn + c12 * f1 + c22 * f2)
                                                    size = wp.sqrt(s1_ * s1_ + s2_ * s2_)
                                                    bound = mu * fn
                                                    if size > bound:
                                                        s1_ = s1_ * (bound / size)
                                                        s2_ = s2_ * (bound / size)
                                                    moved_by = wp.abs(f1 - s1_) + wp.abs(f2 - s2_)
                                                    f1 = s1_
                                                    f2 = s2_
                                                    if moved_by <= real(1e-4) * bound:
                                                        break
                                                fn = wp.max(zero, -(bn + n1 * f1 + n2 * f2) / nn)
                                    # Two contacts at one point may leave nothing to divide by.
                                    if not (fn + wp.abs(f1) + wp.abs(f2) < real(1e6)):
                                        fn = zero
                                        f1 = zero
                                        f2 = zero
                                    force[r] = fn
                                    force[r + 1] = f1
                                    force[r + 2] = f2
                                    # By how much (mm) the forces so far miss the gap that they should leave.
                                    missed = bn + nn * n0 + n1 * p0 + n2 * q0
                                    if n0 == zero:
                                        missed = wp.min(missed, zero)
                                    slipped = c11 * wp.abs(f1 - p0) + c22 * wp.abs(f2 - q0)
                                    change = wp.max(change, h * (wp.abs(missed) + slipped))
                                    moved_force += wp.abs(fn - n0) + wp.abs(f1 - p0) + wp.abs(f2 - q0)
                                    whole_force += fn
                                if change <= real(1e-4) or moved_force <= real(1e-4) * whole_force:
                                    settled = 1
                                if settled == 0 and contacts > 1 and sweep % 2 == 1:
                                    # Neighbouring contacts share a load in ways that Gauss-Seidel finds slowly: solve
                                    # for all normal forces at once, those of sliding contacts with their friction.
                                    for c in range(contacts):
                                        stance[c] = int(0)
                                        if force[3 * c] > zero:
                                            stance[c] = int(1)
                                        ratio[2 * c] = zero
                                        ratio[2 * c + 1] = zero
                                        f1 = force[3 * c + 1]
                                        f2 = force[3 * c + 2]
                                        size = wp.sqrt(f1 * f1 + f2 * f2)
                                        if size > zero and size >= real(0.999) * c_mu[c] * force[3 * c]:
                                            ratio[2 * c] = c_mu[c] * f1 / size
                                            ratio[2 * c + 1] = c_mu[c] * f2 / size
                                    for c in range(contacts):
                                        r = 3 * c
                                        rest = c_gap[c] - free[r]
                                        for e in range(contacts):
                                            near_n = comply[r * wp.static(rows) + 3 * e]
                                            near_1 = comply[r * wp.static(rows) + 3 * e + 1]
                                            near_2 = comply[r * wp.static(rows) + 3 * e + 2]
                                            if ratio[2 * e] != zero or ratio[2 * e + 1] != zero:
                                                near_n += near_1 * ratio[2 * e] + near_2 * ratio[2 * e + 1]
                                            else:
                                                rest -= near_1 * force[3 * e + 1] + near_2 * force[3 * e + 2]
                                            square[c * wp.static(most_held) + e] = near_n
                                        asked[c] = rest
                                    agreed = int(0)
                                    for _ in range(guess_tries):
                                        if agreed == 0:
                                            for c in range(contacts):
                                                for e in range(contacts):
                                                    keep = square[c * wp.static(most_held) + e]
                                                    if stance[c] == 0 or stance[e] == 0:
                                                        keep = zero
                                                        if c == e:
                                                            keep = one
                                                    work[c * wp.static(most_held) + e] = keep
                                                load_n[c] = zero
                                                if stance[c] == 1:
                                                    load_n[c] = asked[c]
                                            for p in range(contacts):
                                                for c in range(p + 1, contacts):
                                                    part = (
                                                        work[c * wp.static(most_held) + p]
                                                        / work[p * wp.static(most_held) + p]
                                                    )
                                                    for e in range(p + 1, contacts):
                                                        work[c * wp.static(most_held) + e] = (
                                                            work[c * wp.static(most_held) + e]
                                                            - part * work[p * wp.static(most_held) + e]
                                                        )
                                                    load_n[c] = load_n[c] - part * load_n[p]
                                            for back in range(contacts):
                                                c = contacts - 1 - back
                                                for e in range(c + 1, contacts):
                                                    load_n[c] = (
                                                        load_n[c] - work[c * wp.static(most_held) + e] * load_n[e]
                                                    )
                                                load_n[c] = load_n[c] / work[c * wp.static(most_held) + c]
                                            worst_c = int(-1)
                                            lowest = zero
                                            for c in range(contacts):
                                                if load_n[c] < lowest:
                                                    lowest = load_n[c]
                                                    worst_c = c
                                            if worst_c >= 0:
                                                stance[worst_c] = int(0)
                                            else:
                                                lowest = real(-1e-6) / h
                                                for c in range(contacts):
                                                    if stance[c] == 0:
                                                        opening = -asked[c]
                                                        for e in range(contacts):
                                                            opening += square[c * wp.static(most_held) + e] * load_n[e]
                                                        if opening < lowest:
                                                            lowest = opening
                                                            worst_c = c
                                                if worst_c >= 0:
                                                    stance[worst_c] = int(1)
                                                else:
                                                    agreed = int(1)
                                    for c in range(contacts):
                                        if not (wp.abs(load_n[c]) < real(1e6)):
                                            agreed = int(-1)
                                    if agreed == 1:
                                        for c in range(contacts):
                                            fn = load_n[c]
                                            if ratio[2 * c] != zero or ratio[2 * c + 1] != zero:
                                                force[3 * c + 1] = ratio[2 * c] * fn
                                                force[3 * c + 2] = ratio[2 * c + 1] * fn
                                            else:
                                                f1 = force[3 * c + 1]
                                                f2 = force[3 * c + 2]
                                                size = wp.sqrt(f1 * f1 + f2 * f2)
                                                if size > c_mu[c] * fn:
                                                    force[3 * c + 1] = f1 * (c_mu[c] * fn / size)
                                                    force[3 * c + 2] = f2 * (c_mu[c] * fn / size)
                                            force[3 * c] = fn
                        # Apply them: forces up the chain, then the change of acceleration down.
                        tw = none
                        tv = none
                        for back in range(top + 1):
                            i = top - back
                            for c in range(contacts):
                                if c_link[c] == i:
                                    total = (
                                        axis[3 * c] * force[3 * c]
                                        + axis[3 * c + 1] * force[3 * c + 1]
                                        + axis[3 * c + 2] * force[3 * c + 2]
                                    )
                                    tv = tv + total
                                    tw = tw + wp.cross(c_at[c], total)
                            s1 = first_axis(e2[i], node[i + 1] - node[i], q[i][1])
                            s2 = e2[i]
                            u1 = wp.dot(s1, tw) + wp.dot(wp.cross(node[i], s1), tv)
                            u2 = wp.dot(s2, tw) + wp.dot(wp.cross(node[i], s2), tv)
                            tw = tw - k1w[i] * u1 - k2w[i] * u2
                            tv = tv - k1v[i] * u1 - k2v[i] * u2
                            inv = inverse[i]
                            lift[i] = vec2(inv[0] * u1 + inv[1] * u2, inv[1] * u1 + inv[2] * u2)
                        aw = none
                        av = none
                        more = int(0)
                        for i in range(links):
                            extra = vec2(zero, zero)
                            if i <= top:
                                extra = lift[i]
                            a1 = extra[0] - wp.dot(k1w[i], aw) - wp.dot(k1v[i], av)
                            a2 = extra[1] - wp.dot(k2w[i], aw) - wp.dot(k2v[i], av)
                            s1 = first_axis(e2[i], node[i + 1] - node[i], q[i][1])
                            s2 = e2[i]
                            aw = aw + s1 * a1 + s2 * a2
                            av = av + wp.cross(node[i], s1) * a1 + wp.cross(node[i], s2) * a2
                            mend[i] = vec2(a1, a2)
                            for j in range(seen):
                                if k_link[j] == i and k_taken[j] == 0:
                                    moved = k_free[j] + (av + wp.cross(aw, k_at[j])) * h
                                    k_ahead[j] = k_gap[j] + h * wp.dot(k_normal[j], moved)
                                    if k_ahead[j] < real(-wp.static(CLOSED)):
                                        more = int(1)
                        if more == 1 and (contacts == wp.static(most_held) or round_ == wp.static(ROUNDS - 1)):
                            more = int(0)
                            crowded = crowded + 1
                        if more == 0:
                            if settled == 0 and change > real(1e-2) and moved_force > real(1e-2) * whole_force:
                                unsolved = unsolved + 1
                                miss = miss + moved_force * moved_force
                            load = load + whole_force * whole_force
                            reaction_w = reaction_w - tw
                            reaction_v = reaction_v - tv
                            tip_push = tip_push + av + wp.cross(aw, node[links])
                            for i in range(links):
                                push[i] = push[i] + mend[i]
                held_count = contacts
                for c in range(contacts):
                    held_arc[c] = c_arc[c]
                    held_force[c] = (
                        axis[3 * c] * force[3 * c]
                        + axis[3 * c + 1] * force[3 * c + 1]
                        + axis[3 * c + 2] * force[3 * c + 2]
                    )

                jump = wp.max(h * wp.length(tip_push), real(0.5) * jump)
                touched = int(0)
                arc_sum = zero
                force_sum = zero
                if contacts > 0:
                    for c in range(contacts):
                        if force[3 * c] > zero:
                            touched = 1
                            arc_sum += force[3 * c] * c_arc[c]
                            force_sum += force[3 * c]
                touching += touched
                if pending >= 0:
                    acting = opt.axes * reaction_v * real(-1e-3)
                    turning = opt.axes * reaction_w * real(-1e-6)
                    for d in range(3):
                        out.wrench[row, pending, column, d] = acting[d]
                        out.wrench[row, pending, column, 3 + d] = turning[d]
                    if force_sum > zero:
                        out.contact[row, pending, column] = real(1e-3) * arc_sum / force_sum
                    if opt.shape == 1:
                        for i in range(links + 1):
                            out.points[pending, i, lane] = origin + node[i]
                        pressed = none
                        twisted = none
                        for c in range(contacts):
                            pressed = pressed + held_force[c]
                            twisted = twisted + wp.cross(c_at[c], held_force[c])
                        out.pressed[pending, 0, lane] = pressed * real(1e-3)
                        out.pressed[pending, 1, lane] = twisted * real(1e-6)
                    pending = int(-1)
                steps = steps + 1
                busy = touched
                moved_links = int(0)
                if seen > 0:
                    moved_links = links
                for i in range(moved_links):
                    rate = qd[i] + push[i] * h
                    angle = q[i] + rate * h
                    if opt.quasistatic == 1:
                        rate = vec2(zero, zero)
                    qd[i] = rate
                    q[i] = angle
                    bend = wp.max(wp.abs(angle[0]), wp.abs(angle[1]))
                    # A value that is no number must not slip through a comparison.
                    if not (bend < real(wp.static(LARGEST_BEND))):
                        if status == 0:
                            status = wp.static(BENT)
                            if not (bend < real(1e30)):
                                status = wp.static(LOST)
                            failed = now + h
                    worst = wp.max(worst, wp.max(bend, wp.max(wp.abs(rate[0]), wp.abs(rate[1]))))
                resting = int(0)
                if busy == 0 and worst < real(wp.static(REST)) and may_rest == 1:
                    resting = 1
                    idle = zero
                if status != 0:
                    break
            if paused != 0:
                first_reading = reading
                break
            before = upto
            if opt.quasistatic == 0:
                pending = reading
            if status != 0:
                break
        if wp.static(sliced) and paused != 0:
            on.counts[0, lane] = first_reading
            on.counts[1, lane] = pending
            on.counts[2, lane] = held_count
            on.counts[3, lane] = near
            on.counts[4, lane] = resting
            on.counts[5, lane] = paused
            on.counts[6, lane] = look_first
            on.times[0, lane] = before
            on.times[1, lane] = rest_of_frame
            on.times[2, lane] = idle
            on.times[3, lane] = jump
            on.times[4, lane] = quickest
            for i in range(links):
                on.joints[i, lane] = vec4(q[i][0], q[i][1], qd[i][0], qd[i][1])
                on.ways[i, lane] = vec2(clear[i], real(close[i]))
            for c in range(held_count):
                grip_f = held_force[c]
                on.held[c, lane] = vec4(held_arc[c], grip_f[0], grip_f[1], grip_f[2])
            if paused == 1:
                on.after[wp.atomic_add(on.tally, 0, 1)] = lane
            else:
                on.after[on.after.shape[0] - 1 - wp.atomic_add(on.tally, 1, 1)] = lane
        out.depth[lane] = deepest
        out.status[lane] = status
        out.failed[lane] = failed
        out.steps[lane] = steps
        out.touching[lane] = touching
        out.crowded[lane] = crowded
        out.unsolved[lane] = unsolved
        out.miss[lane] = miss
        out.load[lane] = load

    return SimpleNamespace(
        run=run,
        turn_over=turn_over,
        look_all=look_all,
        Paused=Paused,
        Chains=Chains,
        Bodies=Bodies,
        Lanes=Lanes,
        Options=Options,
        Results=Results,
        Tracks=Tracks,
        vec3=vec3,
        mat33=mat33,
        primitive=primitive,
    )
