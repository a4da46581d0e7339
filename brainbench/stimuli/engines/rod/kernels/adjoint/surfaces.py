"""Adjoint of a contact's geometry: what its point, normal, gap and velocity give to link, base, object and shape."""

import warp as wp

from brainbench.stimuli.engines.rod.limits import CAPSULE, CREVICE, CYLINDER, MESH, SPHERE

from ..algebra import rotate, symmetric_times, unrotate, vec3
from ..motion import BodyMotion, Instant, MotionArrays, pose_from
from ..parameters import real
from ..state import ShapeArrays
from .contacts import AdjointContacts, contact_row, velocity_block
from .fields import FieldCotangents, Fields
from .pose import PoseCotangent, spread_pose
from .records import ContactRecord


@wp.struct
class ShapeGradients:
    """Derivatives with respect to the packed shapes; threads add to them."""

    place: wp.array(dtype=vec3)
    """[shape] in the frame of its body."""
    turn: wp.array(dtype=vec3)
    """[shape] small turn about its origin, in the frame of its body."""
    size: wp.array(dtype=vec3)
    """[shape]"""
    friction: wp.array(dtype=real)
    """[shape]"""


@wp.struct
class LinkCotangent:
    """Derivatives that a contact gives to its link."""

    start_radius: real
    end_radius: real
    link: vec3
    """By the vector from the link's joint to its far end."""
    friction: real
    velocity: vec3
    """By the velocity at the contact."""


@wp.func
def size_cotangent(kind: int, size: vec3, x: vec3, gap_bar: real, shift_bar: vec3) -> vec3:
    """Return the derivatives by a primitive's sizes, from those by the gap and by a shift of what is nearest to x.

    All in the frame of the shape. A size moves the feature that is nearest, or makes a round one thicker.
    """
    zero = real(0.0)
    found = vec3(zero, zero, zero)
    if kind == wp.static(SPHERE):
        found[0] = -gap_bar
    elif kind == wp.static(CAPSULE):
        found[0] = -gap_bar
        if wp.abs(x[2]) > size[1]:
            found[1] = wp.sign(x[2]) * shift_bar[2]
    elif kind == wp.static(CYLINDER):
        radial = wp.sqrt(x[0] * x[0] + x[1] * x[1])
        side = radial - size[0]
        end = wp.abs(x[2]) - size[1]
        if end > side or (side > zero and end > zero):
            found[1] = wp.sign(x[2]) * shift_bar[2]
        if side > zero and end > zero:
            found[0] = (x[0] * shift_bar[0] + x[1] * shift_bar[1]) / radial
        elif side > end:
            found[0] = -gap_bar
    else:
        over = vec3(wp.abs(x[0]) - size[0], wp.abs(x[1]) - size[1], wp.abs(x[2]) - size[2])
        most = wp.max(over[0], wp.max(over[1], over[2]))
        for d in range(3):
            if over[d] > zero or (most <= zero and over[d] == most):
                found[d] = wp.sign(x[d]) * shift_bar[d]
    return found


@wp.func
def reverse_contact(
    motions: MotionArrays,
    shapes: ShapeArrays,
    gradients: ShapeGradients,
    knots: wp.array2d(dtype=real),
    contacts: wp.ref[AdjointContacts],
    k: int,
    contact: ContactRecord,
    on: Fields,
    bar: wp.ref[FieldCotangents],
    base_bar: wp.ref[PoseCotangent],
    pose: BodyMotion,
    moment_bar: vec3,
    at: vec3,
    link: vec3,
    start_radius: real,
    end_radius: real,
    now: Instant,
    middle: Instant,
    h: real,
) -> LinkCotangent:
    """Add the power of a contact, ν·c − f·w, to the derivatives by fields, base, object and shape.

    ``moment_bar`` is the derivative of the outputs by the moment of the contact forces about the base point; ``link``
    goes from the joint ``at`` to the link's far end.
    """
    zero = real(0.0)
    n = contact.normal
    f = contact.force
    s = contact.share
    radius = start_radius + (end_radius - start_radius) * s
    p = contact_row(contacts.point, k)
    v = contact_row(contacts.velocity, k)
    nu = contact_row(contacts.multiplier, k)
    # By the velocity at the contact, and from it by the fields of link and object.
    tau = velocity_block(contacts, k) * nu
    half = pose_from(motions, shapes.track[contact.shape], middle, pose)
    bar.vv = bar.vv + tau
    bar.av = bar.av + tau * h
    bar.vw = bar.vw + wp.cross(p, tau)
    bar.aw = bar.aw + wp.cross(p, tau) * h
    bar.wv = bar.wv - f
    bar.ww = bar.ww - wp.cross(p, f)
    spun = wp.cross(half.spin, tau)
    p_bar = wp.cross(tau, on.vw + on.aw * h) + spun - wp.cross(f, on.ww) + wp.cross(f, moment_bar)
    halfway = PoseCotangent()
    halfway.velocity = -tau
    halfway.spin = -wp.cross(p - half.place, tau)
    halfway.place = -spun
    spread_pose(motions, knots, shapes.track[contact.shape], middle, halfway)

    # By normal, closing rate and friction.
    found = LinkCotangent()
    found.velocity = tau
    pressed = wp.dot(n, f)
    across = wp.dot(nu, n)
    closing = wp.min(-contact.gap, real(wp.static(CREVICE))) / h
    n_bar = nu * (-closing)
    if contact_row(contacts.slides, k) == 1:
        u = contact_row(contacts.slip, k)
        scale = contact_row(contacts.scale, k)
        sideways = nu - u * wp.dot(nu, u)
        n_bar = v * across + (f * (-across) - nu * pressed + f * (contact.friction * wp.dot(nu, u))) * scale
        n_bar = n_bar - (sideways * wp.dot(n, v) + v * across) * (scale * contact_row(contacts.friction, k))
        found.friction = scale * pressed * wp.dot(nu, u)
    gap_bar = zero
    if -contact.gap < real(wp.static(CREVICE)):
        gap_bar = across / h

    # The point is p = x − n r with x on the axis, gap φ(x) − r, normal ∇φ(x).
    n_bar = n_bar - p_bar * radius
    radius_bar = -wp.dot(n, p_bar) - gap_bar
    fixed_bar = p_bar + n * gap_bar + symmetric_times(contact.curvature, n_bar)
    slope_bar = zero
    if s < real(1.0):
        # Between the ends the place on the axis obeys n·e − (r₁ − r₀) = 0, with the link e; on meshes, which are
        # searched from the axis, n·e = 0.
        curved = wp.dot(link, symmetric_times(contact.curvature, link))
        share_bar = wp.dot(fixed_bar, link) + radius_bar * (end_radius - start_radius)
        if curved > real(1e-9) * wp.length_sq(link):
            slope_bar = -share_bar / curved
    n_bar = n_bar + link * slope_bar
    pulled = n * gap_bar + symmetric_times(contact.curvature, n_bar)
    x_bar = p_bar + pulled
    bar.at = bar.at + x_bar
    found.link = x_bar * s + n * slope_bar
    found.start_radius = radius_bar * (real(1.0) - s)
    found.end_radius = radius_bar * s
    kind = shapes.kind[contact.shape]
    if kind != wp.static(MESH):
        found.start_radius = found.start_radius + slope_bar
        found.end_radius = found.end_radius - slope_bar

    # The object: its shift is the opposite of that of x, and its turn also turns the normal.
    body = pose_from(motions, shapes.track[contact.shape], now, pose)
    x = at + link * s
    bodily = PoseCotangent()
    bodily.place = -pulled
    bodily.turn = wp.cross(n, n_bar) - wp.cross(x - body.place, pulled)
    spread_pose(motions, knots, shapes.track[contact.shape], now, bodily)
    base_bar.place = base_bar.place + pulled + spun
    origin = body.place + rotate(body.turn, shapes.place[contact.shape])
    shift = unrotate(body.turn, -pulled)
    turn = unrotate(body.turn, wp.cross(n, n_bar) - wp.cross(x - origin, pulled))
    wp.atomic_add(gradients.place, contact.shape, shift)
    wp.atomic_add(gradients.turn, contact.shape, turn)
    if kind != wp.static(MESH):
        turn_s = shapes.turn[contact.shape]
        inside = unrotate(turn_s, unrotate(body.turn, x - origin))
        size = size_cotangent(kind, shapes.size[contact.shape], inside, gap_bar, unrotate(turn_s, shift))
        wp.atomic_add(gradients.size, contact.shape, size)
    return found
