"""Kernel that takes steps: one thread takes one whisker from reading to reading.

A step of length h is the articulated-body algorithm, linearly implicit in the springs (``articulated_body``). Contacts
are rigid and unilateral: the factorised chain gives their exact compliance in one more pass (``delassus``), a small
Coulomb problem is solved for their forces, and one pass applies them (``contact_solver``). Everything is O(links).
Units: mg, mm, ms, mN, µN·m; results are in N, N·m and m.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import FINEST, NOTHING, REST, TRAVEL

from .algebra import SpatialAcceleration, Twist, Wrench, vec3
from .articulated_body import (
    ChainState,
    ProximityState,
    articulated_inertia,
    forward_kinematics,
    integrate_joint,
    joint_accelerations,
)
from .broad_phase import count_near_links, find_candidates, lower_clearance, query_distances, search_range
from .contact_problem import any_gap_closes, queue_problem, read_solution, write_problem
from .contact_solver import solve_contacts
from .motion import pose_at
from .parameters import against, bounds, module_options, real, sliced
from .scheduling import next_job, pause, resume
from .sleeping import check_rest
from .state import (
    WAIT_DISTANCES,
    WAIT_FORCES,
    WAIT_SLICE,
    ChainArrays,
    ContactCandidates,
    ContactProblems,
    JobArrays,
    MotionArrays,
    PausedWhiskers,
    ResultArrays,
    ShapeArrays,
    StepOptions,
    WhiskerJob,
    WhiskerState,
    row,
)


@wp.func(inline=True)
def load_job(
    chains: ChainArrays, motions: MotionArrays, shapes: ShapeArrays, jobs: JobArrays, options: StepOptions, index: int
) -> WhiskerJob:
    """Return the constants of a job."""
    zero = real(0.0)
    job = WhiskerJob()
    job.index = index
    job.whisker = jobs.whisker[index]
    job.base = jobs.base[index]
    job.links = chains.links[job.whisker]
    job.beta = chains.beta[job.whisker]
    job.longest_step = jobs.step[index]
    scene = jobs.scene[index]
    job.first_shape = shapes.first[scene]
    # Times 0 in a kernel against nothing: the compiler then drops the loops over shapes.
    job.end_shape = job.first_shape + (shapes.first[scene + 1] - job.first_shape) * wp.static(min(against, 1))
    for s in range(job.first_shape, job.end_shape):
        job.object_speed = wp.max(job.object_speed, shapes.speed[s])
    job.first_load = jobs.load_first[index]
    job.end_load = jobs.load_first[index + 1]
    # Rest is skipped, so the base stands still, nothing pulls, and no shape is to be recorded.
    if motions.count[job.base] == 1 and wp.length_sq(motions.velocity[motions.first[job.base]]) == zero:
        if job.first_load == job.end_load and wp.length_sq(options.gravity) == zero and options.shape == 0:
            job.can_rest = 1
    return job


@wp.func(inline=True)
def preferred_step(job: WhiskerJob, state: wp.ref[WhiskerState]) -> real:
    """Return the step to take: near an object, no point of the whisker moves further in it than contacts are sought."""
    wanted = job.longest_step
    pace = state.top_speed + job.object_speed
    if state.is_near == 1 and pace * job.longest_step > real(wp.static(TRAVEL)):
        wanted = wp.max(job.longest_step / real(wp.static(FINEST)), real(wp.static(TRAVEL)) / pace)
    return wanted


@wp.func(inline=True)
def write_reading(
    results: ResultArrays,
    jobs: JobArrays,
    options: StepOptions,
    problems: ContactProblems,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    reading: int,
    origin: vec3,
    base_wrench: Wrench,
    force_sum: real,
    arc_sum: real,
    solved: int,
):
    """Write the wrench on the base and the contact, as of the beginning of the step."""
    none = vec3(real(0.0), real(0.0), real(0.0))
    index = job.index
    first = jobs.row[index]
    column = jobs.column[index]
    # The wrench found is that of the base on the whisker; reported is the reaction, in N and N·m.
    acting = options.axes * base_wrench.force * real(-1e-3)
    turning = options.axes * base_wrench.moment * real(-1e-6)
    for d in range(3):
        results.wrench[first, reading, column, d] = acting[d]
        results.wrench[first, reading, column, 3 + d] = turning[d]
    # Mean arc of the contacts, weighted by their normal forces; mm to m.
    if force_sum > real(0.0):
        results.contact[first, reading, column] = real(1e-3) * arc_sum / force_sum
    if options.shape == 1:
        for i in range(job.links + 1):
            results.points[reading, i, index] = origin + row(chain.node, i)
        results.contact_wrench[reading, 0, index] = none
        results.contact_wrench[reading, 1, index] = none
        if solved == 1:
            results.contact_wrench[reading, 0, index] = problems.solution[index].contact_force * real(1e-3)
            results.contact_wrench[reading, 1, index] = problems.solution[index].contact_moment * real(1e-6)


@wp.kernel(enable_backward=False, module="unique", module_options=module_options(), launch_bounds=bounds)
def run(
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    jobs: JobArrays,
    options: StepOptions,
    readings: wp.array(dtype=real),
    results: ResultArrays,
    problems: ContactProblems,
    paused: PausedWhiskers,
):
    """Take each whisker to its last reading, or to where it pauses.

    Without slices thread and job have one number and ``problems`` is each thread's room; with slices threads follow the
    queues of ``paused``. ``readings`` are times (ms), ascending.
    """
    index = wp.tid()
    if wp.static(sliced):
        index = next_job(paused, index)
        if index < 0:
            return
    zero = real(0.0)
    none = vec3(zero, zero, zero)
    job = load_job(chains, motions, shapes, jobs, options, index)
    chain = ChainState()
    proximity = ProximityState()
    candidates = ContactCandidates()
    state = WhiskerState()
    if wp.static(sliced):
        state = paused.state[index]
        resume(paused, index, job.links, chain, proximity)
    if state.waiting_for == 0:
        state.reading_time = options.start
        state.safe_until = options.start
        state.at_rest = job.can_rest
        # A reading takes the wrench of the step that begins at its time, so one more step follows the last.
        state.pending_reading = int(-1)
    used = int(0)
    wait = int(0)
    first_reading = state.reading
    for reading in range(first_reading, readings.shape[0] + 1):
        until = state.reading_time + job.longest_step
        if reading < readings.shape[0]:
            until = readings[reading]
        span = until - state.reading_time
        if span <= zero:
            # A reading at the very start.
            state.pending_reading = reading
            continue
        if state.at_rest == 1 and until > state.safe_until and state.time_left == zero:
            end = readings[readings.shape[0] - 1]
            wait = check_rest(chains, motions, shapes, job, paused, chain, proximity, state, options.start, until, end)
            if wp.static(sliced):
                if wait != 0:
                    state.reading = reading
                    break
        if state.at_rest == 1 and until <= state.safe_until and state.time_left == zero:
            # At rest, and nothing can have come near: the wrench stays zero.
            state.reading_time = until
            state.pending_reading = int(-1)
            continue
        left = span
        if state.time_left > zero:
            left = state.time_left
            state.time_left = zero
        last = int(0)
        while last == 0:
            if wp.static(sliced):
                state.time_left = left
                if used >= paused.budget:
                    wait = WAIT_SLICE
                    break
                used = used + 1
            now = until - left
            # Equal steps up to the next reading.
            # The thousandth keeps rounding from adding a step.
            steps = wp.max(1, int(wp.ceil(left / preferred_step(job, state) - real(1e-3))))
            h = left / real(steps)
            left_whole = left
            left = left - h
            if steps == 1:
                last = 1
                if options.quasistatic == 1 and reading < readings.shape[0]:
                    state.pending_reading = reading
            state.largest_change = zero
            count = int(0)
            solved = int(0)
            origin = none
            base_wrench = Wrench()
            tip_acceleration = none
            if wp.static(sliced) and state.waiting_for == WAIT_FORCES:
                # The forces of this step have been found meanwhile.
                state.waiting_for = 0
                state.time_left = zero
                state.is_near = state.step_is_near
                state.top_speed = state.step_top_speed
                count = 1
                solved = 1
            else:
                pose = pose_at(motions, job.base, now)
                later = pose_at(motions, job.base, now + h)
                origin = pose.place
                moving = Twist()
                moving.angular = pose.spin
                moving.linear = pose.velocity
                # The base moves as its track does within the step; gravity is an acceleration of the base.
                # Spatial acceleration is the rate of the twist at a fixed point: v̇ − ω × v (Featherstone 2008, chapter
                # 2).
                base = SpatialAcceleration()
                base.angular = (later.spin - moving.angular) / h
                base.linear = (
                    (later.velocity - moving.linear) / h - wp.cross(moving.angular, moving.linear) - options.gravity
                )
                # A whisker that pauses takes this step again: with these restored, the step has the same length.
                previously_near = state.is_near
                previous_speed = state.top_speed
                tip = forward_kinematics(chains, job, pose, chain, proximity, state)
                state.is_near = 0
                if wp.static(against > NOTHING):
                    reach = search_range(job, options, state, h)
                    near_count = count_near_links(chains, job, proximity, reach)
                    state.is_near = wp.min(near_count, 1)
                    if wp.static(sliced):
                        if near_count > 0 and state.waiting_for != WAIT_DISTANCES:
                            wait = query_distances(
                                chains, job, paused, chain, proximity, state, reach, origin, now, near_count
                            )
                            state.is_near = previously_near
                            state.top_speed = previous_speed
                            break
                    lower_clearance(job, proximity, reach)
                    state.last_step = h
                    if near_count > 0:
                        count = find_candidates(
                            chains, motions, shapes, job, paused, chain, proximity, candidates, state, pose,
                            reach.margin, now, h
                        )  # fmt: skip
                if wp.static(sliced):
                    state.waiting_for = 0
                    state.time_left = zero
                base_wrench = articulated_inertia(chains, jobs, job, chain, proximity, tip, base, now, h, count)
                tip_acceleration = joint_accelerations(
                    job, options, chain, candidates, state, moving, base, now, h, count
                )
                if wp.static(against > NOTHING) and count > 0:
                    solved = any_gap_closes(candidates, count, h)
                    if solved == 1:
                        write_problem(
                            problems, chains, job, chain, proximity, candidates, state, base_wrench, tip_acceleration,
                            h, count
                        )  # fmt: skip
                        if wp.static(sliced):
                            wait = WAIT_FORCES
                            state.step_is_near = state.is_near
                            state.step_top_speed = state.top_speed
                            state.is_near = previously_near
                            state.top_speed = previous_speed
                            state.time_left = left_whole
                            queue_problem(paused, index, count)
                            break
                        else:
                            solve_contacts(problems, index, 0, 1)
            state.contacts = int(0)
            touched = int(0)
            arc_sum = zero
            force_sum = zero
            if wp.static(against > NOTHING) and solved == 1:
                read_solution(problems, job, chain, state)
                base_wrench.moment = problems.solution[index].base_moment
                base_wrench.force = problems.solution[index].base_force
                tip_acceleration = problems.solution[index].tip_acceleration
                force_sum = problems.solution[index].normal_sum
                arc_sum = problems.solution[index].arc_sum
                if force_sum > zero:
                    touched = 1
            # What contact did to the tip's speed, and may do again.
            state.velocity_jump = wp.max(h * wp.length(tip_acceleration), real(0.5) * state.velocity_jump)
            state.touching = state.touching + touched
            if state.pending_reading >= 0:
                write_reading(
                    results, jobs, options, problems, job, chain, state.pending_reading, origin, base_wrench,
                    force_sum, arc_sum, solved
                )  # fmt: skip
                state.pending_reading = int(-1)
            state.steps = state.steps + 1
            if count > 0:
                for i in range(job.links):
                    integrate_joint(chain, state, i, row(chain.acceleration, i), h, now + h, options.quasistatic)
            state.at_rest = int(0)
            if touched == 0 and state.largest_change < real(wp.static(REST)) and job.can_rest == 1:
                state.at_rest = 1
                state.safe_until = zero
            if state.status != 0:
                break
        if wait != 0:
            state.reading = reading
            break
        state.reading_time = until
        if options.quasistatic == 0:
            state.pending_reading = reading
        if state.status != 0:
            break
    if wp.static(sliced):
        if wait != 0:
            state.waiting_for = wait
            pause(paused, index, job.links, chain, proximity, state)
    results.depth[index] = state.depth
    results.status[index] = state.status
    results.failed[index] = state.failed_at
    results.steps[index] = state.steps
    results.touching[index] = state.touching
    results.crowded[index] = state.crowded
    results.unsolved[index] = state.unsolved
    results.miss[index] = state.miss
    results.load[index] = state.load
