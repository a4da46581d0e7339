"""Derivatives of ``motion.pose_at``: how the knots of a track move its pose."""

import warp as wp

from ..algebra import vec3, vec4
from ..motion import Instant, MotionArrays, elapsed, piece_at, quaternion_rate, raw_turn
from ..parameters import real


@wp.struct
class PoseTangent:
    """Change of the pose of a body at one time."""

    place: vec3
    velocity: vec3
    turn: vec3
    """Small turn about its place, world axes."""
    spin: vec3


@wp.func
def knot_vector(knots: wp.array3d(dtype=real), p: int, knot: int, first: int) -> vec3:
    """Return the change of three numbers of a knot."""
    return vec3(knots[p, knot, first], knots[p, knot, first + 1], knots[p, knot, first + 2])


@wp.func
def knot_quaternion(knots: wp.array3d(dtype=real), p: int, knot: int) -> vec4:
    """Return the change of the quaternion of a knot."""
    return vec4(knots[p, knot, 6], knots[p, knot, 7], knots[p, knot, 8], knots[p, knot, 9])


@wp.func
def turn_between(q: vec4, change: vec4) -> vec3:
    """Return the small turn that changes a unit quaternion so: twice the vector part of change times conjugate."""
    v = vec3(q[1], q[2], q[3])
    c = vec3(change[1], change[2], change[3])
    return (c * q[0] - v * change[0] - wp.cross(c, v)) * real(2.0)


@wp.func
def move_pose(motions: MotionArrays, knots: wp.array3d(dtype=real), p: int, index: int, when: Instant) -> PoseTangent:
    """Return the change of a track's pose at a time with that of its knots [p, knot, 16]."""
    first = motions.first[index]
    count = motions.count[index]
    found = PoseTangent()
    if count == 1:
        found.velocity = knot_vector(knots, p, first, 3)
        found.place = knot_vector(knots, p, first, 0) + found.velocity * elapsed(when)
        found.turn = turn_between(motions.quaternion[first], knot_quaternion(knots, p, first))
        return found
    piece = piece_at(motions, first, count, when)
    a = piece.first
    b = a + 1
    way = knot_vector(knots, p, b, 0) - knot_vector(knots, p, a, 0)
    speed_a = knot_vector(knots, p, a, 3)
    speed_b = knot_vector(knots, p, b, 3)
    found.place = knot_vector(knots, p, a, 0) + way * piece.v1 + speed_a * piece.s0 + speed_b * piece.s1
    found.velocity = speed_a * piece.ds0 + speed_b * piece.ds1 - way * piece.dv
    spin_a = knot_vector(knots, p, a, 10)
    spin_b = knot_vector(knots, p, b, 10)
    found.spin = (
        spin_a * piece.v0
        + knot_vector(knots, p, a, 13) * piece.s0
        + spin_b * piece.v1
        + knot_vector(knots, p, b, 13) * piece.s1
    )
    turn_a = knot_quaternion(knots, p, a)
    turn_b = knot_quaternion(knots, p, b)
    change = (
        turn_a * piece.v0
        + (quaternion_rate(turn_a, motions.spin[a]) + quaternion_rate(motions.quaternion[a], spin_a)) * piece.s0
        + turn_b * piece.v1
        + (quaternion_rate(turn_b, motions.spin[b]) + quaternion_rate(motions.quaternion[b], spin_b)) * piece.s1
    )
    turn = raw_turn(motions, piece)
    size = wp.length(turn)
    found.turn = turn_between(turn / size, change / size)
    return found
