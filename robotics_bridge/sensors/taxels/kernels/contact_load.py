"""Kernels that spread every contact force of the engine over the taxels that feel it.

A contact c pushes with F_c at p_c. A taxel n with weight d_n^α belongs to the contacts of the body that gives it its
depth, on the side that faces it, by inverse distance: r_nc = g_nc / Σ_c g_nc (Shepard 1968). With y_nc = d_n^α r_nc and
the outward normal m_n of what is touched::

    f_n = Σ_c y_nc (s_c m_n + (F_c − s_c Σ_n y_nc m_n) / Σ_n y_nc),    s_c = normal force / Σ_n y_nc (m_n · n_c)

so that Σ_n f_n = Σ_c F_c whatever the weights are. A node is one side of a contact: 2c of the first geometry, 2c + 1 of
the second. Vectors are in the frame of the sensor link (m, N).
Letters: B environment, L link, S sensor, C contact, N taxel, K sensor of one link.
"""

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays
from robotics_bridge.sensors.kernels.readout import CLEAN, ProbeArrays, ReadoutArrays, idle, lost
from robotics_bridge.sensors.kernels.series import power
from robotics_bridge.sensors.noise.kernels.noise import episode_draw, radius_noise
from robotics_bridge.sensors.probes.kernels.probe import deepest_function
from robotics_bridge.sensors.queries.kernels.distance import SolidArrays
from robotics_bridge.sensors.queries.kernels.pairs import PairArrays, SlotArrays

wp = warp()


@wp.struct
class SpreadPlan:
    """Sensors whose taxels share the contact forces of their link."""

    sensors: wp.array2d(dtype=wp.int32)
    """[L, K] sensors of every link, −1 for none."""
    link: wp.array(dtype=wp.int32)
    """[S] link of a sensor."""
    order: wp.array(dtype=wp.int32)
    """[S] place k of a sensor on its link."""
    spans: wp.array(dtype=wp.vec3i)
    """[S] first taxel, end and slot of the pair lists."""
    reach: wp.array(dtype=wp.float32)
    """[N] a contact this near is felt (m); negative for fillers."""
    exponent: wp.array(dtype=wp.float32)
    """[S] α."""
    slip: wp.float32
    """Sign of friction: 1 as it acts on the sensor, −1 as published."""


@wp.struct
class ContactNodes:
    """Contact forces on the links that carry sensors."""

    head: wp.array2d(dtype=wp.int32)
    """[B, L] first node of a link, −1 for none."""
    follower: wp.array(dtype=wp.int32)
    """[2 C] next node of the same link."""
    felt: wp.array(dtype=wp.int32)
    """[2 C] bit k: a taxel of sensor k of the link lies near."""
    other: wp.array(dtype=wp.int32)
    """[2 C] link on the other side."""
    point: wp.array(dtype=wp.vec3f)
    """[2 C]."""
    normal: wp.array(dtype=wp.vec3f)
    """[2 C] unit, the way the contact pushes the link."""
    force: wp.array(dtype=wp.vec3f)
    """[2 C] on the link, friction included."""
    load: wp.array(dtype=wp.float32)
    """[2 C] normal part of it."""
    share: wp.array2d(dtype=wp.vec4f)
    """[2 C, K] s_c and the rest (F_c − s_c Σ y m) / Σ y."""


@wp.struct
class PressArrays:
    """What every taxel touches."""

    weight: wp.array2d(dtype=wp.float32)
    """[B, N] d^α."""
    noisy: wp.array2d(dtype=wp.float32)
    """[B, N] the same with radius noise and gain."""
    normal: wp.array2d(dtype=wp.vec3f)
    """[B, N] outward normal of what is touched."""
    body: wp.array2d(dtype=wp.int32)
    """[B, N] its link."""
    total: wp.array2d(dtype=wp.float32)
    """[B, N] Σ_c g_nc; 0 where no contact explains the touch."""


@wp.kernel
def list_contacts(
    plan: SpreadPlan,
    slots: SlotArrays,
    link_of: wp.array(dtype=wp.int32),
    probes: ProbeArrays,
    state: StateArrays,
    friction: wp.array(dtype=wp.vec3f),
    nodes: ContactNodes,
):
    """List the contacts of every link that carries sensors. Thread: node [2 C]."""
    node = wp.tid()
    c = node // 2
    if c >= state.contact_count[0]:
        return
    nodes.felt[node] = 0
    pair = state.contact_geom[c]
    if pair[0] < 0 or pair[1] < 0:
        return
    env = state.contact_env[c]
    # The normal leads from the first to the second, which it pushes away.
    sign = float(-1.0)
    own = pair[0]
    other = pair[1]
    if node % 2 == 1:
        sign = float(1.0)
        own = pair[1]
        other = pair[0]
    link = link_of[own]
    if plan.sensors[link, 0] < 0:
        return
    here = state.pose[env, link]
    turn = wp.transform_get_rotation(here)
    point = wp.quat_rotate_inv(turn, state.contact_position[c] - wp.transform_get_translation(here))
    overlap = wp.max(-state.contact_distance[c], 0.0)
    felt = int(0)
    tracked = int(0)
    for k in range(plan.sensors.shape[1]):
        sensor = plan.sensors[link, k]
        if sensor >= 0:
            span = plan.spans[sensor]
            if slots.place[span[2], other] >= 0:
                bit = 1 << k
                tracked = tracked | bit
                for n in range(span[0], span[1]):
                    if wp.length(probes.position[n] - point) <= plan.reach[n] + overlap:
                        felt = felt | bit
                        break
    load = state.contact_force[c]
    if felt != tracked and load > 0.0:
        wp.atomic_or(state.status, env, 4)
    if felt == 0:
        return
    normal = wp.quat_rotate_inv(turn, sign * state.contact_normal[c])
    nodes.felt[node] = felt
    nodes.other[node] = link_of[other]
    nodes.point[node] = point
    nodes.normal[node] = normal
    nodes.load[node] = load
    nodes.force[node] = load * normal + plan.slip * wp.quat_rotate_inv(turn, sign * friction[c])
    nodes.follower[node] = wp.atomic_exch(nodes.head, env, link, node)


@wp.kernel
def sort_contacts(nodes: ContactNodes):
    """Bring lists into the order of contacts, so that sums do not depend on threads. Thread: [B, L]."""
    env, link = wp.tid()
    first = int(-1)
    node = nodes.head[env, link]
    while node >= 0:
        later = nodes.follower[node]
        before = int(-1)
        after = first
        while after >= 0 and after < node:
            before = after
            after = nodes.follower[after]
        nodes.follower[node] = after
        if before < 0:
            first = node
        else:
            nodes.follower[before] = node
        node = later
    nodes.head[env, link] = first


@wp.func
def nearness(
    plan: SpreadPlan, nodes: ContactNodes, node: int, k: int, n: int, x: wp.vec3f, normal: wp.vec3f, body: int
) -> float:
    """Return g_nc, or 0 where the contact is not one of the taxel's: another body, or the other side of the link."""
    if ((nodes.felt[node] >> k) & 1) == 0 or nodes.other[node] != body:
        return 0.0
    if wp.dot(normal, nodes.normal[node]) <= 0.0:
        return 0.0
    away = wp.length_sq(x - nodes.point[node]) / (plan.reach[n] * plan.reach[n]) + 0.01
    return 1.0 / (away * away)


@cache
def press_kernel(kinds: frozenset[int], raycast: bool, mode: int) -> Any:
    """Return the kernel ``press``: how deep taxels lie in what, and which contacts explain it. Dim [B, N].

    Args:
        kinds: of the geometries tracked.
        raycast: ask triangles.
        mode: of the readout.
    """
    deepest = deepest_function(kinds, raycast)

    @wp.kernel(module="unique")
    def press(
        probes: ProbeArrays,
        solids: SolidArrays,
        pairs: PairArrays,
        state: StateArrays,
        io: ReadoutArrays,
        plan: SpreadPlan,
        nodes: ContactNodes,
        out: PressArrays,
    ):
        env, n = wp.tid()
        out.weight[env, n] = 0.0
        out.total[env, n] = 0.0
        if wp.static(mode != CLEAN):
            out.noisy[env, n] = 0.0
        radius = probes.radius[n]
        if radius <= 0.0 or (state.status[env] & 1) != 0:
            return
        part = probes.part[n]
        best, normal, place = deepest(probes, solids, pairs, env, n, 0.0)
        if place < 0:
            return
        weight = float(0.0)
        if best < radius:
            weight = power(radius - best, plan.exponent[part])
        noisy = float(0.0)
        if wp.static(mode != CLEAN):
            number = env + io.env_offset
            probe = probes.probe[n]
            knobs = io.knobs[part]
            felt = wp.max(radius + radius_noise(knobs, number, probe, io.age[env], io.episode[env]), 0.0) - best
            fixed = episode_draw(knobs, number, probe, io.episode[env])
            if felt * fixed[0] > 0.0:
                noisy = power(felt * fixed[0], plan.exponent[part])
            out.noisy[env, n] = noisy
        if weight + noisy <= 0.0:
            return
        body = solids.link[pairs.geometry[env, place]]
        total = float(0.0)
        node = nodes.head[env, plan.link[part]]
        while node >= 0:
            total += nearness(plan, nodes, node, plan.order[part], n, probes.position[n], normal, body)
            node = nodes.follower[node]
        out.weight[env, n] = weight
        out.normal[env, n] = normal
        out.body[env, n] = body
        out.total[env, n] = total

    return press


@wp.kernel
def share_contacts(
    plan: SpreadPlan,
    slots: SlotArrays,
    link_of: wp.array(dtype=wp.int32),
    probes: ProbeArrays,
    state: StateArrays,
    press: PressArrays,
    nodes: ContactNodes,
):
    """Work out what a unit of weight carries of each contact. Thread: node and sensor of its link [2 C, K].

    One thread adds all taxels of a contact in a fixed order, so that sums do not depend on the device.
    """
    node, k = wp.tid()
    c = node // 2
    if c >= state.contact_count[0]:
        return
    if ((nodes.felt[node] >> k) & 1) == 0:
        return
    env = state.contact_env[c]
    sensor = plan.sensors[link_of[state.contact_geom[c][node % 2]], k]
    span = plan.spans[sensor]
    push = nodes.normal[node]
    whole = float(0.0)
    straight = float(0.0)
    field = wp.vec3f(0.0)
    for n in range(span[0], span[1]):
        if press.weight[env, n] > 0.0 and press.total[env, n] > 0.0:
            m = press.normal[env, n]
            near = nearness(plan, nodes, node, k, n, probes.position[n], m, press.body[env, n])
            y = press.weight[env, n] * near / press.total[env, n]
            whole += y
            straight += y * wp.dot(m, push)
            field += y * m
    load = nodes.load[node]
    share = wp.vec4f(0.0)
    if whole > 0.0:
        # Taxels that face away from the contact by more than 60° on average would be stretched beyond all measure; the
        # rest, which makes the sum right, then carries what is missing.
        scale = load / wp.max(straight, 0.5 * whole)
        rest = (nodes.force[node] - scale * field) / whole
        share = wp.vec4f(scale, rest[0], rest[1], rest[2])
    elif load > 0.0:
        wp.atomic_or(state.status, env, 4)
    nodes.share[node, k] = share


@wp.func
def write_wrench(out: wp.array3d(dtype=wp.float32), env: int, n: int, x: wp.vec3f, f: wp.vec3f):
    """Write a force at x and its torque about the origin of the link."""
    turn = wp.cross(x, f)
    for axis in range(3):
        out[axis, env, n] = f[axis]
        out[axis + 3, env, n] = turn[axis]


@wp.kernel
def spread_contacts(
    plan: SpreadPlan,
    probes: ProbeArrays,
    press: PressArrays,
    nodes: ContactNodes,
    noisy: int,
    io: ReadoutArrays,
):
    """Write the readings. Thread: environment and taxel [B, N]."""
    env, n = wp.tid()
    if probes.radius[n] <= 0.0:
        idle(io, 6, env, n)
        return
    if (io.status[env] & 1) != 0:
        lost(io, 6, env, n)
        return
    f = wp.vec3f(0.0)
    total = press.total[env, n]
    part = probes.part[n]
    x = probes.position[n]
    if total > 0.0:
        m = press.normal[env, n]
        k = plan.order[part]
        node = nodes.head[env, plan.link[part]]
        while node >= 0:
            near = nearness(plan, nodes, node, k, n, x, m, press.body[env, n])
            if near > 0.0:
                share = nodes.share[node, k]
                f += near / total * (share[0] * m + wp.vec3f(share[1], share[2], share[3]))
            node = nodes.follower[node]
    write_wrench(io.truth, env, n, x, press.weight[env, n] * f)
    if noisy == 1:
        write_wrench(io.measured, env, n, x, press.noisy[env, n] * f)
