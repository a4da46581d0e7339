"""Kernels that fill and check a hand state on its own device.

Letters: B environment, L link, C contact. World axes, metres, seconds, newtons; Warp's quaternions are (x, y, z, w).
"""

from typing import Any

from brainbench.core.devices import warp

wp = warp()
UNIT_TOLERANCE = wp.constant(1e-3)
"""Largest difference of a quaternion's length from 1; the rounding of float32 is a ten-thousandth of it."""


@wp.struct
class StateArrays:
    """Arrays of a ``HandState``, as kernels take them."""

    pose: wp.array2d(dtype=wp.transformf)
    """[B, L]."""
    velocity: wp.array2d(dtype=wp.spatial_vectorf)
    """[B, L] of the origin, then angular."""
    contact_count: wp.array(dtype=wp.int32)
    """[1] contacts found, which may exceed C."""
    contact_env: wp.array(dtype=wp.int32)
    """[C]."""
    contact_geom: wp.array(dtype=wp.vec2i)
    """[C]."""
    contact_distance: wp.array(dtype=wp.float32)
    """[C] gap, negative for overlap."""
    contact_position: wp.array(dtype=wp.vec3f)
    """[C]."""
    contact_normal: wp.array(dtype=wp.vec3f)
    """[C] from the first geometry to the second."""
    contact_force: wp.array(dtype=wp.float32)
    """[C] normal force; NaN where the engine does not tell."""
    contact_couple: wp.array(dtype=wp.vec3f)
    """[C] torque on the second geometry about the point (N·m)."""


@wp.func
def in_scene(pair: wp.vec2i, geometries: int) -> bool:
    """Return whether both numbers of a contact are those of geometries; a state made by hand may hold others."""
    return wp.min(pair) >= 0 and wp.max(pair) < geometries


@wp.func
def link_fails(state: StateArrays, env: int, link: int) -> bool:
    """Return whether a pose or a velocity holds a number that is not finite, or a quaternion is not of unit length."""
    at = state.pose[env, link]
    speed = state.velocity[env, link]
    total = float(0.0)
    # Adding zeros keeps a NaN and turns an infinity into one.
    for k in range(7):
        total += at[k] * 0.0
    for k in range(6):
        total += speed[k] * 0.0
    # Rotating by a quaternion of another length would scale what is rotated: plausible readings, all wrong.
    return wp.isnan(total) or wp.abs(wp.length(wp.transform_get_rotation(at)) - 1.0) > UNIT_TOLERANCE


@wp.kernel
def fill_links(
    xpos: wp.array2d(dtype=wp.vec3f),
    xquat: wp.array2d(dtype=wp.quatf),
    cvel: wp.array2d(dtype=wp.spatial_vectorf),
    subtree_com: wp.array2d(dtype=wp.vec3f),
    root: wp.array(dtype=wp.int32),
    pose: wp.array2d(dtype=wp.transformf),
    velocity: wp.array2d(dtype=wp.spatial_vectorf),
):
    """Turn MuJoCo's poses and spatial velocities into those of link origins. Thread: environment and link [B, L].

    MuJoCo's ``cvel`` is (ω, v) at the centre of mass of the kinematic tree: v_origin = v + ω × (origin − com).
    """
    env, link = wp.tid()
    p = xpos[env, link]
    # MuJoCo stores (w, x, y, z) in Warp's quaternions.
    q = xquat[env, link]
    pose[env, link] = wp.transformf(p, wp.quatf(q[1], q[2], q[3], q[0]))
    twist = cvel[env, link]
    # Velocity of a rigid body shifted from the reference point of the tree to the link's origin: v + ω × r.
    omega = wp.vec3f(twist[0], twist[1], twist[2])
    linear = wp.vec3f(twist[3], twist[4], twist[5]) + wp.cross(omega, p - subtree_com[env, root[link]])
    velocity[env, link] = wp.spatial_vectorf(linear[0], linear[1], linear[2], omega[0], omega[1], omega[2])


@wp.kernel
def fill_contacts(
    count: wp.array(dtype=wp.int32),
    env: wp.array(dtype=wp.int32),
    frame: wp.array(dtype=wp.mat33f),
    dim: wp.array(dtype=wp.int32),
    address: wp.array2d(dtype=wp.int32),
    efc_force: wp.array2d(dtype=wp.float32),
    cone: wp.array(dtype=Any),
    pyramidal: int,
    normal: wp.array(dtype=wp.vec3f),
    force: wp.array(dtype=wp.float32),
    friction: wp.array(dtype=wp.vec3f),
    couple: wp.array(dtype=wp.vec3f),
):
    """Read normal, normal force, friction (N) and torque (N·m) of every contact. Thread: contact [C].

    With a pyramidal cone the normal force is the sum of the forces along its edges, and friction along a tangent, or
    about an axis, the difference of its two edges by the coefficient ``cone``.
    """
    c = wp.tid()
    if c >= count[0]:
        return
    rows = frame[c]
    normal[c] = wp.vec3f(rows[0, 0], rows[0, 1], rows[0, 2])
    total = float(0.0)
    # An elliptic cone has one row for the normal force; a pyramidal one has two edges per tangent, each of which
    # carries a share of it.
    edges = int(1)
    if pyramidal == 1 and dim[c] > 1:
        edges = 2 * (dim[c] - 1)
    for edge in range(edges):
        row = address[c, edge]
        if row >= 0:
            total += efc_force[env[c], row]
    force[c] = total
    slip = wp.vec3f(0.0)
    spin = wp.vec3f(0.0)
    # Along two tangents, then about the normal and about both tangents.
    for axis in range(dim[c] - 1):
        side = (axis + 1) % 3
        share = float(0.0)
        first = address[c, axis + 1]
        if pyramidal == 1:
            first = address[c, 2 * axis]
            second = address[c, 2 * axis + 1]
            if first >= 0 and second >= 0:
                share = cone[c][axis] * (efc_force[env[c], first] - efc_force[env[c], second])
        elif first >= 0:
            share = efc_force[env[c], first]
        along = share * wp.vec3f(rows[side, 0], rows[side, 1], rows[side, 2])
        if axis < 2:
            slip += along
        else:
            spin += along
    friction[c] = slip
    couple[c] = spin
