"""Forces of rigid, unilateral contacts with Coulomb friction.

For the forces f of all contacts, with the Delassus matrix G and the rates b without forces, the rate v = Gf + b obeys
at each contact 0 ≤ fₙ ⊥ vₙ + g/h ≥ 0 (Signorini; g the gap, h the step) and |fₜ| ≤ μfₙ, with fₜ against the slip vₜ
where it slides. Projected block Gauss-Seidel finds the forces (Jourdan, Alart & Jean 1998, Comput. Methods Appl. Mech.
Eng. 155); after every other sweep all normal forces are solved for at once by an active set, because neighbouring
contacts share a load in ways that single contacts find slowly.

A group of threads takes one whisker, each thread one contact; the others learn of its forces by broadcast. Groups of a
GPU warp stay together: what one has finished it repeats without keeping it. On a processor one thread has all contacts;
the source is the same. Forces in mN, compliance in mm/ms per mN.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import CONTACT_BOUNDS, CONTACT_ROUNDS, GROUPS, LARGEST_FORCE, STEADY, WARP

from .algebra import spatial, vec3, vec4, vec6
from .articulated_body import ChainState, ProximityState, joint_record
from .delassus import (
    DelassusRows,
    NormalMatrix,
    PerContact1,
    SolverState,
    ThreadContacts,
    add_rates,
    apply_forces,
    build_delassus,
    contact_force,
    own_contacts,
    own_rows,
    row,
    select_contacts,
    stride,
)
from .parameters import capacity, cuda, group_size, max_contacts, module_options, queue, real, recorded, smooth, yields
from .state import (
    ContactCandidates,
    ContactProblems,
    PausedWhiskers,
    PerLinkJoint,
    SceneArrays,
    WhiskerJob,
    WhiskerState,
    most_candidates,
)
from .state import row as chain_row
from .thread_groups import broadcast, group_max, group_or, group_sum, warp_max


@wp.func(inline=True)
def any_gap_closes(candidates: wp.ref[ContactCandidates], count: int, h: real) -> int:
    """Predict the gap of each candidate without contact forces, g + h vₙ; return 1 if any is negative."""
    any_one = int(0)
    for j in range(count):
        predicted = chain_row(candidates.gap, j) + h * wp.dot(
            chain_row(candidates.normal, j), chain_row(candidates.free_velocity, j)
        )
        candidates.predicted_gap[j] = predicted
        if predicted < real(0.0):
            any_one = 1
    return any_one


@wp.func(inline=True)
def write_problem(
    scene: SceneArrays,
    problems: ContactProblems,
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    candidates: wp.ref[ContactCandidates],
    previous_contacts: int,
    h: real,
    count: int,
):
    """Write the factorised chain and its candidates where the solver reads them."""
    index = job.index
    problems.given[index].links = job.links
    problems.given[index].candidates = count
    problems.given[index].contacts = previous_contacts
    problems.given[index].step = h
    problems.given[index].tip = chain_row(chain.node, job.links)
    if wp.static(yields):
        problems.given[index].axes = chain.axes
        problems.given[index].inertia = chain.inertia
        problems.given[index].compliance = chain.compliance
        problems.given[index].yielding = chain.yielding
    for i in range(job.links):
        problems.joint[index * wp.static(capacity) + i] = joint_record(chain, proximity, i)
        problems.free_acceleration[index, i] = chain_row(chain.acceleration, i)
    for j in range(count):
        i = chain_row(candidates.link, j)
        place = index * wp.static(most_candidates) + j
        problems.candidate_link[place] = i
        problems.candidate[place].gap = chain_row(candidates.gap, j)
        problems.candidate[place].arc = chain_row(candidates.arc, j)
        problems.candidate[place].friction = chain_row(candidates.friction, j)
        problems.candidate[place].link_arc = scene.chains.taper[i, job.whisker].arc_length
        problems.candidate[place].point = chain_row(candidates.point, j)
        problems.candidate[place].normal = chain_row(candidates.normal, j)
        problems.candidate[place].free_velocity = chain_row(candidates.free_velocity, j)
        problems.candidate[place].along = chain_row(chain.node, i + 1) - chain_row(chain.node, i)
        problems.predicted_gap[place] = chain_row(candidates.predicted_gap, j)


@wp.func(inline=True)
def queue_problem(paused: PausedWhiskers, index: int, count: int):
    """Queue a problem with those of like size."""
    queue = int(0)
    if wp.static(cuda):
        # A small group would not hold many contacts, and a large one would idle on few.
        if count > wp.static(GROUPS[1][0]):
            queue = int(2)
        elif count > wp.static(GROUPS[0][0]):
            queue = int(1)
    paused.problem_queue[queue, wp.atomic_add(paused.next_problem_size, queue, 1)] = index


@wp.func(inline=True)
def read_solution(problems: ContactProblems, job: WhiskerJob, chain: wp.ref[ChainState], state: wp.ref[WhiskerState]):
    """Add the contacts' part to the accelerations of the joints, and to the totals how well it was found."""
    index = job.index
    state.contacts = problems.solution[index].contacts
    state.crowded = state.crowded + problems.solution[index].crowded
    state.unsolved = state.unsolved + problems.solution[index].unsolved
    state.miss = state.miss + problems.solution[index].miss
    state.load = state.load + problems.solution[index].load
    for i in range(job.links):
        chain.acceleration[i] = problems.free_acceleration[index, i] + problems.added_acceleration[index, i]
    if wp.static(yields):
        chain.yielding = problems.solution[index].yielding


if recorded:
    from .recorder.newton import CAUTIOUS, DIRECT, newton_forces


@wp.func
def solve_single_contact(
    own6: vec6, bn: real, b1: real, b2: real, p0: real, q0: real, mu: real, tolerance: real, tries: int
) -> vec4:
    """Return the forces (normal, two tangents) of one contact alone, and 1 if its direction of slip was not found.

    ``own6`` is its compliance to them (nn, n1, n2, 11, 12, 22); bn, b1, b2 are its rates without them, p0 and q0 its
    last friction.
    """
    zero = real(0.0)
    one = real(1.0)
    nn = own6[0]
    n1 = own6[1]
    n2 = own6[2]
    c11 = own6[3]
    c12 = own6[4]
    c22 = own6[5]
    # Without force the contact opens, or it presses.
    fn = zero
    f1 = zero
    f2 = zero
    missed = zero
    if bn < zero:
        fn = -bn / nn
        if mu > zero:
            # Sticking: solve for all three, tangents eliminated first.
            # A straight chain does not yield along itself: the tangents then have no inverse, and the contact slides.
            det = c11 * c22 - c12 * c12
            stuck = int(0)
            if det > real(1e-9) * c11 * c22:
                tb1 = -(c22 * b1 - c12 * b2) / det
                tb2 = -(c11 * b2 - c12 * b1) / det
                ta1 = -(c22 * n1 - c12 * n2) / det
                ta2 = -(c11 * n2 - c12 * n1) / det
                # Schur complement: compliance along the normal while both tangents are held.
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
                # The trace is at least the largest eigenvalue of the block, so that the projected step cannot
                # overshoot.
                # Slow where the two tangents differ much: a whisker hardly yields along itself.
                relaxation = one / (c11 + c22)
                missed = one
                for _ in range(tries):
                    fn = wp.max(zero, -(bn + n1 * f1 + n2 * f2) / nn)
                    slip1 = f1 - relaxation * (b1 + n1 * fn + c11 * f1 + c12 * f2)
                    slip2 = f2 - relaxation * (b2 + n2 * fn + c12 * f1 + c22 * f2)
                    size = wp.sqrt(slip1 * slip1 + slip2 * slip2)
                    # Projection on the Coulomb disc of the present normal force.
                    bound = mu * fn
                    if size > bound:
                        slip1 = slip1 * (bound / size)
                        slip2 = slip2 * (bound / size)
                    moved_by = wp.abs(f1 - slip1) + wp.abs(f2 - slip2)
                    f1 = slip1
                    f2 = slip2
                    if moved_by <= tolerance * bound:
                        missed = zero
                        break
                fn = wp.max(zero, -(bn + n1 * f1 + n2 * f2) / nn)
    # Two contacts at one point may leave nothing to divide by.
    if not (fn + wp.abs(f1) + wp.abs(f2) < real(wp.static(LARGEST_FORCE))):
        fn = zero
        f1 = zero
        f2 = zero
    return vec4(fn, f1, f2, missed)


@wp.func(inline=True)
def contact_rates(solver: wp.ref[SolverState], own: wp.ref[ThreadContacts], matrix: wp.ref[DelassusRows], refresh: int):
    """Compute the rates at the contacts, less those that would just close the gaps."""
    if refresh == 1:
        for k in range(solver.own_count):
            # vₙ + g/h: zero where the gap just closes at the end of the step.
            own.rate[3 * k] = row(own.free_rate, 3 * k) - row(own.closing_rate, k)
            own.rate[3 * k + 1] = row(own.free_rate, 3 * k + 1)
            own.rate[3 * k + 2] = row(own.free_rate, 3 * k + 2)
    for e in range(solver.warp_contacts):
        k = wp.static(3 * stride) * e
        f0 = broadcast(row(own.force, k), e)
        f1 = broadcast(row(own.force, k + 1), e)
        f2 = broadcast(row(own.force, k + 2), e)
        if refresh == 1:
            add_rates(own, matrix, e, vec3(f0, f1, f2), solver.own_count)


@wp.func(inline=True)
def gauss_seidel_sweep(
    solver: wp.ref[SolverState], own: wp.ref[ThreadContacts], matrix: wp.ref[DelassusRows], tries: int
):
    """Solve each contact once, given the others; note how much changed."""
    zero = real(0.0)
    gap_error = zero
    force_change = zero
    force_sum = zero
    if solver.converged == 0:
        solver.slip_missed = 0
    for c in range(solver.warp_contacts):
        d0 = zero
        d1 = zero
        d2 = zero
        mine = wp.static(group_size == 1) or c == solver.thread
        if mine and solver.converged == 0 and c < solver.contacts:
            k = wp.static(stride) * c
            n0 = row(own.force, 3 * k)
            p0 = row(own.force, 3 * k + 1)
            q0 = row(own.force, 3 * k + 2)
            block = row(own.self_compliance, k)
            missed = row(own.rate, 3 * k)
            # Rates that the other contacts' forces leave.
            bn = missed - block[0] * n0 - block[1] * p0 - block[2] * q0
            b1 = row(own.rate, 3 * k + 1) - block[1] * n0 - block[3] * p0 - block[4] * q0
            b2 = row(own.rate, 3 * k + 2) - block[2] * n0 - block[4] * p0 - block[5] * q0
            found = solve_single_contact(block, bn, b1, b2, p0, q0, row(own.friction, k), solver.tolerance, tries)
            if found[3] > zero:
                solver.slip_missed = 1
            overlap = zero
            # No force below LARGEST_FORCE keeps it closed: without this, zero forces would count as solved.
            if bn < zero and found[0] == zero:
                force_change += real(wp.static(LARGEST_FORCE))
                # All of it, however little of it a step undoes.
                overlap = -row(own.gap, k)
            own.force[3 * k] = found[0]
            own.force[3 * k + 1] = found[1]
            own.force[3 * k + 2] = found[2]
            d0 = found[0] - n0
            d1 = found[1] - p0
            d2 = found[2] - q0
            # By how much (mm) the forces so far miss the gap that they should leave.
            # Without a force the gap may open; only an overlap is an error.
            if n0 == zero:
                missed = wp.min(missed, zero)
            slipped = block[3] * wp.abs(d1) + block[5] * wp.abs(d2)
            gap_error = wp.max(gap_error, wp.max(overlap, solver.step * (wp.abs(missed) + slipped)))
            force_change += wp.abs(d0) + wp.abs(d1) + wp.abs(d2)
            force_sum += found[0]
        # Every contact learns what this change does to its rates.
        d0 = broadcast(d0, c)
        d1 = broadcast(d1, c)
        d2 = broadcast(d2, c)
        add_rates(own, matrix, c, vec3(d0, d1, d2), solver.own_count)
    gap_error = group_max(gap_error)
    force_change = group_sum(force_change)
    force_sum = group_sum(force_sum)
    if solver.converged == 0:
        solver.gap_error = gap_error
        solver.force_change = force_change
        solver.force_sum = force_sum
        if gap_error <= solver.tolerance or force_change <= solver.tolerance * force_sum:
            solver.converged = 1


@wp.func(inline=True)
def solve_normal_forces(
    solver: wp.ref[SolverState],
    normals: wp.ref[NormalMatrix],
    work: wp.ref[NormalMatrix],
    load: wp.ref[PerContact1],
    asked: wp.ref[PerContact1],
    pressing: int,
):
    """Find the normal forces of the contacts that press, by Gauss-Jordan; every contact has its own row."""
    share = PerContact1()
    part = solver.thread
    each = solver.own_count
    count = solver.warp_contacts
    for k in range(each):
        mine_in = (pressing >> (part + k)) % 2
        for e in range(count):
            keep = real(0.0)
            if mine_in == 1 and (pressing >> e) % 2 == 1:
                keep = row(normals, k * wp.static(max_contacts) + e)
            elif part + k == e:
                keep = real(1.0)
            work[k * wp.static(max_contacts) + e] = keep
        load[k] = real(0.0)
        if mine_in == 1:
            load[k] = row(asked, k)
    # Rows of contacts that do not press are those of the identity, so nothing is pivoted.
    for p in range(count):
        at = wp.static(stride * max_contacts) * p
        pivot = broadcast(row(work, at + p), p)
        known = broadcast(row(load, wp.static(stride) * p), p)
        for k in range(each):
            share[k] = real(0.0)
            if part + k != p:
                share[k] = row(work, k * wp.static(max_contacts) + p) / pivot
            load[k] = row(load, k) - share[k] * known
        for e in range(p + 1, count):
            value = broadcast(row(work, at + e), p)
            for k in range(each):
                c = k * wp.static(max_contacts) + e
                work[c] = row(work, c) - share[k] * value
    for k in range(each):
        if part + k < count:
            load[k] = row(load, k) / row(work, k * wp.static(max_contacts) + part + k)


@wp.func(inline=True)
def share_normal_forces(
    solver: wp.ref[SolverState],
    own: wp.ref[ThreadContacts],
    matrix: wp.ref[DelassusRows],
    normals: wp.ref[NormalMatrix],
    work: wp.ref[NormalMatrix],
    guessing: int,
    tries: int,
) -> int:
    """Solve for all normal forces at once, with the friction of sliding contacts; return whether forces changed."""
    zero = real(0.0)
    part = solver.thread
    each = solver.own_count
    count = solver.warp_contacts
    contacts = solver.contacts
    ratio1 = PerContact1()
    ratio2 = PerContact1()
    asked = PerContact1()
    load = PerContact1()
    opening = PerContact1()
    pressing = int(0)
    for k in range(each):
        ratio1[k] = zero
        ratio2[k] = zero
        asked[k] = row(own.closing_rate, k) - row(own.free_rate, 3 * k)
        if part + k < contacts:
            fn = row(own.force, 3 * k)
            if fn > zero:
                pressing = pressing + (1 << (part + k))
            f1 = row(own.force, 3 * k + 1)
            f2 = row(own.force, 3 * k + 2)
            size = wp.sqrt(f1 * f1 + f2 * f2)
            # Friction at the edge of its cone slides: it keeps its direction and grows with the normal force.
            if size > zero and size >= real(0.999) * row(own.friction, k) * fn:
                ratio1[k] = row(own.friction, k) * f1 / size
                ratio2[k] = row(own.friction, k) * f2 / size
    pressing = group_or(pressing)
    # G of the normal forces, friction of sliding contacts in it; that of sticking ones stays as it is.
    for e in range(count):
        slide1 = broadcast(ratio1[wp.static(stride) * e], e)
        slide2 = broadcast(ratio2[wp.static(stride) * e], e)
        stick1 = broadcast(row(own.force, wp.static(3 * stride) * e + 1), e)
        stick2 = broadcast(row(own.force, wp.static(3 * stride) * e + 2), e)
        if slide1 != zero or slide2 != zero:
            stick1 = zero
            stick2 = zero
        for k in range(each):
            r = 3 * e * wp.static(own_rows) + 3 * k
            along1 = row(matrix, r + wp.static(own_rows))
            along2 = row(matrix, r + wp.static(2 * own_rows))
            normals[k * wp.static(max_contacts) + e] = row(matrix, r) + along1 * slide1 + along2 * slide2
            asked[k] = asked[k] - along1 * stick1 - along2 * stick2
    # Active set: which contacts press, one change at a time.
    agreed = 1 - guessing
    for _ in range(tries):
        if warp_max(1 - agreed) == 1:
            solve_normal_forces(solver, normals, work, load, asked, pressing)
            worst = int(-1)
            lowest = zero
            for k in range(each):
                opening[k] = -asked[k]
            for e in range(count):
                value = broadcast(load[wp.static(stride) * e], e)
                if value < lowest:
                    lowest = value
                    worst = e
                for k in range(each):
                    opening[k] = opening[k] + row(normals, k * wp.static(max_contacts) + e) * value
            # A contact that pulls lets go; one that would open into the object presses.
            flip = worst
            # Overlaps below 1e-6 mm are rounding and no reason to change the active set.
            lowest = real(-1e-6) / solver.step
            for e in range(count):
                value = broadcast(opening[wp.static(stride) * e], e)
                if worst < 0 and e < contacts and (pressing >> e) % 2 == 0 and value < lowest:
                    lowest = value
                    flip = e
            if agreed == 0:
                if flip < 0:
                    agreed = 1
                else:
                    pressing = pressing ^ (1 << flip)
    # Take the forces only if all are sound, and keep friction within its cone.
    diverged = zero
    for k in range(each):
        if part + k < contacts and not (wp.abs(load[k]) < real(wp.static(LARGEST_FORCE))):
            diverged = real(1.0)
    diverged = group_max(diverged)
    changed = int(0)
    if guessing == 1 and agreed == 1 and diverged == zero:
        changed = int(1)
        for k in range(each):
            if part + k < contacts:
                fn = load[k]
                f1 = row(own.force, 3 * k + 1)
                f2 = row(own.force, 3 * k + 2)
                if ratio1[k] != zero or ratio2[k] != zero:
                    f1 = ratio1[k] * fn
                    f2 = ratio2[k] * fn
                else:
                    size = wp.sqrt(f1 * f1 + f2 * f2)
                    if size > row(own.friction, k) * fn:
                        f1 = f1 * (row(own.friction, k) * fn / size)
                        f2 = f2 * (row(own.friction, k) * fn / size)
                own.force[3 * k] = fn
                own.force[3 * k + 1] = f1
                own.force[3 * k + 2] = f2
    return changed


@wp.func(inline=True)
def iterate_forces(
    problems: ContactProblems,
    solver: wp.ref[SolverState],
    own: wp.ref[ThreadContacts],
    matrix: wp.ref[DelassusRows],
    normals: wp.ref[NormalMatrix],
    work: wp.ref[NormalMatrix],
    active: int,
):
    """Sweep until the forces hold, with all normal forces solved for at once after every other sweep."""
    solver.tolerance = problems.tolerance
    slip_tries = problems.tries + solver.unknown_zero
    guess_tries = int(10) + solver.unknown_zero
    sweeps_most = problems.sweeps + solver.unknown_zero
    solver.converged = 1 - active
    refresh = active
    solver.gap_error = real(0.0)
    solver.force_change = real(0.0)
    solver.force_sum = real(0.0)
    for sweep in range(sweeps_most):
        if warp_max(1 - solver.converged) == 1:
            if warp_max(refresh) == 1:
                contact_rates(solver, own, matrix, refresh)
                refresh = 0
            gauss_seidel_sweep(solver, own, matrix, slip_tries)
            if wp.static(recorded):
                if solver.converged == 0 and sweep >= 2 and sweep % 2 == 0:
                    caution = real(wp.static(CAUTIOUS))
                    if sweep % 4 == 2:
                        caution = real(wp.static(DIRECT))
                    solver.converged = newton_forces(solver, own, matrix, caution)
                    solver.slip_missed = 1 - solver.converged
                    refresh = 1
            guessing = int(0)
            if solver.converged == 0 and solver.contacts > 1 and sweep % 2 == 1:
                guessing = 1
            if warp_max(guessing) == 1:
                refresh = share_normal_forces(solver, own, matrix, normals, work, guessing, guess_tries)


@wp.func(inline=True)
def store_forces(problems: ContactProblems, solver: wp.ref[SolverState], own: wp.ref[ThreadContacts]):
    """Write what the contacts do together, and their forces for the next step."""
    zero = real(0.0)
    force = vec3(zero, zero, zero)
    moment = vec3(zero, zero, zero)
    normal_sum = zero
    arc_sum = zero
    if wp.static(smooth):
        # Contacts that come of one share its means: otherwise it would bend the rod twice.
        for e in range(warp_max(solver.previous_contacts)):
            heirs = zero
            for k in range(solver.own_count):
                if solver.thread + k < solver.contacts and row(own.origin, k) == e:
                    heirs = heirs + real(1.0)
            heirs = group_sum(heirs)
            for k in range(solver.own_count):
                if solver.thread + k < solver.contacts and row(own.origin, k) == e:
                    own.mean[k] = row(own.mean, k) / heirs
                    own.steady[k] = row(own.steady, k) / heirs
    for k in range(solver.own_count):
        if solver.thread + k < solver.contacts and solver.live == 1:
            force_k = contact_force(own, k)
            arc = row(own.arc, k)
            problems.held[solver.job, solver.thread + k].arc = arc
            problems.held[solver.job, solver.thread + k].force = force_k
            if wp.static(smooth):
                mean = row(own.mean, k)
                steady = row(own.steady, k)
                weight = solver.step / (solver.step + real(wp.static(STEADY)))
                mean = mean + (force_k - mean) * weight
                problems.held[solver.job, solver.thread + k].mean = mean
                problems.held[solver.job, solver.thread + k].steady = steady + (mean - steady) * weight
            if wp.static(recorded):
                problems.held[solver.job, solver.thread + k].slot = row(own.slot, k)
            force = force + force_k
            moment = moment + wp.cross(row(own.point, k), force_k)
            fn = row(own.force, 3 * k)
            if fn > zero:
                normal_sum += fn
                arc_sum += fn * arc
    normal_sum = group_sum(normal_sum)
    arc_sum = group_sum(arc_sum)
    force = vec3(group_sum(force[0]), group_sum(force[1]), group_sum(force[2]))
    moment = vec3(group_sum(moment[0]), group_sum(moment[1]), group_sum(moment[2]))
    if solver.thread == 0 and solver.live == 1:
        problems.solution[solver.job].normal_sum = normal_sum
        problems.solution[solver.job].arc_sum = arc_sum
        problems.solution[solver.job].contact = spatial(moment, force)


@wp.func
def solve_contacts(problems: ContactProblems, index: int, part: int, live: int):
    """Solve the problem of one job in place.

    ``part`` is the thread's place in its group, ``live`` whether the group has a whisker or only keeps others company.
    """
    solver = SolverState()
    solver.job = index
    solver.thread = part
    solver.live = live
    solver.links = problems.given[index].links
    solver.candidates = problems.given[index].candidates
    solver.previous_contacts = problems.given[index].contacts
    solver.step = problems.given[index].step
    solver.unknown_zero = wp.min(0, index)
    solver.own_count = int(wp.static(own_contacts)) + wp.static(stride) * solver.unknown_zero
    own = ThreadContacts()
    matrix = DelassusRows()
    normals = NormalMatrix()
    work = NormalMatrix()
    joint_change = PerLinkJoint()
    rounds_most = int(wp.static(CONTACT_ROUNDS)) + solver.unknown_zero
    more = live
    for round_ in range(rounds_most):
        active = more
        if warp_max(active) == 1:
            select_contacts(problems, solver, own, active)
            build_delassus(problems, solver, own, matrix)
            iterate_forces(problems, solver, own, matrix, normals, work, active)
            last = int(0)
            if round_ == wp.static(CONTACT_ROUNDS - 1):
                last = 1
            more = apply_forces(problems, solver, own, joint_change, last, active)
    store_forces(problems, solver, own)


@wp.kernel(enable_backward=False, module="unique", module_options=module_options(), launch_bounds=CONTACT_BOUNDS)
def solve_queue(problems: ContactProblems, paused: PausedWhiskers):
    """Solve the problems of one queue in place: ``group_size`` threads take one problem."""
    thread = wp.tid()
    count = paused.problem_size[wp.static(queue)]
    which = thread // wp.static(group_size)
    # All threads of a warp go on, or none.
    if (thread // wp.static(WARP)) * wp.static(WARP // group_size) < count:
        live = int(0)
        if which < count:
            live = int(1)
        index = paused.problem_queue[wp.static(queue), wp.min(which, count - 1)]
        solve_contacts(problems, index, thread % wp.static(group_size), live)
