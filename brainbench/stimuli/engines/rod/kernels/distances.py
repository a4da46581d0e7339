"""Distances between a link and the primitives it may touch, in closed form.

Lengths in mm, in the frame of the shape. A link is a segment with a radius that varies linearly along it.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import CAPSULE, CYLINDER, SPHERE

from .algebra import vec2, vec3, vec4, vec5
from .native import SEGMENTS, tiny
from .parameters import real

# As fine as the numbers: 2⁻²⁰ is about 1e-6, 2⁻⁴⁴ about 6e-14 of a link.
halvings = 20 if real is wp.float32 else 44


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


@wp.func_native(
    SEGMENTS + "wp::vec_t<2, real> pair; segments(a.c, d1.c, p.c, d2.c, pair.c[0], pair.c[1]); return pair;"
)
def segments(a: vec3, d1: vec3, p: vec3, d2: vec3) -> vec2:
    """Return s and t of the closest points of the segments a + s d1 and p + t d2."""
    ...
