"""Adjoint of ``motion.pose_at``: derivatives by a pose at one time become derivatives by the knots of its track."""

import warp as wp

from ..algebra import vec3, vec4
from ..motion import Instant, MotionArrays, cell_at, elapsed, turning
from ..parameters import real


@wp.struct
class PoseCotangent:
    """Derivatives with respect to the pose of a body at one time."""

    place: vec3
    velocity: vec3
    turn: vec3
    """By a small turn of the body about its place, world axes."""
    spin: vec3


@wp.func
def add_knot(knots: wp.array2d(dtype=real), knot: int, first: int, value: vec3):
    """Add to three numbers of a knot."""
    for d in range(3):
        wp.atomic_add(knots, knot, first + d, value[d])


@wp.func
def add_quaternion(knots: wp.array2d(dtype=real), knot: int, value: vec4):
    """Add to the quaternion of a knot."""
    for d in range(4):
        wp.atomic_add(knots, knot, 6 + d, value[d])


@wp.func
def spin_cotangent(turn: vec4, bar: vec4) -> vec3:
    """Return the derivative by the angular velocity of ``turning(turn, spin)``, given that by its result."""
    half = real(0.5)
    return vec3(
        half * (bar[1] * turn[0] - bar[0] * turn[1] + bar[3] * turn[2] - bar[2] * turn[3]),
        half * (bar[2] * turn[0] - bar[0] * turn[2] + bar[1] * turn[3] - bar[3] * turn[1]),
        half * (bar[3] * turn[0] - bar[0] * turn[3] + bar[2] * turn[1] - bar[1] * turn[2]),
    )


@wp.func
def spread_pose(motions: MotionArrays, knots: wp.array2d(dtype=real), index: int, when: Instant, bar: PoseCotangent):
    """Add to the derivatives by the knots [knot, 16] of a track what derivatives by its pose at a time give."""
    first = motions.first[index]
    count = motions.count[index]
    two = real(2.0)
    # A small turn φ changes the unit quaternion q by ½ (0, φ) q, so the derivative by it is 2 (0, φ̄) q.
    if count == 1:
        add_knot(knots, first, 0, bar.place)
        add_knot(knots, first, 3, bar.velocity + bar.place * elapsed(when))
        add_quaternion(knots, first, turning(motions.turn[first], bar.turn) * real(4.0))
        return
    cell = cell_at(when, count - 1)
    a = motions.cell[first + cell]
    pieces = motions.cell[first + cell + 1] - a
    spacing = real(1.0) / real(pieces)
    place = (real(when.tick - cell) + when.part) * real(pieces)
    i = wp.clamp(int(wp.floor(place)), 0, pieces - 1)
    u = place - real(i)
    a = a + i
    b = a + 1
    one = real(1.0)
    three = real(3.0)
    # The weights of ``pose_at``.
    v0 = (one + two * u) * (one - u) * (one - u)
    s0 = u * (one - u) * (one - u) * spacing
    v1 = u * u * (three - two * u)
    s1 = u * u * (u - one) * spacing
    dv = real(6.0) * u * (u - one) / spacing
    ds0 = (one - u) * (one - three * u)
    ds1 = u * (three * u - two)
    way = bar.place * v1 - bar.velocity * dv
    add_knot(knots, a, 0, bar.place - way)
    add_knot(knots, b, 0, way)
    add_knot(knots, a, 3, bar.place * s0 + bar.velocity * ds0)
    add_knot(knots, b, 3, bar.place * s1 + bar.velocity * ds1)
    turn = (
        motions.turn[a] * v0
        + turning(motions.turn[a], motions.spin[a]) * s0
        + motions.turn[b] * v1
        + turning(motions.turn[b], motions.spin[b]) * s1
    )
    size = wp.length(turn)
    raw = turning(turn / size, bar.turn) * (real(4.0) / size)
    # The transpose of turning(·, w) is turning(·, −w).
    add_quaternion(knots, a, raw * v0 - turning(raw, motions.spin[a]) * s0)
    add_quaternion(knots, b, raw * v1 - turning(raw, motions.spin[b]) * s1)
    add_knot(knots, a, 10, spin_cotangent(motions.turn[a], raw) * s0 + bar.spin * v0)
    add_knot(knots, b, 10, spin_cotangent(motions.turn[b], raw) * s1 + bar.spin * v1)
    add_knot(knots, a, 13, bar.spin * s0)
    add_knot(knots, b, 13, bar.spin * s1)
