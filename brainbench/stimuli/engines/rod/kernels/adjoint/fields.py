"""Twist, acceleration and virtual motion of a link, carried over a hinge: down the chain, and back with derivatives."""

from typing import Any

import warp as wp

from ..algebra import reader, vec3
from ..parameters import capacity, hinges, real
from ..state import PerLink3

PerHinge3: Any = wp.types.matrix((hinges * capacity, 3), real)


@wp.struct
class StepLinks:
    """Hinges of all links in a recorded step; hinge d of link i stands at hinges · i + d."""

    axis: PerHinge3
    moment: PerHinge3
    """Axis about the base point, p × s."""
    vw: PerHinge3
    """Twist of the body before the hinge."""
    vv: PerHinge3
    before: PerLink3
    """Axis z before the hinges, about which the link bends at rest."""
    behind: PerLink3
    """The same behind them, where the joint twists."""


hinge_row = reader((PerHinge3, vec3))


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
def hinges_of(i: int) -> int:
    """Return how many hinges the joint of a link has."""
    if wp.static(hinges == 3) and i % 2 == 1:
        return 3
    return 2


@wp.func
def move_hinge(
    links: wp.ref[StepLinks],
    j: int,
    moved: wp.ref[FieldTangents],
    at: vec3,
    rate: real,
    acceleration: real,
    angle_d: real,
    rate_d: real,
    axis_d: wp.ref[PerHinge3],
    moment_d: wp.ref[PerHinge3],
):
    """Take the change of the fields over hinge j, at a fixed acceleration; write those of its axis and moment."""
    s = hinge_row(links.axis, j)
    m = hinge_row(links.moment, j)
    vw = hinge_row(links.vw, j)
    vv = hinge_row(links.vv, j)
    s_d = wp.cross(moved.turn, s)
    m_d = wp.cross(moved.at, s) + wp.cross(at, s_d)
    # Of vw × s and vw × m + vv × s, each times the rate.
    turning_d = wp.cross(moved.vw * rate + vw * rate_d, s) + wp.cross(vw, s_d * rate)
    moving_d = wp.cross(moved.vw * rate + vw * rate_d, m) + wp.cross(vw, m_d * rate)
    moving_d = moving_d + wp.cross(moved.vv * rate + vv * rate_d, s) + wp.cross(vv, s_d * rate)
    moved.aw = moved.aw + turning_d + s_d * acceleration
    moved.av = moved.av + moving_d + m_d * acceleration
    moved.vw = moved.vw + s_d * rate + s * rate_d
    moved.vv = moved.vv + m_d * rate + m * rate_d
    moved.turn = moved.turn + s * angle_d
    axis_d[j] = s_d
    moment_d[j] = m_d
