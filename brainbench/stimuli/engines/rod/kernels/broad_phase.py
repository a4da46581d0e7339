"""Which links may touch something within a step, and where: the places of possible contact."""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.kernels.algebra import algebra
from brainbench.stimuli.engines.rod.kernels.inputs import structs
from brainbench.stimuli.engines.rod.kernels.motion import tracks
from brainbench.stimuli.engines.rod.kernels.narrow_phase import looks
from brainbench.stimuli.engines.rod.kernels.state import memory
from brainbench.stimuli.engines.rod.limits import SPARE, WIDEST, contacts_for


@cache
def candidates(real: type, capacity: int, against: int, sliced: bool) -> SimpleNamespace:
    """Return ``sight``, ``nearby``, ``ask`` and ``gather`` for chains of at most ``capacity`` links.

    Args:
        real: ``warp.float32`` or ``warp.float64``.
        capacity: links that fit.
        against: what there is to touch.
        sliced: whether looks are asked for and answered later, or made at once.
    """
    import warp as wp

    vec3: Any = wp.types.vector(3, real)
    kinds, track, near_by, kept = structs(real), tracks(real), looks(real, against), memory(real, capacity)
    Chains, Bodies, Paused, Options = kinds.Chains, kinds.Bodies, kinds.Paused, kinds.Options
    Tracks, Pose, pose_at = track.Tracks, track.Pose, track.pose_at
    Touch, look_at, rotate = near_by.Touch, near_by.look_at, algebra(real).rotate
    first_axis = algebra(real).first_axis
    Links, Watch, Spots, Lane, State = kept.Links, kept.Watch, kept.Spots, kept.Lane, kept.State
    row = kept.row
    most_seen = contacts_for(capacity) + SPARE

    @wp.struct
    class Sight:
        """How far a step looks."""

        margin: real
        """Gap up to which a contact takes part."""
        pace: real
        """Time over which links and objects may have come nearer since the last step."""
        lurch: real
        """Speed at which what is not known of them may have come."""

    @wp.func(inline=True)
    def sight(me: Lane, opt: Options, state: wp.ref[State], h: real) -> Sight:
        here = Sight()
        # Contacts that may close within this step.
        travel = h * (state.quickest + me.speed)
        here.margin = wp.min(real(1.5) * travel + h * state.jump + real(0.001), real(wp.static(WIDEST)))
        # How far links and objects have come since the last step: its rates at the end are those now.
        here.pace = real(1.02) * wp.max(h, state.h_last)
        here.lurch = me.speed
        if opt.quasistatic == 1:
            here.lurch = me.speed + state.jump
        return here

    @wp.func(inline=True)
    def within(ch: Chains, me: Lane, watch: wp.ref[Watch], here: Sight, i: int) -> bool:
        """Whether a link may be so near, for all that is known without a look."""
        taper = ch.taper[i, me.whisker]
        return row(watch.clear, i) - here.pace * (row(watch.swift, i) + here.lurch) <= here.margin + taper[0]

    @wp.func(inline=True)
    def nearby(ch: Chains, me: Lane, watch: wp.ref[Watch], here: Sight) -> int:
        """Number of links that must look."""
        nigh = int(0)
        for i in range(me.links):
            if within(ch, me, watch, here, i):
                nigh = nigh + 1
        return nigh

    @wp.func(inline=True)
    def ask(
        ch: Chains,
        me: Lane,
        on: Paused,
        mem: wp.ref[Links],
        watch: wp.ref[Watch],
        state: wp.ref[State],
        here: Sight,
        origin: vec3,
        now: real,
        nigh: int,
    ) -> int:
        """Ask for looks; returned is what to wait for. When there is no room for more, try again."""
        state.look_first = wp.atomic_add(on.tally, 6, nigh)
        if state.look_first + nigh > on.look_lane.shape[0]:
            return 2
        place = state.look_first
        for i in range(me.links):
            if within(ch, me, watch, here, i):
                on.look_lane[place] = me.lane
                on.look_link[place] = i
                on.look_ends[place, 0] = row(mem.node, i) + origin
                on.look_ends[place, 1] = row(mem.node, i + 1) + origin
                place = place + 1
        on.times[5, me.lane] = now
        on.times[6, me.lane] = here.margin
        return 1

    @wp.func(inline=True)
    def answer(on: Paused, place: int) -> Touch:
        """What a look found."""
        f0 = on.found[place, 0]
        f1 = on.found[place, 1]
        f2 = on.found[place, 2]
        what = int(f2[2])
        touch = Touch()
        touch.normal = vec3(f0[0], f0[1], f0[2])
        touch.gap = f0[3]
        touch.end_normal = vec3(f1[0], f1[1], f1[2])
        touch.end_gap = f1[3]
        touch.share = f2[0]
        touch.clear = f2[1]
        touch.between = what % 2
        touch.end = what // 2
        touch.leaf = int(f2[3])
        return touch

    @wp.func(inline=True)
    def slot_for(spots: wp.ref[Spots], seen: int, point: vec3, normal: vec3, ahead: real, link: vec3) -> int:
        """Where to keep a place of possible contact (``seen``: a further one; −1: nowhere)."""
        slot = seen
        # The same contact seen from two links, or from both ends of a short gap.
        for j in range(seen):
            apart = wp.length_sq(row(spots.at, j) - point)
            same = wp.dot(row(spots.normal, j), normal) > real(0.85)
            if same and apart < real(0.0625) * wp.length_sq(link):
                slot = j
        if slot < seen:
            if row(spots.ahead, slot) <= ahead:
                slot = int(-1)
        elif seen >= wp.static(most_seen):
            slot = int(0)
            for j in range(1, wp.static(most_seen)):
                if row(spots.ahead, j) > row(spots.ahead, slot):
                    slot = j
            if row(spots.ahead, slot) <= ahead:
                slot = int(-1)
        return slot

    @wp.func(inline=True)
    def gather(
        ch: Chains,
        tr: Tracks,
        bodies: Bodies,
        me: Lane,
        on: Paused,
        mem: wp.ref[Links],
        watch: wp.ref[Watch],
        spots: wp.ref[Spots],
        state: wp.ref[State],
        pose: Pose,
        margin: real,
        now: real,
        h: real,
    ) -> int:
        """Find the places of possible contact of all links; returned is their number."""
        zero = real(0.0)
        # Counts that the compiler does not know keep it from writing loops out.
        sides = int(2) + wp.min(0, me.lane)
        origin = pose.place
        seen = int(0)
        asked = state.look_first
        cvw = pose.spin
        cvv = pose.velocity
        for i in range(me.links):
            rate = row(mem.qd, i)
            joint = row(mem.node, i)
            link = row(mem.node, i + 1) - joint
            e2 = row(mem.e2, i)
            spun = first_axis(e2, link, row(mem.q, i)[1]) * rate[0] + e2 * rate[1]
            cvw = cvw + spun
            cvv = cvv + wp.cross(joint, spun)
            taper = ch.taper[i, me.whisker]
            if row(watch.clear, i) <= margin + taper[0]:
                closest = real(1e20)
                for s in range(me.shapes_from, me.shapes_to):
                    body = pose_at(tr, bodies.track[s], now)
                    turn_s = bodies.turn[s]
                    touch = Touch()
                    if wp.static(sliced):
                        touch = answer(on, asked)
                        asked = asked + 1
                    else:
                        a = joint + origin
                        b = row(mem.node, i + 1) + origin
                        touch = look_at(bodies, s, body, a, b, taper, margin, row(watch.leaf, i), 0, 1)
                    watch.leaf[i] = touch.leaf
                    closest = wp.min(closest, touch.clear)
                    for which in range(sides):
                        offered = touch.between
                        share = touch.share
                        gap = touch.gap
                        way = touch.normal
                        if which == 1:
                            offered = touch.end
                            share = real(1.0)
                            gap = touch.end_gap
                            way = touch.end_normal
                        if offered == 1 and gap < margin:
                            state.depth = wp.max(state.depth, -gap)
                            normal = rotate(body.turn, rotate(turn_s, way))
                            radius = taper[0] + (taper[1] - taper[0]) * share
                            point = joint + link * share - normal * radius
                            half = pose_at(tr, bodies.track[s], now + real(0.5) * h)
                            carried = half.velocity + wp.cross(half.spin, point + origin - half.place)
                            approach = wp.dot(normal, cvv + wp.cross(cvw, point) - carried)
                            # Where the gap will be: tells apart what only passes by.
                            ahead = gap + real(1.5) * h * wp.min(approach, zero)
                            slot = slot_for(spots, seen, point, normal, ahead, link)
                            if slot == seen:
                                seen = seen + 1
                            if slot >= 0:
                                mu = bodies.friction[s]
                                if mu < zero:
                                    mu = ch.friction[me.whisker]
                                spots.link[slot] = i
                                spots.gap[slot] = gap
                                spots.ahead[slot] = ahead
                                spots.mu[slot] = mu
                                spots.at[slot] = point
                                spots.arc[slot] = taper[2] + taper[3] * share
                                spots.move[slot] = carried
                                spots.normal[slot] = normal
                watch.clear[i] = closest
        return seen

    return SimpleNamespace(sight=sight, nearby=nearby, ask=ask, gather=gather)
