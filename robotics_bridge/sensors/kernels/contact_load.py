"""Kernels that spread every contact force of the engine over the taxels that feel it, and count what none feels.

A contact c pushes with F_c at p_c, wherever the engine puts that point: it reports a flat face at its corners. A taxel
n with weight d_n^α belongs to the contacts of the body that gives it its depth, on the side that faces it, by inverse
distance: r_nc = g_nc / Σ_c g_nc (Shepard 1968). With y_nc = d_n^α r_nc and the outward normal m_n of what is touched::

    f_n = Σ_c y_nc (s_c q_n + (F_c − s_c Σ_n y_nc q_n) / Σ_n y_nc),    s_c = normal force / Σ_n y_nc (m_n · n_c)

so that Σ_n f_n = Σ_c F_c whatever the weights are. q_n is m_n, and m_n + σ_n for taxels that hold what they touch
(``stick``). A node is one side of a contact: 2c of the first geometry, 2c + 1 of the second. Vectors are in the frame
of the sensor link (m, N).

:func:`settle_kernel` gives the contacts that have no such taxel (a block on a card, a flex, a height field) to taxels
that overlap the body behind the nearest one, else to those near the contact that face it; what is left is missing.
Before, it tilts the forces under each face so that their moment is that of its contacts as well.
Letters: B environment, L link, S sensor, C contact, N taxel, K sensor of one link.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays
from robotics_bridge.sensors.kernels.distance import SIDED, SolidArrays, shape_functions
from robotics_bridge.sensors.kernels.pairs import PairArrays, SlotArrays
from robotics_bridge.sensors.kernels.readout import ProbeArrays, ReadoutArrays

wp = warp()

TILTS = 6
"""Times that forces are tilted at most."""
UNSEEN = wp.constant(-1)
"""Mark of a contact whose taxels were not looked for yet."""


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
    whole: wp.array(dtype=wp.int32)
    """[S] 1 where a sensor feels everything, with what is no geometry (a flex, number −1)."""
    links: wp.array(dtype=wp.int32)
    """[M] links that carry these sensors."""
    loads: wp.array3d(dtype=wp.float32)
    """[2, B, L] sum of the forces that push a link, and what its taxels lack of them (N)."""
    fresh: wp.int32
    """1 for the first group of sensors of a suite, which overwrites the loads of the update before."""
    told: wp.array(dtype=wp.int32)
    """[1] 1 once anything was missing."""


@wp.struct
class ContactNodes:
    """Contact forces on the links that carry sensors."""

    head: wp.array2d(dtype=wp.int32)
    """[B, L] first node of a link, −1 for none."""
    follower: wp.array(dtype=wp.int32)
    """[2 C] next node of the same link."""
    watched: wp.array(dtype=wp.int32)
    """[2 C] bit k: sensor k of the link looks at what pushes."""
    felt: wp.array(dtype=wp.int32)
    """[2 C] bit k: a taxel of it lies near or between the points at which that body pushes from that side."""
    carried: wp.array2d(dtype=wp.int32)
    """[2 C, K] 1 where a taxel of sensor k overlaps the body from that side."""
    other: wp.array(dtype=wp.int32)
    """[2 C] link on the other side, −1 for what is no geometry."""
    geometry: wp.array(dtype=wp.int32)
    """[2 C] geometry on the other side, −1 for none."""
    overlap: wp.array(dtype=wp.float32)
    """[2 C] (m)."""
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


@wp.func
def list_contact(
    plan: SpreadPlan, slots: SlotArrays, link_of: wp.array(dtype=wp.int32), state: StateArrays,
    friction: wp.array(dtype=wp.vec3f), nodes: ContactNodes, node: int, other: int,
):  # fmt: skip
    """List a node whose link carries sensors, if any of them looks at what pushes."""
    c = node // 2
    link = link_of[state.contact_geom[c][node % 2]]
    watched = int(0)
    for k in range(plan.sensors.shape[1]):
        sensor = plan.sensors[link, k]
        if sensor >= 0:
            nodes.carried[node, k] = 0
            looks = plan.whole[sensor] == 1
            if other >= 0:
                looks = slots.place[plan.spans[sensor][2], other] >= 0
            if looks:
                watched = watched | (1 << k)
    if watched == 0:
        return
    env = state.contact_env[c]
    load = state.contact_force[c]
    # The normal leads from the first to the second, which it pushes away.
    sign = wp.where(node % 2 == 0, -1.0, 1.0)
    here = state.pose[env, link]
    turn = wp.transform_get_rotation(here)
    normal = wp.quat_rotate_inv(turn, sign * state.contact_normal[c])
    nodes.watched[node] = watched
    nodes.felt[node] = UNSEEN
    nodes.geometry[node] = other
    nodes.overlap[node] = wp.max(-state.contact_distance[c], 0.0)
    nodes.other[node] = -1
    if other >= 0:
        nodes.other[node] = link_of[other]
    nodes.point[node] = wp.quat_rotate_inv(turn, state.contact_position[c] - wp.transform_get_translation(here))
    nodes.normal[node] = normal
    nodes.load[node] = load
    nodes.force[node] = load * normal + plan.slip * wp.quat_rotate_inv(turn, sign * friction[c])
    nodes.follower[node] = wp.atomic_exch(nodes.head, env, link, node)


@wp.kernel
def list_contacts(
    plan: SpreadPlan, slots: SlotArrays, link_of: wp.array(dtype=wp.int32), state: StateArrays,
    friction: wp.array(dtype=wp.vec3f), stride: int, nodes: ContactNodes,
):  # fmt: skip
    """List the contacts of every link that carries sensors. Thread: contacts [C], ``stride`` apart."""
    c = wp.tid()
    count = wp.min(state.contact_count[0], state.contact_env.shape[0])
    while c < count:
        pair = state.contact_geom[c]
        load = state.contact_force[c]
        nodes.felt[2 * c] = 0
        nodes.felt[2 * c + 1] = 0
        # A state made by hand may hold numbers of no geometry; −1 stands for a flex. What the engine does not tell
        # (NaN) is read as such.
        if not (load <= 0.0) and wp.min(pair) >= -1 and wp.max(pair) < link_of.shape[0]:
            for side in range(2):
                mine = pair[side]
                if mine >= 0:
                    if plan.sensors[link_of[mine], 0] >= 0:
                        list_contact(plan, slots, link_of, state, friction, nodes, 2 * c + side, pair[1 - side])
        c += stride


@wp.func
def alike(nodes: ContactNodes, first: int, second: int) -> bool:
    """Return whether one body pushes at two contacts from one side, within 60°."""
    same = nodes.other[first] == nodes.other[second]
    return same and wp.dot(nodes.normal[first], nodes.normal[second]) > 0.5


@wp.func
def near_taxels(plan: SpreadPlan, probes: ProbeArrays, nodes: ContactNodes, head: int, link: int, node: int) -> int:
    """Return which sensors have taxels near a contact, or between it and others of the same face."""
    # A sphere around all points of the face: a flat one is reported at its corners.
    low = nodes.point[node]
    high = nodes.point[node]
    other = head
    while other >= 0:
        if alike(nodes, node, other):
            low = wp.min(low, nodes.point[other])
            high = wp.max(high, nodes.point[other])
        other = nodes.follower[other]
    center = 0.5 * (low + high)
    extent = 0.5 * wp.length(high - low) + nodes.overlap[node]
    felt = int(0)
    for k in range(plan.sensors.shape[1]):
        if ((nodes.watched[node] >> k) & 1) == 1:
            span = plan.spans[plan.sensors[link, k]]
            for n in range(span[0], span[1]):
                if wp.length(probes.position[n] - center) <= plan.reach[n] + extent:
                    felt = felt | (1 << k)
                    break
    return felt


@wp.kernel
def find_taxels(plan: SpreadPlan, probes: ProbeArrays, nodes: ContactNodes):
    """Bring lists into the order of contacts, so that sums do not depend on threads, and note which sensors have taxels
    near each. Thread: [B, M]."""
    env, number = wp.tid()
    link = plan.links[number]
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
    node = first
    while node >= 0:
        nodes.felt[node] = near_taxels(plan, probes, nodes, first, link, node)
        node = nodes.follower[node]


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


@wp.func
def share_contact(
    plan: SpreadPlan, probes: ProbeArrays, press: PressArrays, nodes: ContactNodes,
    env: int, link: int, node: int, k: int,
):  # fmt: skip
    """Work out what a unit of weight of a sensor carries of a contact.

    One thread adds all taxels of a contact in a fixed order, so that sums do not depend on the device.
    """
    if nodes.felt[node] == UNSEEN or ((nodes.felt[node] >> k) & 1) == 0:
        return
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
                near = nearness(alone, point, push, probes.position[n], m, plan.reach[n])
                if near > 0.0:
                    y = weight * near / total
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
        nodes.carried[node, k] = 1
    nodes.share[node, k] = share


@wp.kernel
def share_contacts(
    plan: SpreadPlan, link_of: wp.array(dtype=wp.int32), state: StateArrays, probes: ProbeArrays, press: PressArrays,
    nodes: ContactNodes,
):  # fmt: skip
    """Share every contact among the taxels of every sensor. Thread: node and sensor of its link [2 C, K]."""
    node, k = wp.tid()
    c = node // 2
    if c < state.contact_count[0] and nodes.felt[node] != 0:
        link = link_of[state.contact_geom[c][node % 2]]
        share_contact(plan, probes, press, nodes, state.contact_env[c], link, node, k)


@wp.func
def write_wrench(out: wp.array3d(dtype=wp.float32), env: int, n: int, x: wp.vec3f, f: wp.vec3f):
    """Write a force at x and its torque about the origin of the link."""
    turn = wp.cross(x, f)
    for axis in range(3):
        out[axis, env, n] = f[axis]
        out[axis + 3, env, n] = turn[axis]


@wp.func
def spread_row(
    plan: SpreadPlan, probes: ProbeArrays, rows: wp.array(dtype=wp.vec4i), press: PressArrays, nodes: ContactNodes,
    noisy: int, written: wp.array2d(dtype=wp.uint8), io: ReadoutArrays, env: int, at_row: int,
):  # fmt: skip
    """Write the readings of a row of taxels."""
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


@wp.kernel
def spread_contacts(
    plan: SpreadPlan, probes: ProbeArrays, rows: wp.array(dtype=wp.vec4i), press: PressArrays, nodes: ContactNodes,
    noisy: int, written: wp.array2d(dtype=wp.uint8), io: ReadoutArrays,
):  # fmt: skip
    """Write the readings. Thread: environment and row of taxels [B, R].

    ``written`` [B, R] is 1 where a row may hold anything but zeros; most touch nothing, now and before.
    """
    env, at_row = wp.tid()
    spread_row(plan, probes, rows, press, nodes, noisy, written, io, env, at_row)


@wp.func
def force_of(planes: wp.array3d(dtype=wp.float32), env: int, n: int) -> wp.vec3f:
    """Return the force of a reading."""
    return wp.vec3f(planes[0, env, n], planes[1, env, n], planes[2, env, n])


@wp.func
def tilted(f: wp.vec3f, x: wp.vec3f, center: wp.vec3f, tilt: wp.vec3f) -> wp.vec3f:
    """Return a force with the part of a tilt about the centre that its size bears."""
    return f + wp.length(f) * wp.cross(tilt, x - center)


@wp.func
def shares(press: PressArrays, env: int, n: int, body: int, push: wp.vec3f) -> bool:
    """Return whether a taxel carries contacts of a body on a side."""
    # All is asked for at once, so that a GPU waits for memory once.
    faces = wp.dot(press.normal[env, n], push) > 0.0
    return press.total[env, n] > 0.0 and press.body[env, n] == body and faces


@wp.func
def tilt_group(
    plan: SpreadPlan, probes: ProbeArrays, nodes: ContactNodes, press: PressArrays, noisy: int, io: ReadoutArrays,
    env: int, sensor: int, k: int, head: int, leader: int,
) -> bool:  # fmt: skip
    """Tilt the forces under one face of a body so that their moment is that of its contacts, their sum the same.

    False where the sum is to be verified: a tilt changed it, or the taxels under it carry other faces as well, or not
    all of it, which are left as they are.
    """
    # The first contact of a face leads it.
    force = wp.vec3f()
    moment = wp.vec3f()
    node = head
    leads = bool(True)
    before = bool(True)
    while node >= 0:
        if node == leader:
            before = False
        if nodes.carried[node, k] == 1 and alike(nodes, node, leader):
            if before:
                leads = False
            force += nodes.force[node]
            moment += wp.cross(nodes.point[node], nodes.force[node])
        node = nodes.follower[node]
    if not leads:
        return True
    body = nodes.other[leader]
    push = nodes.normal[leader]
    span = plan.spans[sensor]
    origin = nodes.point[leader]
    verified = bool(True)
    steepest = float(2.0)
    last = float(1.0e30)
    # One tilt is enough unless the moment takes more than some taxels bear; then the rest is tilted again.
    for _ in range(wp.static(TILTS)):
        if steepest > 1.0:
            total = wp.vec3f()
            weight = float(0.0)
            turning = wp.vec3f()
            center = wp.vec3f()
            spread = wp.mat33f()
            widest = float(0.0)
            for n in range(span[0], span[1]):
                if shares(press, env, n, body, push):
                    f = force_of(io.truth, env, n)
                    size = wp.length(f)
                    x = probes.position[n]
                    total += f
                    turning += wp.cross(x, f)
                    weight += size
                    # From the contact, so that little is lost to rounding.
                    arm = x - origin
                    widest = wp.max(widest, wp.length(arm))
                    center += size * arm
                    spread += size * wp.outer(arm, arm)
            if not (wp.length(total - force) <= 1.0e-4 * weight):
                return False
            # As exact as a hundredth of a millimetre, or nothing won by the last tilt: done.
            rest = wp.length(moment - turning)
            if rest <= 1.0e-5 * weight or rest > 0.9 * last:
                return True
            last = rest
            center = center / weight
            extent = spread[0, 0] + spread[1, 1] + spread[2, 2]
            # Tensor of inertia of the forces' sizes about their centre: the forces |f| θ × r have the moment J θ and
            # the sum 0.
            spread -= weight * wp.outer(center, center)
            trace = spread[0, 0] + spread[1, 1] + spread[2, 2]
            # A little more on its diagonal lets a row of taxels, which bears no moment along it, be solved.
            inertia = 1.0001 * trace * wp.identity(n=3, dtype=wp.float32) - spread
            tilt = wp.vec3f()
            # Taxels at one place bear no moment: what rounding leaves of their inertia is none.
            if trace > 1.0e-4 * extent:
                tilt = wp.inverse(inertia) @ (moment - turning)
            # Most tilts are too small to turn any taxel round, whichever lies farthest.
            steepest = wp.length(tilt) * (widest + wp.length(center))
            center += origin
            if steepest > 1.0:
                steepest = float(0.0)
                for n in range(span[0], span[1]):
                    if shares(press, env, n, body, push):
                        steepest = wp.max(steepest, wp.length(wp.cross(tilt, probes.position[n] - center)))
            # No taxel is turned round: where the patch is too small for the moment, as much as it bears.
            tilt = tilt / wp.max(steepest, 1.0)
            total = wp.vec3f()
            for n in range(span[0], span[1]):
                if shares(press, env, n, body, push):
                    x = probes.position[n]
                    f = tilted(force_of(io.truth, env, n), x, center, tilt)
                    total += f
                    write_wrench(io.truth, env, n, x, f)
                    if noisy == 1:
                        write_wrench(io.measured, env, n, x, tilted(force_of(io.measured, env, n), x, center, tilt))
            verified = wp.length(total - force) <= 1.0e-4 * weight
    return verified


@cache
def settle_kernel(kinds: frozenset[int], raycast: bool, in_turn: bool) -> Any:
    """Return the kernel ``settle``: contacts without a taxel of their body, missing forces, and moments. Dim [B, M].

    One thread goes through the contacts of a link in their order, so that sums do not depend on the device. A processor
    writes the readings ``in_turn`` in the same launch (:func:`spread_contacts`).
    """
    distance = shape_functions(kinds, raycast).distance

    @wp.func
    def overlap_of(
        solids: SolidArrays, pairs: PairArrays, probes: ProbeArrays, env: int, n: int, place: int
    ) -> wp.vec4f:
        """Return outward normal and depth of a taxel in what its list names at ``place``."""
        row = env % solids.kind.shape[0]
        geometry = pairs.geometry[env, place]
        rotation = pairs.rotation[env, place]
        radius = probes.radius[n]
        facing = wp.vec3f()
        limit = float(0.0)
        if wp.static(bool(kinds & SIDED)):
            facing = rotation @ (radius * probes.normal[n])
        if wp.static(raycast or bool(kinds & SIDED)):
            limit = 2.0 * solids.bound[row, geometry][3] + radius
        x = rotation @ probes.position[n] + pairs.offset[env, place]
        found = distance(solids, row, geometry, x, facing, limit)
        m = wp.transpose(rotation) @ wp.vec3f(found[0], found[1], found[2])
        return wp.vec4f(m[0], m[1], m[2], radius - found[3])

    @wp.func
    def weigh(
        plan: SpreadPlan, solids: SolidArrays, pairs: PairArrays, probes: ProbeArrays, nodes: ContactNodes,
        node: int, env: int, n: int, place: int,
    ) -> float:  # fmt: skip
        """Return what a taxel takes of a contact: by overlap with the geometry at ``place``, or −1: by nearness."""
        radius = probes.radius[n]
        if radius <= 0.0:
            return 0.0
        push = nodes.normal[node]
        point = nodes.point[node]
        x = probes.position[n]
        if place >= 0:
            depth = overlap_of(solids, pairs, probes, env, n, place)
            m = wp.vec3f(depth[0], depth[1], depth[2])
            return wp.max(depth[3], 0.0) * nearness(False, point, push, x, m, plan.reach[n])
        # Without a distance the taxel's own normal tells its side.
        away = wp.length(x - point) / (plan.reach[n] + nodes.overlap[node])
        if away > 1.0 or wp.dot(probes.normal[n], push) > 0.1:
            return 0.0
        return 1.001 - away * away

    @wp.kernel(module="unique", enable_backward=False)
    def settle(
        plan: SpreadPlan,
        probes: ProbeArrays,
        rows: wp.array(dtype=wp.vec4i),
        solids: SolidArrays,
        pairs: PairArrays,
        nodes: ContactNodes,
        press: PressArrays,
        noisy: int,
        written: wp.array2d(dtype=wp.uint8),
        io: ReadoutArrays,
    ):
        env, number = wp.tid()
        link = plan.links[number]
        head = nodes.head[env, link]
        if wp.static(in_turn):
            for k in range(plan.sensors.shape[1]):
                sensor = plan.sensors[link, k]
                if sensor >= 0:
                    node = head
                    while node >= 0:
                        share_contact(plan, probes, press, nodes, env, link, node, k)
                        node = nodes.follower[node]
                    for row in range(plan.row_first[sensor], plan.row_first[sensor + 1]):
                        spread_row(plan, probes, rows, press, nodes, noisy, written, io, env, row)
        # The next update lists anew.
        nodes.head[env, link] = -1
        if (io.status[env] & 1) != 0:
            plan.loads[1, env, link] = wp.nan
            return
        if plan.fresh == 1:
            plan.loads[0, env, link] = 0.0
            plan.loads[1, env, link] = 0.0
        if head < 0:
            return
        pushed = float(0.0)
        lost = float(0.0)
        error = float(0.0)
        for k in range(plan.sensors.shape[1]):
            sensor = plan.sensors[link, k]
            if sensor < 0:
                continue
            span = plan.spans[sensor]
            # What a tilt has added up needs no second sum.
            verified = bool(True)
            head_of = head
            while head_of >= 0:
                if nodes.carried[head_of, k] == 1:
                    if not tilt_group(plan, probes, nodes, press, noisy, io, env, sensor, k, head, head_of):
                        verified = False
                head_of = nodes.follower[head_of]
            force = wp.vec3f()
            node = head
            while node >= 0:
                if ((nodes.watched[node] >> k) & 1) == 1:
                    if nodes.carried[node, k] == 0:
                        first = pairs.first[span[2]]
                        place = int(-1)
                        if ((nodes.felt[node] >> k) & 1) == 1:
                            for index in range(pairs.count[env, span[2]]):
                                if pairs.geometry[env, first + index] == nodes.geometry[node]:
                                    place = first + index
                        whole = float(0.0)
                        # Overlap with the body comes first, then taxels near the contact that face it.
                        for way in range(2):
                            if way == 1:
                                place = -1
                            if whole == 0.0 and (way == 1 or place >= 0):
                                for n in range(span[0], span[1]):
                                    whole += weigh(plan, solids, pairs, probes, nodes, node, env, n, place)
                                if whole > 0.0:
                                    nodes.carried[node, k] = 1
                                    verified = False
                                    for row in range(plan.row_first[sensor], plan.row_first[sensor + 1]):
                                        part = rows[row]
                                        n = part[0]
                                        while n < part[1]:
                                            y = weigh(plan, solids, pairs, probes, nodes, node, env, n, place)
                                            if y > 0.0:
                                                x = probes.position[n]
                                                f = y / whole * nodes.force[node]
                                                write_wrench(io.truth, env, n, x, force_of(io.truth, env, n) + f)
                                                if noisy == 1:
                                                    write_wrench(
                                                        io.measured, env, n, x, force_of(io.measured, env, n) + f
                                                    )
                                                written[env, row] = wp.uint8(1)
                                            n += part[2]
                    if nodes.carried[node, k] == 1:
                        force += nodes.force[node]
                node = nodes.follower[node]
            total = wp.vec3f()
            weight = float(0.0)
            for n in range(span[0], span[1]):
                if not verified:
                    f = force_of(io.truth, env, n)
                    total += f
                    weight += wp.length(f)
            gap = wp.length(force - total)
            # Rounding of the sums is no loss.
            if not verified and not (gap <= 1.0e-4 * (weight + wp.length(force))):
                error = wp.max(error, gap)
                if wp.isnan(gap):
                    error = wp.nan
        node = head
        while node >= 0:
            size = wp.length(nodes.force[node])
            carried = int(0)
            for k in range(plan.sensors.shape[1]):
                if plan.sensors[link, k] >= 0:
                    carried += nodes.carried[node, k]
            pushed += size
            if carried == 0:
                lost += size
            node = nodes.follower[node]
        lost += error
        # Sensors of several groups may sit on a link: the most that one of them lacks counts.
        plan.loads[0, env, link] = wp.max(plan.loads[0, env, link], pushed)
        plan.loads[1, env, link] = wp.where(wp.isnan(lost), lost, wp.max(plan.loads[1, env, link], lost))
        if not (lost <= 0.01 * pushed):
            plan.told[0] = 1

    return settle
