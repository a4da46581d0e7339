"""The contacts of one step of a whisker: which take part, their compliance, their forces, and what these move.

A group of threads takes one whisker, each thread one contact: it carries the contact's three forces up the chain, owns
three rows of the compliance (Delassus) matrix, and solves for its forces when its turn comes in the Gauss-Seidel
sweeps; the others learn of them by shuffles. A group of one, on the CPU, holds all contacts; the source is the same.
Groups of a warp stay together: what one has finished it repeats without keeping it.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.backends.rod._groups import groups
from brainbench.stimuli.backends.rod._limits import CLOSED, CREVICE, ROUNDS, SPARE, SWEEPS, contacts_for
from brainbench.stimuli.backends.rod._structs import structs


@cache
def contacts(real: type, capacity: int, held: int, lanes: int) -> SimpleNamespace:
    """Return ``settle(grips, lane, part, live)``, which finds the contact forces of a whisker.

    Args:
        real: ``warp.float32`` or ``warp.float64``.
        capacity: links that fit.
        held: contacts that fit.
        lanes: threads of a group: 1, or a power of two that is no less than ``held``.

    ``part`` is the thread's place in its group, ``live`` whether the group has a whisker or only keeps others company.
    """
    import warp as wp

    vec2: Any = wp.types.vector(2, real)
    vec3: Any = wp.types.vector(3, real)
    vec4: Any = wp.types.vector(4, real)
    Grips = structs(real).Grips
    group = groups(real, lanes)
    give, total, greatest, joined, most = group.give, group.total, group.greatest, group.joined, group.most
    seen_most = contacts_for(capacity) + SPARE
    rows = 3 * held
    own = held if lanes == 1 else 1
    # Where in a thread's memory the contact of another place lies: a thread of many holds but one.
    tall = 1 if lanes == 1 else 0
    # Memory of a thread. Vectors and matrices, because arrays in a kernel carry addresses that the compiler loses.
    Links2: Any = wp.types.matrix((capacity, 2), real)
    OwnWhole: Any = wp.types.vector(own, wp.int32)
    Own: Any = wp.types.vector(own, real)
    Own3: Any = wp.types.matrix((own, 3), real)
    vec6: Any = wp.types.vector(6, real)
    Own6: Any = wp.types.matrix((own, 6), real)
    Rows3: Any = wp.types.matrix((3 * own, 3), real)
    Rows: Any = wp.types.vector(3 * own, real)
    Table: Any = wp.types.vector(3 * own * rows, real)
    Square: Any = wp.types.vector(own * held, real)

    @wp.func
    def at_contact(own6: vec6, bn: real, b1: real, b2: real, p0: real, q0: real, mu: real, tries: int) -> vec3:
        """Forces of one contact alone (normal, two tangents), given the rates without it and its last slip."""
        zero = real(0.0)
        one = real(1.0)
        nn = own6[0]
        n1 = own6[1]
        n2 = own6[2]
        c11 = own6[3]
        c12 = own6[4]
        c22 = own6[5]
        fn = zero
        f1 = zero
        f2 = zero
        if bn < zero:
            fn = -bn / nn
            if mu > zero:
                # Sticking: solve for all three, tangents eliminated first.
                det = c11 * c22 - c12 * c12
                stuck = int(0)
                if det > real(1e-9) * c11 * c22:
                    tb1 = -(c22 * b1 - c12 * b2) / det
                    tb2 = -(c11 * b2 - c12 * b1) / det
                    ta1 = -(c22 * n1 - c12 * n2) / det
                    ta2 = -(c11 * n2 - c12 * n1) / det
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
                    pace = one / (c11 + c22)
                    for _ in range(tries):
                        fn = wp.max(zero, -(bn + n1 * f1 + n2 * f2) / nn)
                        s1_ = f1 - pace * (b1 + n1 * fn + c11 * f1 + c12 * f2)
                        s2_ = f2 - pace * (b2 + n2 * fn + c12 * f1 + c22 * f2)
                        size = wp.sqrt(s1_ * s1_ + s2_ * s2_)
                        bound = mu * fn
                        if size > bound:
                            s1_ = s1_ * (bound / size)
                            s2_ = s2_ * (bound / size)
                        moved_by = wp.abs(f1 - s1_) + wp.abs(f2 - s2_)
                        f1 = s1_
                        f2 = s2_
                        if moved_by <= real(1e-4) * bound:
                            break
                    fn = wp.max(zero, -(bn + n1 * f1 + n2 * f2) / nn)
        # Two contacts at one point may leave nothing to divide by.
        if not (fn + wp.abs(f1) + wp.abs(f2) < real(1e6)):
            fn = zero
            f1 = zero
            f2 = zero
        return vec3(fn, f1, f2)

    @wp.func
    def settle(gp: Grips, lane: int, part: int, live: int):
        zero = real(0.0)
        one = real(1.0)
        none = vec3(zero, zero, zero)
        links = gp.counts[lane, 0]
        seen = gp.counts[lane, 1]
        before = gp.counts[lane, 2]
        plan = gp.plan[lane]
        h = plan[0]
        link0 = lane * wp.static(capacity)
        spot0 = lane * wp.static(seen_most)
        # Counts that the compiler does not know keep it from writing loops out.
        loose = wp.min(0, lane)
        slip_tries = int(8) + loose
        guess_tries = int(10) + loose
        rounds_most = int(wp.static(ROUNDS)) + loose
        sweeps_most = int(wp.static(SWEEPS)) + loose
        each = int(wp.static(own)) + wp.static(tall) * loose

        link = OwnWhole()
        arc = Own()
        gap = Own()
        mu = Own()
        at = Own3()
        axis = Rows3()
        fw = Rows3()
        fv = Rows3()
        ju1 = Rows()
        ju2 = Rows()
        wu1 = Rows()
        wu2 = Rows()
        free = Rows()
        force = Rows()
        rate = Rows()
        block = Own6()
        table = Table()
        ratio1 = Own()
        ratio2 = Own()
        asked = Own()
        load = Own()
        opening = Own()
        share = Own()
        square = Square()
        work = Square()
        lift = Links2()

        contacts = int(0)
        taken = int(0)
        more = live
        crowded = int(0)
        for round_ in range(rounds_most):
            doing = more
            if most(doing) == 1:
                # Contact where the whisker would close a gap, the deepest first.
                for _ in range(wp.static(held) + loose):
                    slot = int(-1)
                    if doing == 1 and contacts < wp.static(held):
                        lowest = zero
                        for j in range(seen):
                            if (taken >> j) % 2 == 0 and gp.ahead[spot0 + j] < lowest:
                                lowest = gp.ahead[spot0 + j]
                                slot = j
                    if slot >= 0:
                        taken = taken + (1 << slot)
                        if wp.static(lanes == 1) or contacts == part:
                            k = wp.static(tall) * contacts
                            i = gp.spot_link[spot0 + slot]
                            size4 = gp.spot_size[spot0 + slot]
                            normal = gp.spot[spot0 + slot, 1]
                            moving = gp.spot[spot0 + slot, 2]
                            # One tangent along the whisker, where it tends to slide.
                            along = gp.spot[spot0 + slot, 3]
                            tangent = along - normal * wp.dot(along, normal)
                            if wp.length_sq(tangent) < real(1e-8) * wp.length_sq(along):
                                e2 = gp.chain[link0 + i, 1]
                                tangent = e2 - normal * wp.dot(e2, normal)
                            tangent = wp.normalize(tangent)
                            link[k] = i
                            arc[k] = size4[1]
                            mu[k] = size4[2]
                            at[k] = gp.spot[spot0 + slot, 0]
                            # A deep overlap is undone over several steps.
                            gap[k] = wp.min(-size4[0], real(wp.static(CREVICE))) / h
                            axis[3 * k] = normal
                            axis[3 * k + 1] = tangent
                            axis[3 * k + 2] = wp.cross(normal, tangent)
                            # The forces of the last step are a good first guess.
                            guess = none
                            for e in range(before):
                                grip = gp.held[lane, e]
                                if wp.abs(grip[0] - size4[1]) < real(0.3) * size4[3]:
                                    guess = vec3(grip[1], grip[2], grip[3])
                            for a in range(3):
                                free[3 * k + a] = wp.dot(axis[3 * k + a], moving)
                                force[3 * k + a] = wp.dot(guess, axis[3 * k + a])
                            force[3 * k] = wp.max(zero, force[3 * k])
                        contacts = contacts + 1
                top = int(-1)
                for k in range(each):
                    if part + k < contacts:
                        top = wp.max(top, link[k])
                top = most(top)
                span = most(contacts)

                # Up the chain: what a unit force at one contact does at the others.
                for r in range(3 * each):
                    for e in range(3 * span):
                        table[r * wp.static(rows) + e] = zero
                for back in range(top + 1):
                    i = top - back
                    for k in range(each):
                        reached = part + k < contacts and link[k] >= i
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
                                if link[k] == i:
                                    v = axis[r]
                                    w = wp.cross(at[k], v)
                                u1 = wp.dot(s1, w) + wp.dot(m1, v)
                                u2 = wp.dot(s2, w) + wp.dot(m2, v)
                                fw[r] = w - gp.chain[link0 + i, 4] * u1 - gp.chain[link0 + i, 6] * u2
                                fv[r] = v - gp.chain[link0 + i, 5] * u1 - gp.chain[link0 + i, 7] * u2
                            ju1[r] = u1
                            ju2[r] = u2
                            wu1[r] = h * (inv[0] * u1 + inv[1] * u2)
                            wu2[r] = h * (inv[1] * u1 + inv[2] * u2)
                    for e in range(span):
                        if wp.static(lanes > 1) or link[e] >= i:
                            for b in range(3):
                                o1 = give(ju1[wp.static(3 * tall) * e + b], e)
                                o2 = give(ju2[wp.static(3 * tall) * e + b], e)
                                for r in range(wp.static(3 * tall) * e, 3 * each):
                                    table[r * wp.static(rows) + 3 * e + b] = (
                                        table[r * wp.static(rows) + 3 * e + b] + wu1[r] * o1 + wu2[r] * o2
                                    )
                if wp.static(lanes == 1):
                    for r in range(3 * span):
                        for e in range(r):
                            table[e * wp.static(rows) + r] = table[r * wp.static(rows) + e]
                for k in range(each):
                    if part + k < contacts:
                        c = 3 * (part + k)
                        r0 = 3 * k * wp.static(rows)
                        r1 = r0 + wp.static(rows)
                        r2 = r1 + wp.static(rows)
                        block[k, 0] = table[r0 + c]
                        block[k, 1] = table[r0 + c + 1]
                        block[k, 2] = table[r0 + c + 2]
                        block[k, 3] = table[r1 + c + 1]
                        block[k, 4] = table[r1 + c + 2]
                        block[k, 5] = table[r2 + c + 2]

                # Forces of rigid contacts with Coulomb friction: projected Gauss-Seidel, one contact at a time.
                settled = 1 - doing
                refresh = doing
                change = zero
                moved_force = zero
                whole_force = zero
                for sweep in range(sweeps_most):
                    if most(1 - settled) == 1:
                        if most(refresh) == 1:
                            # Rates at the contacts, less those that would just close the gaps.
                            if refresh == 1:
                                for k in range(each):
                                    rate[3 * k] = free[3 * k] - gap[k]
                                    rate[3 * k + 1] = free[3 * k + 1]
                                    rate[3 * k + 2] = free[3 * k + 2]
                            for e in range(span):
                                for b in range(3):
                                    pull = give(force[wp.static(3 * tall) * e + b], e)
                                    if refresh == 1:
                                        for r in range(3 * each):
                                            rate[r] = rate[r] + table[r * wp.static(rows) + 3 * e + b] * pull
                            refresh = 0
                        far_off = zero
                        by_now = zero
                        in_all = zero
                        for c in range(span):
                            d0 = zero
                            d1 = zero
                            d2 = zero
                            mine = wp.static(lanes == 1) or c == part
                            if mine and settled == 0 and c < contacts:
                                k = wp.static(tall) * c
                                n0 = force[3 * k]
                                p0 = force[3 * k + 1]
                                q0 = force[3 * k + 2]
                                missed = rate[3 * k]
                                bn = missed - block[k, 0] * n0 - block[k, 1] * p0 - block[k, 2] * q0
                                b1 = rate[3 * k + 1] - block[k, 1] * n0 - block[k, 3] * p0 - block[k, 4] * q0
                                b2 = rate[3 * k + 2] - block[k, 2] * n0 - block[k, 4] * p0 - block[k, 5] * q0
                                found = at_contact(block[k], bn, b1, b2, p0, q0, mu[k], slip_tries)
                                force[3 * k] = found[0]
                                force[3 * k + 1] = found[1]
                                force[3 * k + 2] = found[2]
                                d0 = found[0] - n0
                                d1 = found[1] - p0
                                d2 = found[2] - q0
                                # By how much (mm) the forces so far miss the gap that they should leave.
                                if n0 == zero:
                                    missed = wp.min(missed, zero)
                                slipped = block[k, 3] * wp.abs(d1) + block[k, 5] * wp.abs(d2)
                                far_off = wp.max(far_off, h * (wp.abs(missed) + slipped))
                                by_now += wp.abs(d0) + wp.abs(d1) + wp.abs(d2)
                                in_all += found[0]
                            d0 = give(d0, c)
                            d1 = give(d1, c)
                            d2 = give(d2, c)
                            for r in range(3 * each):
                                e = r * wp.static(rows) + 3 * c
                                rate[r] = rate[r] + table[e] * d0 + table[e + 1] * d1 + table[e + 2] * d2
                        far_off = greatest(far_off)
                        by_now = total(by_now)
                        in_all = total(in_all)
                        if settled == 0:
                            change = far_off
                            moved_force = by_now
                            whole_force = in_all
                            if change <= real(1e-4) or moved_force <= real(1e-4) * whole_force:
                                settled = 1
                        guessing = int(0)
                        if settled == 0 and contacts > 1 and sweep % 2 == 1:
                            guessing = 1
                        if most(guessing) == 1:
                            # Neighbouring contacts share a load in ways that Gauss-Seidel finds slowly: solve for all
                            # normal forces at once, those of sliding contacts with their friction.
                            pressing = int(0)
                            for k in range(each):
                                ratio1[k] = zero
                                ratio2[k] = zero
                                asked[k] = gap[k] - free[3 * k]
                                if part + k < contacts:
                                    if force[3 * k] > zero:
                                        pressing = pressing + (1 << (part + k))
                                    f1 = force[3 * k + 1]
                                    f2 = force[3 * k + 2]
                                    size = wp.sqrt(f1 * f1 + f2 * f2)
                                    if size > zero and size >= real(0.999) * mu[k] * force[3 * k]:
                                        ratio1[k] = mu[k] * f1 / size
                                        ratio2[k] = mu[k] * f2 / size
                            pressing = joined(pressing)
                            for e in range(span):
                                slide1 = give(ratio1[wp.static(tall) * e], e)
                                slide2 = give(ratio2[wp.static(tall) * e], e)
                                stick1 = give(force[wp.static(3 * tall) * e + 1], e)
                                stick2 = give(force[wp.static(3 * tall) * e + 2], e)
                                if slide1 != zero or slide2 != zero:
                                    stick1 = zero
                                    stick2 = zero
                                for k in range(each):
                                    r = 3 * k * wp.static(rows) + 3 * e
                                    square[k * wp.static(held) + e] = (
                                        table[r] + table[r + 1] * slide1 + table[r + 2] * slide2
                                    )
                                    asked[k] = asked[k] - table[r + 1] * stick1 - table[r + 2] * stick2
                            agreed = 1 - guessing
                            for _ in range(guess_tries):
                                if most(1 - agreed) == 1:
                                    # Gauss-Jordan, every contact its own row.
                                    for k in range(each):
                                        mine_in = (pressing >> (part + k)) % 2
                                        for e in range(span):
                                            keep = zero
                                            if mine_in == 1 and (pressing >> e) % 2 == 1:
                                                keep = square[k * wp.static(held) + e]
                                            elif part + k == e:
                                                keep = one
                                            work[k * wp.static(held) + e] = keep
                                        load[k] = zero
                                        if mine_in == 1:
                                            load[k] = asked[k]
                                    for p in range(span):
                                        row = wp.static(tall * held) * p
                                        pivot = give(work[row + p], p)
                                        known = give(load[wp.static(tall) * p], p)
                                        for k in range(each):
                                            share[k] = zero
                                            if part + k != p:
                                                share[k] = work[k * wp.static(held) + p] / pivot
                                            load[k] = load[k] - share[k] * known
                                        for e in range(p + 1, span):
                                            value = give(work[row + e], p)
                                            for k in range(each):
                                                work[k * wp.static(held) + e] = (
                                                    work[k * wp.static(held) + e] - share[k] * value
                                                )
                                    worst = int(-1)
                                    lowest = zero
                                    for k in range(each):
                                        if part + k < span:
                                            load[k] = load[k] / work[k * wp.static(held) + part + k]
                                        opening[k] = -asked[k]
                                    for e in range(span):
                                        value = give(load[wp.static(tall) * e], e)
                                        if value < lowest:
                                            lowest = value
                                            worst = e
                                        for k in range(each):
                                            opening[k] = opening[k] + square[k * wp.static(held) + e] * value
                                    # A contact that pulls lets go; one that would open into the object presses.
                                    flip = worst
                                    lowest = real(-1e-6) / h
                                    for e in range(span):
                                        value = give(opening[wp.static(tall) * e], e)
                                        if worst < 0 and e < contacts and (pressing >> e) % 2 == 0 and value < lowest:
                                            lowest = value
                                            flip = e
                                    if agreed == 0:
                                        if flip < 0:
                                            agreed = 1
                                        else:
                                            pressing = pressing ^ (1 << flip)
                            wild = zero
                            for k in range(each):
                                if part + k < contacts and not (wp.abs(load[k]) < real(1e6)):
                                    wild = one
                            wild = greatest(wild)
                            if guessing == 1 and agreed == 1 and wild == zero:
                                refresh = 1
                                for k in range(each):
                                    if part + k < contacts:
                                        fn = load[k]
                                        f1 = force[3 * k + 1]
                                        f2 = force[3 * k + 2]
                                        if ratio1[k] != zero or ratio2[k] != zero:
                                            f1 = ratio1[k] * fn
                                            f2 = ratio2[k] * fn
                                        else:
                                            size = wp.sqrt(f1 * f1 + f2 * f2)
                                            if size > mu[k] * fn:
                                                f1 = f1 * (mu[k] * fn / size)
                                                f2 = f2 * (mu[k] * fn / size)
                                        force[3 * k] = fn
                                        force[3 * k + 1] = f1
                                        force[3 * k + 2] = f2

                # Apply them: forces up the chain, then the change of acceleration down.
                tw = none
                tv = none
                for back in range(top + 1):
                    i = top - back
                    for k in range(each):
                        if part + k < contacts and link[k] == i:
                            pull3 = axis[3 * k] * force[3 * k]
                            pull3 = pull3 + axis[3 * k + 1] * force[3 * k + 1] + axis[3 * k + 2] * force[3 * k + 2]
                            tv = tv + pull3
                            tw = tw + wp.cross(at[k], pull3)
                    u1 = zero
                    u2 = zero
                    if i < links:
                        u1 = wp.dot(gp.chain[link0 + i, 0], tw) + wp.dot(gp.chain[link0 + i, 2], tv)
                        u2 = wp.dot(gp.chain[link0 + i, 1], tw) + wp.dot(gp.chain[link0 + i, 3], tv)
                        tw = tw - gp.chain[link0 + i, 4] * u1 - gp.chain[link0 + i, 6] * u2
                        tv = tv - gp.chain[link0 + i, 5] * u1 - gp.chain[link0 + i, 7] * u2
                    u1 = total(u1)
                    u2 = total(u2)
                    if i < links:
                        inv = gp.chain[link0 + i, 8]
                        lift[i] = vec2(inv[0] * u1 + inv[1] * u2, inv[1] * u1 + inv[2] * u2)
                tw = vec3(total(tw[0]), total(tw[1]), total(tw[2]))
                tv = vec3(total(tv[0]), total(tv[1]), total(tv[2]))
                if doing == 1:
                    more = int(0)
                    aw = none
                    av = none
                    for i in range(links):
                        extra = vec2(zero, zero)
                        if i <= top:
                            extra = lift[i]
                        a1 = extra[0] - wp.dot(gp.chain[link0 + i, 4], aw) - wp.dot(gp.chain[link0 + i, 5], av)
                        a2 = extra[1] - wp.dot(gp.chain[link0 + i, 6], aw) - wp.dot(gp.chain[link0 + i, 7], av)
                        aw = aw + gp.chain[link0 + i, 0] * a1 + gp.chain[link0 + i, 1] * a2
                        av = av + gp.chain[link0 + i, 2] * a1 + gp.chain[link0 + i, 3] * a2
                        if part == 0:
                            gp.mend[lane, i] = vec2(a1, a2)
                        if contacts < seen:
                            for j in range(seen):
                                if gp.spot_link[spot0 + j] == i and (taken >> j) % 2 == 0:
                                    moved = gp.spot[spot0 + j, 2] + (av + wp.cross(aw, gp.spot[spot0 + j, 0])) * h
                                    ahead = gp.spot_size[spot0 + j][0] + h * wp.dot(gp.spot[spot0 + j, 1], moved)
                                    gp.ahead[spot0 + j] = ahead
                                    if ahead < real(-wp.static(CLOSED)):
                                        more = int(1)
                    if more == 1 and (contacts == wp.static(held) or round_ == wp.static(ROUNDS - 1)):
                        more = int(0)
                        crowded = crowded + 1
                    if more == 0 and part == 0:
                        unsolved = int(0)
                        miss = zero
                        if settled == 0 and change > real(1e-2) and moved_force > real(1e-2) * whole_force:
                            unsolved = int(1)
                            miss = moved_force * moved_force
                        gp.counts[lane, 2] = contacts
                        gp.counts[lane, 3] = crowded
                        gp.counts[lane, 4] = unsolved
                        gp.answer[lane, 0] = gp.answer[lane, 0] - tw
                        gp.answer[lane, 1] = gp.answer[lane, 1] - tv
                        gp.answer[lane, 2] = gp.answer[lane, 2] + av + wp.cross(aw, vec3(plan[1], plan[2], plan[3]))
                        gp.answer[lane, 3] = vec3(miss, whole_force * whole_force, zero)
        # What the contacts do together, and their forces for the next step.
        pressed = none
        twisted = none
        heavy = zero
        arm = zero
        for k in range(each):
            if part + k < contacts and live == 1:
                pull3 = axis[3 * k] * force[3 * k]
                pull3 = pull3 + axis[3 * k + 1] * force[3 * k + 1] + axis[3 * k + 2] * force[3 * k + 2]
                gp.held[lane, part + k] = vec4(arc[k], pull3[0], pull3[1], pull3[2])
                pressed = pressed + pull3
                twisted = twisted + wp.cross(at[k], pull3)
                if force[3 * k] > zero:
                    heavy += force[3 * k]
                    arm += force[3 * k] * arc[k]
        heavy = total(heavy)
        arm = total(arm)
        pressed = vec3(total(pressed[0]), total(pressed[1]), total(pressed[2]))
        twisted = vec3(total(twisted[0]), total(twisted[1]), total(twisted[2]))
        if part == 0 and live == 1:
            gp.answer[lane, 4] = vec3(heavy, arm, zero)
            gp.answer[lane, 5] = pressed
            gp.answer[lane, 6] = twisted

    return SimpleNamespace(settle=settle)
