"""Motion of bases and objects: cubic Hermite pieces between equally spaced knots.

A track with one knot stands still, or moves straight at the knot's velocity. Units: mm, ms, rad.
"""

import warp as wp

from .algebra import vec3, vec4
from .parameters import real
from .state import MotionArrays


@wp.struct
class BodyMotion:
    """Position, velocity, quaternion and angular velocity of a body at one time."""

    place: vec3
    velocity: vec3
    turn: vec4
    spin: vec3


@wp.func
def turning(q: vec4, w: vec3) -> vec4:
    """Return the rate of a quaternion: half of (0, w) times q."""
    half = real(0.5)
    return vec4(
        -half * (w[0] * q[1] + w[1] * q[2] + w[2] * q[3]),
        half * (w[0] * q[0] + w[1] * q[3] - w[2] * q[2]),
        half * (w[1] * q[0] + w[2] * q[1] - w[0] * q[3]),
        half * (w[2] * q[0] + w[0] * q[2] - w[1] * q[1]),
    )


@wp.func
def pose_at(motions: MotionArrays, index: int, time: real) -> BodyMotion:
    """Return the motion of a track at a time."""
    first = motions.first[index]
    count = motions.count[index]
    pose = BodyMotion()
    if count == 1:
        pose.velocity = motions.velocity[first]
        pose.place = motions.place[first] + pose.velocity * (time - motions.start[index])
        pose.turn = motions.turn[first]
        pose.spin = vec3(real(0.0), real(0.0), real(0.0))
        return pose
    spacing = motions.spacing[index]
    place = (time - motions.start[index]) / spacing
    # Outside the knots the first or the last piece goes on.
    i = wp.clamp(int(wp.floor(place)), 0, count - 2)
    u = place - real(i)
    a = first + i
    b = a + 1
    one = real(1.0)
    two = real(2.0)
    three = real(3.0)
    # Weights of value and slope at both ends, and their derivatives.
    # Cubic Hermite basis; the slopes are per ms, hence the spacing.
    v0 = (one + two * u) * (one - u) * (one - u)
    s0 = u * (one - u) * (one - u) * spacing
    v1 = u * u * (three - two * u)
    s1 = u * u * (u - one) * spacing
    dv = real(6.0) * u * (u - one) / spacing
    ds0 = (one - u) * (one - three * u)
    ds1 = u * (three * u - two)
    pose.place = motions.place[a] * v0 + motions.velocity[a] * s0 + motions.place[b] * v1 + motions.velocity[b] * s1
    # The derivatives of both value weights differ in sign only.
    pose.velocity = (motions.place[a] - motions.place[b]) * dv + motions.velocity[a] * ds0 + motions.velocity[b] * ds1
    turn = (
        motions.turn[a] * v0
        + turning(motions.turn[a], motions.spin[a]) * s0
        + motions.turn[b] * v1
        + turning(motions.turn[b], motions.spin[b]) * s1
    )
    # A cubic between quaternions is nearly one; normalised.
    pose.turn = turn / wp.length(turn)
    pose.spin = motions.spin[a] * v0 + motions.surge[a] * s0 + motions.spin[b] * v1 + motions.surge[b] * s1
    return pose
