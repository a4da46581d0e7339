"""Twist, acceleration and virtual motion of a link, carried over a hinge: down the chain, and back with derivatives."""

import warp as wp

from ..algebra import vec3
from ..parameters import real


@wp.struct
class Fields:
    """Twist V, acceleration A and virtual motion W of a link: angular, and of its point at the base point."""

    vw: vec3
    vv: vec3
    aw: vec3
    av: vec3
    ww: vec3
    wv: vec3


@wp.struct
class FieldCotangents:
    """Derivatives of Φ with respect to the fields, to a small turn of the link's frame, and to a joint's place."""

    vw: vec3
    vv: vec3
    aw: vec3
    av: vec3
    ww: vec3
    wv: vec3
    turn: vec3
    at: vec3


@wp.func
def add_hinge(on: wp.ref[Fields], at: vec3, s: vec3, rate: real, acceleration: real, virtual: real):
    """Go from the body before a hinge to that behind it."""
    m = wp.cross(at, s)
    on.aw = on.aw + wp.cross(on.vw, s) * rate + s * acceleration
    on.av = on.av + (wp.cross(on.vw, m) + wp.cross(on.vv, s)) * rate + m * acceleration
    on.vw = on.vw + s * rate
    on.vv = on.vv + m * rate
    on.ww = on.ww + s * virtual
    on.wv = on.wv + m * virtual


@wp.func
def reverse_hinge(
    on: wp.ref[Fields],
    bar: wp.ref[FieldCotangents],
    at: vec3,
    s: vec3,
    rate: real,
    acceleration: real,
    virtual: real,
) -> real:
    """Go back to the body before a hinge; return the derivative with respect to its rate."""
    m = wp.cross(at, s)
    on.vw = on.vw - s * rate
    on.vv = on.vv - m * rate
    on.aw = on.aw - wp.cross(on.vw, s) * rate - s * acceleration
    on.av = on.av - (wp.cross(on.vw, m) + wp.cross(on.vv, s)) * rate - m * acceleration
    on.ww = on.ww - s * virtual
    on.wv = on.wv - m * virtual
    s_bar = (
        bar.aw * acceleration
        + (wp.cross(bar.aw, on.vw) + wp.cross(bar.av, on.vv)) * rate
        + bar.vw * rate
        + bar.ww * virtual
    )
    m_bar = bar.av * acceleration + wp.cross(bar.av, on.vw) * rate + bar.vv * rate + bar.wv * virtual
    rate_bar = (
        wp.dot(bar.aw, wp.cross(on.vw, s))
        + wp.dot(bar.av, wp.cross(on.vw, m) + wp.cross(on.vv, s))
        + wp.dot(bar.vw, s)
        + wp.dot(bar.vv, m)
    )
    bar.vw = bar.vw + (wp.cross(s, bar.aw) + wp.cross(m, bar.av)) * rate
    bar.vv = bar.vv + wp.cross(s, bar.av) * rate
    s_bar = s_bar + wp.cross(m_bar, at)
    bar.at = bar.at + wp.cross(s, m_bar)
    bar.turn = bar.turn + wp.cross(s, s_bar)
    return rate_bar


@wp.struct
class FieldTangents:
    """Change of the fields of a link, of its frame by a small turn, and of a joint's place."""

    vw: vec3
    vv: vec3
    aw: vec3
    av: vec3
    turn: vec3
    at: vec3


@wp.func
def move_hinge(
    on: wp.ref[Fields],
    moved: wp.ref[FieldTangents],
    at: vec3,
    s: vec3,
    rate: real,
    acceleration: real,
    angle_d: real,
    rate_d: real,
):
    """Go from the body before a hinge to that behind it, with the change of both at a fixed acceleration."""
    m = wp.cross(at, s)
    s_d = wp.cross(moved.turn, s)
    m_d = wp.cross(moved.at, s) + wp.cross(at, s_d)
    turning = wp.cross(on.vw, s)
    moving = wp.cross(on.vw, m) + wp.cross(on.vv, s)
    turning_d = wp.cross(moved.vw, s) + wp.cross(on.vw, s_d)
    moving_d = wp.cross(moved.vw, m) + wp.cross(on.vw, m_d) + wp.cross(moved.vv, s) + wp.cross(on.vv, s_d)
    moved.aw = moved.aw + turning_d * rate + turning * rate_d + s_d * acceleration
    moved.av = moved.av + moving_d * rate + moving * rate_d + m_d * acceleration
    moved.vw = moved.vw + s_d * rate + s * rate_d
    moved.vv = moved.vv + m_d * rate + m * rate_d
    moved.turn = moved.turn + s * angle_d
    add_hinge(on, at, s, rate, acceleration, real(0.0))
