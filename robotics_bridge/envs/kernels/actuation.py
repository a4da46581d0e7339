"""Torques of imperfect position actuators. Letters: B environment, J joint.

    tau = strength · (stiffness · e − damping · v + kick · sign e) + noise, within ± effort

e is the target less the measured position; below the deadband it counts as none.
"""

from __future__ import annotations

import warp as wp


@wp.struct
class ActuatorArrays:
    """Gains and imperfections of every actuator, and what it remembers."""

    # [B, J]
    stiffness: wp.array2d(dtype=wp.float32)
    damping: wp.array2d(dtype=wp.float32)
    strength: wp.array2d(dtype=wp.float32)
    bias: wp.array2d(dtype=wp.float32)
    deadband: wp.array2d(dtype=wp.float32)
    backlash: wp.array2d(dtype=wp.float32)
    kick: wp.array2d(dtype=wp.float32)
    play: wp.array2d(dtype=wp.float32)
    before: wp.array2d(dtype=wp.float32)
    # [J]
    effort: wp.array(dtype=wp.float32)
    noise: wp.array(dtype=wp.float32)
    position: wp.array(dtype=wp.int32)
    speed: wp.array(dtype=wp.int32)
    channel: wp.array(dtype=wp.int32)


@wp.kernel(module="unique")
def actuate(
    d: ActuatorArrays,
    qpos: wp.array2d(dtype=wp.float32),
    qvel: wp.array2d(dtype=wp.float32),
    target: wp.array2d(dtype=wp.float32),
    random: wp.array(dtype=wp.int32),  # [2] launches so far, seed
    first: int,
    share: float,
    ctrl: wp.array2d(dtype=wp.float32),
    power: wp.array2d(dtype=wp.float32),
):
    """Write the torque (N·m) of each joint of each environment, dim [B, J], and its mean power in a control step."""
    env, joint = wp.tid()
    q = qpos[env, d.position[joint]]
    v = qvel[env, d.speed[joint]]
    # Play (a stop operator): the motor sees the joint move once the gap has been taken up.
    half = 0.5 * d.backlash[env, joint]
    play = wp.clamp(d.play[env, joint] + q - d.before[env, joint], -half, half)
    d.play[env, joint] = play
    d.before[env, joint] = q
    error = target[env, joint] - (q - play + d.bias[env, joint])
    if wp.abs(error) < d.deadband[env, joint]:
        error = 0.0
    # PD law on the error after play, bias and deadband; damping acts on the true speed.
    torque = d.stiffness[env, joint] * error - d.damping[env, joint] * v
    # A constant torque towards the target, none within the deadband, where it would switch to and fro.
    if error != 0.0:
        torque += wp.sign(error) * d.kick[env, joint]
    # Strength scales what the controller asks for, noise comes on top of it, and the effort limits the sum.
    torque *= d.strength[env, joint]
    if d.noise[joint] > 0.0:
        # Numbers counted by launch, environment and joint, not drawn in turn: the same on every device and in every
        # order.
        state = wp.rand_init(random[1] + random[0], env * d.position.shape[0] + joint)
        torque += d.noise[joint] * wp.randf(state, -1.0, 1.0)
    torque = wp.clamp(torque, -d.effort[joint], d.effort[joint])
    ctrl[env, d.channel[joint]] = torque
    # Mean of |τ q̇| over the physics steps of a control step; the first launch starts the sum, so nothing need be
    # cleared.
    spent = share * wp.abs(torque * v)
    if first == 1:
        power[env, joint] = spent
    else:
        power[env, joint] = power[env, joint] + spent


@wp.kernel(module="unique")
def add_contact_forces(
    count: wp.array(dtype=wp.int32),  # [1] contacts in use
    geoms: wp.array(dtype=wp.vec2i),  # [C]
    env: wp.array(dtype=wp.int32),  # [C]
    normal: wp.array(dtype=wp.vec3f),  # [C] from the first geometry to the second
    force: wp.array(dtype=wp.float32),  # [C] (N)
    row: wp.array(dtype=wp.int32),  # [G] row of each geometry; -1 for none
    total: wp.array2d(dtype=wp.vec3f),  # [B, R] (N), added to
):
    """Add the force of each contact, dim [C], to the second geometry, and the opposite one to the first."""
    c = wp.tid()
    if c >= count[0]:
        return
    pair = geoms[c]
    f = force[c]
    if not wp.isfinite(f):
        return
    # Newton's third law with the normal from the first geometry to the second; friction is left out, as in the
    # published senses. A flex (−1) has no row, and what it presses does.
    push = f * normal[c]
    for side in range(2):
        geometry = pair[side]
        if geometry >= 0:
            if row[geometry] >= 0:
                wp.atomic_add(total, env[c], row[geometry], wp.where(side == 1, push, -push))
