"""Warp kernels of the environment: torques of imperfect drives, and net contact forces on links."""

from functools import cache
from types import SimpleNamespace


@cache
def environment_kernels() -> SimpleNamespace:
    """Return the kernels ``drive``, ``count``, ``forces`` and ``meets``, and the struct ``Drive``."""
    import warp as wp

    @wp.struct
    class Drive:
        stiffness: wp.array2d(dtype=wp.float32)
        damping: wp.array2d(dtype=wp.float32)
        strength: wp.array2d(dtype=wp.float32)
        bias: wp.array2d(dtype=wp.float32)
        deadband: wp.array2d(dtype=wp.float32)
        backlash: wp.array2d(dtype=wp.float32)
        kick: wp.array2d(dtype=wp.float32)
        play: wp.array2d(dtype=wp.float32)
        before: wp.array2d(dtype=wp.float32)
        effort: wp.array(dtype=wp.float32)
        noise: wp.array(dtype=wp.float32)
        position: wp.array(dtype=wp.int32)
        speed: wp.array(dtype=wp.int32)
        channel: wp.array(dtype=wp.int32)

    @wp.kernel(module="unique")
    def drive(
        d: Drive,
        qpos: wp.array2d(dtype=wp.float32),
        qvel: wp.array2d(dtype=wp.float32),
        target: wp.array2d(dtype=wp.float32),
        seed: int,
        tick: wp.array(dtype=wp.int32),
        first: int,
        share: float,
        ctrl: wp.array2d(dtype=wp.float32),
        power: wp.array2d(dtype=wp.float32),
    ):
        env, joint = wp.tid()
        q = qpos[env, d.position[joint]]
        v = qvel[env, d.speed[joint]]
        # Play: the motor sees the joint move once the gap has been taken up.
        half = 0.5 * d.backlash[env, joint]
        play = wp.clamp(d.play[env, joint] + q - d.before[env, joint], -half, half)
        d.play[env, joint] = play
        d.before[env, joint] = q
        error = target[env, joint] - (q - play + d.bias[env, joint])
        if wp.abs(error) < d.deadband[env, joint]:
            error = 0.0
        torque = d.stiffness[env, joint] * error - d.damping[env, joint] * v
        if error != 0.0:
            torque += wp.sign(error) * d.kick[env, joint]
        torque *= d.strength[env, joint]
        if d.noise[joint] > 0.0:
            state = wp.rand_init(seed + tick[0], env * d.position.shape[0] + joint)
            torque += d.noise[joint] * wp.randf(state, -1.0, 1.0)
        torque = wp.clamp(torque, -d.effort[joint], d.effort[joint])
        ctrl[env, d.channel[joint]] = torque
        spent = share * wp.abs(torque * v)
        if first == 1:
            power[env, joint] = spent
        else:
            power[env, joint] = power[env, joint] + spent

    @wp.kernel(module="unique")
    def count(tick: wp.array(dtype=wp.int32)):
        tick[0] = tick[0] + 1

    @wp.kernel(module="unique")
    def forces(
        count: wp.array(dtype=wp.int32),
        geoms: wp.array(dtype=wp.vec2i),
        env: wp.array(dtype=wp.int32),
        normal: wp.array(dtype=wp.vec3f),
        force: wp.array(dtype=wp.float32),
        row: wp.array(dtype=wp.int32),
        total: wp.array2d(dtype=wp.vec3f),
    ):
        c = wp.tid()
        if c >= count[0]:
            return
        pair = geoms[c]
        f = force[c]
        if pair[0] < 0 or pair[1] < 0 or not wp.isfinite(f):
            return
        push = f * normal[c]
        if row[pair[1]] >= 0:
            wp.atomic_add(total, env[c], row[pair[1]], push)
        if row[pair[0]] >= 0:
            wp.atomic_add(total, env[c], row[pair[0]], -push)

    @wp.kernel(module="unique")
    def meets(
        count: wp.array(dtype=wp.int32),
        geoms: wp.array(dtype=wp.vec2i),
        env: wp.array(dtype=wp.int32),
        distance: wp.array(dtype=wp.float32),
        role: wp.array(dtype=wp.int32),
        touched: wp.array2d(dtype=wp.int32),
    ):
        c = wp.tid()
        if c >= count[0] or distance[c] > 0.0:
            return
        pair = geoms[c]
        if pair[0] < 0 or pair[1] < 0:
            return
        a = role[pair[0]]
        b = role[pair[1]]
        if a == 1 and b >= 2:
            touched[env[c], b - 2] = 1
        if b == 1 and a >= 2:
            touched[env[c], a - 2] = 1

    return SimpleNamespace(Drive=Drive, drive=drive, count=count, forces=forces, meets=meets)
