"""The contacts of one step of a whisker: which take part, their compliance, their forces, and what these move.

A group of threads takes one whisker, each thread one contact: it carries the contact's three forces up the chain, owns
three rows of the compliance (Delassus) matrix, and solves for its forces when its turn comes in the Gauss-Seidel
sweeps; the others learn of them by shuffles. A group of one, on the CPU, holds all contacts; the source is the same.
Groups of a warp stay together: what one has finished it repeats without keeping it.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.kernels.compliance import compliances
from brainbench.stimuli.engines.rod.kernels.contact_memory import grasps
from brainbench.stimuli.engines.rod.kernels.contact_solver import relaxations
from brainbench.stimuli.engines.rod.kernels.inputs import structs
from brainbench.stimuli.engines.rod.kernels.thread_groups import groups
from brainbench.stimuli.engines.rod.limits import CLOSED, ROUNDS, SWEEPS


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
    Grips, kept, group = structs(real).Grips, grasps(real, capacity, held, lanes), groups(real, lanes)
    Own, Grasp, Table, Square, row = kept.Own, kept.Grasp, kept.Table, kept.Square, kept.row
    Links2 = kept.Links2
    total, most, seen_most = group.total, group.most, kept.seen_most
    ways, relax = compliances(real, capacity, held, lanes), relaxations(real, capacity, held, lanes)
    collect, comply, rates, sweep, share = ways.collect, ways.comply, relax.rates, relax.sweep, relax.share

    @wp.func(inline=True)
    def pull_of(own: wp.ref[Own], k: int) -> vec3:
        """Force of a contact."""
        pull = row(own.axis, 3 * k) * row(own.force, 3 * k)
        return (
            pull
            + row(own.axis, 3 * k + 1) * row(own.force, 3 * k + 1)
            + row(own.axis, 3 * k + 2) * row(own.force, 3 * k + 2)
        )

    @wp.func(inline=True)
    def find_forces(
        grasp: wp.ref[Grasp],
        own: wp.ref[Own],
        table: wp.ref[Table],
        square: wp.ref[Square],
        work: wp.ref[Square],
        doing: int,
    ):
        """Gauss-Seidel sweeps until the forces hold, with all normal forces solved for at once after every other."""
        slip_tries = int(8) + grasp.loose
        guess_tries = int(10) + grasp.loose
        sweeps_most = int(wp.static(SWEEPS)) + grasp.loose
        grasp.settled = 1 - doing
        refresh = doing
        grasp.change = real(0.0)
        grasp.moved = real(0.0)
        grasp.whole = real(0.0)
        for turn in range(sweeps_most):
            if most(1 - grasp.settled) == 1:
                if most(refresh) == 1:
                    rates(grasp, own, table, refresh)
                    refresh = 0
                sweep(grasp, own, table, slip_tries)
                guessing = int(0)
                if grasp.settled == 0 and grasp.contacts > 1 and turn % 2 == 1:
                    guessing = 1
                if most(guessing) == 1:
                    refresh = share(grasp, own, table, square, work, guessing, guess_tries)

    @wp.func(inline=True)
    def keep_forces(gp: Grips, grasp: wp.ref[Grasp], own: wp.ref[Own]):
        """What the contacts do together, and their forces for the next step."""
        zero = real(0.0)
        pressed = vec3(zero, zero, zero)
        twisted = vec3(zero, zero, zero)
        heavy = zero
        arm = zero
        for k in range(grasp.each):
            if grasp.part + k < grasp.contacts and grasp.live == 1:
                pull = pull_of(own, k)
                arc = row(own.arc, k)
                gp.held[grasp.lane, grasp.part + k] = vec4(arc, pull[0], pull[1], pull[2])
                pressed = pressed + pull
                twisted = twisted + wp.cross(row(own.at, k), pull)
                fn = row(own.force, 3 * k)
                if fn > zero:
                    heavy += fn
                    arm += fn * arc
        heavy = total(heavy)
        arm = total(arm)
        pressed = vec3(total(pressed[0]), total(pressed[1]), total(pressed[2]))
        twisted = vec3(total(twisted[0]), total(twisted[1]), total(twisted[2]))
        if grasp.part == 0 and grasp.live == 1:
            gp.answer[grasp.lane, 4] = vec3(heavy, arm, zero)
            gp.answer[grasp.lane, 5] = pressed
            gp.answer[grasp.lane, 6] = twisted

    @wp.func(inline=True)
    def apply(gp: Grips, grasp: wp.ref[Grasp], own: wp.ref[Own], lift: wp.ref[Links2], last: int, doing: int) -> int:
        """Forces up the chain, then the change of acceleration down.

        ``last`` says that there will be no further round. Returned is whether the forces press the whisker onto places
        that do not take part, with room for them: then another round is needed.
        """
        zero = real(0.0)
        none = vec3(zero, zero, zero)
        link0 = grasp.lane * wp.static(capacity)
        spot0 = grasp.lane * wp.static(seen_most)
        tw = none
        tv = none
        for back in range(grasp.top + 1):
            i = grasp.top - back
            for k in range(grasp.each):
                if grasp.part + k < grasp.contacts and row(own.link, k) == i:
                    pull = pull_of(own, k)
                    tv = tv + pull
                    tw = tw + wp.cross(row(own.at, k), pull)
            u1 = zero
            u2 = zero
            if i < grasp.links:
                u1 = wp.dot(gp.chain[link0 + i, 0], tw) + wp.dot(gp.chain[link0 + i, 2], tv)
                u2 = wp.dot(gp.chain[link0 + i, 1], tw) + wp.dot(gp.chain[link0 + i, 3], tv)
                tw = tw - gp.chain[link0 + i, 4] * u1 - gp.chain[link0 + i, 6] * u2
                tv = tv - gp.chain[link0 + i, 5] * u1 - gp.chain[link0 + i, 7] * u2
            u1 = total(u1)
            u2 = total(u2)
            if i < grasp.links:
                inv = gp.chain[link0 + i, 8]
                lift[i] = vec2(inv[0] * u1 + inv[1] * u2, inv[1] * u1 + inv[2] * u2)
        tw = vec3(total(tw[0]), total(tw[1]), total(tw[2]))
        tv = vec3(total(tv[0]), total(tv[1]), total(tv[2]))
        more = int(0)
        if doing == 1:
            aw = none
            av = none
            for i in range(grasp.links):
                extra = vec2(zero, zero)
                if i <= grasp.top:
                    extra = row(lift, i)
                a1 = extra[0] - wp.dot(gp.chain[link0 + i, 4], aw) - wp.dot(gp.chain[link0 + i, 5], av)
                a2 = extra[1] - wp.dot(gp.chain[link0 + i, 6], aw) - wp.dot(gp.chain[link0 + i, 7], av)
                aw = aw + gp.chain[link0 + i, 0] * a1 + gp.chain[link0 + i, 1] * a2
                av = av + gp.chain[link0 + i, 2] * a1 + gp.chain[link0 + i, 3] * a2
                if grasp.part == 0:
                    gp.mend[grasp.lane, i] = vec2(a1, a2)
                if grasp.contacts < grasp.seen:
                    for j in range(grasp.seen):
                        if gp.spot_link[spot0 + j] == i and (grasp.taken >> j) % 2 == 0:
                            moved = gp.spot[spot0 + j, 2] + (av + wp.cross(aw, gp.spot[spot0 + j, 0])) * grasp.h
                            ahead = gp.spot_size[spot0 + j][0] + grasp.h * wp.dot(gp.spot[spot0 + j, 1], moved)
                            gp.ahead[spot0 + j] = ahead
                            if ahead < real(-wp.static(CLOSED)):
                                more = int(1)
            crowded = int(0)
            if more == 1 and (grasp.contacts == wp.static(held) or last == 1):
                more = int(0)
                crowded = int(1)
            if more == 0 and grasp.part == 0:
                unsolved = int(0)
                miss = zero
                if grasp.settled == 0 and grasp.change > real(1e-2) and grasp.moved > real(1e-2) * grasp.whole:
                    unsolved = int(1)
                    miss = grasp.moved * grasp.moved
                lane = grasp.lane
                plan = gp.plan[lane]
                gp.counts[lane, 2] = grasp.contacts
                gp.counts[lane, 3] = crowded
                gp.counts[lane, 4] = unsolved
                gp.answer[lane, 0] = gp.answer[lane, 0] - tw
                gp.answer[lane, 1] = gp.answer[lane, 1] - tv
                gp.answer[lane, 2] = gp.answer[lane, 2] + av + wp.cross(aw, vec3(plan[1], plan[2], plan[3]))
                gp.answer[lane, 3] = vec3(miss, grasp.whole * grasp.whole, zero)
        return more

    @wp.func
    def settle(gp: Grips, lane: int, part: int, live: int):
        grasp = Grasp()
        grasp.lane = lane
        grasp.part = part
        grasp.live = live
        grasp.links = gp.counts[lane, 0]
        grasp.seen = gp.counts[lane, 1]
        grasp.before = gp.counts[lane, 2]
        grasp.h = gp.plan[lane][0]
        grasp.loose = wp.min(0, lane)
        grasp.each = int(wp.static(kept.own)) + wp.static(kept.tall) * grasp.loose
        own = Own()
        table = Table()
        square = Square()
        work = Square()
        lift = Links2()
        rounds_most = int(wp.static(ROUNDS)) + grasp.loose
        more = live
        for round_ in range(rounds_most):
            doing = more
            if most(doing) == 1:
                collect(gp, grasp, own, doing)
                comply(gp, grasp, own, table)
                find_forces(grasp, own, table, square, work, doing)
                last = int(0)
                if round_ == wp.static(ROUNDS - 1):
                    last = 1
                more = apply(gp, grasp, own, lift, last, doing)
        keep_forces(gp, grasp, own)

    return SimpleNamespace(settle=settle)
