"""Kernels that answer what paused whiskers wait for: looks at meshes, and contact forces, each queue by its own."""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.engines.rod.kernels.contacts import contacts
from brainbench.stimuli.engines.rod.kernels.inputs import structs
from brainbench.stimuli.engines.rod.kernels.motion import tracks
from brainbench.stimuli.engines.rod.kernels.narrow_phase import looks
from brainbench.stimuli.engines.rod.limits import GRIP_BOUNDS, LOOK_BOUNDS, LOOKERS, WARP


@cache
def queues(
    real: type, capacity: int, against: int, classes: tuple[tuple[int, int], ...], cuda: bool, fast_math: bool
) -> SimpleNamespace:
    """Return the kernels ``turn_over`` and ``look_all`` and, for each queue of contact problems, ``settle``.

    Args:
        real: ``warp.float32`` or ``warp.float64``.
        capacity: links that fit.
        against: what there is to touch.
        classes: (contacts that fit, threads of a group) of each queue.
        cuda: groups of threads look at a link together.
        fast_math: approximate divisions and roots.
    """
    import warp as wp

    vec4: Any = wp.types.vector(4, real)
    kinds, track = structs(real), tracks(real)
    Chains, Bodies, Lanes, Paused, Grips = kinds.Chains, kinds.Bodies, kinds.Lanes, kinds.Paused, kinds.Grips
    Tracks, pose_at = track.Tracks, track.pose_at
    lookers = LOOKERS if cuda else 1
    look_together = looks(real, against, lookers).look_at
    options = {"fast_math": fast_math}

    def settle_all(rank: int, held: int, lanes: int) -> Any:
        """Make the kernel that finds contact forces of the whiskers in one queue."""
        settle_group = contacts(real, capacity, held, lanes).settle

        @wp.kernel(enable_backward=False, module="unique", module_options=options, launch_bounds=GRIP_BOUNDS)
        def settle_queue(gp: Grips, on: Paused):
            thread = wp.tid()
            count = on.size[wp.static(3 + rank)]
            which = thread // wp.static(lanes)
            # All threads of a warp go on, or none.
            if (thread // wp.static(WARP)) * wp.static(WARP // lanes) < count:
                live = int(0)
                if which < count:
                    live = int(1)
                lane = on.grips[wp.static(rank), wp.min(which, count - 1)]
                settle_group(gp, lane, thread % wp.static(lanes), live)

        return settle_queue

    @wp.kernel(enable_backward=False, module="unique")
    def turn_over(on: Paused):
        for d in range(7):
            on.size[d] = on.tally[d]
            on.tally[d] = 0

    @wp.kernel(enable_backward=False, module="unique", module_options=options, launch_bounds=LOOK_BOUNDS)
    def look_all(ch: Chains, tr: Tracks, bodies: Bodies, ln: Lanes, on: Paused, threads: int):
        """Answer the looks of all waiting whiskers."""
        thread = wp.tid()
        part = thread % wp.static(lookers)
        place = thread // wp.static(lookers)
        count = wp.min(on.size[6], on.look_lane.shape[0])
        # All threads of a warp go on, or none.
        while place - place % wp.static(WARP // lookers) < count:
            live = int(0)
            if place < count:
                live = 1
            which = wp.min(place, count - 1)
            place = place + threads // wp.static(lookers)
            lane = on.look_lane[which]
            i = on.look_link[which]
            s = bodies.first[ln.scene[lane]]
            body = pose_at(tr, bodies.track[s], on.times[5, lane])
            margin = on.times[6, lane]
            start = on.look_ends[which, 0]
            stop = on.look_ends[which, 1]
            leaf = int(on.ways[i, lane][1])
            taper = ch.taper[i, ln.whisker[lane]]
            touch = look_together(bodies, s, body, start, stop, taper, margin, leaf, part, live)
            if live == 1 and part == 0:
                on.found[which, 0] = vec4(touch.normal[0], touch.normal[1], touch.normal[2], touch.gap)
                on.found[which, 1] = vec4(touch.end_normal[0], touch.end_normal[1], touch.end_normal[2], touch.end_gap)
                what = real(touch.between + 2 * touch.end)
                on.found[which, 2] = vec4(touch.share, touch.clear, what, real(touch.leaf))

    settle = [(settle_all(rank, *one), one[1]) for rank, one in enumerate(classes)]
    return SimpleNamespace(turn_over=turn_over, look_all=look_all, lookers=lookers, settle=settle)
