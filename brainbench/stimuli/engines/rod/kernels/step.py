"""Kernel that takes steps: one thread takes one whisker from reading to reading.

A step of length h is the articulated-body algorithm, linearly implicit in the springs (``articulated_body``). Contacts
are rigid and unilateral: the factorised chain gives their exact compliance in one more pass (``delassus``), a small
Coulomb problem is solved for their forces, and one pass applies them (``contact_solver``). Everything is O(links).
Units: mg, mm, ms, mN, µN·m; results are in N, N·m and m.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import AFTERMATH, FINEST, NOTHING, REST

from .algebra import Spatial, vec3
from .articulated_body import (
    ChainState,
    ProximityState,
    articulated_inertia,
    forward_kinematics,
    integrate_follicle,
    integrate_joint,
    joint_accelerations,
    yield_base,
)
from .broad_phase import (
    check_rest,
    count_near_links,
    find_candidates,
    keep,
    lower_clearance,
    next_job,
    query_distances,
    resume,
    search_range,
    stand_in_queue,
)
from .contact_solver import any_gap_closes, queue_problem, read_solution, solve_contacts, write_problem
from .motion import cell_at, elapsed, instant
from .parameters import against, bounds, flows, module_options, real, recorded, sliced, stage, yields
from .state import (
    ENDED,
    WAIT_DISTANCES,
    WAIT_FORCES,
    WAIT_SLICE,
    ChainArrays,
    ContactCandidates,
    ContactProblems,
    Instant,
    JobArrays,
    MotionArrays,
    NearShapes,
    PausedWhiskers,
    ReadingArrays,
    ResultArrays,
    SceneArrays,
    ShapeArrays,
    StepOptions,
    WhiskerJob,
    WhiskerState,
    begin_step,
    row,
    scene_of,
)

if recorded:
    from .recorder.recording import record_accelerations, record_contacts, record_state


@wp.func(inline=True)
def load_job(scene: SceneArrays, index: int) -> WhiskerJob:
    """Return the constants of a job."""
    zero = real(0.0)
    job = WhiskerJob()
    job.index = index
    job.whisker = scene.jobs.whisker[index]
    job.base = scene.jobs.base[index]
    job.links = scene.chains.links[job.whisker]
    job.beta = scene.chains.beta[job.whisker]
    job.longest_step = scene.jobs.step[index]
    job.first_limit = scene.jobs.limit_first[index]
    job.limits = scene.jobs.limit_first[index + 1] - job.first_limit
    place = scene.jobs.scene[index]
    job.first_shape = scene.shapes.first[place]
    # Times 0 in a kernel against nothing: the compiler then drops the loops over shapes.
    job.end_shape = job.first_shape + (scene.shapes.first[place + 1] - job.first_shape) * wp.static(min(against, 1))
    for s in range(job.first_shape, job.end_shape):
        job.object_speed = wp.max(job.object_speed, scene.shapes.speed[s])
    job.first_load = scene.jobs.load_first[index]
    job.end_load = scene.jobs.load_first[index + 1]
    # Rest is skipped, so the base stands still, nothing pulls, and no shape is to be recorded.
    if (
        scene.motions.count[job.base] == 1
        and wp.length_sq(scene.motions.velocity[scene.motions.first[job.base]]) == zero
    ):
        if job.first_load == job.end_load and wp.length_sq(scene.options.gravity) == zero and scene.options.shape == 0:
            job.can_rest = 1
    if wp.static(flows):
        job.can_rest = 0
    return job


@wp.func(inline=True)
def preferred_step(scene: SceneArrays, job: WhiskerJob, state: wp.ref[WhiskerState], now: Instant) -> real:
    """Return the step to take: short enough for the motions, and near an object no point of the whisker moves further
    in it than contacts are sought."""
    wanted = job.longest_step
    if job.limits > 0:
        wanted = wp.min(wanted, scene.jobs.limit[job.first_limit + cell_at(now, job.limits)])
    pace = state.top_speed + state.near_speed
    if state.split_time > real(0.0) and pace * wanted > scene.options.travel:
        wanted = wp.max(wanted / real(wp.static(FINEST)), scene.options.travel / pace)
    return wanted


@wp.func(inline=True)
def write_reading(
    scene: SceneArrays,
    results: ResultArrays,
    problems: ContactProblems,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    reading: int,
    base_wrench: Spatial,
    solved: int,
):
    """Write the wrench on the base and the contact, as of the beginning of the step."""
    index = job.index
    first = scene.jobs.row[index]
    column = scene.jobs.column[index]
    # The wrench found is that of the base on the whisker; reported is the reaction, in N and N·m.
    force = scene.options.axes * base_wrench.v * real(-1e-3)
    moment = scene.options.axes * base_wrench.w * real(-1e-6)
    for d in range(3):
        results.wrench[first, reading, column, d] = force[d]
        results.wrench[first, reading, column, 3 + d] = moment[d]
    if wp.static(against > NOTHING) and solved == 1:
        # Mean arc of the contacts, weighted by their normal forces; mm to m.
        normal_sum = problems.solution[index].normal_sum
        if normal_sum > real(0.0):
            results.contact[first, reading, column] = real(1e-3) * problems.solution[index].arc_sum / normal_sum
    if scene.options.shape == 1:
        for i in range(job.links + 1):
            results.points[reading, i, index] = row(chain.node, i)
        contact = Spatial()
        if solved == 1:
            contact = problems.solution[index].contact
        results.contact_wrench[reading, 0, index] = contact.v * real(1e-3)
        results.contact_wrench[reading, 1, index] = contact.w * real(1e-6)


@wp.kernel(enable_backward=False, module="unique", module_options=module_options(), launch_bounds=bounds)
def run(
    # Model:
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    jobs: JobArrays,
    readings: ReadingArrays,
    options: StepOptions,
    # Data in and out:
    problems: ContactProblems,
    paused: PausedWhiskers,
    # Data out:
    results: ResultArrays,
):
    """Take each whisker to its last reading, or to where it pauses.

    Without slices thread and job have one number and ``problems`` is each thread's room; with slices threads follow the
    queues of ``paused``. A run that is recorded pauses as well, but has no queues.
    """
    index = wp.tid()
    scene = scene_of(chains, motions, shapes, jobs, readings, options)
    if wp.static(sliced):
        index = next_job(paused, index)
        if index < 0:
            return
    zero = real(0.0)
    none = vec3(zero, zero, zero)
    job = load_job(scene, index)
    chain = ChainState()
    proximity = ProximityState()
    near = NearShapes()
    candidates = ContactCandidates()
    state = WhiskerState()
    if wp.static(sliced or recorded):
        state = paused.state[index]
        if wp.static(recorded):
            if state.waiting_for == ENDED:
                return
        if wp.static(stage == 2):
            if state.waiting_for != WAIT_DISTANCES:
                stand_in_queue(paused, index, state)
                return
        resume(paused, index, job.links, chain, proximity)
    first_step = state.steps
    if state.waiting_for == 0:
        state.at_rest = job.can_rest
        # A reading takes the wrench of the step that begins at its time, so one more step follows the last.
        state.pending_reading = int(-1)
    used = int(0)
    wait = int(0)
    first_reading = state.reading
    count_readings = scene.readings.time.shape[0]
    for reading in range(first_reading, count_readings + 1):
        if wp.static(stage == 2):
            # The step is taken.
            if state.waiting_for == 0:
                wait = WAIT_SLICE
                state.reading = reading
                break
        until = instant(state.reading_time.tick, state.reading_time.part + job.longest_step)
        result = int(-1)
        if reading < count_readings:
            until = scene.readings.time[reading]
            result = scene.readings.row[reading]
        span = real(until.tick - state.reading_time.tick) + (until.part - state.reading_time.part)
        if span <= zero:
            # A reading at the very start.
            state.pending_reading = result
            continue
        resting = state.at_rest == 1 and state.time_left == zero
        if wp.static(stage != 2) and resting and elapsed(until) > state.safe_until:
            end = elapsed(scene.readings.time[count_readings - 1])
            wait = check_rest(scene, paused, job, chain, proximity, state, elapsed(until), end)
            if wp.static(sliced):
                if wait != 0:
                    state.reading = reading
                    break
        if resting and elapsed(until) <= state.safe_until:
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
            if wp.static(sliced or recorded):
                state.time_left = left
                # A step for which distances or forces were found meanwhile began in an earlier slice.
                if state.waiting_for != WAIT_DISTANCES and state.waiting_for != WAIT_FORCES:
                    if wp.static(recorded):
                        if used >= paused.budget:
                            wait = WAIT_SLICE
                            break
                        used = used + 1
                    if wp.static(stage == 2):
                        wait = WAIT_SLICE
                        break
            now = instant(until.tick, until.part - left)
            # Equal steps up to the next reading.
            # The thousandth keeps rounding from adding a step.
            steps = wp.max(1, int(wp.ceil(left / preferred_step(scene, job, state, now) - real(1e-3))))
            h = left / real(steps)
            left_whole = left
            left = left - h
            if steps == 1:
                last = 1
                if scene.options.quasistatic == 1:
                    state.pending_reading = result
            state.largest_change = zero
            count = int(0)
            solved = int(0)
            base_wrench = Spatial()
            tip_acceleration = none
            if wp.static(stage == 1) and state.waiting_for == WAIT_FORCES:
                # The forces of this step have been found meanwhile.
                state.waiting_for = 0
                state.time_left = zero
                state.split_time = state.step_split_time
                state.near_speed = state.step_near_speed
                state.top_speed = state.step_top_speed
                count = 1
                solved = 1
            else:
                step = begin_step(scene, job, now, h)
                if wp.static(yields):
                    step = yield_base(job, state, step)
                # A whisker that pauses takes this step again: with these restored, the step has the same length.
                previous_split = state.split_time
                previous_near_speed = state.near_speed
                previous_speed = state.top_speed
                tip = forward_kinematics(scene.chains, job, step.pose, chain, proximity, state)
                if wp.static(against > NOTHING):
                    reach = search_range(scene, job, state, h)
                    near_count = count_near_links(scene, job, proximity, reach)
                    if wp.static(stage == 1):
                        wait = WAIT_DISTANCES
                        if near_count > 0:
                            wait = query_distances(
                                scene, problems, paused, job, chain, proximity, state, reach, step, near_count
                            )
                        state.top_speed = previous_speed
                        break
                    lower_clearance(job, proximity, near, reach)
                    state.closes = 0
                    state.closing_speed = zero
                    if near_count > 0:
                        step.margin = reach.margin
                        count = find_candidates(
                            scene, problems, paused, job, chain, proximity, near, candidates, state, step
                        )
                    state.last_step = h
                if wp.static(sliced or recorded):
                    state.waiting_for = 0
                    state.time_left = zero
                # Steps are split only for what is about to be touched: whatever else stands near changes nothing.
                if wp.static(against > NOTHING):
                    if state.closes == 1 and state.split_time <= zero:
                        if (state.top_speed + state.closing_speed) * h > scene.options.travel:
                            # Too long for what comes: the same step again, split.
                            state.split_time = real(2.0) * job.longest_step
                            state.near_speed = state.closing_speed
                            left = left_whole
                            last = int(0)
                            continue
                    if state.closes == 1:
                        state.split_time = wp.max(state.split_time, real(2.0) * job.longest_step)
                        state.near_speed = wp.max(state.near_speed, state.closing_speed)
                    else:
                        state.split_time = wp.max(state.split_time - h, zero)
                        if state.split_time == zero:
                            state.near_speed = zero
                if wp.static(recorded):
                    if paused.keep == 1:
                        record_state(paused, problems, job, chain, state, state.steps - first_step, now, h)
                base_wrench = articulated_inertia(scene, job, chain, proximity, step, tip, count)
                tip_acceleration = joint_accelerations(scene, job, chain, candidates, state, step, count)
                if wp.static(against > NOTHING) and count > 0:
                    solved = any_gap_closes(candidates, count, h)
                    if solved == 1:
                        problems.given[index].base = base_wrench
                        problems.given[index].tip_acceleration = tip_acceleration
                        write_problem(scene, problems, job, chain, proximity, candidates, state.contacts, h, count)
                        if wp.static(sliced):
                            wait = WAIT_FORCES
                            state.step_split_time = state.split_time
                            state.step_near_speed = state.near_speed
                            state.step_top_speed = state.top_speed
                            state.split_time = previous_split
                            state.near_speed = previous_near_speed
                            state.top_speed = previous_speed
                            state.time_left = left_whole
                            queue_problem(paused, index, count)
                            break
                        else:
                            solve_contacts(problems, index, 0, 1)
                if wp.static(recorded):
                    if paused.keep == 1:
                        candidates.count = count
                        place = state.steps - first_step
                        record_contacts(scene, paused, problems, job, candidates, step, place, solved)
            state.contacts = int(0)
            touched = int(0)
            if wp.static(against > NOTHING and stage != 2) and solved == 1:
                read_solution(problems, job, chain, state)
                base_wrench = problems.solution[index].base
                tip_acceleration = problems.solution[index].tip_acceleration
                if problems.solution[index].normal_sum > zero:
                    touched = 1
                    # A whisker that slips off swings back fast.
                    state.split_time = real(wp.static(AFTERMATH)) * job.longest_step
            # What contact did to the tip's speed, and may do again.
            state.velocity_jump = wp.max(h * wp.length(tip_acceleration), real(0.5) * state.velocity_jump)
            state.touching = state.touching + touched
            if wp.static(yields):
                # A quasi-static reading takes the end of the step.
                if scene.options.quasistatic == 1:
                    integrate_follicle(scene.chains, job, chain, state, h, elapsed(now) + h, 1)
            if state.pending_reading >= 0:
                if wp.static(yields):
                    # In m and rad.
                    first = scene.jobs.row[job.index]
                    column = scene.jobs.column[job.index]
                    for d in range(3):
                        results.displacement[first, state.pending_reading, column, d] = state.slide.v[d] * real(1e-3)
                        results.displacement[first, state.pending_reading, column, 3 + d] = state.slide.w[d]
                write_reading(scene, results, problems, job, chain, state.pending_reading, base_wrench, solved)
                state.pending_reading = int(-1)
            if count > 0:
                for i in range(job.links):
                    integrate_joint(
                        chain, state, i, row(chain.acceleration, i), h, elapsed(now) + h, scene.options.quasistatic
                    )
            if wp.static(yields):
                if scene.options.quasistatic == 0:
                    integrate_follicle(scene.chains, job, chain, state, h, elapsed(now) + h, 0)
            if wp.static(recorded):
                if paused.keep == 1:
                    record_accelerations(paused, job, chain, state.steps - first_step, h)
            state.steps = state.steps + 1
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
        if scene.options.quasistatic == 0:
            state.pending_reading = result
        if state.status != 0:
            break
    if wp.static(sliced):
        if wait != 0:
            state.waiting_for = wait
            keep(paused, index, job.links, chain, proximity, state)
            stand_in_queue(paused, index, state)
    if wp.static(recorded):
        state.waiting_for = ENDED
        paused.ended[index] = 1
        if wait != 0:
            state.waiting_for = wait
            paused.ended[index] = 0
        keep(paused, index, job.links, chain, proximity, state)
    results.state[index] = state
