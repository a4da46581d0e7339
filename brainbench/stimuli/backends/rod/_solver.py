"""The whisker kernel: one thread takes one whisker from its first reading to its last.

A step is the articulated-body algorithm (Featherstone 2008, chapter 7) in world axes about the base point, made
linearly implicit: joint springs and dampers act at the end of the step, so the joint-space inertia is
D = SᵀAS + h d + h² k and stiffness limits no time step. Contacts are rigid and unilateral: the factorised chain gives
their exact compliance (Delassus) matrix in one more pass, a small Coulomb problem is solved for their forces, and one
pass applies them. A contact takes part before it closes (g + h vₙ ≥ 0, gap g, approach vₙ), so nothing passes through
anything within a step. Everything is O(links). Units: mg, mm, ms, mN, µN·m.
"""

import threading
from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.backends.rod._algebra import algebra
from brainbench.stimuli.backends.rod._contacts import contacts
from brainbench.stimuli.backends.rod._limits import (
    AFTER_GRIP,
    AFTER_LOOK,
    ANYHOW,
    BENT,
    FINEST,
    FOLD,
    GRIP_BOUNDS,
    GROUPS,
    LARGEST_BEND,
    LOOK_BOUNDS,
    LOOKERS,
    LOST,
    MESHES,
    NOTHING,
    REST,
    SPARE,
    STOP,
    TRAVEL,
    WARP,
    WIDEST,
    contacts_for,
)
from brainbench.stimuli.backends.rod._looks import looks
from brainbench.stimuli.backends.rod._shapes import distances
from brainbench.stimuli.backends.rod._structs import structs
from brainbench.stimuli.backends.rod._tracks import tracks

MAKING = threading.Lock()
"""To be held while kernels are made: two threads at once would make their structures twice."""


@cache
def solver(
    real: type,
    capacity: int,
    against: int = MESHES,
    bounds: tuple[int, int] | None = None,
    sliced: bool = False,
    cuda: bool = False,
) -> SimpleNamespace:
    """Return the structures and the kernel for chains of at most ``capacity`` links in one precision.

    Args:
        real: ``warp.float32`` or ``warp.float64``.
        capacity: links that fit; a module is compiled for each.
        against: what there is to touch, :data:`NOTHING`, :data:`PRIMITIVES` or :data:`MESHES`.
        bounds: threads per block and blocks per multiprocessor that the CUDA compiler aims at.
        sliced: whether a whisker pauses wherever it must look at a mesh and wherever contact forces must be found, so
            that both are done for all whiskers by kernels of their own and the threads of a block do alike work;
            results are the same. One shape a scene.
        cuda: compile for a GPU: with approximate divisions and roots, and groups of threads that find contact forces.
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
    Results, Paused, Grips = kinds.Results, kinds.Paused, kinds.Grips
    sym, sym_pair, sine, cosine = maths.sym, maths.sym_pair, maths.sine, maths.cosine
    first_axis, rotate = maths.first_axis, maths.rotate
    Touch, look_at = near_by.Touch, near_by.look_at
    # Threads that look at one link together.
    lookers = LOOKERS if sliced and cuda else 1
    look_together = looks(real, against, lookers).look_at
    Tracks, pose_at = track.Tracks, track.pose_at
    most_held = contacts_for(capacity)
    most_seen = most_held + SPARE
    # Threads of a group: for few contacts, for some and for many. A processor takes them one by one.
    classes: tuple[tuple[int, int], ...] = ((most_held, 1),)
    if sliced and cuda:
        classes = (*GROUPS, (most_held, 8 if most_held <= 8 else 16))
    settle = contacts(real, capacity, most_held, 1).settle
    # Memory of a thread. Vectors and matrices, because arrays in a kernel carry addresses that the compiler loses.
    Links2: Any = wp.types.matrix((capacity, 2), real)
    Links3: Any = wp.types.matrix((capacity, 3), real)
    Nodes3: Any = wp.types.matrix((capacity + 1, 3), real)
    Links: Any = wp.types.vector(capacity, real)
    LinksWhole: Any = wp.types.vector(capacity, wp.int32)
    SeenWhole: Any = wp.types.vector(most_seen, wp.int32)
    Seen: Any = wp.types.vector(most_seen, real)
    Seen3: Any = wp.types.matrix((most_seen, 3), real)

    # Warp's own flags for a processor inline without bound, which is no faster here and takes longer to compile.
    options = {"fast_math": cuda and real is wp.float32, "cpu_compiler_flags": "-march=native"}

    def settle_all(rank: int, held: int, lanes: int) -> Any:
        """Make the kernel that finds contact forces of the whiskers in one queue."""
        settle_group = contacts(real, capacity, held, lanes).settle

        @wp.kernel(enable_backward=False, module="unique", module_options=options, launch_bounds=GRIP_BOUNDS)
        def settle_queue(gp: Grips, on: Paused):
            thread = wp.tid()
            count = on.size[wp.static(3 + rank)]
            which = thread // wp.static(lanes)
            # All threads of a warp go on, or none.
            if (thread // wp.static(WARP)) * wp.static(WARP // lanes) < count:
                live = int(0)
                if which < count:
                    live = int(1)
                lane = on.grips[wp.static(rank), wp.min(which, count - 1)]
                settle_group(gp, lane, thread % wp.static(lanes), live)

        return settle_queue

    @wp.kernel(enable_backward=False, module="unique")
    def turn_over(on: Paused):
        for d in range(7):
            on.size[d] = on.tally[d]
            on.tally[d] = 0

    @wp.kernel(enable_backward=False, module="unique", module_options=options, launch_bounds=LOOK_BOUNDS)
    def look_all(ch: Chains, tr: Tracks, bodies: Bodies, ln: Lanes, on: Paused, threads: int):
        """Answer the looks of all waiting whiskers."""
        thread = wp.tid()
        part = thread % wp.static(lookers)
        place = thread // wp.static(lookers)
        count = wp.min(on.size[6], on.look_lane.shape[0])
        # All threads of a warp go on, or none.
        while place - place % wp.static(WARP // lookers) < count:
            live = int(0)
            if place < count:
                live = 1
            which = wp.min(place, count - 1)
            place = place + threads // wp.static(lookers)
            lane = on.look_lane[which]
            i = on.look_link[which]
            s = bodies.first[ln.scene[lane]]
            body = pose_at(tr, bodies.track[s], on.times[5, lane])
            margin = on.times[6, lane]
            start = on.look_ends[which, 0]
            stop = on.look_ends[which, 1]
            leaf = int(on.ways[i, lane][1])
            taper = ch.taper[i, ln.whisker[lane]]
            touch = look_together(bodies, s, body, start, stop, taper, margin, leaf, part, live)
            if live == 1 and part == 0:
                on.found[which, 0] = vec4(touch.normal[0], touch.normal[1], touch.normal[2], touch.gap)
                on.found[which, 1] = vec4(touch.end_normal[0], touch.end_normal[1], touch.end_normal[2], touch.end_gap)
                what = real(touch.between + 2 * touch.end)
                on.found[which, 2] = vec4(touch.share, touch.clear, what, real(touch.leaf))

    @wp.kernel(enable_backward=False, module="unique", module_options=options, launch_bounds=bounds)
    def run(
        ch: Chains,
        tr: Tracks,
        bodies: Bodies,
        ln: Lanes,
        opt: Options,
        readings: wp.array(dtype=real),
        out: Results,
        gp: Grips,
        on: Paused,
    ):
        lane = wp.tid()
        if wp.static(sliced):
            # Each queue begins with a block of its own.
            place = lane
            lane = int(-1)
            for which_queue in range(3):
                if place >= 0 and lane < 0:
                    many = on.size[which_queue]
                    if place < many:
                        lane = on.queue[which_queue, place]
                    place = place - ((many + wp.static(WARP - 1)) // wp.static(WARP)) * wp.static(WARP)
            if lane < 0:
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
        leaf = LinksWhole()
        until = Links()
        swift = Links()
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
        held_count = int(0)

        near = int(0)
        quickest = zero
        h_last = zero
        # Counts that the compiler does not know keep it from writing loops out.
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
            h_last = on.times[8, lane]
            for i in range(links):
                both4 = on.joints[i, lane]
                q[i] = vec2(both4[0], both4[1])
                qd[i] = vec2(both4[2], both4[3])
                way2 = on.ways[i, lane]
                clear[i] = way2[0]
                leaf[i] = int(way2[1])
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
                idle_before = idle
                idle = real(1e30)
                if object_speed > zero or before == opt.start:
                    pose0 = pose_at(tr, base, before)
                    x = rotate(pose0.turn, vec3(one, zero, zero))
                    y = rotate(pose0.turn, vec3(zero, one, zero))
                    at = pose0.place
                    # Nothing can come near after the last reading.
                    look = object_speed * (readings[readings.shape[0] - 1] - before) + real(0.5)
                    # While at rest, ``clear`` keeps until when nothing can reach a link.
                    fresh = int(0)
                    if idle_before == zero or before == opt.start:
                        fresh = 1
                    asked = int(1)
                    if wp.static(sliced):
                        if waiting != 4:
                            # Ask for these distances like for all others, and wait.
                            nigh_links = int(0)
                            for i in range(links):
                                if fresh == 1 or clear[i] < upto:
                                    nigh_links = nigh_links + 1
                            asked = int(0)
                            paused = 2
                            look_first = wp.atomic_add(on.tally, 6, nigh_links)
                            if look_first + nigh_links <= on.look_lane.shape[0]:
                                asked = int(1)
                                paused = 4
                                on.times[5, lane] = before
                                on.times[6, lane] = -look
                    place = look_first
                    for i in range(links * asked):
                        b4 = ch.build[i, who]
                        turned = x * b4[1] + y * b4[2]
                        y = y * b4[1] - x * b4[2]
                        x = turned
                        ahead_at = at + x * b4[0]
                        until[i] = clear[i]
                        if fresh == 1 or clear[i] < upto:
                            if wp.static(sliced) and paused == 4:
                                on.look_lane[place] = lane
                                on.look_link[place] = i
                                on.look_ends[place, 0] = at
                                on.look_ends[place, 1] = ahead_at
                            else:
                                slack = real(1e30)
                                taper = ch.taper[i, who]
                                if wp.static(sliced):
                                    answer4 = on.found[place, 2]
                                    slack = answer4[1]
                                    leaf[i] = int(answer4[3])
                                else:
                                    for s in range(shapes_from, shapes_to):
                                        body = pose_at(tr, bodies.track[s], before)
                                        touch = look_at(bodies, s, body, at, ahead_at, taper, -look, leaf[i], 0, 1)
                                        slack = wp.min(slack, touch.clear)
                                        leaf[i] = touch.leaf
                                slack = slack - taper[0] - real(0.05)
                                until[i] = real(1e30)
                                if slack <= zero:
                                    until[i] = before
                                elif object_speed > zero:
                                    until[i] = before + slack / (real(1.02) * object_speed)
                            place = place + 1
                        idle = wp.min(idle, until[i])
                        at = ahead_at
                    if wp.static(sliced):
                        if paused != 0:
                            idle = idle_before
                            first_reading = reading
                            break
                        waiting = 0
                    for i in range(links):
                        if upto > idle:
                            # Not at rest any longer: a distance again.
                            bound = zero
                            if until[i] > before:
                                bound = (
                                    (until[i] - before) * real(1.02) * object_speed + ch.taper[i, who][0] + real(0.04)
                                )
                            if fresh == 1:
                                bound = wp.max(bound, clear[i])
                            until[i] = bound
                        clear[i] = until[i]
                if upto <= idle:
                    for i in range(links):
                        q[i] = vec2(zero, zero)
                        qd[i] = vec2(zero, zero)
            if resting == 1 and upto <= idle and rest_of_frame == zero:
                # At rest, and nothing can have come near: the wrench stays zero.
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
                left_whole = left
                left = left - h
                if count == 1:
                    last = 1
                    if opt.quasistatic == 1 and reading < readings.shape[0]:
                        pending = reading
                worst = zero
                seen = int(0)
                solved = int(0)
                origin = none
                reaction_w = none
                reaction_v = none
                tip_push = none
                if wp.static(sliced) and waiting == 3:
                    # The forces of this step have been found meanwhile.
                    waiting = 0
                    rest_of_frame = zero
                    near = on.counts[7, lane]
                    quickest = on.times[7, lane]
                    seen = 1
                    solved = 1
                else:
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
                    speed = wp.length_sq(bv)
                    fastest = speed
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
                        end_speed = wp.length_sq(vv + wp.cross(vw, at))
                        swift[i] = wp.sqrt(wp.max(speed, end_speed))
                        fastest = wp.max(fastest, end_speed)
                        speed = end_speed
                    node[links] = at
                    was_quickest = quickest
                    quickest = wp.sqrt(fastest)
                    # Contacts that may close within this step.
                    travel = h * (quickest + object_speed)
                    margin = wp.min(real(1.5) * travel + h * jump + real(0.001), real(wp.static(WIDEST)))
                    # How far links and objects have come since the last step: its rates at the end are those now.
                    pace = real(1.02) * wp.max(h, h_last)
                    lurch = object_speed
                    if opt.quasistatic == 1:
                        lurch = object_speed + jump
                    was_near = near
                    near = int(0)
                    nigh = int(0)
                    if wp.static(against > NOTHING):
                        for i in range(links):
                            if clear[i] - pace * (swift[i] + lurch) <= margin + ch.taper[i, who][0]:
                                near = 1
                                nigh = nigh + 1
                    if wp.static(sliced):
                        if near == 1 and waiting != 1:
                            # Ask for looks, and wait; when there is no room for more, try again.
                            paused = 2
                            look_first = wp.atomic_add(on.tally, 6, nigh)
                            if look_first + nigh <= on.look_lane.shape[0]:
                                paused = 1
                                asked_for = look_first
                                for i in range(links):
                                    if clear[i] - pace * (swift[i] + lurch) <= margin + ch.taper[i, who][0]:
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
                            clear[i] = clear[i] - pace * (swift[i] + lurch)
                        h_last = h
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
                                        touch.leaf = int(f2_[3])
                                    else:
                                        touch = look_at(
                                            bodies,
                                            s,
                                            body,
                                            node[i] + origin,
                                            node[i + 1] + origin,
                                            taper,
                                            margin,
                                            leaf[i],
                                            0,
                                            1,
                                        )
                                    leaf[i] = touch.leaf
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
                    if wp.static(against > NOTHING) and seen > 0:
                        # Contact where the whisker would close a gap if it moved freely.
                        spot0 = lane * wp.static(most_seen)
                        for j in range(seen):
                            k_ahead[j] = k_gap[j] + h * wp.dot(k_normal[j], k_free[j])
                            if k_ahead[j] < zero:
                                solved = 1
                        if solved == 1:
                            gp.counts[lane, 0] = links
                            gp.counts[lane, 1] = seen
                            gp.counts[lane, 2] = held_count
                            gp.plan[lane] = vec4(h, node[links][0], node[links][1], node[links][2])
                            gp.answer[lane, 0] = reaction_w
                            gp.answer[lane, 1] = reaction_v
                            gp.answer[lane, 2] = tip_push
                            for i in range(links):
                                s1 = first_axis(e2[i], node[i + 1] - node[i], q[i][1])
                                s2 = e2[i]
                                link_row = lane * wp.static(capacity) + i
                                gp.chain[link_row, 0] = s1
                                gp.chain[link_row, 1] = s2
                                gp.chain[link_row, 2] = wp.cross(node[i], s1)
                                gp.chain[link_row, 3] = wp.cross(node[i], s2)
                                gp.chain[link_row, 4] = k1w[i]
                                gp.chain[link_row, 5] = k1v[i]
                                gp.chain[link_row, 6] = k2w[i]
                                gp.chain[link_row, 7] = k2v[i]
                                gp.chain[link_row, 8] = inverse[i]
                                gp.push[lane, i] = push[i]
                            for j in range(seen):
                                i = k_link[j]
                                gp.spot_link[spot0 + j] = i
                                gp.spot_size[spot0 + j] = vec4(k_gap[j], k_arc[j], k_mu[j], ch.taper[i, who][3])
                                gp.spot[spot0 + j, 0] = k_at[j]
                                gp.spot[spot0 + j, 1] = k_normal[j]
                                gp.spot[spot0 + j, 2] = k_free[j]
                                gp.spot[spot0 + j, 3] = node[i + 1] - node[i]
                                gp.ahead[spot0 + j] = k_ahead[j]
                            if wp.static(sliced):
                                paused = 3
                                on.counts[7, lane] = near
                                on.times[7, lane] = quickest
                                near = was_near
                                quickest = was_quickest
                                rest_of_frame = left_whole
                                sort = int(0)
                                if wp.static(len(classes) > 1):
                                    if seen > wp.static(GROUPS[1][0]):
                                        sort = int(2)
                                    elif seen > wp.static(GROUPS[0][0]):
                                        sort = int(1)
                                on.grips[sort, wp.atomic_add(on.tally, 3 + sort, 1)] = lane
                                break
                            else:
                                settle(gp, lane, 0, 1)
                held_count = int(0)
                touched = int(0)
                arc_sum = zero
                force_sum = zero
                if wp.static(against > NOTHING) and solved == 1:
                    held_count = gp.counts[lane, 2]
                    crowded = crowded + gp.counts[lane, 3]
                    unsolved = unsolved + gp.counts[lane, 4]
                    reaction_w = gp.answer[lane, 0]
                    reaction_v = gp.answer[lane, 1]
                    tip_push = gp.answer[lane, 2]
                    missed = gp.answer[lane, 3]
                    miss = miss + missed[0]
                    load = load + missed[1]
                    sums = gp.answer[lane, 4]
                    force_sum = sums[0]
                    arc_sum = sums[1]
                    if force_sum > zero:
                        touched = 1
                    for i in range(links):
                        push[i] = gp.push[lane, i] + gp.mend[lane, i]
                jump = wp.max(h * wp.length(tip_push), real(0.5) * jump)
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
                        out.pressed[pending, 0, lane] = none
                        out.pressed[pending, 1, lane] = none
                        if solved == 1:
                            out.pressed[pending, 0, lane] = gp.answer[lane, 5] * real(1e-3)
                            out.pressed[pending, 1, lane] = gp.answer[lane, 6] * real(1e-6)
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
            on.times[8, lane] = h_last
            for i in range(links):
                on.joints[i, lane] = vec4(q[i][0], q[i][1], qd[i][0], qd[i][1])
                on.ways[i, lane] = vec2(clear[i], real(leaf[i]))
            after = wp.static(AFTER_LOOK)
            if paused == 3:
                after = wp.static(AFTER_GRIP)
            elif paused != 1:
                after = wp.static(ANYHOW)
            on.after[after, wp.atomic_add(on.tally, after, 1)] = lane
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
        loading=threading.Lock(),
        run=run,
        turn_over=turn_over,
        look_all=look_all,
        lookers=lookers,
        settle=[(settle_all(rank, *one), one[1]) for rank, one in enumerate(classes)] if sliced else [],
        Paused=Paused,
        Grips=Grips,
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
