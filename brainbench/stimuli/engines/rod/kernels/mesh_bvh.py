"""Nearest triangles of a surface to a link: a group of threads goes down the surface's bounding volume hierarchy.

The tree is that of ``brainbench.stimuli.engines.rod.mesh_bvh``: eight children a node, without pointers. The search
always opens the box that may hold something nearer and is nearest, one thread a child, and measures triangles at the
leaves, one thread a triangle. It begins at the leaf where the last search of the same link ended, so that hardly
anything else is left to open. All lengths are in units of the surface.
"""

import warp as wp

from brainbench.stimuli.engines.rod.mesh_bvh import BITS, WIDE

from .algebra import maximum, minimum, vec3
from .mesh_nodes import (
    Kept,
    NearestTriangles,
    SearchBounds,
    SearchSegment,
    beyond,
    bound_boxes,
    children,
    measure_triangles,
    nearest_child,
    none_left,
    stride,
)
from .parameters import group_size, real
from .state import ShapeArrays
from .thread_groups import broadcast, group_min, group_min_int, warp_max


@wp.func
def node_count(count: int, level: int) -> int:
    """Return the number of nodes of a level, of a surface of ``count`` triangles; level −1 is that of leaves."""
    return ((count - 1) >> (wp.static(BITS) * (level + 2))) + 1


@wp.func
def nearest_triangles(
    shapes: ShapeArrays, s: int, a: vec3, b: vec3, radius: real, within: real, leaf: int, part: int, live: int
) -> NearestTriangles:
    """Return the triangle nearest of all to the segment a–b (by edges, or a face that it pierces), to b or to a.

    Nothing further than ``radius`` is found; ``within`` so much the nearest to the segment and to b are found each.
    ``leaf`` is where to begin (−1: anywhere), ``part`` the thread's place in its group, ``live`` whether the group
    has a question or only keeps others company.
    """
    far = real(wp.static(beyond))
    first_face = shapes.face[s]
    count = shapes.faces[s]
    first_leaf = first_face // wp.static(WIDE)
    row = shapes.box[s]
    # Nodes of all levels stand one behind the other, those of leaves first; the search begins at the top.
    level = int(0)
    while node_count(count, level) > 1:
        row = row + node_count(count, level)
        level = level + 1
    top = level
    node = int(0)
    opened = int(-1)
    begun = int(-1)
    if leaf >= 0 and leaf < node_count(count, -1):
        opened = leaf
        begun = leaf
    measure = int(1)
    busy = live

    along = b - a
    half = real(0.5) * along
    line = SearchSegment()
    line.a = a
    line.b = b
    line.length = wp.length(along)
    line.axis = along / maximum(line.length, real(1e-20))
    line.middle = a + half
    line.reach = vec3(wp.abs(half[0]), wp.abs(half[1]), wp.abs(half[2]))

    # Squared distances of the nearest so far.
    got = NearestTriangles()
    got.side = radius * radius
    got.end = got.side
    got.start = got.side
    got.face = -1
    got.end_face = -1
    got.start_face = -1
    side = got.side
    end = got.side
    bounds = SearchBounds()
    bounds.side = got.side
    bounds.end = got.side
    bounds.start = got.side
    own_only = within * within
    side_kept = Kept()
    end_kept = Kept()

    while warp_max(busy) == 1:
        if busy == 1 and opened >= 0:
            first = wp.static(WIDE) * opened + wp.static(children) * part
            measure_triangles(shapes.corners, first_leaf + opened, first, count, part, line, bounds, got)
        # Bounds that all threads of the group share; of a start only one that is nearest of all matters.
        side = group_min(got.side)
        end = group_min(got.end)
        all_of = minimum(minimum(side, end), group_min(got.start))
        bounds.side = minimum(side, maximum(all_of, own_only))
        bounds.end = minimum(end, maximum(all_of, own_only))
        bounds.start = all_of
        if busy == 1 and measure == 1:
            bound_boxes(shapes.boxes, row + node, part, line, bounds, level, side_kept, end_kept)
        measure = 0
        opened = -1
        # The nearest child that may hold something nearer; its rank among eight in the last bits of its bound.
        code = group_min_int(nearest_child(side_kept, end_kept, level, part, bounds))
        if busy == 1:
            if code == wp.static(none_left):
                if level == top:
                    busy = 0
                else:
                    # The tree has no pointers: parent and children of a box follow from its rank.
                    # Nothing left below: back to the parent.
                    row = row + node_count(count, level)
                    level = level + 1
                    node = node // wp.static(WIDE)
            else:
                rank = code % wp.static(WIDE)
                # Open this child, and never again.
                if rank // wp.static(children) == part:
                    side_kept[level, wp.static(stride) * (rank % wp.static(children))] = far
                    end_kept[level, wp.static(stride) * (rank % wp.static(children))] = far
                node = wp.static(WIDE) * node + rank
                if level == 0:
                    if node != begun:
                        opened = node
                        got.boxes = got.boxes + 1
                    node = node // wp.static(WIDE)
                else:
                    level = level - 1
                    row = row - node_count(count, level)
                    measure = 1
                    got.boxes = got.boxes + 1

    if wp.static(group_size > 1):
        # What the thread that found the nearest of each kind knows of it; ranks of triangles are exact as numbers.
        who = group_min_int(wp.where(got.face >= 0 and got.side <= side, part, wp.static(group_size - 1)))
        got.side = broadcast(got.side, who)
        got.share = broadcast(got.share, who)
        got.v = broadcast(got.v, who)
        got.w = broadcast(got.w, who)
        got.face = int(broadcast(real(got.face), who))
        who = group_min_int(wp.where(got.end_face >= 0 and got.end <= end, part, wp.static(group_size - 1)))
        got.end = broadcast(got.end, who)
        got.end_v = broadcast(got.end_v, who)
        got.end_w = broadcast(got.end_w, who)
        got.end_face = int(broadcast(real(got.end_face), who))
        start = group_min(got.start)
        who = group_min_int(wp.where(got.start_face >= 0 and got.start <= start, part, wp.static(group_size - 1)))
        got.start = broadcast(got.start, who)
        got.start_v = broadcast(got.start_v, who)
        got.start_w = broadcast(got.start_w, who)
        got.start_face = int(broadcast(real(got.start_face), who))
    return got
