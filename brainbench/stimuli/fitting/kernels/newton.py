"""Newton's method for the contact forces of recorded steps, which are solved to rounding.

Gauss-Seidel sweeps come near the forces but then gain a constant factor in each; where several contacts with friction
share a load that factor is close to 1. The Coulomb conditions as the roots of a projection (Alart & Curnier 1991,
Comput. Methods Appl. Mech. Eng. 92, 353) have a generalised derivative, whose steps converge quadratically: with the
rate r = G f + r₀ and z = fₜ − ρ rₜ, ρ > 0, a contact is

    open       f = 0                          if fₙ ≤ rₙ / Gₙₙ,
    sticking   r = 0                          if |z| ≤ μ fₙ,
    sliding    rₙ = 0, fₜ = μ fₙ z / |z|      else.

Whole steps may go round in circles; a step is halved until the conditions are missed by less than before it.
"""

from typing import Any

import warp as wp

from ..algebra import reader, vec3
from ..delassus import DelassusRows, PerRow1, SolverState, ThreadContacts, add_rates, own_rows, row, row_size
from ..parameters import real

NEWTON_STEPS = 30  # most steps; a start near the forces takes two to four
HALVINGS = 8  # most halvings of a step
SETTLED = 1e-9  # change of the forces in a step, as a share of the normal ones, from which the next would be rounding
CAUTIOUS, DIRECT = 0.3, 1.0
"""ρ times the tangential compliance of a contact, in turn: where one goes in circles, the other does not."""

width = row_size + 2
"""Numbers in a row: the matrix, the right-hand side, and whether the column of this number has a pivot."""
DenseSystem: Any = wp.types.vector(row_size * width, real)
dense_entry = reader((DenseSystem, real))


@wp.func
def solve_dense(system: wp.ref[DenseSystem], size: int) -> int:
    """Solve in place by Gauss-Jordan with pivots; return 1 where the solution is not unique.

    The solution of a column without pivot is 0; :func:`dense_entry` of row c at ``size`` is that of column c.
    """
    largest = real(0.0)
    for r in range(size):
        for c in range(size):
            largest = wp.max(largest, wp.abs(dense_entry(system, r * wp.static(width) + c)))
    degenerate = int(0)
    used = int(0)
    for c in range(size):
        best = used
        pivot = real(0.0)
        for r in range(used, size):
            value = dense_entry(system, r * wp.static(width) + c)
            if wp.abs(value) > wp.abs(pivot):
                best = r
                pivot = value
        has_pivot = real(0.0)
        if wp.abs(pivot) <= real(1e-11) * largest:
            degenerate = 1
        else:
            has_pivot = real(1.0)
            for e in range(c, size + 1):
                kept = dense_entry(system, used * wp.static(width) + e)
                system[used * wp.static(width) + e] = dense_entry(system, best * wp.static(width) + e) / pivot
                if best != used:
                    system[best * wp.static(width) + e] = kept
            for r in range(size):
                factor = dense_entry(system, r * wp.static(width) + c)
                if r != used and factor != real(0.0):
                    for e in range(c, size + 1):
                        at = r * wp.static(width) + e
                        system[at] = (
                            dense_entry(system, at) - factor * dense_entry(system, used * wp.static(width) + e)
                        )  # fmt: skip
            used = used + 1
        system[c * wp.static(width) + size + 1] = has_pivot
    # Rows stand in the order of the pivots; from the last on, each goes to its column.
    for back in range(size):
        c = size - 1 - back
        value = real(0.0)
        if dense_entry(system, c * wp.static(width) + size + 1) == real(1.0):
            used = used - 1
            value = dense_entry(system, used * wp.static(width) + size)
        system[c * wp.static(width) + size] = value
    return degenerate


@wp.struct
class ContactCondition:
    """State of one contact, and by how much it misses its condition."""

    pressing: wp.int32
    sticking: wp.int32
    missed: vec3
    """In units of a rate."""
    slip1: real
    """Direction of z."""
    slip2: real
    bound: real
    """Friction that a sliding contact has, and the same over the length of z."""
    across: real


@wp.func
def contact_condition(own: wp.ref[ThreadContacts], k: int, compliance: real) -> ContactCondition:
    """Return the condition of a contact; ``compliance`` is 1/ρ."""
    n = 3 * k
    fn = row(own.force, n)
    f1 = row(own.force, n + 1)
    f2 = row(own.force, n + 2)
    rn = row(own.rate, n)
    r1 = row(own.rate, n + 1)
    r2 = row(own.rate, n + 2)
    normal = row(own.self_compliance, k)[0]
    friction = row(own.friction, k)
    found = ContactCondition()
    if fn * normal <= rn:
        found.missed = vec3(fn * normal, f1 * compliance, f2 * compliance)
        return found
    found.pressing = 1
    z1 = f1 - r1 / compliance
    z2 = f2 - r2 / compliance
    length = wp.sqrt(z1 * z1 + z2 * z2)
    found.bound = friction * wp.max(fn, real(0.0))
    if friction > real(0.0) and length <= found.bound:
        found.sticking = 1
        found.missed = vec3(rn, r1, r2)
        return found
    if length > real(0.0):
        found.slip1 = z1 / length
        found.slip2 = z2 / length
        found.across = found.bound / length
    found.missed = vec3(
        rn, (f1 - found.bound * found.slip1) * compliance, (f2 - found.bound * found.slip2) * compliance
    )
    return found


@wp.func
def missed_by(solver: wp.ref[SolverState], own: wp.ref[ThreadContacts], caution: real) -> real:
    """Return the sum of squares by which all contacts miss their conditions."""
    total = real(0.0)
    for k in range(solver.contacts):
        block = row(own.self_compliance, k)
        total = total + wp.length_sq(contact_condition(own, k, (block[3] + block[5]) / caution).missed)
    return total


@wp.func
def write_equations(
    own: wp.ref[ThreadContacts],
    matrix: wp.ref[DelassusRows],
    k: int,
    size: int,
    caution: real,
    system: wp.ref[DenseSystem],
):
    """Write the three linear equations of a contact for the change of all forces, by the state it is in."""
    zero = real(0.0)
    n = 3 * k
    block = row(own.self_compliance, k)
    compliance = (block[3] + block[5]) / caution
    now = contact_condition(own, k, compliance)
    for e in range(size):
        at = e * wp.static(own_rows) + n
        g0 = row(matrix, at)
        g1 = row(matrix, at + 1)
        g2 = row(matrix, at + 2)
        if now.pressing == 0:
            g0 = wp.where(e == n, block[0], zero)
        if now.sticking == 0:
            d1 = wp.where(e == n + 1, compliance, zero)
            d2 = wp.where(e == n + 2, compliance, zero)
            if now.pressing == 1:
                c1 = (d1 - g1) * now.across
                c2 = (d2 - g2) * now.across
                along = now.slip1 * c1 + now.slip2 * c2
                grown = wp.where(e == n, row(own.friction, k) * compliance, zero)
                d1 = d1 - c1 + now.slip1 * (along - grown)
                d2 = d2 - c2 + now.slip2 * (along - grown)
            g1 = d1
            g2 = d2
        system[n * wp.static(width) + e] = g0
        system[(n + 1) * wp.static(width) + e] = g1
        system[(n + 2) * wp.static(width) + e] = g2
    for d in range(3):
        system[(n + d) * wp.static(width) + size] = -now.missed[d]


@wp.func
def add_step(
    solver: wp.ref[SolverState],
    own: wp.ref[ThreadContacts],
    matrix: wp.ref[DelassusRows],
    system: wp.ref[DenseSystem],
    share: real,
) -> real:
    """Add a share of the step to the forces and to their rates; return the step's size over the normal forces."""
    size = 3 * solver.contacts
    change = real(0.0)
    total = real(1e-30)
    for k in range(solver.contacts):
        step = vec3(
            dense_entry(system, (3 * k) * wp.static(width) + size),
            dense_entry(system, (3 * k + 1) * wp.static(width) + size),
            dense_entry(system, (3 * k + 2) * wp.static(width) + size),
        )
        for d in range(3):
            own.force[3 * k + d] = row(own.force, 3 * k + d) + share * step[d]
            change = change + wp.abs(step[d])
        total = total + wp.abs(row(own.force, 3 * k))
        add_rates(own, matrix, k, step * share, solver.own_count)
    return change / total


@wp.func
def newton_forces(
    solver: wp.ref[SolverState], own: wp.ref[ThreadContacts], matrix: wp.ref[DelassusRows], caution: real
) -> int:
    """Take Newton steps from the forces as they are, whose rates are known; keep them only if they settle: then 1."""
    kept = PerRow1()
    system = DenseSystem()
    size = 3 * solver.contacts
    for r in range(size):
        kept[r] = row(own.force, r)
    settled = int(0)
    before = missed_by(solver, own, caution)
    for _ in range(wp.static(NEWTON_STEPS) + solver.unknown_zero):
        if settled == 0:
            for k in range(solver.contacts):
                write_equations(own, matrix, k, size, caution, system)
            solve_dense(system, size)
            if add_step(solver, own, matrix, system, real(1.0)) <= real(wp.static(SETTLED)):
                settled = 1
            share = real(1.0)
            after = missed_by(solver, own, caution)
            for _ in range(wp.static(HALVINGS) + solver.unknown_zero):
                if settled == 0 and not (after < before):
                    share = share * real(0.5)
                    add_step(solver, own, matrix, system, -share)
                    after = missed_by(solver, own, caution)
            before = after
    for k in range(solver.contacts):
        block = row(own.self_compliance, k)
        if contact_condition(own, k, (block[3] + block[5]) / caution).pressing == 0:
            # What rounding left of it.
            for d in range(3):
                own.force[3 * k + d] = real(0.0)
        elif not (row(own.force, 3 * k) > real(0.0)):
            settled = 0
    if settled == 0:
        for r in range(size):
            own.force[r] = row(kept, r)
    return settled
