"""The whisker kernel: one thread takes one whisker from its first reading to its last.

A step is the articulated-body algorithm (:mod:`._passes`), made linearly implicit: joint springs and dampers act at
the end of the step, so the joint-space inertia is D = SᵀAS + h d + h² k and stiffness limits no time step. Contacts
are rigid and unilateral: the factorised chain gives their exact compliance (Delassus) matrix in one more pass, a small
Coulomb problem is solved for their forces, and one pass applies them (:mod:`._contacts`). A contact takes part before
it closes (g + h vₙ ≥ 0, gap g, approach vₙ; :mod:`._candidates`), so nothing passes through anything within a step.
Everything is O(links). Units: mg, mm, ms, mN, µN·m.
"""

import threading
from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.kernels.articulated_body import passes
from brainbench.stimuli.engines.rod.kernels.broad_phase import candidates
from brainbench.stimuli.engines.rod.kernels.contact_problem import problems
from brainbench.stimuli.engines.rod.kernels.contacts import contacts
from brainbench.stimuli.engines.rod.kernels.distances import distances
from brainbench.stimuli.engines.rod.kernels.inputs import structs
from brainbench.stimuli.engines.rod.kernels.motion import tracks
from brainbench.stimuli.engines.rod.kernels.pausing import pauses
from brainbench.stimuli.engines.rod.kernels.queues import queues
from brainbench.stimuli.engines.rod.kernels.sleeping import look_ahead_of
from brainbench.stimuli.engines.rod.kernels.state import memory
from brainbench.stimuli.engines.rod.limits import FINEST, GROUPS, MESHES, NOTHING, REST, TRAVEL, contacts_for

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
    """Return the structures and the kernels for chains of at most ``capacity`` links in one precision.

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

    vec3: Any = wp.types.vector(3, real)
    mat33: Any = wp.types.matrix((3, 3), real)
    kinds, track, kept = structs(real), tracks(real), memory(real, capacity)
    Chains, Bodies, Lanes, Options = kinds.Chains, kinds.Bodies, kinds.Lanes, kinds.Options
    Results, Paused, Grips = kinds.Results, kinds.Paused, kinds.Grips
    Tracks, pose_at = track.Tracks, track.pose_at
    Links, Watch, Spots, Lane, State = kept.Links, kept.Watch, kept.Spots, kept.Lane, kept.State
    Twist, row = kept.Twist, kept.row
    most_held = contacts_for(capacity)
    # Threads of a group: for few contacts, for some and for many. A processor takes them one by one.
    classes: tuple[tuple[int, int], ...] = ((most_held, 1),)
    if sliced and cuda:
        classes = (*GROUPS, (most_held, 8 if most_held <= 8 else 16))
    fast_math = cuda and real is wp.float32
    # Warp's own flags for a processor inline without bound, which is no faster here and takes longer to compile.
    options = {"fast_math": fast_math, "cpu_compiler_flags": "-march=native"}
    chain, near_by = passes(real, capacity), candidates(real, capacity, against, sliced)
    place, articulate, accelerate, advance = chain.place, chain.articulate, chain.accelerate, chain.advance
    sight, nearby, ask, gather = near_by.sight, near_by.nearby, near_by.ask, near_by.gather
    pause, problem = pauses(real, capacity), problems(real, capacity, len(classes))
    next_lane, wake, sleep = pause.next_lane, pause.wake, pause.sleep
    closing, state_problem, queue_problem = problem.closing, problem.state_problem, problem.queue_problem
    take_answer, look_ahead = problem.take_answer, look_ahead_of(real, capacity, against, sliced)
    settle = contacts(real, capacity, most_held, 1).settle

    @wp.func(inline=True)
    def lane_of(ch: Chains, tr: Tracks, bodies: Bodies, ln: Lanes, opt: Options, lane: int) -> Lane:
        zero = real(0.0)
        me = Lane()
        me.lane = lane
        me.whisker = ln.whisker[lane]
        me.base = ln.base[lane]
        me.links = ch.links[me.whisker]
        me.beta = ch.beta[me.whisker]
        me.longest = ln.step[lane]
        scene = ln.scene[lane]
        me.shapes_from = bodies.first[scene]
        me.shapes_to = me.shapes_from + (bodies.first[scene + 1] - me.shapes_from) * wp.static(min(against, 1))
        for s in range(me.shapes_from, me.shapes_to):
            me.speed = wp.max(me.speed, bodies.speed[s])
        me.loads_from = ln.load_first[lane]
        me.loads_to = ln.load_first[lane + 1]
        if tr.count[me.base] == 1 and wp.length_sq(tr.velocity[tr.first[me.base]]) == zero:
            if me.loads_from == me.loads_to and wp.length_sq(opt.gravity) == zero and opt.shape == 0:
                me.may_rest = 1
        return me

    @wp.func(inline=True)
    def step_wanted(me: Lane, state: wp.ref[State]) -> real:
        """Where something is near, a step moves no point of the whisker further than a contact search looks."""
        wanted = me.longest
        pace = state.quickest + me.speed
        if state.near == 1 and pace * me.longest > real(wp.static(TRAVEL)):
            wanted = wp.max(me.longest / real(wp.static(FINEST)), real(wp.static(TRAVEL)) / pace)
        return wanted

    @wp.func(inline=True)
    def write_reading(
        out: Results,
        ln: Lanes,
        opt: Options,
        gp: Grips,
        me: Lane,
        mem: wp.ref[Links],
        reading: int,
        origin: vec3,
        felt: Twist,
        force_sum: real,
        arc_sum: real,
        solved: int,
    ):
        """Write the action on the base and what there is of contact, as of the beginning of the step."""
        none = vec3(real(0.0), real(0.0), real(0.0))
        lane = me.lane
        first = ln.row[lane]
        column = ln.column[lane]
        acting = opt.axes * felt.v * real(-1e-3)
        turning = opt.axes * felt.w * real(-1e-6)
        for d in range(3):
            out.wrench[first, reading, column, d] = acting[d]
            out.wrench[first, reading, column, 3 + d] = turning[d]
        if force_sum > real(0.0):
            out.contact[first, reading, column] = real(1e-3) * arc_sum / force_sum
        if opt.shape == 1:
            for i in range(me.links + 1):
                out.points[reading, i, lane] = origin + row(mem.node, i)
            out.pressed[reading, 0, lane] = none
            out.pressed[reading, 1, lane] = none
            if solved == 1:
                out.pressed[reading, 0, lane] = gp.answer[lane, 5] * real(1e-3)
                out.pressed[reading, 1, lane] = gp.answer[lane, 6] * real(1e-6)

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
            lane = next_lane(on, lane)
            if lane < 0:
                return
        zero = real(0.0)
        none = vec3(zero, zero, zero)
        me = lane_of(ch, tr, bodies, ln, opt, lane)
        mem = Links()
        watch = Watch()
        spots = Spots()
        state = State()
        state.depth = out.depth[lane]
        state.steps = out.steps[lane]
        state.touching = out.touching[lane]
        state.crowded = out.crowded[lane]
        state.unsolved = out.unsolved[lane]
        state.miss = out.miss[lane]
        state.load = out.load[lane]
        state.before = opt.start
        state.idle = opt.start
        state.resting = me.may_rest
        # A reading takes the wrench of the step that begins at its time, so one more step follows the last.
        state.pending = int(-1)
        used = int(0)
        if wp.static(sliced):
            wake(on, lane, me.links, mem, watch, state)
        wait = int(0)
        first_reading = state.reading
        for reading in range(first_reading, readings.shape[0] + 1):
            upto = state.before + me.longest
            if reading < readings.shape[0]:
                upto = readings[reading]
            span = upto - state.before
            if span <= zero:
                # A reading at the very start.
                state.pending = reading
                continue
            if state.resting == 1 and upto > state.idle and state.left == zero:
                end = readings[readings.shape[0] - 1]
                wait = look_ahead(ch, tr, bodies, me, on, mem, watch, state, opt.start, upto, end)
                if wp.static(sliced):
                    if wait != 0:
                        state.reading = reading
                        break
            if state.resting == 1 and upto <= state.idle and state.left == zero:
                # At rest, and nothing can have come near: the wrench stays zero.
                state.before = upto
                state.pending = int(-1)
                continue
            left = span
            if state.left > zero:
                left = state.left
                state.left = zero
            last = int(0)
            while last == 0:
                if wp.static(sliced):
                    state.left = left
                    if used >= on.budget:
                        wait = 2
                        break
                    used = used + 1
                now = upto - left
                count = wp.max(1, int(wp.ceil(left / step_wanted(me, state) - real(1e-3))))
                h = left / real(count)
                left_whole = left
                left = left - h
                if count == 1:
                    last = 1
                    if opt.quasistatic == 1 and reading < readings.shape[0]:
                        state.pending = reading
                state.worst = zero
                seen = int(0)
                solved = int(0)
                origin = none
                felt = Twist()
                tip_push = none
                if wp.static(sliced) and state.waiting == 3:
                    # The forces of this step have been found meanwhile.
                    state.waiting = 0
                    state.left = zero
                    state.near = on.counts[7, lane]
                    state.quickest = on.times[7, lane]
                    seen = 1
                    solved = 1
                else:
                    pose = pose_at(tr, me.base, now)
                    later = pose_at(tr, me.base, now + h)
                    origin = pose.place
                    moving = Twist()
                    moving.w = pose.spin
                    moving.v = pose.velocity
                    base = Twist()
                    base.w = (later.spin - moving.w) / h
                    base.v = (later.velocity - moving.v) / h - wp.cross(moving.w, moving.v) - opt.gravity
                    was_near = state.near
                    was_quickest = state.quickest
                    tip = place(ch, me, pose, mem, watch, state)
                    state.near = 0
                    if wp.static(against > NOTHING):
                        here = sight(me, opt, state, h)
                        nigh = nearby(ch, me, watch, here)
                        state.near = wp.min(nigh, 1)
                        if wp.static(sliced):
                            if nigh > 0 and state.waiting != 1:
                                wait = ask(ch, me, on, mem, watch, state, here, origin, now, nigh)
                                state.near = was_near
                                state.quickest = was_quickest
                                break
                        for i in range(me.links):
                            watch.clear[i] = row(watch.clear, i) - here.pace * (row(watch.swift, i) + here.lurch)
                        state.h_last = h
                        if nigh > 0:
                            seen = gather(ch, tr, bodies, me, on, mem, watch, spots, state, pose, here.margin, now, h)
                    if wp.static(sliced):
                        state.waiting = 0
                        state.left = zero
                    felt = articulate(ch, ln, me, mem, watch, tip, base, now, h, seen)
                    tip_push = accelerate(me, opt, mem, spots, state, moving, base, now, h, seen)
                    if wp.static(against > NOTHING) and seen > 0:
                        solved = closing(spots, seen, h)
                        if solved == 1:
                            state_problem(gp, ch, me, mem, watch, spots, state, felt, tip_push, h, seen)
                            if wp.static(sliced):
                                wait = 3
                                on.counts[7, lane] = state.near
                                on.times[7, lane] = state.quickest
                                state.near = was_near
                                state.quickest = was_quickest
                                state.left = left_whole
                                queue_problem(on, lane, seen)
                                break
                            else:
                                settle(gp, lane, 0, 1)
                state.held = int(0)
                touched = int(0)
                arc_sum = zero
                force_sum = zero
                if wp.static(against > NOTHING) and solved == 1:
                    take_answer(gp, me, mem, state)
                    felt.w = gp.answer[lane, 0]
                    felt.v = gp.answer[lane, 1]
                    tip_push = gp.answer[lane, 2]
                    sums = gp.answer[lane, 4]
                    force_sum = sums[0]
                    arc_sum = sums[1]
                    if force_sum > zero:
                        touched = 1
                state.jump = wp.max(h * wp.length(tip_push), real(0.5) * state.jump)
                state.touching = state.touching + touched
                if state.pending >= 0:
                    write_reading(out, ln, opt, gp, me, mem, state.pending, origin, felt, force_sum, arc_sum, solved)
                    state.pending = int(-1)
                state.steps = state.steps + 1
                if seen > 0:
                    for i in range(me.links):
                        advance(mem, state, i, row(mem.push, i), h, now + h, opt.quasistatic)
                state.resting = int(0)
                if touched == 0 and state.worst < real(wp.static(REST)) and me.may_rest == 1:
                    state.resting = 1
                    state.idle = zero
                if state.status != 0:
                    break
            if wait != 0:
                state.reading = reading
                break
            state.before = upto
            if opt.quasistatic == 0:
                state.pending = reading
            if state.status != 0:
                break
        if wp.static(sliced):
            if wait != 0:
                sleep(on, lane, me.links, mem, watch, state, wait)
        out.depth[lane] = state.depth
        out.status[lane] = state.status
        out.failed[lane] = state.failed
        out.steps[lane] = state.steps
        out.touching[lane] = state.touching
        out.crowded[lane] = state.crowded
        out.unsolved[lane] = state.unsolved
        out.miss[lane] = state.miss
        out.load[lane] = state.load

    further = queues(real, capacity, against, classes if sliced else (), sliced and cuda, fast_math)
    return SimpleNamespace(
        loading=threading.Lock(),
        run=run,
        turn_over=further.turn_over,
        look_all=further.look_all,
        lookers=further.lookers,
        settle=further.settle,
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
        primitive=distances(real).primitive,
    )
