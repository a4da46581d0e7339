"""Kernel that answers the distance queries of paused whiskers.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import LOOK_BOUNDS, WARP

from .algebra import vec4
from .motion import pose_at
from .narrow_phase import link_shape_distance
from .parameters import group_size, module_options, real
from .state import ChainArrays, JobArrays, MotionArrays, PausedWhiskers, ShapeArrays


@wp.kernel(enable_backward=False, module="unique", module_options=module_options(), launch_bounds=LOOK_BOUNDS)
def measure_distances(chains: ChainArrays, motions: MotionArrays, shapes: ShapeArrays, jobs: JobArrays, paused: PausedWhiskers, threads: int):
    """Answer the looks of all waiting whiskers."""
    thread = wp.tid()
    part = thread % wp.static(group_size)
    place = thread // wp.static(group_size)
    count = wp.min(paused.size[6], paused.query_job.shape[0])
    # All threads of a warp go paused, or none.
    while place - place % wp.static(WARP // group_size) < count:
        live = int(0)
        if place < count:
            live = 1
        which = wp.min(place, count - 1)
        place = place + threads // wp.static(group_size)
        index = paused.query_job[which]
        i = paused.query_link[which]
        s = shapes.first[jobs.scene[index]]
        body = pose_at(motions, shapes.track[s], paused.times[5, index])
        margin = paused.times[6, index]
        start = paused.query_ends[which, 0]
        stop = paused.query_ends[which, 1]
        leaf = int(paused.ways[i, index][1])
        taper = chains.taper[i, jobs.whisker[index]]
        touch = link_shape_distance(shapes, s, body, start, stop, taper, margin, leaf, part, live)
        if live == 1 and part == 0:
            paused.found[which, 0] = vec4(touch.normal[0], touch.normal[1], touch.normal[2], touch.gap)
            paused.found[which, 1] = vec4(touch.end_normal[0], touch.end_normal[1], touch.end_normal[2], touch.end_gap)
            what = real(touch.between + 2 * touch.end)
            paused.found[which, 2] = vec4(touch.share, touch.clear, what, real(touch.leaf))
