"""Kernels that scale force fields to the normal force which the physics engine resolved.

Loads [S, B] are forces (N) on the sensor link in world axes; scales are load / force of the field along the load.
Letters: B environment, S sensor, C contact, N taxel.
"""

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays
from robotics_bridge.sensors.queries.kernels.pairs import SlotArrays

wp = warp()


@wp.func
def add_load(
    spans: wp.array(dtype=wp.vec3i),
    slots: SlotArrays,
    env: int,
    link: int,
    other: int,
    push: wp.vec3f,
    loads: wp.array2d(dtype=wp.vec3f),
):
    """Add a force to the sensors of a link that track the other geometry."""
    for sensor in range(spans.shape[0]):
        slot = spans[sensor][2]
        if slots.link[slot] == link and slots.place[slot, other] >= 0:
            wp.atomic_add(loads, sensor, env, push)


@wp.kernel
def gather_loads(
    spans: wp.array(dtype=wp.vec3i),
    slots: SlotArrays,
    link_of: wp.array(dtype=wp.int32),
    state: StateArrays,
    loads: wp.array2d(dtype=wp.vec3f),
):
    """Sum the engine's contact forces on each sensor. Thread: contact [C]."""
    c = wp.tid()
    if c >= state.contact_count[0]:
        return
    pair = state.contact_geom[c]
    env = state.contact_env[c]
    if pair[0] < 0 or pair[1] < 0:
        return
    # The normal leads from the first to the second, which it pushes away.
    push = state.contact_force[c] * state.contact_normal[c]
    add_load(spans, slots, env, link_of[pair[0]], pair[1], -push, loads)
    add_load(spans, slots, env, link_of[pair[1]], pair[0], push, loads)


@wp.kernel
def weigh_field(
    spans: wp.array(dtype=wp.vec3i),
    slots: SlotArrays,
    state: StateArrays,
    truth: wp.array3d(dtype=wp.float32),
    loads: wp.array2d(dtype=wp.vec3f),
    scales: wp.array2d(dtype=wp.float32),
):
    """Compare the sum of a field with its load. Thread: sensor and environment [S, B]."""
    sensor, env = wp.tid()
    span = spans[sensor]
    # Loads come in world axes and fields in link axes. One thread adds all taxels of a sensor in a fixed order, so the
    # total does not depend on the device; atomic additions would round differently from run to run.
    turn = wp.transform_get_rotation(state.pose[env, slots.link[span[2]]])
    load = wp.quat_rotate_inv(turn, loads[sensor, env])
    size = wp.length(load)
    total = wp.vec3f(0.0)
    for n in range(span[0], span[1]):
        total += wp.vec3f(truth[0, env, n], truth[1, env, n], truth[2, env, n])
    # The field is scaled until its sum has the load's component along the load: s (total · load) = |load|².
    along = wp.dot(total, load)
    scale = float(0.0)
    # A field that does not oppose the load cannot be stretched into it.
    if along > 0.0:
        scale = size * size / along
    # A lost contact force must reach the readings as NaN instead of ending as a plausible zero.
    if wp.isnan(size):
        scale = size
    scales[sensor, env] = scale


@wp.kernel
def scale_field(
    part: wp.array(dtype=wp.int32),
    scales: wp.array2d(dtype=wp.float32),
    truth: wp.array3d(dtype=wp.float32),
    measured: wp.array3d(dtype=wp.float32),
    noisy: int,
):
    """Multiply the readings. Thread: environment and taxel [B, N]."""
    env, n = wp.tid()
    s = scales[part[n], env]
    for channel in range(6):
        truth[channel, env, n] = s * truth[channel, env, n]
        if noisy == 1:
            measured[channel, env, n] = s * measured[channel, env, n]
