"""Distances between a link and the shapes it may touch: closed forms and exact triangles.

Lengths in mm, in the frame of the shape. A link is a segment with a radius that varies linearly along it. The distance
of a segment from a triangle is the least of ``segment_triangle`` and of ``point_triangle`` at both of its ends.
Closest points as in Ericson, Real-Time Collision Detection (2005), chapter 5.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import CAPSULE, CYLINDER, SPHERE

from .algebra import maximum, minimum, vec2, vec3, vec4, vec5
from .parameters import real

# As fine as the numbers: 2⁻²⁰ is about 1e-6, 2⁻⁴⁴ about 6e-14 of a link.
halvings = 20 if real is wp.float32 else 44
tiny = 1e-12 if real is wp.float32 else 1e-24


@wp.func
def primitive(kind: int, size: vec3, x: vec3) -> vec4:
    """Return the outward direction at a point and its signed distance from a primitive."""
    zero = real(0.0)
    out = vec4(zero, zero, real(1.0), zero)
    if kind == wp.static(SPHERE) or kind == wp.static(CAPSULE):
        z = x[2]
        if kind == wp.static(CAPSULE):
            z = x[2] - wp.clamp(x[2], -size[1], size[1])
        else:
            z = x[2]
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
def segment_primitive(kind: int, size: vec3, a: vec3, b: vec3, ra: real, rb: real) -> vec5:
    """Return the place along a–b (0 to 1) of the least gap, that gap (negative inside) and the normal.

    The gap is convex along the segment: its slope is halved to zero.
    """
    low = real(0.0)
    high = real(1.0)
    along = b - a
    for _ in range(wp.static(halvings)):
        middle = real(0.5) * (low + high)
        here = primitive(kind, size, a + along * middle)
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
    found = primitive(kind, size, a + along * share)
    return vec5(share, found[3] - (ra + (rb - ra) * share), found[0], found[1], found[2])


@wp.func
def point_triangle(x: vec3, p: vec3, q: vec3, r: vec3) -> vec2:
    """Return the barycentric coordinates of q and r of the point of a triangle that is closest to x."""
    pq = q - p
    pr = r - p
    px = x - p
    # Ericson (2005), section 5.1.5.
    # Voronoi regions of p, q, pq, r, pr, qr, and the face.
    d1 = wp.dot(pq, px)
    d2 = wp.dot(pr, px)
    zero = real(0.0)
    one = real(1.0)
    if d1 <= zero and d2 <= zero:
        return vec2(zero, zero)
    qx = x - q
    d3 = wp.dot(pq, qx)
    d4 = wp.dot(pr, qx)
    if d3 >= zero and d4 <= d3:
        return vec2(one, zero)
    vc = d1 * d4 - d3 * d2
    if vc <= zero and d1 >= zero and d3 <= zero:
        return vec2(d1 / (d1 - d3), zero)
    rx = x - r
    d5 = wp.dot(pq, rx)
    d6 = wp.dot(pr, rx)
    if d6 >= zero and d5 <= d6:
        return vec2(zero, one)
    vb = d5 * d2 - d1 * d6
    if vb <= zero and d2 >= zero and d6 <= zero:
        return vec2(zero, d2 / (d2 - d6))
    va = d3 * d6 - d5 * d4
    if va <= zero and d4 - d3 >= zero and d5 - d6 >= zero:
        share = (d4 - d3) / (d4 - d3 + d5 - d6)
        return vec2(one - share, share)
    whole = va + vb + vc
    return vec2(vb / whole, vc / whole)


@wp.func
def segments(a: vec3, d1: vec3, p: vec3, d2: vec3) -> vec2:
    """Return s and t of the closest points of the segments a + s d1 and p + t d2."""
    r = a - p
    aa = wp.dot(d1, d1)
    ee = wp.dot(d2, d2)
    f = wp.dot(d2, r)
    c = wp.dot(d1, r)
    b = wp.dot(d1, d2)
    zero = real(0.0)
    one = real(1.0)
    # Ericson (2005), section 5.1.9.
    # On the infinite lines; parallel ones take the middle.
    determinant = aa * ee - b * b
    s = real(0.5)
    if determinant > real(1e-6) * aa * ee:
        s = minimum(maximum((b * f - c * ee) / determinant, zero), one)
    t = (b * s + f) / maximum(ee, real(tiny))
    # Clamped to the second segment, then again to the first.
    if t < zero:
        t = zero
        s = minimum(maximum(-c / aa, zero), one)
    elif t > one:
        t = one
        s = minimum(maximum((b - c) / aa, zero), one)
    return vec2(s, t)


@wp.func
def segment_triangle(a: vec3, b: vec3, p: vec3, q: vec3, r: vec3) -> vec4:
    """Return (squared distance, place along a–b, barycentric q, barycentric r) of the closest points of a segment and
    the edges of a triangle; distance 0 where the segment pierces the face."""
    along = b - a
    pq = q - p
    pr = r - p
    zero = real(0.0)
    one = real(1.0)
    pair = segments(a, along, p, pq)
    gap = a + along * pair[0] - (p + pq * pair[1])
    best = vec4(wp.dot(gap, gap), pair[0], pair[1], zero)
    pair = segments(a, along, p, pr)
    gap = a + along * pair[0] - (p + pr * pair[1])
    square = wp.dot(gap, gap)
    if square < best[0]:
        best = vec4(square, pair[0], zero, pair[1])
    pair = segments(a, along, q, r - q)
    gap = a + along * pair[0] - (q + (r - q) * pair[1])
    square = wp.dot(gap, gap)
    if square < best[0]:
        best = vec4(square, pair[0], one - pair[1], pair[1])
    # A segment that crosses the face touches it, whatever its ends and the edges say.
    normal = wp.cross(pq, pr)
    slope = wp.dot(normal, along)
    if wp.abs(slope) > real(tiny):
        share = wp.dot(normal, p - a) / slope
        if share > zero and share < one:
            inside = a + along * share - p
            square = wp.dot(normal, normal)
            # Barycentric coordinates by areas: the point is inside when none is negative.
            v = wp.dot(wp.cross(inside, pr), normal) / square
            w = wp.dot(wp.cross(pq, inside), normal) / square
            if v >= zero and w >= zero and v + w <= one:
                best = vec4(zero, share, v, w)
    return best
