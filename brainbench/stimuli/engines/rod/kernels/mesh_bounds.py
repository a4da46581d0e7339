"""Lower bounds of the distance of a link from eight triangles of a leaf, or from the boxes of eight children, at once.

Each thread of a group takes its share of the eight: one on a GPU, all on a processor, which computes them side by side
in the lanes of its vector unit. The loops are native code without calls or branches, because the processor's compiler
makes vector code of no loop of Warp. All distances are squared.
"""

from typing import Any

import warp as wp

from brainbench.stimuli.engines.rod.mesh_bvh import LEVELS, WIDE

from .algebra import vec3
from .distances import NUMBERS, TRIANGLES
from .parameters import group_size, real
from .state import LeafCorners, NodeBoxes

children = WIDE // group_size
step = 1 if children > 1 else 0
"""Child k of the node stands at step · k among its thread's own."""
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


lanes = f"""
constexpr int children = {children};
const real tiny = real(1e-20);
#if defined(__CUDA_ARCH__)
const auto magnitude = [](real x) {{ return abs(x); }};
#else
const auto magnitude = [](real x) {{ return __builtin_elementwise_abs(x); }};
#endif
"""


@wp.func_native(
    TRIANGLES
    + lanes
    + """
const auto& c = corners.data[leaf].data;
real side[children], end[children], start[children];
SIDE_BY_SIDE for (int k = 0; k < children; k++) {
    const int n = children * part + k;
    real along[3], beside[3][3], way[3];
    for (int i = 0; i < 3; i++) {
        const real x[3] = {c[3 * i][n] - a.c[0], c[3 * i + 1][n] - a.c[1], c[3 * i + 2][n] - a.c[2]};
        along[i] = dot(x, axis.c);
        for (int d = 0; d < 3; d++) beside[i][d] = x[d] - axis.c[d] * along[i];
    }
    // No point of a triangle is less far along this way than its nearest corner: a bound from three products.
    for (int d = 0; d < 3; d++) way[d] = beside[0][d] + beside[1][d] + beside[2][d];
    real near = lower(dot(beside[0], way), lower(dot(beside[1], way), dot(beside[2], way)));
    near = upper(near, zero);
    near = near * near / upper(dot(way, way), tiny);
    // Along the axis, from the segment and from its ends.
    const real low = lower(along[0], lower(along[1], along[2]));
    const real high = upper(along[0], upper(along[1], along[2]));
    const real beyond_both = upper(zero, upper(low - length, -high));
    const real beyond_end = upper(zero, upper(low - length, length - high));
    const real beyond_start = upper(zero, upper(low, -high));
    side[k] = sure * (near + beyond_both * beyond_both);
    end[k] = sure * (near + beyond_end * beyond_end);
    start[k] = sure * (near + beyond_start * beyond_start);
}
// Places of the last leaf may be empty.
const int first = 8 * (leaf - first_leaf) + children * part, held = count - first < children ? count - first : children;
int any_side = 0, any_end = 0, any_start = 0;
for (int k = 0; k < held; k++) {
    any_side |= side[k] < lower(side_most, got.side);
    any_end |= end[k] < lower(end_most, got.end);
    any_start |= start[k] < lower(all_of, got.start);
}
real square[children], share[children], v[children], w[children];
if (any_side) {
    SIDE_BY_SIDE for (int k = 0; k < children; k++) {
        const int n = children * part + k;
        const real p[3] = {c[0][n], c[1][n], c[2][n]}, q[3] = {c[3][n], c[4][n], c[5][n]};
        const real r[3] = {c[6][n], c[7][n], c[8][n]};
        segment_triangle(a.c, b.c, p, q, r, square[k], share[k], v[k], w[k]);
    }
    for (int k = 0; k < held; k++)
        if (side[k] < lower(side_most, got.side) && square[k] < got.side) {
            got.side = square[k]; got.share = share[k]; got.v = v[k]; got.w = w[k]; got.face = first + k;
        }
}
if (any_end) {
    SIDE_BY_SIDE for (int k = 0; k < children; k++) {
        const int n = children * part + k;
        const real p[3] = {c[0][n], c[1][n], c[2][n]}, q[3] = {c[3][n], c[4][n], c[5][n]};
        const real r[3] = {c[6][n], c[7][n], c[8][n]};
        from_triangle(b.c, p, q, r, square[k], v[k], w[k]);
    }
    for (int k = 0; k < held; k++)
        if (end[k] < lower(end_most, got.end) && square[k] < got.end) {
            got.end = square[k]; got.end_v = v[k]; got.end_w = w[k]; got.end_face = first + k;
        }
}
if (any_start) {
    SIDE_BY_SIDE for (int k = 0; k < children; k++) {
        const int n = children * part + k;
        const real p[3] = {c[0][n], c[1][n], c[2][n]}, q[3] = {c[3][n], c[4][n], c[5][n]};
        const real r[3] = {c[6][n], c[7][n], c[8][n]};
        from_triangle(a.c, p, q, r, square[k], v[k], w[k]);
    }
    for (int k = 0; k < held; k++)
        if (start[k] < lower(all_of, got.start) && square[k] < got.start) {
            got.start = square[k]; got.start_v = v[k]; got.start_w = w[k]; got.start_face = first + k;
        }
}
"""
)
def measure_triangles(
    corners: wp.array(dtype=LeafCorners),
    first_leaf: int,
    leaf: int,
    count: int,
    part: int,
    a: vec3,
    b: vec3,
    axis: vec3,
    length: real,
    sure: real,
    side_most: real,
    end_most: real,
    all_of: real,
    got: wp.ref[NearestTriangles],
):
    """Keep what is nearer in a leaf to the segment a–b, to b and to a than what was found before."""
    ...


@wp.func_native(
    NUMBERS
    + lanes
    + """
const auto& c = boxes.data[node].data;
SIDE_BY_SIDE for (int k = 0; k < children; k++) {
    const int n = children * part + k;
    real wide[3], centre[3], x[3], gap[3], off[3];
    for (int d = 0; d < 3; d++) {
        wide[d] = half * (c[3 + d][n] - c[d][n]);
        centre[d] = c[d][n] + wide[d];
        gap[d] = upper(magnitude(centre[d] - middle.c[d]) - wide[d] - reach.c[d], zero);
        x[d] = centre[d] - a.c[d];
    }
    real bound = dot(gap, gap);
    const bool worth = sure * bound < upper(side_most, end_most);
    // All of the segment lies behind the plane through its point nearest to the centre.
    const real t = lower(upper(dot(x, axis.c), zero), length);
    for (int d = 0; d < 3; d++) off[d] = x[d] - axis.c[d] * t;
    const real square = dot(off, off);
    const real over = square - magnitude(off[0]) * wide[0] - magnitude(off[1]) * wide[1] - magnitude(off[2]) * wide[2];
    bound = over > zero ? upper(bound, over * over / square) : bound;
    for (int d = 0; d < 3; d++) gap[d] = upper(magnitude(centre[d] - b.c[d]) - wide[d], zero);
    side.data[level][k] = worth ? bound : FAR;
    end.data[level][k] = worth ? dot(gap, gap) : FAR;
}
""".replace("FAR", f"real({beyond})")
)
def bound_boxes(
    boxes: wp.array(dtype=NodeBoxes),
    node: int,
    part: int,
    a: vec3,
    b: vec3,
    axis: vec3,
    length: real,
    middle: vec3,
    reach: vec3,
    sure: real,
    side_most: real,
    end_most: real,
    level: int,
    side: wp.ref[Kept],
    end: wp.ref[Kept],
):
    """Find how near the children of a node can be to the segment a–b and to b; ``beyond`` where that is no matter."""
    ...


@wp.func_native(
    NUMBERS
    + lanes
    + f"""
int code = {none_left};
SIDE_BY_SIDE for (int k = 0; k < children; k++) {{
    const real bound = side.data[level][k];
    const bool worth = (sure * bound < side_most) | (sure * end.data[level][k] < end_most);
    // The bits of positive floats are ordered like their values, so one minimum gives box and rank.
    const int own = ((wp::cast<int>(wp::float32(bound)) >> 3) << 3) + children * part + k;
    const int here = worth ? own : {none_left};
    code = here < code ? here : code;
}}
return code;
"""
)
def nearest_child(
    side: wp.ref[Kept], end: wp.ref[Kept], level: int, part: int, sure: real, side_most: real, end_most: real
) -> int:
    """Return the bound of the nearest child that may hold something nearer, with its rank in the last three bits."""
    ...
