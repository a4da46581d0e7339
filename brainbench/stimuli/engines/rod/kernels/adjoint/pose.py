"""Derivatives of ``motion.pose_at``: those by a pose become those by the knots of its track, and knots move a pose."""

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


@wp.struct
class TrackPiece:
    """Cubic piece of a track at one time: its first knot, and the weights of ``motion.pose_at``."""

    first: wp.int32
    v0: real
    s0: real
    v1: real
    s1: real
    dv: real
    ds0: real
    ds1: real


@wp.func
def piece_at(motions: MotionArrays, first: int, count: int, when: Instant) -> TrackPiece:
    """Return the piece of a track of more than one knot."""
    one = real(1.0)
    two = real(2.0)
    three = real(3.0)
    cell = cell_at(when, count - 1)
    start = motions.cell[first + cell]
    pieces = motions.cell[first + cell + 1] - start
    spacing = one / real(pieces)
    place = (real(when.tick - cell) + when.part) * real(pieces)
    i = wp.clamp(int(wp.floor(place)), 0, pieces - 1)
    u = place - real(i)
    piece = TrackPiece()
    piece.first = start + i
    piece.v0 = (one + two * u) * (one - u) * (one - u)
    piece.s0 = u * (one - u) * (one - u) * spacing
    piece.v1 = u * u * (three - two * u)
    piece.s1 = u * u * (u - one) * spacing
    piece.dv = real(6.0) * u * (u - one) / spacing
    piece.ds0 = (one - u) * (one - three * u)
    piece.ds1 = u * (three * u - two)
    return piece


@wp.func
def raw_turn(motions: MotionArrays, piece: TrackPiece) -> vec4:
    """Return the quaternion of a piece before it is normalised."""
    a = piece.first
    b = a + 1
    return (
        motions.turn[a] * piece.v0
        + turning(motions.turn[a], motions.spin[a]) * piece.s0
        + motions.turn[b] * piece.v1
        + turning(motions.turn[b], motions.spin[b]) * piece.s1
    )


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
    # A small turn φ changes the unit quaternion q by ½ (0, φ) q, so the derivative by it is 2 (0, φ̄) q.
    if count == 1:
        add_knot(knots, first, 0, bar.place)
        add_knot(knots, first, 3, bar.velocity + bar.place * elapsed(when))
        add_quaternion(knots, first, turning(motions.turn[first], bar.turn) * real(4.0))
        return
    piece = piece_at(motions, first, count, when)
    a = piece.first
    b = a + 1
    way = bar.place * piece.v1 - bar.velocity * piece.dv
    add_knot(knots, a, 0, bar.place - way)
    add_knot(knots, b, 0, way)
    add_knot(knots, a, 3, bar.place * piece.s0 + bar.velocity * piece.ds0)
    add_knot(knots, b, 3, bar.place * piece.s1 + bar.velocity * piece.ds1)
    turn = raw_turn(motions, piece)
    size = wp.length(turn)
    raw = turning(turn / size, bar.turn) * (real(4.0) / size)
    # The transpose of turning(·, w) is turning(·, −w).
    add_quaternion(knots, a, raw * piece.v0 - turning(raw, motions.spin[a]) * piece.s0)
    add_quaternion(knots, b, raw * piece.v1 - turning(raw, motions.spin[b]) * piece.s1)
    add_knot(knots, a, 10, spin_cotangent(motions.turn[a], raw) * piece.s0 + bar.spin * piece.v0)
    add_knot(knots, b, 10, spin_cotangent(motions.turn[b], raw) * piece.s1 + bar.spin * piece.v1)
    add_knot(knots, a, 13, bar.spin * piece.s0)
    add_knot(knots, b, 13, bar.spin * piece.s1)


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
        found.turn = turn_between(motions.turn[first], knot_quaternion(knots, p, first))
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
        + (turning(turn_a, motions.spin[a]) + turning(motions.turn[a], spin_a)) * piece.s0
        + turn_b * piece.v1
        + (turning(turn_b, motions.spin[b]) + turning(motions.turn[b], spin_b)) * piece.s1
    )
    turn = raw_turn(motions, piece)
    size = wp.length(turn)
    found.turn = turn_between(turn / size, change / size)
    return found
