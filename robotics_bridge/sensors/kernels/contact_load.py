"""Kernels that spread every contact force of the engine over the taxels that feel it.

A contact c pushes with F_c at p_c. A taxel n with weight d_n^α belongs to the contacts of the body that gives it its
depth, on the side that faces it, by inverse distance: r_nc = g_nc / Σ_c g_nc (Shepard 1968). With y_nc = d_n^α r_nc and
the outward normal m_n of what is touched::

    f_n = Σ_c y_nc (s_c q_n + (F_c − s_c Σ_n y_nc q_n) / Σ_n y_nc),    s_c = normal force / Σ_n y_nc (m_n · n_c)

so that Σ_n f_n = Σ_c F_c whatever the weights are. q_n is m_n, and m_n + σ_n for taxels that hold what they touch
(``stick``). A node is one side of a contact: 2c of the first geometry, 2c + 1 of
the second. Vectors are in the frame of the sensor link (m, N).
Letters: B environment, L link, S sensor, C contact, N taxel, K sensor of one link.
"""

from __future__ import annotations

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays, in_scene
from robotics_bridge.sensors.kernels.pairs import SlotArrays
from robotics_bridge.sensors.kernels.readout import ProbeArrays, ReadoutArrays

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
    row_first: wp.array(dtype=wp.int32)
    """[S + 1] first row of a sensor."""
    reach: wp.array(dtype=wp.float32)
    """[N] a contact this near is felt (m); negative for fillers."""
    slip: wp.float32
    """Sign of friction: 1 as it acts on the sensor, −1 as published."""
    status: wp.array(dtype=wp.int32)
    """[B] bits of the suite; 4 is a force that no taxel carries."""


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
    """Contact of every taxel."""

    weight: wp.array2d(dtype=wp.float32)
    """[B, N] d^α."""
    noisy: wp.array2d(dtype=wp.float32)
    """[B, N] the same with radius noise and gain."""
    normal: wp.array2d(dtype=wp.vec3f)
    """[B, N] outward normal m of what is touched."""
    sigma: wp.array2d(dtype=wp.vec3f)
    """[B, N] σ: friction at rest over normal force, where taxels hold what they touch."""
    body: wp.array2d(dtype=wp.int32)
    """[B, N] its link."""
    total: wp.array2d(dtype=wp.float32)
    """[B, N] Σ_c g_nc; 0 where no contact explains the touch."""
    part: wp.array2d(dtype=wp.spatial_vectorf)
    """[B, R] of a row: number of taxels with a touch that a contact explains and, where the link has one contact alone,
    Σ y, Σ y (m · n) and Σ y q."""


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
    if not in_scene(pair, link_of.shape[0]):
        return
    env = state.contact_env[c]
    # The normal leads from the first to the second, which it pushes away.
    sign = wp.where(node % 2 == 0, -1.0, 1.0)
    other = pair[1 - node % 2]
    link = link_of[pair[node % 2]]
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
        wp.atomic_or(plan.status, env, 4)
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
def nearness(alone: bool, point: wp.vec3f, push: wp.vec3f, x: wp.vec3f, normal: wp.vec3f, reach: float) -> float:
    """Return g_nc of a contact and a taxel at ``x``; 0 where they lie on different sides of the link.

    Only ratios of it matter: of a contact that is ``alone`` on its link it is 1.
    """
    if wp.dot(normal, push) <= 0.0:
        return 0.0
    if alone:
        return 1.0
    away = wp.length_sq(x - point) / (reach * reach) + 0.01
    return 1.0 / (away * away)


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
    link = link_of[state.contact_geom[c][node % 2]]
    sensor = plan.sensors[link, k]
    alone = nodes.follower[nodes.head[env, link]] < 0
    push = nodes.normal[node]
    point = nodes.point[node]
    other = nodes.other[node]
    whole = float(0.0)
    straight = float(0.0)
    field = wp.vec3f(0.0)
    held = press.sigma.shape[0] == press.normal.shape[0]
    if alone:
        # Every touch is that of this contact: its taxels were added up row by row.
        for row in range(plan.row_first[sensor], plan.row_first[sensor + 1]):
            part = press.part[env, row]
            whole += part[1]
            straight += part[2]
            field += wp.vec3f(part[3], part[4], part[5])
    else:
        span = plan.spans[sensor]
        for n in range(span[0], span[1]):
            weight = press.weight[env, n]
            total = press.total[env, n]
            if weight > 0.0 and total > 0.0 and press.body[env, n] == other:
                m = press.normal[env, n]
                y = weight * nearness(alone, point, push, probes.position[n], m, plan.reach[n]) / total
                whole += y
                straight += y * wp.dot(m, push)
                way = m
                if held:
                    way = m + press.sigma[env, n]
                field += y * way
    load = nodes.load[node]
    share = wp.vec4f(0.0)
    if whole > 0.0:
        # Taxels that face away from the contact by more than 60° on average would be stretched beyond all measure; the
        # rest, which makes the sum right, then carries what is missing.
        scale = load / wp.max(straight, 0.5 * whole)
        rest = (nodes.force[node] - scale * field) / whole
        share = wp.vec4f(scale, rest[0], rest[1], rest[2])
    elif load > 0.0:
        wp.atomic_or(plan.status, env, 4)
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
    rows: wp.array(dtype=wp.vec4i),
    press: PressArrays,
    nodes: ContactNodes,
    noisy: int,
    written: wp.array2d(dtype=wp.uint8),
    io: ReadoutArrays,
):
    """Write the readings. Thread: environment and row of taxels [B, R].

    ``written`` [B, R] is 1 where a row may hold anything but zeros; most touch nothing, now and before.
    """
    env, at_row = wp.tid()
    span = rows[at_row]
    part = span[3]
    k = plan.order[part]
    head = nodes.head[env, plan.link[part]]
    diverged = (io.status[env] & 1) != 0
    full = diverged or (head >= 0 and press.part[env, at_row][0] > 0.0)
    if not full and written[env, at_row] == wp.uint8(0):
        return
    written[env, at_row] = wp.uint8(wp.where(full or noisy == 1, 1, 0))
    held = press.sigma.shape[0] == press.normal.shape[0]
    alone = bool(False)
    share = wp.vec4f(0.0)
    if full and not diverged:
        alone = nodes.follower[head] < 0
        share = nodes.share[head, k]
    n = span[0]
    while n < span[1]:
        f = wp.vec3f(0.0)
        x = probes.position[n]
        weight = float(0.0)
        measured = float(0.0)
        if diverged and probes.radius[n] > 0.0:
            weight = wp.nan
            measured = wp.nan
        elif full and not diverged and press.total[env, n] > 0.0:
            total = press.total[env, n]
            m = press.normal[env, n]
            way = m
            if held:
                way = m + press.sigma[env, n]
            if alone:
                f = share[0] * way + wp.vec3f(share[1], share[2], share[3])
            else:
                body = press.body[env, n]
                node = head
                while node >= 0:
                    if ((nodes.felt[node] >> k) & 1) == 1 and nodes.other[node] == body:
                        near = nearness(alone, nodes.point[node], nodes.normal[node], x, m, plan.reach[n])
                        if near > 0.0:
                            one = nodes.share[node, k]
                            f += near / total * (one[0] * way + wp.vec3f(one[1], one[2], one[3]))
                    node = nodes.follower[node]
            weight = press.weight[env, n]
            if noisy == 1:
                measured = press.noisy[env, n]
        write_wrench(io.truth, env, n, x, weight * f)
        if noisy == 1:
            write_wrench(io.measured, env, n, x, measured * f)
        n += span[2]
