"""What a search for the nearest triangles does at a leaf and at a node: eight triangles, or eight boxes, at once.

Each thread of a group takes its share of the eight: one on a GPU, all on a processor (``distances``). All distances are
squared, and in units of the surface.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.mesh_bvh import LEVELS, WIDE

from .algebra import vec3
from .distances import NUMBERS, TRIANGLES
from .parameters import group_size, real
from .state import LeafCorners, NodeBoxes

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
    """Distances beyond which nothing is looked at, for the sake of the segment, of its end b, and of its start a."""

    side: real
    end: real
    start: real


@wp.struct
class NearestTriangles:
    """Distances from the segment, its end b and its start a, the rank of the triangle of each (−1: none) and the place
    on it."""

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
if (any(side, lower(bounds.side, got.side))) {
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
measure(a, start, bounds.start, got.start, got.start_face, got.start_v, got.start_w);
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
    ...


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
    ...


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
    ...
