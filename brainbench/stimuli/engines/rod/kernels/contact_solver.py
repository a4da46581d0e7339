"""Forces of rigid contacts with Coulomb friction: projected Gauss-Seidel, and all normal forces at once in between."""

from functools import cache
from types import SimpleNamespace

from brainbench.stimuli.engines.rod.kernels.contact_memory import grasps
from brainbench.stimuli.engines.rod.kernels.single_contact import contact_alone
from brainbench.stimuli.engines.rod.kernels.thread_groups import groups


@cache
def relaxations(real: type, capacity: int, held: int, lanes: int) -> SimpleNamespace:
    """Return ``rates``, ``sweep`` and ``share``; see :func:`~brainbench.stimuli.engines.rod.kernels.contacts`."""
    import warp as wp

    kept, group, at_contact = grasps(real, capacity, held, lanes), groups(real, lanes), contact_alone(real)
    Own, Grasp, Table, Square, Own1, row = kept.Own, kept.Grasp, kept.Table, kept.Square, kept.Own1, kept.row
    rows, tall = kept.rows, kept.tall
    give, total, greatest, joined, most = group.give, group.total, group.greatest, group.joined, group.most

    @wp.func(inline=True)
    def rates(grasp: wp.ref[Grasp], own: wp.ref[Own], table: wp.ref[Table], refresh: int):
        """Rates at the contacts, less those that would just close the gaps."""
        if refresh == 1:
            for k in range(grasp.each):
                own.rate[3 * k] = row(own.free, 3 * k) - row(own.gap, k)
                own.rate[3 * k + 1] = row(own.free, 3 * k + 1)
                own.rate[3 * k + 2] = row(own.free, 3 * k + 2)
        for e in range(grasp.span):
            for b in range(3):
                pull = give(row(own.force, wp.static(3 * tall) * e + b), e)
                if refresh == 1:
                    for r in range(3 * grasp.each):
                        own.rate[r] = row(own.rate, r) + row(table, r * wp.static(rows) + 3 * e + b) * pull

    @wp.func(inline=True)
    def sweep(grasp: wp.ref[Grasp], own: wp.ref[Own], table: wp.ref[Table], tries: int):
        """One contact at a time."""
        zero = real(0.0)
        far_off = zero
        by_now = zero
        in_all = zero
        for c in range(grasp.span):
            d0 = zero
            d1 = zero
            d2 = zero
            mine = wp.static(lanes == 1) or c == grasp.part
            if mine and grasp.settled == 0 and c < grasp.contacts:
                k = wp.static(tall) * c
                n0 = row(own.force, 3 * k)
                p0 = row(own.force, 3 * k + 1)
                q0 = row(own.force, 3 * k + 2)
                block = row(own.block, k)
                missed = row(own.rate, 3 * k)
                bn = missed - block[0] * n0 - block[1] * p0 - block[2] * q0
                b1 = row(own.rate, 3 * k + 1) - block[1] * n0 - block[3] * p0 - block[4] * q0
                b2 = row(own.rate, 3 * k + 2) - block[2] * n0 - block[4] * p0 - block[5] * q0
                found = at_contact(block, bn, b1, b2, p0, q0, row(own.mu, k), tries)
                own.force[3 * k] = found[0]
                own.force[3 * k + 1] = found[1]
                own.force[3 * k + 2] = found[2]
                d0 = found[0] - n0
                d1 = found[1] - p0
                d2 = found[2] - q0
                # By how much (mm) the forces so far miss the gap that they should leave.
                if n0 == zero:
                    missed = wp.min(missed, zero)
                slipped = block[3] * wp.abs(d1) + block[5] * wp.abs(d2)
                far_off = wp.max(far_off, grasp.h * (wp.abs(missed) + slipped))
                by_now += wp.abs(d0) + wp.abs(d1) + wp.abs(d2)
                in_all += found[0]
            d0 = give(d0, c)
            d1 = give(d1, c)
            d2 = give(d2, c)
            for r in range(3 * grasp.each):
                e = r * wp.static(rows) + 3 * c
                own.rate[r] = row(own.rate, r) + row(table, e) * d0 + row(table, e + 1) * d1 + row(table, e + 2) * d2
        far_off = greatest(far_off)
        by_now = total(by_now)
        in_all = total(in_all)
        if grasp.settled == 0:
            grasp.change = far_off
            grasp.moved = by_now
            grasp.whole = in_all
            if far_off <= real(1e-4) or by_now <= real(1e-4) * in_all:
                grasp.settled = 1

    @wp.func(inline=True)
    def solve(
        grasp: wp.ref[Grasp],
        square: wp.ref[Square],
        work: wp.ref[Square],
        load: wp.ref[Own1],
        asked: wp.ref[Own1],
        pressing: int,
    ):
        """Gauss-Jordan, every contact its own row: normal forces of those that press."""
        share = Own1()
        part = grasp.part
        each = grasp.each
        span = grasp.span
        for k in range(each):
            mine_in = (pressing >> (part + k)) % 2
            for e in range(span):
                keep = real(0.0)
                if mine_in == 1 and (pressing >> e) % 2 == 1:
                    keep = row(square, k * wp.static(held) + e)
                elif part + k == e:
                    keep = real(1.0)
                work[k * wp.static(held) + e] = keep
            load[k] = real(0.0)
            if mine_in == 1:
                load[k] = row(asked, k)
        for p in range(span):
            at = wp.static(tall * held) * p
            pivot = give(row(work, at + p), p)
            known = give(row(load, wp.static(tall) * p), p)
            for k in range(each):
                share[k] = real(0.0)
                if part + k != p:
                    share[k] = row(work, k * wp.static(held) + p) / pivot
                load[k] = row(load, k) - share[k] * known
            for e in range(p + 1, span):
                value = give(row(work, at + e), p)
                for k in range(each):
                    c = k * wp.static(held) + e
                    work[c] = row(work, c) - share[k] * value
        for k in range(each):
            if part + k < span:
                load[k] = row(load, k) / row(work, k * wp.static(held) + part + k)

    @wp.func(inline=True)
    def share(
        grasp: wp.ref[Grasp],
        own: wp.ref[Own],
        table: wp.ref[Table],
        square: wp.ref[Square],
        work: wp.ref[Square],
        guessing: int,
        tries: int,
    ) -> int:
        """Neighbouring contacts share a load in ways that Gauss-Seidel finds slowly: solve for all normal forces at
        once, those of sliding contacts with their friction. Returned is whether the forces were changed."""
        zero = real(0.0)
        part = grasp.part
        each = grasp.each
        span = grasp.span
        contacts = grasp.contacts
        ratio1 = Own1()
        ratio2 = Own1()
        asked = Own1()
        load = Own1()
        opening = Own1()
        pressing = int(0)
        for k in range(each):
            ratio1[k] = zero
            ratio2[k] = zero
            asked[k] = row(own.gap, k) - row(own.free, 3 * k)
            if part + k < contacts:
                fn = row(own.force, 3 * k)
                if fn > zero:
                    pressing = pressing + (1 << (part + k))
                f1 = row(own.force, 3 * k + 1)
                f2 = row(own.force, 3 * k + 2)
                size = wp.sqrt(f1 * f1 + f2 * f2)
                if size > zero and size >= real(0.999) * row(own.mu, k) * fn:
                    ratio1[k] = row(own.mu, k) * f1 / size
                    ratio2[k] = row(own.mu, k) * f2 / size
        pressing = joined(pressing)
        for e in range(span):
            slide1 = give(ratio1[wp.static(tall) * e], e)
            slide2 = give(ratio2[wp.static(tall) * e], e)
            stick1 = give(row(own.force, wp.static(3 * tall) * e + 1), e)
            stick2 = give(row(own.force, wp.static(3 * tall) * e + 2), e)
            if slide1 != zero or slide2 != zero:
                stick1 = zero
                stick2 = zero
            for k in range(each):
                r = 3 * k * wp.static(rows) + 3 * e
                square[k * wp.static(held) + e] = (
                    row(table, r) + row(table, r + 1) * slide1 + row(table, r + 2) * slide2
                )
                asked[k] = asked[k] - row(table, r + 1) * stick1 - row(table, r + 2) * stick2
        agreed = 1 - guessing
        for _ in range(tries):
            if most(1 - agreed) == 1:
                solve(grasp, square, work, load, asked, pressing)
                worst = int(-1)
                lowest = zero
                for k in range(each):
                    opening[k] = -asked[k]
                for e in range(span):
                    value = give(load[wp.static(tall) * e], e)
                    if value < lowest:
                        lowest = value
                        worst = e
                    for k in range(each):
                        opening[k] = opening[k] + row(square, k * wp.static(held) + e) * value
                # A contact that pulls lets go; one that would open into the object presses.
                flip = worst
                lowest = real(-1e-6) / grasp.h
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
                wild = real(1.0)
        wild = greatest(wild)
        changed = int(0)
        if guessing == 1 and agreed == 1 and wild == zero:
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
                        if size > row(own.mu, k) * fn:
                            f1 = f1 * (row(own.mu, k) * fn / size)
                            f2 = f2 * (row(own.mu, k) * fn / size)
                    own.force[3 * k] = fn
                    own.force[3 * k + 1] = f1
                    own.force[3 * k + 2] = f2
        return changed

    return SimpleNamespace(rates=rates, sweep=sweep, share=share)
