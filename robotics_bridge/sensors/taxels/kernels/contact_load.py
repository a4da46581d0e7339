"""Kernels that scale force fields to the normal force which the physics engine resolved. B environment, S sensor."""

from functools import cache
from types import SimpleNamespace

from robotics_bridge.sensors.queries.kernels.pairs import pair_structs


@cache
def load_kernels() -> SimpleNamespace:
    """Return ``gather`` (dim [C]), ``weigh`` (dim [S, B]) and ``scale`` (dim [B, N]).

    Loads are [S, B] forces on the sensor link in world axes; scales are load / force of the field along the load.
    """
    import warp as wp

    slots_type = pair_structs().Slots

    @wp.func
    def add(
        spans: wp.array(dtype=wp.vec3i),
        slots: slots_type,
        env: int,
        link: int,
        other: int,
        push: wp.vec3f,
        loads: wp.array2d(dtype=wp.vec3f),
    ):
        for sensor in range(spans.shape[0]):
            slot = spans[sensor][2]
            if slots.link[slot] == link and slots.place[slot, other] >= 0:
                wp.atomic_add(loads, sensor, env, push)

    @wp.kernel(module="unique")
    def gather(
        spans: wp.array(dtype=wp.vec3i),
        slots: slots_type,
        link_of: wp.array(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        geometry: wp.array(dtype=wp.vec2i),
        env: wp.array(dtype=wp.int32),
        normal: wp.array(dtype=wp.vec3f),
        force: wp.array(dtype=wp.float32),
        loads: wp.array2d(dtype=wp.vec3f),
    ):
        c = wp.tid()
        if c >= count[0]:
            return
        pair = geometry[c]
        if pair[0] < 0 or pair[1] < 0:
            return
        # The normal leads from the first to the second, which it pushes away.
        push = force[c] * normal[c]
        add(spans, slots, env[c], link_of[pair[0]], pair[1], -push, loads)
        add(spans, slots, env[c], link_of[pair[1]], pair[0], push, loads)

    @wp.kernel(module="unique")
    def weigh(
        spans: wp.array(dtype=wp.vec3i),
        slots: slots_type,
        pose: wp.array2d(dtype=wp.transformf),
        truth: wp.array3d(dtype=wp.float32),
        loads: wp.array2d(dtype=wp.vec3f),
        scales: wp.array2d(dtype=wp.float32),
    ):
        sensor, env = wp.tid()
        span = spans[sensor]
        turn = wp.transform_get_rotation(pose[env, slots.link[span[2]]])
        load = wp.quat_rotate_inv(turn, loads[sensor, env])
        size = wp.length(load)
        total = wp.vec3f(0.0)
        for n in range(span[0], span[1]):
            total += wp.vec3f(truth[0, env, n], truth[1, env, n], truth[2, env, n])
        along = wp.dot(total, load)
        scale = float(0.0)
        # A field that does not oppose the load cannot be stretched into it.
        if along > 0.0:
            scale = size * size / along
        if wp.isnan(size):
            scale = size
        scales[sensor, env] = scale

    @wp.kernel(module="unique")
    def scale(
        part: wp.array(dtype=wp.int32),
        scales: wp.array2d(dtype=wp.float32),
        truth: wp.array3d(dtype=wp.float32),
        measured: wp.array3d(dtype=wp.float32),
        noisy: int,
    ):
        env, n = wp.tid()
        s = scales[part[n], env]
        for channel in range(6):
            truth[channel, env, n] = s * truth[channel, env, n]
            if noisy == 1:
                measured[channel, env, n] = s * measured[channel, env, n]

    return SimpleNamespace(gather=gather, weigh=weigh, scale=scale)
