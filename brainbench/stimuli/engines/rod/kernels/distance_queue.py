"""Kernel that answers the distance queries of paused whiskers."""

import warp as wp

from brainbench.stimuli.engines.rod.limits import DISTANCE_BOUNDS, WARP

from .motion import pose_at
from .narrow_phase import link_shape_distance
from .parameters import group_size, module_options
from .state import ChainArrays, JobArrays, MotionArrays, PausedWhiskers, ShapeArrays


@wp.kernel(enable_backward=False, module="unique", module_options=module_options(), launch_bounds=DISTANCE_BOUNDS)
def measure_distances(
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    jobs: JobArrays,
    paused: PausedWhiskers,
    threads: int,
):
    """Answer all queries: ``group_size`` threads take one link after the other, ``threads`` in all.

    Reads ``paused.query``, ``query_time`` and ``query_margin``, and the links' last leaves; writes ``paused.answer``.
    Scenes have one shape each.
    """
    thread = wp.tid()
    part = thread % wp.static(group_size)
    place = thread // wp.static(group_size)
    count = wp.min(paused.query_count[0], paused.query.shape[0])
    # All threads of a warp go on, or none.
    while place - place % wp.static(WARP // group_size) < count:
        live = int(0)
        if place < count:
            live = 1
        which = wp.min(place, count - 1)
        place = place + threads // wp.static(group_size)
        index = paused.query[which].job
        i = paused.query[which].link
        s = shapes.first[jobs.scene[index]]
        body = pose_at(motions, shapes.track[s], paused.query_time[index])
        margin = paused.query_margin[index]
        start = paused.query[which].start
        stop = paused.query[which].stop
        leaf = paused.link[i, index].leaf
        taper = chains.taper[i, jobs.whisker[index]]
        found = link_shape_distance(shapes, s, body, start, stop, taper, margin, leaf, part, live)
        if live == 1 and part == 0:
            paused.answer[which] = found
