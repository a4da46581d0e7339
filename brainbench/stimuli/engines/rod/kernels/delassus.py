"""Contacts of a step and their Delassus matrix G = J H⁻¹ Jᵀ: what a unit force at one contact does at the others.

A group of threads takes one whisker, each thread one contact (the only thread of a group takes all of them): it carries
the contact's three unit forces up the factorised chain, where force (w, v) leaves the joint rates u = Sᵀ(w, v) and goes
on as (w, v) − UD⁻¹u, and owns three rows of G = h Σ uᵀD⁻¹u. A row of the matrix is a normal or one of two tangents.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import CREVICE

from .algebra import vec2, vec3, vec6
from .parameters import capacity, group_size, max_contacts, real
from .state import ContactProblems, PerLink2, most_candidates, reader
from .thread_groups import broadcast, warp_max

own_contacts = max_contacts if group_size == 1 else 1
row_size = 3 * max_contacts
stride = 1 if group_size == 1 else 0
"""Contact c of the whisker stands at stride · c among its thread's own."""
PerContactInt: Any = wp.types.vector(own_contacts, wp.int32)
PerContact1: Any = wp.types.vector(own_contacts, real)
PerContact3: Any = wp.types.matrix((own_contacts, 3), real)
PerContact6: Any = wp.types.matrix((own_contacts, 6), real)
PerRow1: Any = wp.types.vector(3 * own_contacts, real)
PerRow3: Any = wp.types.matrix((3 * own_contacts, 3), real)
DelassusRows: Any = wp.types.vector(3 * own_contacts * row_size, real)
NormalMatrix: Any = wp.types.vector(own_contacts * max_contacts, real)


@wp.struct
class ThreadContacts:
    """Contacts of a thread; each has three rows, its normal and two tangents."""

    link: PerContactInt
    arc: PerContact1
    closing_rate: PerContact1
    """Rate that just closes the gap within the step (negative gap over the step)."""
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


@wp.struct
class SolverState:
    """Problem of a whisker, and how far its solution is."""

    job: wp.int32
    thread: wp.int32
    """Place of the thread in its group."""
    live: wp.int32
    """Whether the group has a whisker or only keeps others company."""
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
    converged: wp.int32
    gap_error: real
    """How far (mm) the last sweep's forces missed."""
    force_change: real
    """Change of the forces in the last sweep; sum of the normal forces."""
    force_sum: real


row = reader(
    (PerLink2, vec2),
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
        e2 = problems.joint[first_joint + i].axis2
        tangent = e2 - normal * wp.dot(e2, normal)
    tangent = wp.normalize(tangent)
    own.link[k] = i
    own.arc[k] = candidate.arc
    own.friction[k] = candidate.friction
    own.point[k] = candidate.point
    # A deep overlap is undone over several steps.
    own.closing_rate[k] = wp.min(-candidate.gap, real(wp.static(CREVICE))) / solver.step
    own.axis[3 * k] = normal
    own.axis[3 * k + 1] = tangent
    own.axis[3 * k + 2] = wp.cross(normal, tangent)
    # The forces of the last step are a good first guess.
    guess = vec3(zero, zero, zero)
    for e in range(solver.previous_contacts):
        held = problems.held[index, e]
        if wp.abs(held.arc - candidate.arc) < real(0.3) * candidate.link_arc:
            guess = held.force
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
    top = int(-1)
    for k in range(solver.own_count):
        if solver.thread + k < solver.contacts:
            top = wp.max(top, row(own.link, k))
    solver.last_link = warp_max(top)
    solver.warp_contacts = warp_max(solver.contacts)


@wp.func(inline=True)
def build_delassus(
    problems: ContactProblems, solver: wp.ref[SolverState], own: wp.ref[ThreadContacts], matrix: wp.ref[DelassusRows]
):
    """Carry unit forces up the chain and sum the rows of the Delassus matrix."""
    zero = real(0.0)
    none = vec3(zero, zero, zero)
    first_joint = solver.job * wp.static(capacity)
    count = solver.warp_contacts
    thread = solver.thread
    each = solver.own_count
    fw = PerRow3()
    fv = PerRow3()
    ju1 = PerRow1()
    ju2 = PerRow1()
    wu1 = PerRow1()
    wu2 = PerRow1()
    for r in range(3 * each):
        for e in range(3 * count):
            matrix[r * wp.static(row_size) + e] = zero
    for back in range(solver.last_link + 1):
        i = solver.last_link - back
        joint = first_joint + i
        for k in range(each):
            reached = thread + k < solver.contacts and row(own.link, k) >= i
            s1 = none
            s2 = none
            m1 = none
            m2 = none
            inv = none
            if reached:
                s1 = problems.joint[joint].axis1
                s2 = problems.joint[joint].axis2
                m1 = problems.joint[joint].moment1
                m2 = problems.joint[joint].moment2
                inv = problems.joint[joint].inverse_inertia
            for a in range(3):
                r = 3 * k + a
                u1 = zero
                u2 = zero
                if reached:
                    w = fw[r]
                    v = fv[r]
                    if row(own.link, k) == i:
                        v = row(own.axis, r)
                        w = wp.cross(row(own.point, k), v)
                    u1 = wp.dot(s1, w) + wp.dot(m1, v)
                    u2 = wp.dot(s2, w) + wp.dot(m2, v)
                    fw[r] = w - problems.joint[joint].gain1_w * u1 - problems.joint[joint].gain2_w * u2
                    fv[r] = v - problems.joint[joint].gain1_v * u1 - problems.joint[joint].gain2_v * u2
                ju1[r] = u1
                ju2[r] = u2
                wu1[r] = solver.step * (inv[0] * u1 + inv[1] * u2)
                wu2[r] = solver.step * (inv[1] * u1 + inv[2] * u2)
        for e in range(count):
            if wp.static(group_size > 1) or row(own.link, e) >= i:
                for b in range(3):
                    o1 = broadcast(ju1[wp.static(3 * stride) * e + b], e)
                    o2 = broadcast(ju2[wp.static(3 * stride) * e + b], e)
                    for r in range(wp.static(3 * stride) * e, 3 * each):
                        c = r * wp.static(row_size) + 3 * e + b
                        matrix[c] = row(matrix, c) + wu1[r] * o1 + wu2[r] * o2
    if wp.static(group_size == 1):
        for r in range(3 * count):
            for e in range(r):
                matrix[e * wp.static(row_size) + r] = row(matrix, r * wp.static(row_size) + e)
    for k in range(each):
        if thread + k < solver.contacts:
            c = 3 * (thread + k)
            r0 = 3 * k * wp.static(row_size)
            r1 = r0 + wp.static(row_size)
            r2 = r1 + wp.static(row_size)
            own.self_compliance[k, 0] = row(matrix, r0 + c)
            own.self_compliance[k, 1] = row(matrix, r0 + c + 1)
            own.self_compliance[k, 2] = row(matrix, r0 + c + 2)
            own.self_compliance[k, 3] = row(matrix, r1 + c + 1)
            own.self_compliance[k, 4] = row(matrix, r1 + c + 2)
            own.self_compliance[k, 5] = row(matrix, r2 + c + 2)
