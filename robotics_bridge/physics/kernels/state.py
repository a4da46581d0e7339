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
    """Arrays of a ``HandState``."""

    pose: wp.array2d(dtype=wp.transformf)
    """[B, L] world pose of every link frame (x, y, z, qx, qy, qz, qw)."""
    velocity: wp.array2d(dtype=wp.spatial_vectorf)
    """[B, L] velocity of the link's origin (m/s), then angular velocity (rad/s)."""
    contact_count: wp.array(dtype=wp.int32)
    """[1] contacts found, which may exceed the room C."""
    contact_env: wp.array(dtype=wp.int32)
    """[C] environment of every contact."""
    contact_geom: wp.array(dtype=wp.vec2i)
    """[C] its geometry numbers, of all environments mixed."""
    contact_distance: wp.array(dtype=wp.float32)
    """[C] gap, negative for overlap (m)."""
    contact_position: wp.array(dtype=wp.vec3f)
    """[C] (m)."""
    contact_normal: wp.array(dtype=wp.vec3f)
    """[C] from the first geometry to the second."""
    contact_force: wp.array(dtype=wp.float32)
    """[C] normal force (N); NaN where the engine does not tell."""
    contact_friction: wp.array(dtype=wp.vec3f)
    """[C] tangential force on the second geometry (N), world axes; 0 where the engine does not tell."""
    contact_couple: wp.array(dtype=wp.vec3f)
    """[C] torque on the second geometry about the point (N·m), world axes, of what resists turning and rolling; 0 where
    the engine does not tell."""
    time: wp.array(dtype=wp.float32)
    """[B] (s)."""


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
    state: StateArrays,
):
    """Turn MuJoCo's poses and spatial velocities into those of link origins. Thread: environment and link [B, L].

    MuJoCo's ``cvel`` is (ω, v) at the centre of mass of the kinematic tree: v_origin = v + ω × (origin − com).
    """
    env, link = wp.tid()
    p = xpos[env, link]
    # MuJoCo stores (w, x, y, z) in Warp's quaternions.
    q = xquat[env, link]
    state.pose[env, link] = wp.transformf(p, wp.quatf(q[1], q[2], q[3], q[0]))
    twist = cvel[env, link]
    # Velocity of a rigid body shifted from the reference point of the tree to the link's origin: v + ω × r.
    omega = wp.vec3f(twist[0], twist[1], twist[2])
    linear = wp.vec3f(twist[3], twist[4], twist[5]) + wp.cross(omega, p - subtree_com[env, root[link]])
    state.velocity[env, link] = wp.spatial_vectorf(linear[0], linear[1], linear[2], omega[0], omega[1], omega[2])


@wp.kernel
def fill_contacts(
    frame: wp.array(dtype=wp.mat33f),
    dim: wp.array(dtype=wp.int32),
    address: wp.array2d(dtype=wp.int32),
    efc_force: wp.array2d(dtype=wp.float32),
    cone: wp.array(dtype=Any),
    pyramidal: int,
    state: StateArrays,
):
    """Read normal, normal force, friction (N) and torque (N·m) of every contact. Thread: contact [C].

    With a pyramidal cone the normal force is the sum of the forces along its edges, and friction along a tangent, or
    about an axis, the difference of its two edges by the coefficient ``cone``.
    """
    c = wp.tid()
    if c >= state.contact_count[0]:
        return
    env = state.contact_env[c]
    rows = frame[c]
    state.contact_normal[c] = wp.vec3f(rows[0, 0], rows[0, 1], rows[0, 2])
    total = float(0.0)
    # An elliptic cone has one row for the normal force; a pyramidal one has two edges per tangent, each of which
    # carries a share of it.
    edges = int(1)
    if pyramidal == 1 and dim[c] > 1:
        edges = 2 * (dim[c] - 1)
    for edge in range(edges):
        row = address[c, edge]
        if row >= 0:
            total += efc_force[env, row]
    state.contact_force[c] = total
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
                share = cone[c][axis] * (efc_force[env, first] - efc_force[env, second])
        elif first >= 0:
            share = efc_force[env, first]
        along = share * wp.vec3f(rows[side, 0], rows[side, 1], rows[side, 2])
        if axis < 2:
            slip += along
        else:
            spin += along
    state.contact_friction[c] = slip
    state.contact_couple[c] = spin
