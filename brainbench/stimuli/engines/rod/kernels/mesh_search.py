"""Search for the triangles of a surface that are nearest to a segment and its ends, by the surface's tree.

The tree is that of ``brainbench.stimuli.engines.rod.packing``: eight children a node, without pointers. The search
always opens the box that may hold something nearer and is nearest, and measures the triangles of leaves. It begins at
the leaf where the last search of the same link ended, so that hardly anything else is left to open. Each thread of a
group takes its share of eight boxes or triangles: one on a GPU, all on a processor, side by side (``distances``).
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.limits import BITS, LEVELS, WIDE

from .algebra import maximum, minimum, vec3
from .distances import NUMBERS, TRIANGLES
from .parameters import cuda, group_size, real
from .state import LeafCorners, NodeBoxes, ShapeArrays
from .thread_groups import broadcast, group_min, group_min_int, warp_max

children = WIDE // group_size
stride = 1 if children > 1 else 0
"""Child k of the node stands at stride · k among its thread's own."""
Kept: Any = wp.types.matrix((LEVELS, children), real)
beyond = 1e30
none_left = 2**31 - 1


@wp.struct
class SearchSegment:
    """The segment that is asked about, from a to b."""

    a: vec3
    b: vec3
    axis: vec3
    """Its direction."""
    length: real
    middle: vec3
    reach: vec3
    """Half of its extent along each coordinate."""


@wp.struct
class SearchBounds:
    """Squared distances beyond which nothing is looked at, for the segment, for its end b and for its start a."""

    side: real
    end: real
    start: real


@wp.struct
class NearestTriangles:
    """Squared distances from the segment, its end b and its start a, the rank of the triangle of each (−1: none) and
    the place on it."""

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


SHARE = f"""
constexpr int children = {children};
// Rounding must not hide a triangle.
const real sure = real(0.998);
"""
SEGMENT = "const real *a = line.a.c, *b = line.b.c, *axis = line.axis.c;"


@wp.func_native(
    TRIANGLES
    + SHARE
    + SEGMENT
    + """
const auto& c = corners.data[leaf].data;
const auto triangle = [&](int k, real* p, real* q, real* r) INLINE {
    for (int d = 0; d < 3; d++) {
        p[d] = c[d][children * part + k]; q[d] = c[3 + d][children * part + k]; r[d] = c[6 + d][children * part + k];
    }
};
// No triangle is nearer than these.
real side[children], end[children], start[children];
SIDE_BY_SIDE for (int k = 0; k < children; k++) {
    real corner[3][3], along[3], beside[3][3], way[3];
    triangle(k, corner[0], corner[1], corner[2]);
    for (int i = 0; i < 3; i++) {
        for (int d = 0; d < 3; d++) corner[i][d] = corner[i][d] - a[d];
        along[i] = dot(corner[i], axis);
        for (int d = 0; d < 3; d++) beside[i][d] = corner[i][d] - axis[d] * along[i];
    }
    // No point of a triangle is less far along this way than its nearest corner: a bound from three products.
    for (int d = 0; d < 3; d++) way[d] = beside[0][d] + beside[1][d] + beside[2][d];
    real near = lower(dot(beside[0], way), lower(dot(beside[1], way), dot(beside[2], way)));
    near = upper(near, zero);
    near = near * near / upper(dot(way, way), real(1e-20));
    // Along the axis, from the segment and from its ends.
    const real low = lower(along[0], lower(along[1], along[2])), high = upper(along[0], upper(along[1], along[2]));
    const real off_side = upper(zero, upper(low - line.length, -high));
    const real off_end = upper(zero, upper(low - line.length, line.length - high));
    const real off_start = upper(zero, upper(low, -high));
    side[k] = sure * (near + off_side * off_side);
    end[k] = sure * (near + off_end * off_end);
    start[k] = sure * (near + off_start * off_start);
}
// Places of the last leaf may be empty. All triangles are measured as soon as one may be nearer, and then kept one
// after another, as if each had been asked for by itself.
const int held = count - first < children ? count - first : children;
const auto any = [&](const real* bound, real most) INLINE {
    int found = 0;
    for (int k = 0; k < held; k++) found |= bound[k] < most;
    return found;
};
real square[children], share[children], v[children], w[children];
if (line.length > zero && any(side, lower(bounds.side, got.side))) {
    SIDE_BY_SIDE for (int k = 0; k < children; k++) {
        real p[3], q[3], r[3];
        triangle(k, p, q, r);
        segment_triangle(a, b, p, q, r, square[k], share[k], v[k], w[k]);
    }
    for (int k = 0; k < held; k++)
        if (side[k] < lower(bounds.side, got.side) && square[k] < got.side) {
            got.side = square[k]; got.share = share[k]; got.face = first + k; got.v = v[k]; got.w = w[k];
        }
}
const auto measure =
    [&](const real* x, const real* bound, real most, real& best, int& face, real& at_v, real& at_w) INLINE {
    if (!any(bound, lower(most, best))) return;
    SIDE_BY_SIDE for (int k = 0; k < children; k++) {
        real p[3], q[3], r[3];
        triangle(k, p, q, r);
        from_triangle(x, p, q, r, square[k], v[k], w[k]);
    }
    for (int k = 0; k < held; k++)
        if (bound[k] < lower(most, best) && square[k] < best) {
            best = square[k]; face = first + k; at_v = v[k]; at_w = w[k];
        }
};
measure(b, end, bounds.end, got.end, got.end_face, got.end_v, got.end_w);
if (line.length > zero) measure(a, start, bounds.start, got.start, got.start_face, got.start_v, got.start_w);
"""
)
def measure_triangles(
    corners: wp.array(dtype=LeafCorners),
    leaf: int,
    first: int,
    count: int,
    part: int,
    line: SearchSegment,
    bounds: SearchBounds,
    got: wp.ref[NearestTriangles],
):
    """Keep what is nearer in a leaf than what was found before.

    ``first`` is the rank of the thread's first triangle among the ``count`` of the surface.
    """


@wp.func_native(
    NUMBERS
    + SHARE
    + SEGMENT
    + f"""
const auto& c = boxes.data[node].data;
SIDE_BY_SIDE for (int k = 0; k < children; k++) {{
    const int n = children * part + k;
    real wide[3], centre[3], x[3], gap[3], off[3];
    for (int d = 0; d < 3; d++) {{
        wide[d] = half * (c[3 + d][n] - c[d][n]);
        centre[d] = c[d][n] + wide[d];
        gap[d] = upper(magnitude(centre[d] - line.middle.c[d]) - wide[d] - line.reach.c[d], zero);
        x[d] = centre[d] - a[d];
    }}
    real bound = dot(gap, gap);
    const bool worth = sure * bound < upper(bounds.side, bounds.end);
    // All of the segment lies behind the plane through its point nearest to the centre.
    const real t = lower(upper(dot(x, axis), zero), line.length);
    for (int d = 0; d < 3; d++) off[d] = x[d] - axis[d] * t;
    const real square = dot(off, off);
    const real over = square - magnitude(off[0]) * wide[0] - magnitude(off[1]) * wide[1] - magnitude(off[2]) * wide[2];
    bound = over > zero ? upper(bound, over * over / square) : bound;
    for (int d = 0; d < 3; d++) gap[d] = upper(magnitude(centre[d] - b[d]) - wide[d], zero);
    side.data[level][k] = worth ? bound : real({beyond});
    end.data[level][k] = worth ? dot(gap, gap) : real({beyond});
}}
"""
)
def bound_boxes(
    boxes: wp.array(dtype=NodeBoxes),
    node: int,
    part: int,
    line: SearchSegment,
    bounds: SearchBounds,
    level: int,
    side: wp.ref[Kept],
    end: wp.ref[Kept],
):
    """Find how near the children of a node can be to the segment and to b; ``beyond`` where that is no matter."""


@wp.func_native(
    NUMBERS
    + SHARE
    + f"""
int code = {none_left};
SIDE_BY_SIDE for (int k = 0; k < children; k++) {{
    const real bound = side.data[level][k];
    const bool worth = (sure * bound < bounds.side) | (sure * end.data[level][k] < bounds.end);
    // The bits of positive floats are ordered like their values, so one minimum gives box and rank.
    const int own = ((wp::cast<int>(wp::float32(bound)) >> 3) << 3) + children * part + k;
    const int here = worth ? own : {none_left};
    code = here < code ? here : code;
}}
return code;
"""
)
def nearest_child(side: wp.ref[Kept], end: wp.ref[Kept], level: int, part: int, bounds: SearchBounds) -> int:
    """Return the bound of the nearest child that may hold something nearer, with its rank in the last three bits."""


@wp.func
def node_count(count: int, level: int) -> int:
    """Return the number of nodes of a level, of a surface of ``count`` triangles; level −1 is that of leaves."""
    return ((count - 1) >> (wp.static(BITS) * (level + 2))) + 1


# Where one thread searches alone, compilers of GPUs would write the search out at all its 20 calls: minutes to compile.
@wp.func(inline=False if cuda and group_size == 1 else None)
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
