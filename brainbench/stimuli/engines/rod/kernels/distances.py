"""Distances between a link and the shapes it may touch: closed forms and exact triangles.

Lengths in mm, in the frame of the shape. A link is a segment with a radius that varies linearly along it. Closest
points as in Ericson, Real-Time Collision Detection (2005), chapter 5.

Triangles come in eights, and rows of the contact problem too: a processor computes eight in the lanes of its vector
unit. Its compiler makes vector code of no loop of Warp, but of loops over numbers in C++ without branches and calls, so
what these loops need is native code (``NUMBERS``, ``SEGMENTS``, ``TRIANGLES``). On a GPU they have the few turns that
are one thread's own. Every number is found by the same operations in the same order as one after another.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import CAPSULE, CYLINDER, SPHERE, WIDE

from .algebra import mat33, vec2, vec3, vec4, vec5
from .parameters import real, smooth
from .state import Cone, LeafCorners, ShapeArrays, line_place, line_tangent

# As fine as the numbers: 2⁻²⁰ is about 1e-6, 2⁻⁴⁴ about 6e-14 of a link.
halvings = 20 if real is wp.float32 else 44
least_slope = 2e-7 if real is wp.float32 else 1e-14
tiny = 1e-12 if real is wp.float32 else 1e-24


@wp.func(inline=True)
def primitive(kind: int, size: vec3, x: vec3) -> vec4:
    """Return the outward direction at a point and its signed distance from a primitive."""
    zero = real(0.0)
    out = vec4(zero, zero, real(1.0), zero)
    if kind == wp.static(SPHERE) or kind == wp.static(CAPSULE):
        z = x[2]
        if kind == wp.static(CAPSULE):
            z = x[2] - wp.clamp(x[2], -size[1], size[1])
        away = vec3(x[0], x[1], z)
        far = wp.length(away)
        if far > real(tiny):
            away = away / far
            out = vec4(away[0], away[1], away[2], far - size[0])
        else:
            out = vec4(real(1.0), zero, zero, -size[0])
    elif kind == wp.static(CYLINDER):
        radial = wp.sqrt(x[0] * x[0] + x[1] * x[1])
        side = radial - size[0]
        end = wp.abs(x[2]) - size[1]
        ux = real(1.0)
        uy = zero
        if radial > real(tiny):
            ux = x[0] / radial
            uy = x[1] / radial
        uz = wp.where(x[2] < zero, real(-1.0), real(1.0))
        # Beyond side and end the rim is nearest; otherwise the face with the larger signed distance.
        if side > zero and end > zero:
            far = wp.sqrt(side * side + end * end)
            out = vec4(ux * side / far, uy * side / far, uz * end / far, far)
        elif side > end:
            out = vec4(ux, uy, zero, side)
        else:
            out = vec4(zero, zero, uz, end)
    else:
        over = vec3(wp.abs(x[0]) - size[0], wp.abs(x[1]) - size[1], wp.abs(x[2]) - size[2])
        sx = wp.where(x[0] < zero, real(-1.0), real(1.0))
        sy = wp.where(x[1] < zero, real(-1.0), real(1.0))
        sz = wp.where(x[2] < zero, real(-1.0), real(1.0))
        if over[0] > zero or over[1] > zero or over[2] > zero:
            beyond = vec3(wp.max(over[0], zero), wp.max(over[1], zero), wp.max(over[2], zero))
            far = wp.length(beyond)
            out = vec4(sx * beyond[0] / far, sy * beyond[1] / far, sz * beyond[2] / far, far)
        elif over[0] >= over[1] and over[0] >= over[2]:
            out = vec4(sx, zero, zero, over[0])
        elif over[1] >= over[2]:
            out = vec4(zero, sy, zero, over[1])
        else:
            out = vec4(zero, zero, sz, over[2])
    return out


@wp.func
def slope_change(link: Cone) -> real:
    """Return by how much the slope of the gap to a convex shape may pass zero between an end of a link and any place.

    Along a segment not at all; beside it, by how far the tangents turn from the chords of the line. Places on the cubic
    are bounded by those that it goes through; some more is left for rounding.
    """
    change = real(0.01) * wp.length(link.b - link.a)
    if wp.static(smooth):
        offset = wp.transpose(link.line.offset)
        turn = wp.transpose(link.line.turn)
        chord = offset[3] - offset[0]
        near = offset[1] - offset[0] - chord / real(3.0)
        far = offset[2] - offset[3] + chord / real(3.0)
        turned = wp.max(wp.length(turn[0] - chord), wp.length(turn[1] - chord))
        turned = wp.max(turned, wp.max(wp.length(turn[2] - chord), wp.length(turn[3] - chord)))
        bowed = wp.max(wp.length(near + near - far), wp.length(far + far - near))
        change = change + real(9.0) * bowed + real(2.7) * turned
    return change


@wp.func
def segment_primitive(kind: int, size: vec3, link: Cone, start: vec4, end: vec4) -> vec5:
    """Return the place along a link (0 to 1) of the least gap, that gap (negative inside) and the normal.

    The gap is convex along a segment, and hardly less along its centre line: its slope is halved to zero, unless what
    :func:`primitive` says of ``start`` and ``end`` proves that one of them is nearest.
    """
    low = real(0.0)
    high = real(1.0)
    ra = link.start_radius
    rb = link.end_radius
    # Directions close to a surface would change by rounding.
    if wp.min(start[3], end[3]) > real(1e-4) * wp.max(wp.length(link.a), wp.length(link.b)):
        change = slope_change(link)
        if wp.dot(vec3(start[0], start[1], start[2]), line_tangent(link, low)) - (rb - ra) > change:
            high = low
        elif wp.dot(vec3(end[0], end[1], end[2]), line_tangent(link, high)) - (rb - ra) < -change:
            low = high
    for _ in range(wp.static(halvings) * int(high > low)):
        middle = real(0.5) * (low + high)
        here = primitive(kind, size, line_place(link, middle))
        along = line_tangent(link, middle)
        # Derivative of the gap along a–b: of the distance, less that of the radius.
        slope = here[0] * along[0] + here[1] * along[1] + here[2] * along[2] - (rb - ra)
        if slope > real(0.0):
            high = middle
        else:
            low = middle
    share = real(0.5) * (low + high)
    # A minimum at an end is put exactly there, because contacts at ends are handled apart.
    if low == real(0.0):
        share = real(0.0)
    if high == real(1.0):
        share = real(1.0)
    found = primitive(kind, size, line_place(link, share))
    return vec5(share, found[3] - (ra + (rb - ra) * share), found[0], found[1], found[2])


NUMBERS = f"""
using real = wp::{real.__name__};
#if defined(__CUDA_ARCH__)
#define INLINE
#define SIDE_BY_SIDE
const auto lower = [](real x, real y) {{ return min(x, y); }};
const auto upper = [](real x, real y) {{ return max(x, y); }};
const auto magnitude = [](real x) {{ return abs(x); }};
#else
#define INLINE __attribute__((always_inline))
#define SIDE_BY_SIDE _Pragma("clang loop vectorize(assume_safety) unroll(disable)")
const auto lower = [](real x, real y) {{ return x < y ? x : y; }};
const auto upper = [](real x, real y) {{ return x > y ? x : y; }};
const auto magnitude = [](real x) {{ return __builtin_elementwise_abs(x); }};
#endif
const real zero = 0, half = real(0.5), one = 1;
const auto dot = [](const real* x, const real* y) {{ return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]; }};
const auto cross = [](const real* x, const real* y, real* z) {{
    z[0] = x[1] * y[2] - x[2] * y[1]; z[1] = x[2] * y[0] - x[0] * y[2]; z[2] = x[0] * y[1] - x[1] * y[0];
}};
"""
"""Numbers of the solver's precision, and vectors of three."""

SEGMENTS = (
    NUMBERS
    + f"""
// Closest points of the segments a + s d1 and p + t d2: Ericson (2005), section 5.1.9.
const auto segments = [&](const real* a, const real* d1, const real* p, const real* d2, real& s, real& t) INLINE {{
    const real r[3] = {{a[0] - p[0], a[1] - p[1], a[2] - p[2]}};
    const real aa = dot(d1, d1), ee = dot(d2, d2), f = dot(d2, r), c = dot(d1, r), b = dot(d1, d2);
    // On the infinite lines; parallel ones take the middle.
    const real determinant = aa * ee - b * b;
    const real crossing = lower(upper((b * f - c * ee) / determinant, zero), one);
    const real along = determinant > real(1e-6) * aa * ee ? crossing : half;
    const real across = (b * along + f) / upper(ee, real({tiny}));
    // Clamped to the second segment, then again to the first.
    const real first = lower(upper(-c / aa, zero), one), last = lower(upper((b - c) / aa, zero), one);
    s = across < zero ? first : across > one ? last : along;
    t = across < zero ? zero : across > one ? one : across;
}};
"""
)
"""Closest points of two segments."""

AREAS = "const real vc = d1 * d4 - d3 * d2, vb = d5 * d2 - d1 * d6, va = d3 * d6 - d5 * d4;"
if smooth:
    # The same without products of four lengths, whose rounding moves a place on a slender triangle by a radius.
    AREAS = """real normal[3], part[3];
    cross(pq, pr, normal);
    cross(qx, rx, part); const real va = dot(normal, part);
    cross(rx, px, part); const real vb = dot(normal, part);
    cross(px, qx, part); const real vc = dot(normal, part);"""
TRIANGLES = (
    SEGMENTS
    + f"""
// Barycentric v and w of q and r of the point of a triangle that is closest to x: Ericson (2005), section 5.1.5.
const auto point_triangle = [&](const real* x, const real* p, const real* q, const real* r, real& v, real& w) INLINE {{
    real pq[3], pr[3], px[3], qx[3], rx[3];
    for (int d = 0; d < 3; d++) {{
        pq[d] = q[d] - p[d]; pr[d] = r[d] - p[d]; px[d] = x[d] - p[d]; qx[d] = x[d] - q[d]; rx[d] = x[d] - r[d];
    }}
    const real d1 = dot(pq, px), d2 = dot(pr, px), d3 = dot(pq, qx), d4 = dot(pr, qx), d5 = dot(pq, rx);
    const real d6 = dot(pr, rx), share = (d4 - d3) / (d4 - d3 + d5 - d6);
    {AREAS}
    const real whole = va + vb + vc;
    // Voronoi regions of the face, then from the last to the first of p, q, pq, r, pr, qr: the first counts.
    v = vb / whole; w = vc / whole;
    const bool at_qr = (va <= zero) & (d4 - d3 >= zero) & (d5 - d6 >= zero);
    v = at_qr ? one - share : v; w = at_qr ? share : w;
    const bool at_pr = (vb <= zero) & (d2 >= zero) & (d6 <= zero);
    const real on_pr = d2 / (d2 - d6);
    v = at_pr ? zero : v; w = at_pr ? on_pr : w;
    const bool at_r = (d6 >= zero) & (d5 <= d6);
    v = at_r ? zero : v; w = at_r ? one : w;
    const bool at_pq = (vc <= zero) & (d1 >= zero) & (d3 <= zero);
    const real on_pq = d1 / (d1 - d3);
    v = at_pq ? on_pq : v; w = at_pq ? zero : w;
    const bool at_q = (d3 >= zero) & (d4 <= d3);
    v = at_q ? one : v; w = at_q ? zero : w;
    const bool at_p = (d1 <= zero) & (d2 <= zero);
    v = at_p ? zero : v; w = at_p ? zero : w;
}};
// Squared distance of x from that point, and v and w.
const auto from_triangle =
    [&](const real* x, const real* p, const real* q, const real* r, real& square, real& v, real& w) INLINE {{
    real away[3];
    point_triangle(x, p, q, r, v, w);
    for (int d = 0; d < 3; d++) away[d] = x[d] - p[d] - (q[d] - p[d]) * v - (r[d] - p[d]) * w;
    square = dot(away, away);
}};
// Squared distance of a segment from the edges of a triangle, 0 where it pierces the face; with the place s on a–b.
const auto segment_triangle = [&](const real* a, const real* b, const real* p, const real* q, const real* r,
                                  real& square, real& s, real& v, real& w) INLINE {{
    real along[3], pq[3], pr[3], qr[3], gap[3], normal[3], from_a[3], inside[3], side[3], place, edge, found;
    for (int d = 0; d < 3; d++) {{
        along[d] = b[d] - a[d]; pq[d] = q[d] - p[d]; pr[d] = r[d] - p[d]; qr[d] = r[d] - q[d]; from_a[d] = p[d] - a[d];
    }}
    segments(a, along, p, pq, s, v);
    for (int d = 0; d < 3; d++) gap[d] = a[d] + along[d] * s - (p[d] + pq[d] * v);
    square = dot(gap, gap); w = zero;
    segments(a, along, p, pr, place, edge);
    for (int d = 0; d < 3; d++) gap[d] = a[d] + along[d] * place - (p[d] + pr[d] * edge);
    found = dot(gap, gap);
    bool nearer = found < square;
    square = nearer ? found : square; s = nearer ? place : s; v = nearer ? zero : v; w = nearer ? edge : w;
    segments(a, along, q, qr, place, edge);
    for (int d = 0; d < 3; d++) gap[d] = a[d] + along[d] * place - (q[d] + qr[d] * edge);
    found = dot(gap, gap);
    nearer = found < square;
    square = nearer ? found : square; s = nearer ? place : s; v = nearer ? one - edge : v; w = nearer ? edge : w;
    // A segment that crosses the face touches it, whatever its ends and the edges say.
    cross(pq, pr, normal);
    const real slope = dot(normal, along);
    place = dot(normal, from_a) / slope;
    for (int d = 0; d < 3; d++) inside[d] = a[d] + along[d] * place - p[d];
    // Barycentric coordinates by areas: the point is inside when none is negative.
    const real area = dot(normal, normal);
    cross(inside, pr, side);
    const real inside_v = dot(side, normal) / area;
    cross(pq, inside, side);
    const real inside_w = dot(side, normal) / area;
    const bool pierced = ((slope > real({tiny})) | (-slope > real({tiny}))) & (place > zero) & (place < one)
        & (inside_v >= zero) & (inside_w >= zero) & (inside_v + inside_w <= one);
    square = pierced ? zero : square; s = pierced ? place : s; v = pierced ? inside_v : v; w = pierced ? inside_w : w;
}};
"""
)
"""Distances from triangles, with :data:`SEGMENTS`: ``from_triangle`` of a point, and ``segment_triangle``, which with
the former at both ends of the segment gives its distance."""


@wp.func_native(
    SEGMENTS + "wp::vec_t<2, real> pair; segments(a.c, d1.c, p.c, d2.c, pair.c[0], pair.c[1]); return pair;"
)
def segments(a: vec3, d1: vec3, p: vec3, d2: vec3) -> vec2:
    """Return s and t of the closest points of the segments a + s d1 and p + t d2."""


@wp.func_native(f"""
wp::mat_t<3, 3, wp::{real.__name__}> rows;
const auto& leaf = corners.data[face / {WIDE}].data;
for (int i = 0; i < 9; i++) rows.data[i / 3][i % 3] = leaf[i][face % {WIDE}];
return rows;
""")
def triangle_corners(corners: wp.array(dtype=LeafCorners), face: int) -> mat33:
    """Return the corners of a triangle as rows, without a copy of its whole leaf."""


@wp.func
def triangle_feature(v: real, w: real, low: real) -> int:
    """Return what holds a point of a triangle: 0 its face, 1 to 3 a corner, 4 to 6 the edge opposite to that corner.

    Coordinates up to ``low`` count as none.
    """
    u = real(1.0) - v - w
    on_p = u > low
    on_q = v > low
    on_r = w > low
    slot = 0
    if on_p and not on_q and not on_r:
        slot = 1
    elif on_q and not on_p and not on_r:
        slot = 2
    elif on_r and not on_p and not on_q:
        slot = 3
    elif not on_p:
        slot = 4
    elif not on_q:
        slot = 5
    elif not on_r:
        slot = 6
    return slot


@wp.func
def pseudo_normal(shapes: ShapeArrays, face: int, v: real, w: real) -> vec3:
    """Return the pseudo-normal of the corner, edge or face that holds a point of these barycentric coordinates.

    The normal of one face tells the wrong side near a sharp edge or corner.
    """
    return shapes.outward[face, triangle_feature(v, w, real(1e-4))]


@wp.func
def way_out(shapes: ShapeArrays, face: int, v: real, w: real, x: vec3, distance: real, radius: real) -> vec4:
    """Return the direction out of a mesh and the signed distance at a point, given the place that is closest to it."""
    outward = pseudo_normal(shapes, face, v, w)
    # So near the surface, rounding would turn the way from it.
    if distance < real(1e-3) * radius:
        return vec4(outward[0], outward[1], outward[2], distance)
    rows = triangle_corners(shapes.corners, face)
    away = x - (rows[0] + (rows[1] - rows[0]) * v + (rows[2] - rows[0]) * w)
    side = real(1.0) / distance
    signed = distance
    if wp.dot(away, outward) < real(0.0):
        side = -side
        signed = -distance
    return vec4(away[0] * side, away[1] * side, away[2] * side, signed)


@wp.func_native(TRIANGLES + "wp::vec_t<2, real> at; point_triangle(x.c, p.c, q.c, r.c, at.c[0], at.c[1]); return at;")
def triangle_place(x: vec3, p: vec3, q: vec3, r: vec3) -> vec2:
    """Return barycentric v and w of q and r of the point of a triangle that is closest to x."""


@wp.func
def beside_triangle(shapes: ShapeArrays, face: int, x: vec3, normal: vec3) -> int:
    """Return −1 where a point, ``normal`` away from a triangle, is inside, and 1 where none beside it may be nearer.

    0: the point is over the face beyond an edge, as nearly as rounding tells, and its line flush with that face.
    """
    rows = triangle_corners(shapes.corners, face)
    at = triangle_place(x, rows[0], rows[1], rows[2])
    outward = pseudo_normal(shapes, face, at[0], at[1])
    over = wp.dot(outward, normal)
    if over < real(0.0):
        return -1
    return int(over >= wp.dot(outward, shapes.outward[face, 0]) - real(1e-6))


@wp.func
def line_triangle(shapes: ShapeArrays, face: int, link: Cone) -> vec5:
    """Return the place along a link's centre line (0 to 1) of the least gap to a triangle, that gap and the direction.

    Where the slope of the gap is zero, by false position: a slope that stays twice counts half (Dowell & Jarratt 1971).
    Triangles have no inside: a point beyond an edge may lie below their plane.
    """
    rows = triangle_corners(shapes.corners, face)
    ra = link.start_radius
    rb = link.end_radius
    precise = real(wp.static(least_slope)) * wp.length(link.b - link.a)
    low = real(0.0)
    high = real(1.0)
    below = real(0.0)
    above = real(0.0)
    # The far end, then the near one: a minimum at an end is put exactly there, because contacts at ends are handled
    # apart.
    share = high
    away = vec3()
    far = real(0.0)
    side = int(0)
    turns = int(0)
    while turns < wp.static(2 * halvings):
        if turns == 1:
            share = low
        elif turns > 1:
            share = low + (high - low) * below / (below - above)
        x = line_place(link, share)
        at = triangle_place(x, rows[0], rows[1], rows[2])
        away = x - rows[0] - (rows[1] - rows[0]) * at[0] - (rows[2] - rows[0]) * at[1]
        far = wp.max(wp.length(away), real(tiny))
        away = away / far
        slope = wp.dot(away, line_tangent(link, share)) - (rb - ra)
        if slope > real(0.0):
            if turns == 1:
                break
            if side == 1:
                below = real(0.5) * below
            high = share
            above = slope
            side = 1
        else:
            if turns == 0:
                break
            if side == -1:
                above = real(0.5) * above
            low = share
            below = slope
            side = -1
        if turns > 1 and (wp.abs(slope) <= precise or high - low <= real(wp.static(2.0**-halvings))):
            break
        if turns == 1:
            side = 0
        turns = turns + 1
    return vec5(share, far - (ra + (rb - ra) * share), away[0], away[1], away[2])
