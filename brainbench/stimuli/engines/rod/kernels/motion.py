"""Motion of bases and obstacles inside the kernels: cubic Hermite pieces between equally spaced knots.

A track with one knot stands still or moves straight at the knot's velocity. Units: mm, ms, rad.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any


@cache
def tracks(real: type) -> SimpleNamespace:
    """Return ``Tracks`` (the arrays), ``Pose`` and ``pose_at(tracks, index, time)`` of a precision."""
    import warp as wp

    vec3: Any = wp.types.vector(3, real)
    vec4: Any = wp.types.vector(4, real)

    @wp.struct
    class Tracks:
        first: wp.array(dtype=wp.int32)
        """[track] index of the first knot."""
        count: wp.array(dtype=wp.int32)
        """[track] number of knots."""
        start: wp.array(dtype=real)
        """[track] time of the first knot."""
        spacing: wp.array(dtype=real)
        """[track] time between knots."""
        place: wp.array(dtype=vec3)
        """[knot] position."""
        velocity: wp.array(dtype=vec3)
        """[knot]"""
        turn: wp.array(dtype=vec4)
        """[knot] unit quaternion (w, x, y, z), without jumps of sign."""
        spin: wp.array(dtype=vec3)
        """[knot] angular velocity, world axes."""
        surge: wp.array(dtype=vec3)
        """[knot] angular acceleration, world axes."""

    @wp.struct
    class Pose:
        place: vec3
        velocity: vec3
        turn: vec4
        spin: vec3

    @wp.func
    def turning(q: vec4, w: vec3) -> vec4:
        """Rate of a quaternion: half of (0, w) times q."""
        half = real(0.5)
        return vec4(
            -half * (w[0] * q[1] + w[1] * q[2] + w[2] * q[3]),
            half * (w[0] * q[0] + w[1] * q[3] - w[2] * q[2]),
            half * (w[1] * q[0] + w[2] * q[1] - w[0] * q[3]),
            half * (w[2] * q[0] + w[0] * q[2] - w[1] * q[1]),
        )

    @wp.func
    def pose_at(tr: Tracks, index: int, time: real) -> Pose:
        first = tr.first[index]
        count = tr.count[index]
        pose = Pose()
        if count == 1:
            pose.velocity = tr.velocity[first]
            pose.place = tr.place[first] + pose.velocity * (time - tr.start[index])
            pose.turn = tr.turn[first]
            pose.spin = vec3(real(0.0), real(0.0), real(0.0))
            return pose
        spacing = tr.spacing[index]
        place = (time - tr.start[index]) / spacing
        i = wp.clamp(int(wp.floor(place)), 0, count - 2)
        u = place - real(i)
        a = first + i
        b = a + 1
        one = real(1.0)
        two = real(2.0)
        three = real(3.0)
        # Weights of value and slope at both ends, and their derivatives.
        v0 = (one + two * u) * (one - u) * (one - u)
        s0 = u * (one - u) * (one - u) * spacing
        v1 = u * u * (three - two * u)
        s1 = u * u * (u - one) * spacing
        dv = real(6.0) * u * (u - one) / spacing
        ds0 = (one - u) * (one - three * u)
        ds1 = u * (three * u - two)
        pose.place = tr.place[a] * v0 + tr.velocity[a] * s0 + tr.place[b] * v1 + tr.velocity[b] * s1
        pose.velocity = (tr.place[a] - tr.place[b]) * dv + tr.velocity[a] * ds0 + tr.velocity[b] * ds1
        turn = (
            tr.turn[a] * v0
            + turning(tr.turn[a], tr.spin[a]) * s0
            + tr.turn[b] * v1
            + turning(tr.turn[b], tr.spin[b]) * s1
        )
        pose.turn = turn / wp.length(turn)
        pose.spin = tr.spin[a] * v0 + tr.surge[a] * s0 + tr.spin[b] * v1 + tr.surge[b] * s1
        return pose

    return SimpleNamespace(Tracks=Tracks, Pose=Pose, pose_at=pose_at)
