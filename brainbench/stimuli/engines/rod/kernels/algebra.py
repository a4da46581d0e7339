"""Vectors, quaternions (w, x, y, z), symmetric matrices and spatial vectors of the solver's precision."""

from typing import Any

import warp as wp

from .parameters import hinges, real

vec2: Any = wp.types.vector(2, real)
vec3: Any = wp.types.vector(3, real)
vec4: Any = wp.types.vector(4, real)
vec5: Any = wp.types.vector(5, real)
vec6: Any = wp.types.vector(6, real)
mat33: Any = wp.types.matrix((3, 3), real)
mat34: Any = wp.types.matrix((3, 4), real)
JointVector: Any = wp.types.vector(hinges, real)
"""One number for each hinge of a joint: bending about y, bending about z, twist about x."""
JointInverse: Any = wp.types.vector(hinges + 1, real)
"""Inverse inertia of a joint: (11, 12, 22) of bending, then that of twist."""
single = real is wp.float32


@wp.func
def symmetric_times(a: vec6, x: vec3) -> vec3:
    """Return the product of a symmetric matrix (xx yy zz xy xz yz) and a vector."""
    return vec3(
        a[0] * x[0] + a[3] * x[1] + a[4] * x[2],
        a[3] * x[0] + a[1] * x[1] + a[5] * x[2],
        a[4] * x[0] + a[5] * x[1] + a[2] * x[2],
    )


@wp.func
def symmetric_outer(a: vec3, b: vec3, c: vec3, d: vec3) -> vec6:
    """Return the matrix a bᵀ + c dᵀ, given that it is symmetric."""
    return vec6(
        a[0] * b[0] + c[0] * d[0],
        a[1] * b[1] + c[1] * d[1],
        a[2] * b[2] + c[2] * d[2],
        a[0] * b[1] + c[0] * d[1],
        a[0] * b[2] + c[0] * d[2],
        a[1] * b[2] + c[1] * d[2],
    )


@wp.func
def upper_outer(a: vec3, b: vec3) -> vec6:
    """Return the diagonal and the upper half of the matrix a bᵀ."""
    return vec6(a[0] * b[0], a[1] * b[1], a[2] * b[2], a[0] * b[1], a[0] * b[2], a[1] * b[2])


@wp.func
def sine(x: real) -> real:
    """Return the sine; in single precision by a series, good to 1e-7 up to 1.5 rad: joints bend no further."""
    if wp.static(single):
        y = x * x
        return x * (
            real(1.0)
            + y * (real(-1.0 / 6.0) + y * (real(1.0 / 120.0) + y * (real(-1.0 / 5040.0) + y * real(1.0 / 362880.0))))
        )
    return wp.sin(x)


@wp.func
def cosine(x: real) -> real:
    """Return the cosine as :func:`sine` does."""
    if wp.static(single):
        y = x * x
        return real(1.0) + y * (
            real(-0.5)
            + y * (real(1.0 / 24.0) + y * (real(-1.0 / 720.0) + y * (real(1.0 / 40320.0) + y * real(-1.0 / 3628800.0))))
        )
    return wp.cos(x)


@wp.func
def first_axis(z: vec3, along: vec3, angle: real) -> vec3:
    """Return the axis of a joint's first hinge from that of its second, the link behind it and the second angle."""
    x = wp.normalize(along)
    return wp.cross(z, x) * cosine(angle) + x * sine(angle)


@wp.func
def rotate(q: vec4, x: vec3) -> vec3:
    """Return the vector turned by a unit quaternion."""
    u = vec3(q[1], q[2], q[3])
    # Two cross products instead of a rotation matrix: x + q₀ t + u × t with t = 2 u × x.
    t = real(2.0) * wp.cross(u, x)
    return x + q[0] * t + wp.cross(u, t)


@wp.func
def unrotate(q: vec4, x: vec3) -> vec3:
    """Return the vector turned back by a unit quaternion."""
    u = vec3(-q[1], -q[2], -q[3])
    t = real(2.0) * wp.cross(u, x)
    return x + q[0] * t + wp.cross(u, t)


@wp.func
def quaternion_product(p: vec4, q: vec4) -> vec4:
    """Return the quaternion of turn q and then turn p."""
    a = vec3(p[1], p[2], p[3])
    b = vec3(q[1], q[2], q[3])
    c = p[0] * b + q[0] * a + wp.cross(a, b)
    return vec4(p[0] * q[0] - wp.dot(a, b), c[0], c[1], c[2])


@wp.func
def quaternion_of(turn: vec3) -> vec4:
    """Return the unit quaternion of a rotation vector."""
    half = real(0.5) * wp.length(turn)
    share = real(0.5)
    if half > real(1e-4):
        share = real(0.5) * wp.sin(half) / half
    return vec4(wp.cos(half), share * turn[0], share * turn[1], share * turn[2])


@wp.func
def rotation_vector(q: vec4) -> vec3:
    """Return the rotation vector of a unit quaternion, of less than half a turn."""
    u = vec3(q[1], q[2], q[3])
    sine_half = wp.length(u)
    share = real(2.0)
    if sine_half > real(1e-4):
        share = real(2.0) * wp.atan2(sine_half, q[0]) / sine_half
    return u * share


def chosen(name: str, sign: str) -> str:
    """Return native code that picks one of two numbers.

    Warp's own functions make sure on a processor, at four times the cost, that a value that is no number loses.
    """
    return f"#if defined(__CUDA_ARCH__)\nreturn {name}(a, b);\n#else\nreturn a {sign} b ? a : b;\n#endif\n"


@wp.func_native(chosen("min", "<"))
def minimum(a: real, b: real) -> real:
    """Return the smaller number; which one, if one is no number, depends on the machine."""


@wp.func_native(chosen("max", ">"))
def maximum(a: real, b: real) -> real:
    """Return the larger number; which one, if one is no number, depends on the machine."""


def reader(*kinds: tuple[Any, Any]) -> Any:
    """Return ``row(memory, index)`` for references to memory of each of these (type, type of its elements)."""
    for memory, element in dict.fromkeys(kinds):

        @wp.func_native("return wp::extract(memory, index);")
        def row(memory: wp.ref[memory], index: int) -> element:
            """Return the element of a place in memory."""

    return row


@wp.struct
class Spatial:
    """A spatial vector at the base point: rotation and velocity there (a motion), or moment and force."""

    w: vec3
    v: vec3


@wp.func
def spatial(w: vec3, v: vec3) -> Spatial:
    """Return a spatial vector."""
    both = Spatial()
    both.w = w
    both.v = v
    return both


@wp.func
def hinge_motion(at: vec3, axis: vec3) -> Spatial:
    """Return the motion S of what turns at rate 1 about an axis through a point: its other part is at × axis."""
    return spatial(axis, wp.cross(at, axis))


@wp.func
def spatial_dot(a: Spatial, b: Spatial) -> real:
    """Return the power of a force b at a motion a."""
    return wp.dot(a.w, b.w) + wp.dot(a.v, b.v)


@wp.func
def scaled(a: Spatial, x: real) -> Spatial:
    """Return a x."""
    return spatial(a.w * x, a.v * x)


@wp.func
def combined(a: Spatial, x: real, b: Spatial, y: real) -> Spatial:
    """Return a x + b y."""
    return spatial(a.w * x + b.w * y, a.v * x + b.v * y)


@wp.func
def plus(a: Spatial, b: Spatial, x: real) -> Spatial:
    """Return a + b x."""
    return spatial(a.w + b.w * x, a.v + b.v * x)


@wp.func
def minus(a: Spatial, b: Spatial, x: real) -> Spatial:
    """Return a − b x."""
    return spatial(a.w - b.w * x, a.v - b.v * x)


@wp.func
def cross_motion(a: Spatial, b: Spatial) -> Spatial:
    """Return the spatial cross product a × b of two motions."""
    return spatial(wp.cross(a.w, b.w), wp.cross(a.w, b.v) + wp.cross(a.v, b.w))


@wp.func
def plus_cross(c: Spatial, a: Spatial, b: Spatial) -> Spatial:
    """Return c + a × b of motions, added up from the left."""
    return spatial(c.w + wp.cross(a.w, b.w), c.v + wp.cross(a.w, b.v) + wp.cross(a.v, b.w))


@wp.func
def minus_dot(x: real, a: Spatial, b: Spatial) -> real:
    """Return x − a·b, subtracted from the left."""
    return x - wp.dot(a.w, b.w) - wp.dot(a.v, b.v)


@wp.struct
class SpatialInertia:
    """A symmetric spatial matrix (a b; bᵀ c)."""

    a: vec6
    b: mat33
    c: vec6


@wp.func
def inertia_times(inertia: SpatialInertia, s: Spatial) -> Spatial:
    """Return the force that a spatial inertia has at a motion."""
    return spatial(symmetric_times(inertia.a, s.w) + inertia.b * s.v, s.w * inertia.b + symmetric_times(inertia.c, s.v))


@wp.func
def plus_inertia_times(f: Spatial, inertia: SpatialInertia, s: Spatial) -> Spatial:
    """Return a force and that of an inertia at a motion, added up from the left."""
    return spatial(
        f.w + symmetric_times(inertia.a, s.w) + inertia.b * s.v, f.v + s.w * inertia.b + symmetric_times(inertia.c, s.v)
    )
