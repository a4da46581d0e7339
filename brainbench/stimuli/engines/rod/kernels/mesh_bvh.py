"""Nearest triangles of a surface to a link: a group of threads goes down the surface's bounding volume hierarchy.

The tree is that of ``brainbench.stimuli.engines.rod.mesh_bvh``: eight children a node, without pointers. The search
always opens the box that may hold something nearer and is nearest, one thread a child, and measures triangles at the
leaves, one thread a triangle. It begins at the leaf where the last search of the same link ended, so that hardly
anything else is left to open. All lengths are in units of the surface.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.mesh_bvh import LEVELS, WIDE

from .algebra import maximum, minimum, vec3
from .distances import point_triangle, segment_triangle
from .parameters import group_size, real
from .state import ShapeArrays
from .thread_groups import broadcast, group_min, group_min_int, warp_max

children = WIDE // group_size
Kept: Any = wp.types.matrix((LEVELS, children), real)
beyond = 1e30
none_left = 2**31 - 1


@wp.struct
class NearestTriangles:
    """Squared distances from the segment, its end b and its start a, the rank of the triangle of each (−1: none)
    and the place on it."""

    side: real
    share: real
    face: wp.int32
    v: real
    w: real
    end: real
    end_face: wp.int32
    end_v: real
    end_w: real
    start: real
    start_face: wp.int32
    start_v: real
    start_w: real
    boxes: wp.int32
    """Boxes opened."""


@wp.func
def level_size(count: int, level: int) -> int:
    """Return the number of boxes of a level, of a surface of ``count`` triangles."""
    size = (count + wp.static(WIDE - 1)) // wp.static(WIDE)
    for _ in range(level):
        size = (size + wp.static(WIDE - 1)) // wp.static(WIDE)
    return size


@wp.func
def nearest_triangles(
    shapes: ShapeArrays, s: int, a: vec3, b: vec3, radius: real, within: real, leaf: int, part: int, live: int
) -> NearestTriangles:
    """Return the triangle nearest of all to the segment a–b (by edges, or a face that it pierces), to b or to a.

    Nothing further than ``radius`` is found; ``within`` so much the nearest to the segment and to b are found each.
    ``leaf`` is where to begin (−1: anywhere), ``part`` the thread's place in its group, ``live`` whether the group
    has a question or only keeps others company.
    """
    zero = real(0.0)
    far = real(wp.static(beyond))
    # Rounding must not hide a triangle.
    sure = real(0.998)
    first_face = shapes.face[s]
    count = shapes.faces[s]
    row = shapes.box[s]
    size = (count + wp.static(WIDE - 1)) // wp.static(WIDE)
    # Boxes of all levels stand one behind the other, leaves first; the search begins at the top.
    level = int(0)
    while size > wp.static(WIDE):
        row = row + size
        size = (size + wp.static(WIDE - 1)) // wp.static(WIDE)
        level = level + 1
    top = level
    node = int(0)
    opened = int(-1)
    begun = int(-1)
    if leaf >= 0 and leaf < level_size(count, 0):
        opened = leaf
        begun = leaf
    measure = int(1)
    busy = live

    along = b - a
    length = wp.length(along)
    axis = along / maximum(length, real(1e-20))
    half = real(0.5) * along
    middle = a + half
    reach = vec3(wp.abs(half[0]), wp.abs(half[1]), wp.abs(half[2]))

    # Squared distances of the nearest so far.
    got = NearestTriangles()
    got.side = radius * radius
    got.end = got.side
    got.start = got.side
    got.face = -1
    got.end_face = -1
    got.start_face = -1
    side = got.side
    all_of = got.side
    # Beyond these, squared, nothing is looked at for the sake of the segment and of its end.
    side_most = got.side
    end_most = got.side
    own_only = within * within
    side_kept = Kept()
    end_kept = Kept()
    each = int(wp.static(children)) + wp.min(0, part)

    while warp_max(busy) == 1:
        if busy == 1 and opened >= 0:
            for k in range(each):
                place = wp.static(WIDE) * opened + part * wp.static(children) + k
                if place < count:
                    p = shapes.corner[first_face + place, 0]
                    q = shapes.corner[first_face + place, 1]
                    r = shapes.corner[first_face + place, 2]
                    # No triangle is nearer than this, squared: beside the axis, and along it from the segment and
                    # from its ends.
                    tp = wp.dot(p - a, axis)
                    tq = wp.dot(q - a, axis)
                    tr = wp.dot(r - a, axis)
                    beside_p = p - a - axis * tp
                    beside_q = q - a - axis * tq
                    beside_r = r - a - axis * tr
                    # No point of a triangle is less far along ``way`` than its nearest corner: a bound from three
                    # products.
                    way = beside_p + beside_q + beside_r
                    beside = minimum(wp.dot(beside_p, way), minimum(wp.dot(beside_q, way), wp.dot(beside_r, way)))
                    beside = maximum(beside, zero)
                    beside = beside * beside / maximum(wp.length_sq(way), real(1e-20))
                    low = minimum(tp, minimum(tq, tr))
                    high = maximum(tp, maximum(tq, tr))
                    apart = maximum(zero, maximum(low - length, -high))
                    if sure * (beside + apart * apart) < minimum(side_most, got.side):
                        at = segment_triangle(a, b, p, q, r)
                        if at[0] < got.side:
                            got.side = at[0]
                            got.share = at[1]
                            got.v = at[2]
                            got.w = at[3]
                            got.face = place
                    apart = maximum(zero, maximum(low - length, length - high))
                    if sure * (beside + apart * apart) < minimum(end_most, got.end):
                        spot = point_triangle(b, p, q, r)
                        square = wp.length_sq(b - p - (q - p) * spot[0] - (r - p) * spot[1])
                        if square < got.end:
                            got.end = square
                            got.end_v = spot[0]
                            got.end_w = spot[1]
                            got.end_face = place
                    apart = maximum(zero, maximum(low, -high))
                    if sure * (beside + apart * apart) < minimum(all_of, got.start):
                        spot = point_triangle(a, p, q, r)
                        square = wp.length_sq(a - p - (q - p) * spot[0] - (r - p) * spot[1])
                        if square < got.start:
                            got.start = square
                            got.start_v = spot[0]
                            got.start_w = spot[1]
                            got.start_face = place
        # Bounds that all threads of the group share.
        side = group_min(got.side)
        end = group_min(got.end)
        all_of = minimum(minimum(side, end), group_min(got.start))
        side_most = minimum(side, maximum(all_of, own_only))
        end_most = minimum(end, maximum(all_of, own_only))
        if busy == 1 and measure == 1:
            # How near the children of the node can be: beside the segment, and from its end.
            for k in range(each):
                place = wp.static(WIDE) * node + part * wp.static(children) + k
                side_kept[level, k] = far
                end_kept[level, k] = far
                if place < size:
                    low3 = shapes.low[row + place]
                    high3 = shapes.high[row + place]
                    wide = real(0.5) * (high3 - low3)
                    centre = low3 + wide
                    off = centre - middle
                    gap = vec3(
                        maximum(wp.abs(off[0]) - wide[0] - reach[0], zero),
                        maximum(wp.abs(off[1]) - wide[1] - reach[1], zero),
                        maximum(wp.abs(off[2]) - wide[2] - reach[2], zero),
                    )
                    bound = wp.length_sq(gap)
                    if sure * bound < maximum(side_most, end_most):
                        # All of the segment lies behind the plane through its point nearest to the centre.
                        t = minimum(maximum(wp.dot(centre - a, axis), zero), length)
                        off = centre - a - axis * t
                        square = wp.length_sq(off)
                        over = square - wp.abs(off[0]) * wide[0] - wp.abs(off[1]) * wide[1] - wp.abs(off[2]) * wide[2]
                        if over > zero:
                            bound = maximum(bound, over * over / square)
                        side_kept[level, k] = bound
                        off = centre - b
                        gap = vec3(
                            maximum(wp.abs(off[0]) - wide[0], zero),
                            maximum(wp.abs(off[1]) - wide[1], zero),
                            maximum(wp.abs(off[2]) - wide[2], zero),
                        )
                        end_kept[level, k] = wp.length_sq(gap)
        measure = 0
        opened = -1
        # The nearest child that may hold something nearer; its rank among eight in the last bits of its bound.
        code = int(wp.static(none_left))
        for k in range(each):
            bound = side_kept[level, k]
            if sure * bound < side_most or sure * end_kept[level, k] < end_most:
                rank = part * wp.static(children) + k
                # The bits of positive floats are ordered like their values, so one minimum gives box and rank.
                code = wp.min(code, ((wp.cast(wp.float32(bound), wp.int32) >> 3) << 3) + rank)
        code = group_min_int(code)
        if busy == 1:
            if code == wp.static(none_left):
                if level == top:
                    busy = 0
                else:
                    # The tree has no pointers: parent and children of a box follow from its rank.
                    # Nothing left below: back to the parent.
                    row = row + size
                    level = level + 1
                    size = (size + wp.static(WIDE - 1)) // wp.static(WIDE)
                    node = node // wp.static(WIDE)
            else:
                rank = code % wp.static(WIDE)
                # Open this child, and never again.
                if rank // wp.static(children) == part:
                    side_kept[level, rank % wp.static(children)] = far
                    end_kept[level, rank % wp.static(children)] = far
                node = wp.static(WIDE) * node + rank
                if level == 0:
                    if node != begun:
                        opened = node
                        got.boxes = got.boxes + 1
                    node = node // wp.static(WIDE)
                else:
                    level = level - 1
                    size = level_size(count, level)
                    row = row - size
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
