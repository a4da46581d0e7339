"""Which contacts take part in a step, and how they give way to their forces: the rows of the Delassus matrix."""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.kernels.contact_memory import grasps
from brainbench.stimuli.engines.rod.kernels.inputs import structs
from brainbench.stimuli.engines.rod.kernels.thread_groups import groups
from brainbench.stimuli.engines.rod.limits import CREVICE


@cache
def compliances(real: type, capacity: int, held: int, lanes: int) -> SimpleNamespace:
    """Return ``collect`` and ``comply``; see :func:`brainbench.stimuli.engines.rod.kernels.contacts.contacts`."""
    import warp as wp

    vec3: Any = wp.types.vector(3, real)
    kept, group, Grips = grasps(real, capacity, held, lanes), groups(real, lanes), structs(real).Grips
    Own, Grasp, Table, Rows1, Rows3, row = kept.Own, kept.Grasp, kept.Table, kept.Rows1, kept.Rows3, kept.row
    rows, tall, seen_most = kept.rows, kept.tall, kept.seen_most
    give, most = group.give, group.most

    @wp.func(inline=True)
    def take(gp: Grips, grasp: wp.ref[Grasp], own: wp.ref[Own], k: int, slot: int):
        """Make a place of possible contact the contact k of this thread."""
        zero = real(0.0)
        lane = grasp.lane
        link0 = lane * wp.static(capacity)
        spot = lane * wp.static(seen_most) + slot
        i = gp.spot_link[spot]
        size4 = gp.spot_size[spot]
        normal = gp.spot[spot, 1]
        moving = gp.spot[spot, 2]
        # One tangent along the whisker, where it tends to slide.
        along = gp.spot[spot, 3]
        tangent = along - normal * wp.dot(along, normal)
        if wp.length_sq(tangent) < real(1e-8) * wp.length_sq(along):
            e2 = gp.chain[link0 + i, 1]
            tangent = e2 - normal * wp.dot(e2, normal)
        tangent = wp.normalize(tangent)
        own.link[k] = i
        own.arc[k] = size4[1]
        own.mu[k] = size4[2]
        own.at[k] = gp.spot[spot, 0]
        # A deep overlap is undone over several steps.
        own.gap[k] = wp.min(-size4[0], real(wp.static(CREVICE))) / grasp.h
        own.axis[3 * k] = normal
        own.axis[3 * k + 1] = tangent
        own.axis[3 * k + 2] = wp.cross(normal, tangent)
        # The forces of the last step are a good first guess.
        guess = vec3(zero, zero, zero)
        for e in range(grasp.before):
            grip = gp.held[lane, e]
            if wp.abs(grip[0] - size4[1]) < real(0.3) * size4[3]:
                guess = vec3(grip[1], grip[2], grip[3])
        for a in range(3):
            own.free[3 * k + a] = wp.dot(row(own.axis, 3 * k + a), moving)
            own.force[3 * k + a] = wp.dot(guess, row(own.axis, 3 * k + a))
        own.force[3 * k] = wp.max(zero, row(own.force, 3 * k))

    @wp.func(inline=True)
    def collect(gp: Grips, grasp: wp.ref[Grasp], own: wp.ref[Own], doing: int):
        """Contact where the whisker would close a gap, the deepest first."""
        spot0 = grasp.lane * wp.static(seen_most)
        for _ in range(wp.static(held) + grasp.loose):
            slot = int(-1)
            if doing == 1 and grasp.contacts < wp.static(held):
                lowest = real(0.0)
                for j in range(grasp.seen):
                    if (grasp.taken >> j) % 2 == 0 and gp.ahead[spot0 + j] < lowest:
                        lowest = gp.ahead[spot0 + j]
                        slot = j
            if slot >= 0:
                grasp.taken = grasp.taken + (1 << slot)
                if wp.static(lanes == 1) or grasp.contacts == grasp.part:
                    take(gp, grasp, own, wp.static(tall) * grasp.contacts, slot)
                grasp.contacts = grasp.contacts + 1
        top = int(-1)
        for k in range(grasp.each):
            if grasp.part + k < grasp.contacts:
                top = wp.max(top, row(own.link, k))
        grasp.top = most(top)
        grasp.span = most(grasp.contacts)

    @wp.func(inline=True)
    def comply(gp: Grips, grasp: wp.ref[Grasp], own: wp.ref[Own], table: wp.ref[Table]):
        """Up the chain: what a unit force at one contact does at the others."""
        zero = real(0.0)
        none = vec3(zero, zero, zero)
        link0 = grasp.lane * wp.static(capacity)
        span = grasp.span
        part = grasp.part
        each = grasp.each
        fw = Rows3()
        fv = Rows3()
        ju1 = Rows1()
        ju2 = Rows1()
        wu1 = Rows1()
        wu2 = Rows1()
        for r in range(3 * each):
            for e in range(3 * span):
                table[r * wp.static(rows) + e] = zero
        for back in range(grasp.top + 1):
            i = grasp.top - back
            for k in range(each):
                reached = part + k < grasp.contacts and row(own.link, k) >= i
                s1 = none
                s2 = none
                m1 = none
                m2 = none
                inv = none
                if reached:
                    s1 = gp.chain[link0 + i, 0]
                    s2 = gp.chain[link0 + i, 1]
                    m1 = gp.chain[link0 + i, 2]
                    m2 = gp.chain[link0 + i, 3]
                    inv = gp.chain[link0 + i, 8]
                for a in range(3):
                    r = 3 * k + a
                    u1 = zero
                    u2 = zero
                    if reached:
                        w = fw[r]
                        v = fv[r]
                        if row(own.link, k) == i:
                            v = row(own.axis, r)
                            w = wp.cross(row(own.at, k), v)
                        u1 = wp.dot(s1, w) + wp.dot(m1, v)
                        u2 = wp.dot(s2, w) + wp.dot(m2, v)
                        fw[r] = w - gp.chain[link0 + i, 4] * u1 - gp.chain[link0 + i, 6] * u2
                        fv[r] = v - gp.chain[link0 + i, 5] * u1 - gp.chain[link0 + i, 7] * u2
                    ju1[r] = u1
                    ju2[r] = u2
                    wu1[r] = grasp.h * (inv[0] * u1 + inv[1] * u2)
                    wu2[r] = grasp.h * (inv[1] * u1 + inv[2] * u2)
            for e in range(span):
                if wp.static(lanes > 1) or row(own.link, e) >= i:
                    for b in range(3):
                        o1 = give(ju1[wp.static(3 * tall) * e + b], e)
                        o2 = give(ju2[wp.static(3 * tall) * e + b], e)
                        for r in range(wp.static(3 * tall) * e, 3 * each):
                            c = r * wp.static(rows) + 3 * e + b
                            table[c] = row(table, c) + wu1[r] * o1 + wu2[r] * o2
        if wp.static(lanes == 1):
            for r in range(3 * span):
                for e in range(r):
                    table[e * wp.static(rows) + r] = row(table, r * wp.static(rows) + e)
        for k in range(each):
            if part + k < grasp.contacts:
                c = 3 * (part + k)
                r0 = 3 * k * wp.static(rows)
                r1 = r0 + wp.static(rows)
                r2 = r1 + wp.static(rows)
                own.block[k, 0] = row(table, r0 + c)
                own.block[k, 1] = row(table, r0 + c + 1)
                own.block[k, 2] = row(table, r0 + c + 2)
                own.block[k, 3] = row(table, r1 + c + 1)
                own.block[k, 4] = row(table, r1 + c + 2)
                own.block[k, 5] = row(table, r2 + c + 2)

    return SimpleNamespace(collect=collect, comply=comply)
