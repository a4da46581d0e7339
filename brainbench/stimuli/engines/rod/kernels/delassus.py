"""Contacts of a step, their Delassus matrix G = J H⁻¹ Jᵀ, and what their forces do to the chain.

The matrix says what a unit force at one contact does at the others. A group of threads takes one whisker, each thread
one contact (the only thread of a group takes all of them): it carries the contact's three unit forces up the factorised
chain, where force (w, v) leaves the joint rates u = Sᵀ(w, v) and goes on as (w, v) − UD⁻¹u, and owns three rows of
G = h Σ uᵀD⁻¹u. A row of the matrix is a normal or one of two tangents.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import CLOSED, CREVICE, PRESSED, UNDONE

from .algebra import JointVector, Spatial, inertia_times, minus, plus, reader, spatial, vec3, vec6
from .articulated_body import acceleration_over_joint, force_over_joint, inverse_times
from .distances import NUMBERS
from .parameters import capacity, group_size, hinges, max_contacts, real, recorded, smooth, yields
from .state import ContactProblems, JointRecord, PerLinkJoint, most_candidates
from .thread_groups import broadcast, group_or, group_sum, warp_max

own_contacts = max_contacts if group_size == 1 else 1
row_size = 3 * max_contacts
stride = 1 if group_size == 1 else 0
"""Contact c of the whisker stands at stride · c among its thread's own."""
PerContactInt: Any = wp.types.vector(own_contacts, wp.int32)
PerContact1: Any = wp.types.vector(own_contacts, real)
PerContact3: Any = wp.types.matrix((own_contacts, 3), real)
PerContact6: Any = wp.types.matrix((own_contacts, 6), real)
lanes = 8 if group_size == 1 else 3
"""Rows that a thread computes side by side: a processor takes some, and a GPU's thread its own three, at once."""
own_rows = -(-3 * own_contacts // lanes) * lanes
PerRow1: Any = wp.types.vector(own_rows, real)
PerRow3: Any = wp.types.matrix((own_rows, 3), real)
ByRow3: Any = wp.types.matrix((3, own_rows), real)
DelassusRows: Any = wp.types.vector(row_size * own_rows, real)
"""The thread's own rows, column after column."""
NormalMatrix: Any = wp.types.vector(own_contacts * max_contacts, real)


@wp.struct
class ThreadContacts:
    """Contacts of a thread; each has three rows, its normal and two tangents."""

    link: PerContactInt
    arc: PerContact1
    closing_rate: PerContact1
    """Rate that just closes the gap within the step (negative gap over the step)."""
    gap: PerContact1
    friction: PerContact1
    point: PerContact3
    axis: PerRow3
    free_rate: PerRow1
    """Rate without contact forces."""
    force: PerRow1
    rate: PerRow1
    """Rate with them, less what just closes the gap."""
    self_compliance: PerContact6
    """Compliance to the contact's own forces."""
    if recorded:
        slot: PerContactInt
    if smooth:
        mean: PerContact3
        steady: PerContact3
        origin: PerContactInt
        """Contact of the last step whose mean forces it takes over; −1: none."""


@wp.struct
class SolverState:
    """Problem of a whisker, and how far its solution is."""

    job: wp.int32
    thread: wp.int32
    """Place of the thread in its group."""
    live: wp.int32
    """1: the group has a whisker; 0: it only keeps others company."""
    own_count: wp.int32
    """Contacts of a thread."""
    unknown_zero: wp.int32
    """Zero, which the compiler does not know: it keeps it from writing loops out."""
    links: wp.int32
    candidates: wp.int32
    previous_contacts: wp.int32
    """Contacts of the last step."""
    step: real
    contacts: wp.int32
    selected: wp.int32
    """Bits of the candidates that are contacts."""
    warp_contacts: wp.int32
    """Most contacts of a whisker of the warp."""
    last_link: wp.int32
    """Last link with a contact, of all whiskers of the warp."""
    tolerance: real
    converged: wp.int32
    slip_missed: wp.int32
    """1: the thread did not find the direction in which one of its contacts slips, in the last sweep."""
    gap_error: real
    """Largest error (mm) of a gap in the last sweep."""
    force_change: real
    """Change of the forces in the last sweep; sum of the normal forces."""
    force_sum: real


row = reader(
    (PerLinkJoint, JointVector),
    (PerContact1, real),
    (PerContact3, vec3),
    (PerContact6, vec6),
    (PerRow1, real),
    (PerRow3, vec3),
    (DelassusRows, real),
    (NormalMatrix, real),
    (PerContactInt, wp.int32),
)


@wp.func(inline=True)
def add_contact(problems: ContactProblems, solver: wp.ref[SolverState], own: wp.ref[ThreadContacts], k: int, slot: int):
    """Make a candidate the contact k of this thread."""
    zero = real(0.0)
    index = solver.job
    first_joint = index * wp.static(capacity)
    place = index * wp.static(most_candidates) + slot
    i = problems.candidate_link[place]
    candidate = problems.candidate[place]
    normal = candidate.normal
    # One tangent along the whisker, where it tends to slide.
    along = candidate.along
    tangent = along - normal * wp.dot(along, normal)
    if wp.length_sq(tangent) < real(1e-8) * wp.length_sq(along):
        e2 = problems.joint[first_joint + i].motion2.w
        tangent = e2 - normal * wp.dot(e2, normal)
    tangent = wp.normalize(tangent)
    own.link[k] = i
    if wp.static(recorded):
        own.slot[k] = slot
    own.arc[k] = candidate.arc
    own.friction[k] = candidate.friction
    own.point[k] = candidate.point
    own.gap[k] = candidate.gap
    # A deep overlap is undone over several steps.
    own.closing_rate[k] = wp.min(-candidate.gap, real(wp.static(CREVICE[smooth]))) / solver.step
    if wp.static(smooth):
        own.closing_rate[k] = wp.min(own.closing_rate[k], real(wp.static(UNDONE)))
    own.axis[3 * k] = normal
    own.axis[3 * k + 1] = tangent
    own.axis[3 * k + 2] = wp.cross(normal, tangent)
    # The forces of the last step are a good first guess.
    # They are kept in world axes, because the tangents turn from step to step.
    guess = vec3(zero, zero, zero)
    if wp.static(smooth):
        own.mean[k] = guess
        own.steady[k] = guess
        own.origin[k] = -1
    closest = real(0.3) * candidate.link_arc
    for e in range(solver.previous_contacts):
        held = problems.held[index, e]
        apart = wp.abs(held.arc - candidate.arc)
        if apart < closest:
            guess = held.force
            if wp.static(smooth):
                closest = apart
                own.mean[k] = held.mean
                own.steady[k] = held.steady
                own.origin[k] = e
    for a in range(3):
        own.free_rate[3 * k + a] = wp.dot(row(own.axis, 3 * k + a), candidate.free_velocity)
        own.force[3 * k + a] = wp.dot(guess, row(own.axis, 3 * k + a))
    own.force[3 * k] = wp.max(zero, row(own.force, 3 * k))


@wp.func(inline=True)
def select_contacts(problems: ContactProblems, solver: wp.ref[SolverState], own: wp.ref[ThreadContacts], active: int):
    """Make contacts of the candidates whose gaps would close, the deepest first."""
    first_candidate = solver.job * wp.static(most_candidates)
    for _ in range(wp.static(max_contacts) + solver.unknown_zero):
        slot = int(-1)
        if active == 1 and solver.contacts < wp.static(max_contacts):
            lowest = real(0.0)
            for j in range(solver.candidates):
                if (solver.selected >> j) % 2 == 0 and problems.predicted_gap[first_candidate + j] < lowest:
                    lowest = problems.predicted_gap[first_candidate + j]
                    slot = j
        if slot >= 0:
            solver.selected = solver.selected + (1 << slot)
            if wp.static(group_size == 1) or solver.contacts == solver.thread:
                add_contact(problems, solver, own, wp.static(stride) * solver.contacts, slot)
            solver.contacts = solver.contacts + 1
    if wp.static(group_size == 1):
        solver.own_count = solver.contacts
    # Threads of a warp walk the same links and contacts.
    # No force enters behind the last link with a contact, so the passes below begin there.
    top = int(-1)
    for k in range(solver.own_count):
        if solver.thread + k < solver.contacts:
            top = wp.max(top, row(own.link, k))
    solver.last_link = warp_max(top)
    solver.warp_contacts = warp_max(solver.contacts)


@wp.struct
class UnitForces:
    """Unit force of each row as it is below the present link, and what its joint does: [axis or hinge, row]."""

    w: ByRow3
    v: ByRow3
    joint_rate: ByRow3
    impulse: ByRow3
    """h D⁻¹ of the joint rates."""


ROWS = (
    NUMBERS
    + f"""
constexpr int stride = {own_rows}, lanes = {lanes};
// Rows of contacts that the whisker lacks are zeros.
const int rows = (3 * each + lanes - 1) / lanes * lanes;
"""
)
LANES = "for (int k = 0; k < rows; k += lanes) SIDE_BY_SIDE for (int r = k; r < k + lanes; r++)"


TWIST = """
    if (twists) {
        const real u3 = dot(j.motion3.w.c, w) + dot(j.motion3.v.c, v);
        for (int d = 0; d < 3; d++) { w[d] = w[d] - j.gain3.w.c[d] * u3; v[d] = v[d] - j.gain3.v.c[d] * u3; }
        unit.joint_rate.data[2][r] = u3;
        unit.impulse.data[2][r] = step * j.inverse_inertia.c[3] * u3;
    }
"""


@wp.func_native(
    ROWS
    + f"""
const auto j = joints.data[joint];
const real i11 = j.inverse_inertia.c[0], i12 = j.inverse_inertia.c[1], i22 = j.inverse_inertia.c[2];
{LANES} {{
    real w[3], v[3];
    for (int d = 0; d < 3; d++) {{ w[d] = unit.w.data[d][r]; v[d] = unit.v.data[d][r]; }}
    {TWIST if hinges == 3 else ""}
    const real u1 = dot(j.motion1.w.c, w) + dot(j.motion1.v.c, v), u2 = dot(j.motion2.w.c, w) + dot(j.motion2.v.c, v);
    for (int d = 0; d < 3; d++) {{
        unit.w.data[d][r] = w[d] - j.gain1.w.c[d] * u1 - j.gain2.w.c[d] * u2;
        unit.v.data[d][r] = v[d] - j.gain1.v.c[d] * u1 - j.gain2.v.c[d] * u2;
    }}
    unit.joint_rate.data[0][r] = u1;
    unit.joint_rate.data[1][r] = u2;
    unit.impulse.data[0][r] = step * (i11 * u1 + i12 * u2);
    unit.impulse.data[1][r] = step * (i12 * u1 + i22 * u2);
}}
"""
)
def pass_joint(
    joints: wp.array(dtype=JointRecord), joint: int, twists: int, step: real, each: int, unit: wp.ref[UnitForces]
):
    """Carry the unit forces of a thread's ``each`` contacts over a joint, and find what they do to it."""


@wp.func_native(
    ROWS
    + f"""
real *g0 = matrix.c + 3 * contact * stride, *g1 = g0 + stride, *g2 = g1 + stride;
const real *h1 = unit.impulse.data[0], *h2 = unit.impulse.data[1], *h3 = unit.impulse.data[2];
if (twists)
    {LANES.replace("k = 0", "k = first / lanes * lanes")} {{
        g0[r] = g0[r] + h1[r] * rate1.c[0] + h2[r] * rate2.c[0] + h3[r] * rate3.c[0];
        g1[r] = g1[r] + h1[r] * rate1.c[1] + h2[r] * rate2.c[1] + h3[r] * rate3.c[1];
        g2[r] = g2[r] + h1[r] * rate1.c[2] + h2[r] * rate2.c[2] + h3[r] * rate3.c[2];
    }}
else
    {LANES.replace("k = 0", "k = first / lanes * lanes")} {{
        g0[r] = g0[r] + h1[r] * rate1.c[0] + h2[r] * rate2.c[0];
        g1[r] = g1[r] + h1[r] * rate1.c[1] + h2[r] * rate2.c[1];
        g2[r] = g2[r] + h1[r] * rate1.c[2] + h2[r] * rate2.c[2];
    }}
"""
)
def add_joint(
    unit: wp.ref[UnitForces],
    contact: int,
    rate1: vec3,
    rate2: vec3,
    rate3: vec3,
    twists: int,
    first: int,
    each: int,
    matrix: wp.ref[DelassusRows],
):
    """Add a joint's part of G to the three columns of a contact, whose joint rates are given, from a row on."""


@wp.func_native(ROWS + f"for (int c = 0; c < 3 * count; c++) {LANES} matrix.c[c * stride + r] = zero;")
def clear(matrix: wp.ref[DelassusRows], count: int, each: int):
    """Set the columns of some contacts to zero."""


@wp.func_native(
    ROWS
    + f"""
const real *g0 = matrix.c + 3 * contact * stride, *g1 = g0 + stride, *g2 = g1 + stride;
{LANES} own.rate.c[r] = own.rate.c[r] + g0[r] * force.c[0] + g1[r] * force.c[1] + g2[r] * force.c[2];
"""
)
def add_rates(own: wp.ref[ThreadContacts], matrix: wp.ref[DelassusRows], contact: int, force: vec3, each: int):
    """Add to the rates at a thread's ``each`` contacts what a contact's force does there."""


@wp.func_native("return unit.joint_rate.data[hinge][r];")
def joint_rate(unit: wp.ref[UnitForces], hinge: int, r: int) -> real:
    """Return what the unit force of a row does to a hinge; an index of Warp would copy all of them first."""


@wp.func(inline=True)
def joint_rates(unit: wp.ref[UnitForces], hinge: int, r: int, contact: int) -> vec3:
    """Return what the three unit forces of a contact, from row r of its thread on, do to a hinge of the joint."""
    return vec3(
        broadcast(joint_rate(unit, hinge, r), contact),
        broadcast(joint_rate(unit, hinge, r + 1), contact),
        broadcast(joint_rate(unit, hinge, r + 2), contact),
    )


@wp.func(inline=True)
def add_follicle(
    problems: ContactProblems,
    solver: wp.ref[SolverState],
    unit: wp.ref[UnitForces],
    matrix: wp.ref[DelassusRows],
):
    """Add the follicle's part of G, as that of two joints of three hinges: its turns and its slides."""
    compliance = problems.given[solver.job].compliance
    each = solver.own_count
    for part in range(2):
        for r in range(3 * each):
            turn = vec3(unit.w[0, r], unit.w[1, r], unit.w[2, r])
            slide = vec3(unit.v[0, r], unit.v[1, r], unit.v[2, r])
            moved = inertia_times(compliance, spatial(turn, slide))
            rate = turn
            impulse = moved.w * solver.step
            if part == 1:
                rate = slide
                impulse = moved.v * solver.step
            for d in range(3):
                unit.joint_rate[d, r] = rate[d]
                unit.impulse[d, r] = impulse[d]
        for e in range(solver.warp_contacts):
            r = wp.static(3 * stride) * e
            o1 = joint_rates(unit, 0, r, e)
            o2 = joint_rates(unit, 1, r, e)
            o3 = joint_rates(unit, 2, r, e)
            add_joint(unit, e, o1, o2, o3, 1, r, each, matrix)


@wp.func(inline=True)
def build_delassus(
    problems: ContactProblems, solver: wp.ref[SolverState], own: wp.ref[ThreadContacts], matrix: wp.ref[DelassusRows]
):
    """Carry unit forces up the chain and sum the rows of the Delassus matrix."""
    zero = real(0.0)
    first_joint = solver.job * wp.static(capacity)
    count = solver.warp_contacts
    thread = solver.thread
    each = solver.own_count
    unit = UnitForces()
    clear(matrix, count, each)
    for back in range(solver.last_link + 1):
        i = solver.last_link - back
        for k in range(each):
            # A contact's force enters at its own link; only joints between that and the base feel it.
            if thread + k < solver.contacts and row(own.link, k) == i:
                for a in range(3):
                    v = row(own.axis, 3 * k + a)
                    w = wp.cross(row(own.point, k), v)
                    for d in range(3):
                        unit.v[d, 3 * k + a] = v[d]
                        unit.w[d, 3 * k + a] = w[d]
        twists = int(0)
        if wp.static(hinges == 3):
            twists = i % 2
        # A thread of a GPU follows the longest whisker of its warp, beyond the end of its own.
        if wp.static(group_size == 1) or (thread < solver.contacts and row(own.link, 0) >= i):
            pass_joint(problems.joint, first_joint + i, twists, solver.step, each, unit)
        # Both contacts share this joint: its part of G. One thread alone computes the lower half.
        for e in range(count):
            if wp.static(group_size > 1) or row(own.link, e) >= i:
                r = wp.static(3 * stride) * e
                o1 = joint_rates(unit, 0, r, e)
                o2 = joint_rates(unit, 1, r, e)
                o3 = vec3(zero, zero, zero)
                if wp.static(hinges == 3) and twists == 1:
                    o3 = joint_rates(unit, 2, r, e)
                add_joint(unit, e, o1, o2, o3, twists, r, each, matrix)
    if wp.static(yields):
        add_follicle(problems, solver, unit, matrix)
    if wp.static(group_size == 1):
        for r in range(3 * count):
            for c in range(r):
                matrix[r * wp.static(own_rows) + c] = row(matrix, c * wp.static(own_rows) + r)
    # Diagonal blocks, for the solution of single contacts.
    for k in range(each):
        if thread + k < solver.contacts:
            c0 = 3 * (thread + k) * wp.static(own_rows) + 3 * k
            c1 = c0 + wp.static(own_rows)
            c2 = c1 + wp.static(own_rows)
            own.self_compliance[k, 0] = row(matrix, c0)
            own.self_compliance[k, 1] = row(matrix, c1)
            own.self_compliance[k, 2] = row(matrix, c2)
            own.self_compliance[k, 3] = row(matrix, c1 + 1)
            own.self_compliance[k, 4] = row(matrix, c2 + 1)
            own.self_compliance[k, 5] = row(matrix, c2 + 2)


@wp.func(inline=True)
def contact_force(own: wp.ref[ThreadContacts], k: int) -> vec3:
    """Return the force of a contact in world axes."""
    force_k = row(own.axis, 3 * k) * row(own.force, 3 * k)
    return (
        force_k
        + row(own.axis, 3 * k + 1) * row(own.force, 3 * k + 1)
        + row(own.axis, 3 * k + 2) * row(own.force, 3 * k + 2)
    )


@wp.func(inline=True)
def apply_forces(
    problems: ContactProblems,
    solver: wp.ref[SolverState],
    own: wp.ref[ThreadContacts],
    joint_change: wp.ref[PerLinkJoint],
    last: int,
    active: int,
) -> int:
    """Carry the forces up the chain, then the change of acceleration down.

    ``last`` says that there will be no further round. Returned is whether the forces press the whisker onto candidates
    that do not take part, with room for them: then another round is needed.
    """
    zero = real(0.0)
    first_joint = solver.job * wp.static(capacity)
    first_candidate = solver.job * wp.static(most_candidates)
    force = Spatial()
    for back in range(solver.last_link + 1):
        i = solver.last_link - back
        for k in range(solver.own_count):
            if solver.thread + k < solver.contacts and row(own.link, k) == i:
                force_k = contact_force(own, k)
                force.v = force.v + force_k
                force.w = force.w + wp.cross(row(own.point, k), force_k)
        felt = JointVector()
        if i < solver.links:
            felt = force_over_joint(problems.joint[first_joint + i], i, force)
        # Joint accelerations D⁻¹u of all contacts' forces.
        for d in range(wp.static(hinges)):
            felt[d] = group_sum(felt[d])
        if i < solver.links:
            joint_change[i] = inverse_times(problems.joint[first_joint + i].inverse_inertia, felt)
    force.w = vec3(group_sum(force.w[0]), group_sum(force.w[1]), group_sum(force.w[2]))
    force.v = vec3(group_sum(force.v[0]), group_sum(force.v[1]), group_sum(force.v[2]))
    unsolved = group_or(wp.max(solver.slip_missed, 1 - solver.converged))
    # The force that no joint takes up reaches the base; it is subtracted from its wrench below.
    # Down again, and where the other candidates are then.
    more = int(0)
    if active == 1:
        overlap = real(0.0)
        a = Spatial()
        if wp.static(yields):
            given = problems.given[solver.job]
            a = inertia_times(given.compliance, force)
            force = minus(force, inertia_times(given.inertia, a), real(1.0))
            to_follicle = wp.transpose(given.axes)
            yielding = plus(given.yielding, spatial(to_follicle * a.w, to_follicle * a.v), real(1.0))
            problems.solution[solver.job].yielding = yielding
        for i in range(solver.links):
            extra = JointVector()
            # Joints behind the last contact are only carried along.
            if i <= solver.last_link:
                extra = row(joint_change, i)
            extra = acceleration_over_joint(problems.joint[first_joint + i], i, extra, a)
            if solver.thread == 0:
                problems.added_acceleration[solver.job, i] = extra
            if solver.contacts < solver.candidates:
                for j in range(solver.candidates):
                    if problems.candidate_link[first_candidate + j] == i and (solver.selected >> j) % 2 == 0:
                        candidate = problems.candidate[first_candidate + j]
                        moved = candidate.free_velocity + (a.v + wp.cross(a.w, candidate.point)) * solver.step
                        predicted = candidate.gap + solver.step * wp.dot(candidate.normal, moved)
                        problems.predicted_gap[first_candidate + j] = predicted
                        overlap = wp.max(overlap, -predicted)
        crowded = int(0)
        if overlap > real(wp.static(PRESSED[real is wp.float64])):
            more = int(1)
        if more == 1 and (solver.contacts == wp.static(max_contacts) or last == 1):
            more = int(0)
            if overlap > real(wp.static(CLOSED)):
                crowded = int(1)
        if more == 0 and solver.thread == 0:
            # Below ten micrometres or one per cent it does not show in the wrench.
            miss = zero
            if (
                solver.converged == 0
                and solver.gap_error > real(1e-2)
                and solver.force_change > real(1e-2) * solver.force_sum
            ):
                miss = solver.force_change * solver.force_change
            index = solver.job
            problems.solution[index].contacts = solver.contacts
            problems.solution[index].crowded = crowded
            problems.solution[index].unsolved = unsolved
            problems.solution[index].base = minus(problems.given[index].base, force, real(1.0))
            problems.solution[index].tip_acceleration = (
                problems.given[index].tip_acceleration + a.v + wp.cross(a.w, problems.given[index].tip)
            )
            problems.solution[index].miss = miss
            if wp.static(recorded):
                problems.solution[index].inexact = 1 - solver.converged
            problems.solution[index].load = solver.force_sum * solver.force_sum
    return more
