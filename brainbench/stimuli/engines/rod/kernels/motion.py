"""Motion of bases and objects: cubic Hermite pieces, of equal length within each cell of a millisecond.

A track with one knot stands still, or moves straight at the knot's velocity. Times count from the start of the launch
as whole milliseconds and a rest, places as a coarse grid and a rest, so that both keep their digits in single precision
however long a simulation lasts and wherever it stands. The jobs that these motions drive, and the times at which they
are read, stand here too. Units: mm, ms, mN, rad.
"""

import warp as wp

from .algebra import vec3, vec4
from .parameters import real


@wp.struct
class Instant:
    """A time since the start of the launch."""

    tick: wp.int32
    """Whole milliseconds."""
    part: real
    """The rest; it may be negative or more than one."""


@wp.struct
class ReadingArrays:
    """Times at which whiskers are read, ascending, and some between them so that none are far apart."""

    time: wp.array(dtype=Instant)
    """[reading]"""
    row: wp.array(dtype=wp.int32)
    """[reading] where the results go; negative for none."""


@wp.struct
class MotionArrays:
    """Motions of bases and objects, see ``motion``: knots of all tracks one behind the other."""

    first: wp.array(dtype=wp.int32)
    """[track] first of its cells; of a track with one knot that knot."""
    count: wp.array(dtype=wp.int32)
    """[track] number of cells + 1; 1 of a track with one knot."""
    cell: wp.array(dtype=wp.int32)
    """[cell] first knot; behind the cells of each track its last knot."""
    coarse: wp.array(dtype=vec3)
    """[knot] part of the position on a coarse grid."""
    place: wp.array(dtype=vec3)
    """[knot] the rest of it."""
    velocity: wp.array(dtype=vec3)
    """[knot]"""
    quaternion: wp.array(dtype=vec4)
    """[knot] unit quaternion (w, x, y, z), without jumps of sign."""
    spin: wp.array(dtype=vec3)
    """[knot] angular velocity, world axes."""
    surge: wp.array(dtype=vec3)
    """[knot] angular acceleration, world axes."""


@wp.struct
class JobArrays:
    """Jobs, and the forces that act on them besides contact."""

    whisker: wp.array(dtype=wp.int32)
    """[job]"""
    scene: wp.array(dtype=wp.int32)
    """[job]"""
    base: wp.array(dtype=wp.int32)
    """[job] motion of the base."""
    step: wp.array(dtype=real)
    """[job] longest time step."""
    limit_first: wp.array(dtype=wp.int32)
    """[job + 1] first limit of each job."""
    limit: wp.array(dtype=real)
    """[limit] longest step from each cell of the motions on; a job without is limited by ``step`` alone."""
    row: wp.array(dtype=wp.int32)
    """[job] first index of its results."""
    column: wp.array(dtype=wp.int32)
    """[job] third index of its results."""
    load_first: wp.array(dtype=wp.int32)
    """[job + 1] first load of each job."""
    load_link: wp.array(dtype=wp.int32)
    """[load]"""
    load_share: wp.array(dtype=real)
    """[load] place along its link, 0 to 1."""
    load_force: wp.array(dtype=vec3)
    """[load]"""
    load_stop: wp.array(dtype=real)
    """[load] time at which it ends."""


@wp.struct
class BodyMotion:
    """Position, velocity, quaternion and angular velocity of a body at one time."""

    coarse: vec3
    """Part of the position on a coarse grid."""
    place: vec3
    """The rest of it."""
    velocity: vec3
    quaternion: vec4
    spin: vec3


@wp.func
def instant(tick: int, part: real) -> Instant:
    """Return a time."""
    when = Instant()
    when.tick = tick
    when.part = part
    return when


@wp.func
def elapsed(when: Instant) -> real:
    """Return the time since the start in one number; its last digits are lost when it is long."""
    return real(when.tick) + when.part


@wp.func
def cell_at(when: Instant, count: int) -> int:
    """Return the cell that holds a time; the first and the last go on outside."""
    return wp.clamp(when.tick + int(wp.floor(when.part)), 0, count - 1)


@wp.func
def quaternion_rate(q: vec4, w: vec3) -> vec4:
    """Return the rate of a quaternion: half of (0, w) times q."""
    half = real(0.5)
    return vec4(
        -half * (w[0] * q[1] + w[1] * q[2] + w[2] * q[3]),
        half * (w[0] * q[0] + w[1] * q[3] - w[2] * q[2]),
        half * (w[1] * q[0] + w[2] * q[1] - w[0] * q[3]),
        half * (w[2] * q[0] + w[0] * q[2] - w[1] * q[1]),
    )


@wp.struct
class TrackPiece:
    """Cubic piece of a track at one time: its first knot, and the weights of value and slope at both of its ends."""

    first: wp.int32
    v0: real
    s0: real
    v1: real
    s1: real
    dv: real
    """Derivative of the weight of the first value; that of the second is its negative."""
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
    # Outside the knots the first or the last piece goes on.
    i = wp.clamp(int(wp.floor(place)), 0, pieces - 1)
    u = place - real(i)
    piece = TrackPiece()
    piece.first = start + i
    # Cubic Hermite basis; the slopes are per ms, hence the spacing.
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
        motions.quaternion[a] * piece.v0
        + quaternion_rate(motions.quaternion[a], motions.spin[a]) * piece.s0
        + motions.quaternion[b] * piece.v1
        + quaternion_rate(motions.quaternion[b], motions.spin[b]) * piece.s1
    )


@wp.func(inline=True)
def pose_at(motions: MotionArrays, index: int, when: Instant) -> BodyMotion:
    """Return the motion of a track at a time."""
    first = motions.first[index]
    count = motions.count[index]
    pose = BodyMotion()
    if count == 1:
        pose.velocity = motions.velocity[first]
        pose.coarse = motions.coarse[first]
        pose.place = motions.place[first] + pose.velocity * elapsed(when)
        pose.quaternion = motions.quaternion[first]
        pose.spin = vec3(real(0.0), real(0.0), real(0.0))
        return pose
    piece = piece_at(motions, first, count, when)
    a = piece.first
    b = a + 1
    # From the first knot on: differences keep the digits that the places themselves would lose.
    way = (motions.coarse[b] - motions.coarse[a]) + (motions.place[b] - motions.place[a])
    pose.coarse = motions.coarse[a]
    pose.place = motions.place[a] + way * piece.v1 + motions.velocity[a] * piece.s0 + motions.velocity[b] * piece.s1
    # The derivatives of both value weights differ in sign only.
    pose.velocity = motions.velocity[a] * piece.ds0 + motions.velocity[b] * piece.ds1 - way * piece.dv
    quaternion = raw_turn(motions, piece)
    # A cubic between quaternions is nearly one; normalised.
    pose.quaternion = quaternion / wp.length(quaternion)
    pose.spin = (
        motions.spin[a] * piece.v0
        + motions.surge[a] * piece.s0
        + motions.spin[b] * piece.v1
        + motions.surge[b] * piece.s1
    )
    return pose


@wp.func
def pose_from(motions: MotionArrays, index: int, when: Instant, origin: BodyMotion) -> BodyMotion:
    """Return the motion of a track at a time, with its place from that of ``origin`` on."""
    pose = pose_at(motions, index, when)
    pose.place = (pose.coarse - origin.coarse) + (pose.place - origin.place)
    pose.coarse = vec3(real(0.0), real(0.0), real(0.0))
    return pose
