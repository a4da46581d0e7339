"""Change of the contacts of a step: the solved conditions, and the system of the change of their forces.

With the velocity v at the end of the step, the closing rate κ = min(−g, crevice)/h, the force f, the normal n and the
direction of slip u, a pressing contact obeys c = 0 with

    sticking   c = v − κ n,
    sliding    c = n (n·v − κ) + σ (f − n (n·f) + μ (n·f) u),

three equations for the three components of f in world axes (σ only makes the units alike; frictionless: μ = 0). The
change of the forces solves (A G + B) δf = −δc − A w with A = ∂c/∂v (symmetric), B = ∂c/∂f, the Delassus matrix G, the
change δc at fixed accelerations and forces, and the change w of the velocities without a change of the forces.
"""

import warp as wp

from ..algebra import JointVector, mat33, spatial, vec3
from ..articulated_body import ChainState, ProximityState, force_over_joint, inverse_times, joint_record
from ..delassus import PerContact1, PerContact3, PerContactInt
from ..delassus import row as contact_row
from ..parameters import real
from ..state import WhiskerJob, row
from .newton import DenseSystem, dense_entry, solve_dense, width
from .records import ContactRecord, StepRecords

SLIDING = 1 - 1e-6
"""Share of the friction cone from which a contact slides: forces of recorded steps are solved to rounding."""


@wp.struct
class StepContacts:
    """Contacts of a step, in order of the record."""

    count: wp.int32
    link: PerContactInt
    slides: PerContactInt
    point: PerContact3
    normal: PerContact3
    force: PerContact3
    velocity: PerContact3
    """Against the object at the end of the step."""
    slip: PerContact3
    """Direction of slip."""
    coefficient: PerContact1
    """Coefficient of friction."""
    friction: PerContact1
    """Friction times normal force over the speed of slip."""
    scale: PerContact1
    """σ"""
    change: PerContact3
    """Change of the force."""


@wp.struct
class ContactSystem:
    """Room for what the contacts' system is made of."""

    unit: wp.array3d(dtype=JointVector)
    """[3 · contact, link, job] what the joints feel of a unit force at a contact."""


@wp.struct
class ContactSummary:
    """Contacts of all steps of a run: what changed, and how near they came to a change."""

    first: wp.int32
    """Contacts of the first step."""
    contacts: wp.int32
    """Contacts of the last step so far, and how many of them slide."""
    sliding: wp.int32
    begun: wp.int32
    """Steps with more contacts than the one before, with fewer, and with as many of which others slide."""
    ended: wp.int32
    slipped: wp.int32
    jumped: wp.int32
    """Steps in which a contact left one triangle for another that lies elsewhere along the link."""
    degenerate: wp.int32
    """Steps whose contacts had no unique derivative, or whose forces were not solved to rounding."""
    largest_force: real
    """Normal force (mN)."""
    least_force: real
    fastest_slip: real
    """Speed of sliding contacts (mm/ms)."""
    slowest_slip: real
    fullest_cone: real
    """Largest share of the friction cone that a sticking contact used."""
    least_gap: real
    """Least distance (mm) from closing, of what did not press."""
    least_lead: real
    """Least distance (mm) by which one link was chosen before the next one, which touched the same."""
    steps: wp.int32


@wp.func
def summarize(
    summary: wp.ref[ContactSummary], contacts: wp.ref[StepContacts], records: StepRecords, place: int, index: int
):
    """Add the next step."""
    step = records.step[place, index]
    if summary.steps == 0:
        summary.first = contacts.count
        summary.least_force = real(1e30)
        summary.slowest_slip = real(1e30)
        summary.least_gap = real(1e30)
        summary.least_lead = real(1e30)
    sliding = int(0)
    jumped = int(0)
    for k in range(contacts.count):
        now = records.contact[place, k, index]
        if place > 0:
            for e in range(records.step[place - 1, index].contacts):
                last = records.contact[place - 1, e, index]
                if last.link == now.link and last.shape == now.shape and last.triangle != now.triangle:
                    if wp.max(last.share, now.share) < real(1.0) and wp.abs(last.share - now.share) > real(0.01):
                        jumped = 1
        n = contact_row(contacts.normal, k)
        f = contact_row(contacts.force, k)
        v = contact_row(contacts.velocity, k)
        fn = wp.dot(n, f)
        summary.largest_force = wp.max(summary.largest_force, fn)
        summary.least_force = wp.min(summary.least_force, fn)
        if contact_row(contacts.slides, k) == 0:
            bound = fn * contact_row(contacts.coefficient, k)
            summary.fullest_cone = wp.max(summary.fullest_cone, wp.length(f - n * fn) / bound)
        elif contact_row(contacts.coefficient, k) > real(0.0):
            sliding = sliding + 1
            speed = wp.length(v - n * wp.dot(n, v))
            summary.fastest_slip = wp.max(summary.fastest_slip, speed)
            summary.slowest_slip = wp.min(summary.slowest_slip, speed)
    summary.least_gap = wp.min(summary.least_gap, wp.abs(step.open_gap))
    summary.least_lead = wp.min(summary.least_lead, step.lead)
    summary.degenerate = summary.degenerate + step.inexact
    summary.jumped = summary.jumped + jumped
    if summary.steps > 0:
        if contacts.count > summary.contacts:
            summary.begun = summary.begun + 1
        elif contacts.count < summary.contacts:
            summary.ended = summary.ended + 1
        elif summary.sliding != sliding:
            summary.slipped = summary.slipped + 1
    summary.contacts = contacts.count
    summary.sliding = sliding
    summary.steps = summary.steps + 1


@wp.func
def set_state(contacts: wp.ref[StepContacts], k: int, contact: ContactRecord, velocity: vec3):
    """Find whether a contact sticks or slides, and where to."""
    n = contact.normal
    f = contact.force
    fn = wp.dot(n, f)
    ft = f - n * fn
    vt = velocity - n * wp.dot(n, velocity)
    contacts.normal[k] = n
    contacts.force[k] = f
    contacts.velocity[k] = velocity
    contacts.slides[k] = 1
    contacts.coefficient[k] = contact.friction
    contacts.friction[k] = real(0.0)
    contacts.slip[k] = vec3()
    if contact.friction > real(0.0):
        if wp.length(ft) < real(wp.static(SLIDING)) * contact.friction * fn:
            contacts.slides[k] = 0
        else:
            # Friction is against the slip; its own direction is known also where hardly anything slips.
            contacts.slip[k] = -wp.normalize(ft)
            contacts.friction[k] = contact.friction * fn / wp.max(wp.length(vt), real(1e-9))


@wp.func
def velocity_block(contacts: wp.ref[StepContacts], k: int) -> mat33:
    """Return A = ∂c/∂v of a contact."""
    whole = wp.identity(n=3, dtype=real)
    if contact_row(contacts.slides, k) == 0:
        return whole
    n = contact_row(contacts.normal, k)
    u = contact_row(contacts.slip, k)
    turning = contact_row(contacts.scale, k) * contact_row(contacts.friction, k)
    return wp.outer(n, n) + (whole - wp.outer(n, n) - wp.outer(u, u)) * turning


@wp.func
def force_block(contacts: wp.ref[StepContacts], k: int) -> mat33:
    """Return B = ∂c/∂f of a contact."""
    if contact_row(contacts.slides, k) == 0:
        return mat33()
    n = contact_row(contacts.normal, k)
    away = contact_row(contacts.slip, k) * contact_row(contacts.coefficient, k) - n
    return (wp.identity(n=3, dtype=real) + wp.outer(away, n)) * contact_row(contacts.scale, k)


@wp.func
def carry_units(
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    contacts: wp.ref[StepContacts],
    system: ContactSystem,
):
    """Carry unit forces at the contacts up the factorised chain, as ``delassus.build_delassus`` does."""
    for k in range(contacts.count):
        for d in range(3):
            unit = vec3()
            unit[d] = real(1.0)
            force = spatial(wp.cross(contact_row(contacts.point, k), unit), unit)
            for back in range(contact_row(contacts.link, k) + 1):
                i = contact_row(contacts.link, k) - back
                felt = force_over_joint(joint_record(chain, proximity, i), i, force)
                system.unit[3 * k + d, i, job.index] = felt


@wp.func
def compliance(
    job: WhiskerJob,
    proximity: wp.ref[ProximityState],
    contacts: wp.ref[StepContacts],
    system: ContactSystem,
    k: int,
    e: int,
    h: real,
) -> mat33:
    """Return the block of the Delassus matrix G = h J H⁻¹ Jᵀ of two contacts."""
    block = mat33()
    for i in range(wp.min(contact_row(contacts.link, k), contact_row(contacts.link, e)) + 1):
        inverse = row(proximity.inverse_inertia, i)
        for a in range(3):
            moved = inverse_times(inverse, system.unit[3 * k + a, i, job.index]) * h
            for b in range(3):
                shared = wp.dot(moved, system.unit[3 * e + b, i, job.index])
                block[a, b] = block[a, b] + shared
    return block


@wp.func
def build_system(
    job: WhiskerJob,
    chain: wp.ref[ChainState],
    proximity: wp.ref[ProximityState],
    contacts: wp.ref[StepContacts],
    system: ContactSystem,
    h: real,
    matrix: wp.ref[DenseSystem],
):
    """Write the matrix A G + B of the change of the forces."""
    carry_units(job, chain, proximity, contacts, system)
    for k in range(contacts.count):
        own = compliance(job, proximity, contacts, system, k, k, h)
        contacts.scale[k] = (own[0, 0] + own[1, 1] + own[2, 2]) / real(3.0)
    for k in range(contacts.count):
        for e in range(contacts.count):
            block = velocity_block(contacts, k) * compliance(job, proximity, contacts, system, k, e, h)
            if k == e:
                block = block + force_block(contacts, k)
            for a in range(3):
                for b in range(3):
                    matrix[(3 * k + a) * wp.static(width) + 3 * e + b] = block[a, b]


@wp.func
def solve_system(contacts: wp.ref[StepContacts], matrix: wp.ref[DenseSystem], asked: wp.ref[PerContact3]) -> int:
    """Solve the system in place for the change of the forces; return 1 where contacts share a load in several ways."""
    size = 3 * contacts.count
    for r in range(size):
        matrix[r * wp.static(width) + size] = contact_row(asked, r // 3)[r % 3]
    degenerate = solve_dense(matrix, size)
    for k in range(contacts.count):
        for d in range(3):
            contacts.change[k, d] = dense_entry(matrix, (3 * k + d) * wp.static(width) + size)
    return degenerate
