"""Kernels that spread every contact force of the engine over the taxels that feel it, and count what none feels.

Contacts by which one body pushes a link from one side, within 60°, are a face, with force F, load P along its normal n
and moment M about the middle c of the taxels that carry it. A taxel of weight y = d^α, at r from c, carries::

    f = y (s q + b + θ × r),    s = P / Σ y (m · n),    b = (F − s Σ y q) / Σ y,    J θ = M − s Σ r × y q

with the outward normal m of what is touched, q = m (and m + σ for taxels that hold what they touch, ``stick``) and
J = Σ y (r² − r rᵀ), so that Σ f = F and Σ r × f = M whatever the weights are. Where θ would pull a taxel, weights lean
over first, y e^(λ · r), until it does not, as far as some taxels bear the moment.

The carriers of a face are, by source: :data:`TOUCH`, taxels that the body
gives their depth, from that side; else :data:`BEHIND`, those that overlap it behind what is nearer (a block on a card);
else :data:`NEAR`, contact by contact, those near its point that face it (a flex, a height field). What is left is
missing. A node is one side of a contact: 2c of the first geometry, 2c + 1 of the second. Vectors are in the frame of
the sensor link (m, N). Letters: B environment, L link, M link with sensors, S sensor, C contact, N taxel, K sensor of
one link.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays
from robotics_bridge.sensors.kernels.distance import FAR, SIDED, SolidArrays, shape_functions
from robotics_bridge.sensors.kernels.pairs import PairArrays, SlotArrays
from robotics_bridge.sensors.kernels.readout import ProbeArrays, ReadoutArrays, load_planes, silenced, store_planes

wp = warp()

ROUNDS = 6  # times that weights lean over at most
STEEPEST = 10.0  # largest exponent of a weight
TOUCH, BEHIND, NEAR = range(3)  # sources of carriers


@wp.struct
class SpreadPlan:
    """Sensors whose taxels share the contact forces of their link."""

    sensors: wp.array2d(dtype=wp.int32)
    """[L, K] sensors of every link, −1 for none."""
    link: wp.array(dtype=wp.int32)
    """[S] link of a sensor."""
    spans: wp.array(dtype=wp.vec3i)
    """[S] first taxel, end and slot of the pair lists."""
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
    fresh: wp.array(dtype=wp.int32)
    """[M] 1 in the first group with sensors on a link, which overwrites its loads of the update before."""
    told: wp.array(dtype=wp.int32)
    """[1] 1 once anything was missing."""


@wp.struct
class ContactFaces:
    """Faces that push the links with sensors, each under the number of its first node."""

    head: wp.array2d(dtype=wp.int32)
    """[B, L] first face of a link, −1 for none."""
    listed: wp.array2d(dtype=wp.int32)
    """[B, L] first node of a link in any order, −1 for none (on a GPU)."""
    items: wp.array(dtype=wp.int32)
    """[B M] places (environment, link) at which there is something to write (on a GPU)."""
    count: wp.array(dtype=wp.int32)
    """[1] how many."""
    stale: wp.array2d(dtype=wp.int32)
    """[B, M] 1 where readings may be anything but zeros."""
    filled: wp.array2d(dtype=wp.uint8)
    """[B, N] 1 where a reading is anything but zeros."""
    follower: wp.array(dtype=wp.int32)
    """[2 C] next node of the same face, −1 for none."""
    watched: wp.array(dtype=wp.int32)
    """[2 C] bit k: sensor k of the link looks at what pushes."""
    next: wp.array(dtype=wp.int32)
    """[2 C] next face of the same link, −1 for none."""
    last: wp.array(dtype=wp.int32)
    """[2 C] last node of a face."""
    other: wp.array(dtype=wp.int32)
    """[2 C] link on the other side, −1 for what is no geometry."""
    normal: wp.array(dtype=wp.vec3f)
    """[2 C] unit, the way its first contact pushes the link."""
    origin: wp.array(dtype=wp.vec3f)
    """[2 C] point of its first contact."""
    low: wp.array(dtype=wp.vec3f)
    """[2 C] corner of the box around its points."""
    high: wp.array(dtype=wp.vec3f)
    """[2 C] the opposite one."""
    overlap: wp.array(dtype=wp.float32)
    """[2 C] deepest (m)."""
    load: wp.array(dtype=wp.float32)
    """[2 C] sum of normal forces."""
    force: wp.array(dtype=wp.vec3f)
    """[2 C] sum of forces on the link, friction included."""
    moment: wp.array(dtype=wp.vec3f)
    """[2 C] of these about the origin (N·m)."""


@wp.struct
class PressArrays:
    """Contact of every taxel."""

    weight: wp.array2d(dtype=wp.float32)
    """[B, N] d^α."""
    noisy: wp.array2d(dtype=wp.float32)
    """[B, N] the same with radius noise and gain."""
    normal: wp.array2d(dtype=wp.vec3f)
    """[B, N] outward normal m of what is touched, where a weight is above 0."""
    sigma: wp.array2d(dtype=wp.vec3f)
    """[B, N] σ: friction at rest over normal force, where taxels hold what they touch."""
    body: wp.array2d(dtype=wp.int32)
    """[B, N] its link."""


@wp.struct
class ContactPush:
    """What a contact does to a link."""

    point: wp.vec3f
    normal: wp.vec3f
    load: wp.float32
    force: wp.vec3f
    overlap: wp.float32
    lean: wp.vec3f
    """λ of the weights that carry it (1/m)."""


@wp.struct
class Carrier:
    """How a taxel takes part in a face."""

    weight: wp.float32
    noisy: wp.float32
    facing: wp.float32
    """m · n."""
    way: wp.vec3f
    """q."""


@wp.func
def push_of(
    plan: SpreadPlan, state: StateArrays, friction: wp.array(dtype=wp.vec3f), link: int, node: int
) -> ContactPush:
    """Return what a node's contact does to its link."""
    c = node // 2
    # The normal leads from the first to the second, which it pushes away.
    sign = wp.where(node % 2 == 0, -1.0, 1.0)
    here = state.pose[state.contact_env[c], link]
    turn = wp.transform_get_rotation(here)
    push = ContactPush()
    push.point = wp.quat_rotate_inv(turn, state.contact_position[c] - wp.transform_get_translation(here))
    push.normal = wp.quat_rotate_inv(turn, sign * state.contact_normal[c])
    push.load = state.contact_force[c]
    push.force = push.load * push.normal + plan.slip * wp.quat_rotate_inv(turn, sign * friction[c])
    push.overlap = wp.max(-state.contact_distance[c], 0.0)
    return push


@wp.func
def join_face(
    plan: SpreadPlan, link_of: wp.array(dtype=wp.int32), state: StateArrays, friction: wp.array(dtype=wp.vec3f),
    faces: ContactFaces, env: int, link: int, node: int,
):  # fmt: skip
    """Add a node to the face of its body and side, or begin one."""
    push = push_of(plan, state, friction, link, node)
    geometry = state.contact_geom[node // 2][1 - node % 2]
    other = int(-1)
    if geometry >= 0:
        other = link_of[geometry]
    before = int(-1)
    face = int(-1)
    at = faces.head[env, link]
    while at >= 0:
        before = at
        if faces.other[at] == other and wp.dot(faces.normal[at], push.normal) > 0.5:
            face = at
            at = int(-1)
        else:
            at = faces.next[at]
    faces.follower[node] = -1
    if face < 0:
        face = node
        if before < 0:
            faces.head[env, link] = node
        else:
            faces.next[before] = node
        faces.next[node] = -1
        faces.other[node] = other
        faces.normal[node] = push.normal
        faces.origin[node] = push.point
        faces.low[node] = push.point
        faces.high[node] = push.point
        faces.overlap[node] = push.overlap
        faces.load[node] = push.load
        faces.force[node] = push.force
        faces.moment[node] = wp.vec3f()
    else:
        faces.follower[faces.last[face]] = node
        faces.watched[face] = faces.watched[face] | faces.watched[node]
        faces.low[face] = wp.min(faces.low[face], push.point)
        faces.high[face] = wp.max(faces.high[face], push.point)
        faces.overlap[face] = wp.max(faces.overlap[face], push.overlap)
        faces.load[face] = faces.load[face] + push.load
        faces.force[face] = faces.force[face] + push.force
        faces.moment[face] = faces.moment[face] + wp.cross(push.point - faces.origin[face], push.force)
    faces.last[face] = node


@cache
def list_kernel(cuda: bool) -> Any:
    """Return the kernel ``list_contacts``. Thread: contacts [C], ``stride`` apart.

    A processor takes all in one thread and joins faces at once; a GPU does so afterwards, in the order of contacts
    (:func:`join_faces`), so that sums do not depend on threads.
    """

    @wp.kernel(module="unique", enable_backward=False)
    def list_contacts(
        plan: SpreadPlan, slots: SlotArrays, link_of: wp.array(dtype=wp.int32), state: StateArrays,
        friction: wp.array(dtype=wp.vec3f), stride: int, faces: ContactFaces,
    ):  # fmt: skip
        c = wp.tid()
        if c == 0:
            faces.count[0] = 0
        count = wp.min(state.contact_count[0], state.contact_env.shape[0])
        while c < count:
            pair = state.contact_geom[c]
            # A state made by hand may hold numbers of no geometry; −1 stands for a flex. What the engine does not tell
            # (NaN) is read as such.
            if not (state.contact_force[c] <= 0.0) and wp.min(pair) >= -1 and wp.max(pair) < link_of.shape[0]:
                env = state.contact_env[c]
                for side in range(2):
                    link = int(0)
                    watched = int(0)
                    other = pair[1 - side]
                    if pair[side] >= 0:
                        link = link_of[pair[side]]
                        for k in range(plan.sensors.shape[1]):
                            sensor = plan.sensors[link, k]
                            if sensor >= 0:
                                looks = plan.whole[sensor] == 1
                                if other >= 0:
                                    looks = slots.place[plan.spans[sensor][2], other] >= 0
                                if looks:
                                    watched = watched | (1 << k)
                    if watched != 0:
                        node = 2 * c + side
                        faces.watched[node] = watched
                        if wp.static(cuda):
                            faces.follower[node] = wp.atomic_exch(faces.listed, env, link, node)
                        else:
                            join_face(plan, link_of, state, friction, faces, env, link, node)
            c += stride

    return list_contacts


@wp.kernel(enable_backward=False)
def join_faces(
    plan: SpreadPlan, link_of: wp.array(dtype=wp.int32), state: StateArrays, friction: wp.array(dtype=wp.vec3f),
    noisy: int, faces: ContactFaces, io: ReadoutArrays,
):  # fmt: skip
    """Join the listed nodes to faces in their order, and list the links that have any. Thread: [B, M]."""
    env, number = wp.tid()
    link = plan.links[number]
    first = int(-1)
    node = faces.listed[env, link]
    while node >= 0:
        later = faces.follower[node]
        before = int(-1)
        after = first
        while after >= 0 and after < node:
            before = after
            after = faces.follower[after]
        faces.follower[node] = after
        if before < 0:
            first = node
        else:
            faces.follower[before] = node
        node = later
    faces.listed[env, link] = -1
    faces.head[env, link] = -1
    node = first
    while node >= 0:
        later = faces.follower[node]
        join_face(plan, link_of, state, friction, faces, env, link, node)
        node = later
    full = first >= 0 or (io.status[env] & 1) != 0
    if full or faces.stale[env, number] == 1:
        faces.items[wp.atomic_add(faces.count, 0, 1)] = env * plan.links.shape[0] + number
    elif plan.fresh[number] == 1:
        plan.loads[0, env, link] = 0.0
        plan.loads[1, env, link] = 0.0
    faces.stale[env, number] = wp.where(full or noisy == 1, 1, 0)


@wp.func
def wrench_at(x: wp.vec3f, f: wp.vec3f) -> wp.spatial_vectorf:
    """Return a force at x with its torque about the origin."""
    turn = wp.cross(x, f)
    return wp.spatial_vectorf(f[0], f[1], f[2], turn[0], turn[1], turn[2])


@wp.func
def sphere_of(faces: ContactFaces, face: int) -> wp.vec4f:
    """Return centre and radius of the sphere around the points of a face: a flat one is reported at its corners."""
    low = faces.low[face]
    high = faces.high[face]
    center = 0.5 * (low + high)
    return wp.vec4f(center[0], center[1], center[2], 0.5 * wp.length(high - low) + faces.overlap[face])


@wp.func
def gap_to(sphere: wp.vec4f, x: wp.vec3f) -> float:
    """Return how far a point lies from a sphere, negative inside."""
    return wp.length(x - wp.vec3f(sphere[0], sphere[1], sphere[2])) - sphere[3]


@wp.func
def belongs(faces: ContactFaces, head: int, face: int, x: wp.vec3f, m: wp.vec3f, reach: float) -> bool:
    """Return whether a taxel at ``x`` carries a face of the body that it touches: one that pushes it, the nearest."""
    best = float(0.0)
    nearest = int(-1)
    at = head
    while at >= 0:
        if faces.other[at] == faces.other[face]:
            facing = wp.dot(m, faces.normal[at])
            away = wp.max(gap_to(sphere_of(faces, at), x), 0.0) / reach
            if facing / (0.01 + away * away) > best:
                best = facing / (0.01 + away * away)
                nearest = at
        at = faces.next[at]
    return nearest == face


@cache
def spread_kernel(kinds: frozenset[int], raycast: bool, noisy: bool, sticky: bool, cuda: bool) -> Any:
    """Return the kernel ``spread`` that writes readings and loads. Block: link of an environment, ``stride`` apart.

    The threads of a block share its taxels, and add up what each has found, so that a contact costs no more than the
    taxels of its link divided by them. A processor takes them in one thread.
    """
    distance = shape_functions(kinds, raycast).distance

    @wp.func
    def behind(
        solids: SolidArrays, pairs: PairArrays, probes: ProbeArrays, env: int, n: int, slot: int, body: int
    ) -> wp.vec4f:
        """Return outward normal and distance of what a taxel overlaps of a body most."""
        row = env % solids.kind.shape[0]
        radius = probes.radius[n]
        nearest = wp.vec4f(0.0, 0.0, 1.0, wp.static(FAR))
        first = pairs.first[slot]
        for place in range(first, first + pairs.count[env, slot]):
            geometry = pairs.geometry[env, place]
            if solids.link[geometry] == body:
                rotation = pairs.rotation[env, place]
                facing = wp.vec3f()
                limit = float(0.0)
                if wp.static(bool(kinds & SIDED)):
                    facing = rotation @ (radius * probes.normal[n])
                if wp.static(raycast or bool(kinds & SIDED)):
                    limit = 2.0 * solids.bound[row, geometry][3] + radius
                x = rotation @ probes.position[n] + pairs.offset[env, place]
                touch = distance(solids, row, geometry, x, facing, limit)
                if touch[3] < nearest[3]:
                    m = wp.transpose(rotation) @ wp.vec3f(touch[0], touch[1], touch[2])
                    nearest = wp.vec4f(m[0], m[1], m[2], touch[3])
        return nearest

    @wp.func
    def carrier_of(
        plan: SpreadPlan, probes: ProbeArrays, solids: SolidArrays, pairs: PairArrays, faces: ContactFaces,
        press: PressArrays, push: ContactPush, env: int, n: int, slot: int, head: int, alone: bool, face: int,
        source: int,
    ) -> Carrier:  # fmt: skip
        carrier = Carrier()
        x = probes.position[n]
        radius = probes.radius[n]
        if radius > 0.0:
            if source == wp.static(TOUCH):
                weight = press.weight[env, n]
                extra = float(0.0)
                if wp.static(noisy):
                    extra = press.noisy[env, n]
                if weight + extra > 0.0:
                    m = press.normal[env, n]
                    mine = press.body[env, n] == faces.other[face]
                    facing = wp.dot(m, faces.normal[face])
                    if mine and not alone:
                        mine = belongs(faces, head, face, x, m, plan.reach[n])
                    if mine and facing > 0.0:
                        carrier.weight = weight
                        carrier.noisy = extra
                        carrier.facing = facing
                        carrier.way = m
                        if wp.static(sticky):
                            carrier.way = m + press.sigma[env, n]
            elif source == wp.static(BEHIND):
                touch = behind(solids, pairs, probes, env, n, slot, faces.other[face])
                carrier.way = wp.vec3f(touch[0], touch[1], touch[2])
                carrier.facing = wp.dot(carrier.way, faces.normal[face])
                if carrier.facing > 0.0:
                    carrier.weight = wp.max(radius - touch[3], 0.0)
            else:
                # Without a distance the taxel's own normal tells its side.
                away = wp.length(x - push.point) / (plan.reach[n] + push.overlap)
                if away <= 1.0 and wp.dot(probes.normal[n], push.normal) <= 0.1:
                    carrier.weight = 1.001 - away * away
                carrier.facing = 1.0
                carrier.way = push.normal
            if source != wp.static(TOUCH):
                carrier.noisy = carrier.weight
            steep = wp.dot(push.lean, x - push.point)
            if steep != 0.0 and carrier.weight + carrier.noisy > 0.0:
                carrier.weight *= wp.exp(steep)
                carrier.noisy *= wp.exp(steep)
        return carrier

    @wp.func
    def clear(faces: ContactFaces, io: ReadoutArrays, env: int, n: int):
        if faces.filled[env, n] != wp.uint8(0):
            store_planes(io.truth, env, n, 6, wp.spatial_vectorf())
            faces.filled[env, n] = wp.uint8(0)
        # Stages after this one write into the measured readings, which are then never left alone.
        if wp.static(noisy):
            store_planes(io.measured, env, n, 6, wp.spatial_vectorf())

    @wp.kernel(module="unique", enable_backward=False)
    def spread(
        plan: SpreadPlan,
        probes: ProbeArrays,
        link_of: wp.array(dtype=wp.int32),
        state: StateArrays,
        friction: wp.array(dtype=wp.vec3f),
        solids: SolidArrays,
        pairs: PairArrays,
        faces: ContactFaces,
        press: PressArrays,
        stride: int,
        io: ReadoutArrays,
    ):
        item, lane = wp.tid()
        threads = wp.block_dim()
        many = plan.links.shape[0]
        count = io.status.shape[0] * many
        if wp.static(cuda):
            count = faces.count[0]
        while item < count:
            at = item
            if wp.static(cuda):
                at = faces.items[item]
            item += stride
            env = at // many
            link = plan.links[at % many]
            head = faces.head[env, link]
            diverged = (io.status[env] & 1) != 0
            if wp.static(not cuda):
                full = head >= 0 or diverged
                stale = faces.stale[env, at % many] == 1
                faces.stale[env, at % many] = wp.where(full or wp.static(noisy), 1, 0)
                # The next update lists anew.
                faces.head[env, link] = -1
                if not full and not stale:
                    if plan.fresh[at % many] == 1:
                        plan.loads[0, env, link] = 0.0
                        plan.loads[1, env, link] = 0.0
                    continue
            written = int(0)
            pushed = float(0.0)
            lost = float(0.0)
            face = head
            if diverged:
                face = -1
            while face >= 0:
                alone = face == head and faces.next[face] < 0
                sphere = sphere_of(faces, face)
                size = wp.length(faces.force[face])
                lack = size
                for k in range(plan.sensors.shape[1]):
                    if ((faces.watched[face] >> k) & 1) == 1:
                        sensor = plan.sensors[link, k]
                        span = plan.spans[sensor]
                        # What this sensor does not carry of the face.
                        rest = float(0.0)
                        fresh = ((written >> k) & 1) == 0
                        near = bool(False)
                        source = int(wp.static(TOUCH))
                        solved = bool(False)
                        node = face
                        rounds = int(0)
                        lean = wp.vec3f()
                        tilt = wp.vec3f()
                        even = wp.vec3f()
                        center = wp.vec3f()
                        scale = float(0.0)
                        while node >= 0:
                            push = ContactPush()
                            push.point = wp.vec3f(sphere[0], sphere[1], sphere[2])
                            push.normal = faces.normal[face]
                            push.load = faces.load[face]
                            push.force = faces.force[face]
                            moment = faces.moment[face] + wp.cross(faces.origin[face] - push.point, push.force)
                            if source == wp.static(NEAR):
                                push = push_of(plan, state, friction, link, node)
                                moment = wp.vec3f()
                            push.lean = lean
                            # Sums over taxels: y, y m · n and whether any is near; columns y q, y a, y a × q; y a aᵀ,
                            # with a from the point.
                            first = wp.vec3f()
                            second = wp.mat33f()
                            third = wp.mat33f()
                            most = float(0.0)
                            total = wp.vec3f()
                            n = span[0] + lane
                            while n < span[1]:
                                # Called at one place alone, so that a processor's compiler copies no structures.
                                c = carrier_of(
                                    plan, probes, solids, pairs, faces, press, push, env, n, span[2], head, alone,
                                    face, source,
                                )  # fmt: skip
                                x = probes.position[n]
                                if not solved:
                                    if not near and first[2] == 0.0 and gap_to(sphere, x) <= plan.reach[n]:
                                        first[2] = 1.0
                                    if c.weight > 0.0:
                                        a = x - push.point
                                        most = wp.max(most, wp.length(a))
                                        first += c.weight * wp.vec3f(1.0, c.facing, 0.0)
                                        second += c.weight * wp.matrix_from_cols(c.way, a, wp.cross(a, c.way))
                                        third += c.weight * wp.outer(a, a)
                                elif c.weight + c.noisy > 0.0:
                                    unit = scale * c.way + even + wp.cross(tilt, x - center)
                                    total += c.weight * unit
                                    reading = wrench_at(x, c.weight * unit)
                                    if not fresh:
                                        reading += load_planes(io.truth, env, n, 6)
                                    store_planes(io.truth, env, n, 6, reading)
                                    if wp.static(noisy):
                                        reading = wrench_at(x, c.noisy * unit)
                                        if not fresh:
                                            reading += load_planes(io.measured, env, n, 6)
                                        store_planes(io.measured, env, n, 6, reading)
                                    faces.filled[env, n] = wp.uint8(1)
                                elif fresh:
                                    clear(faces, io, env, n)
                                n += threads
                            if not solved:
                                first = wp.tile_sum(wp.tile(first, preserve_type=True))[0]
                                whole = first[0]
                                near = near or first[2] > 0.0
                                if whole > 0.0 and (near or source == wp.static(NEAR)):
                                    second = wp.tile_sum(wp.tile(second, preserve_type=True))[0]
                                    third = wp.tile_sum(wp.tile(third, preserve_type=True))[0]
                                    most = wp.tile_max(wp.tile(most))[0]
                                    # Taxels that face away by more than 60° on average would be stretched beyond all
                                    # measure; b then carries what is missing.
                                    scale = push.load / wp.max(first[1], 0.5 * whole)
                                    mean = push.load / whole
                                    field = wp.vec3f(second[0, 0], second[1, 0], second[2, 0])
                                    center = wp.vec3f(second[0, 1], second[1, 1], second[2, 1]) / whole
                                    turning = wp.vec3f(second[0, 2], second[1, 2], second[2, 2])
                                    even = (push.force - scale * field) / whole
                                    moment -= scale * turning + whole * wp.cross(center, even)
                                    # Shares of the weights and of their extent, lest squares of small numbers vanish.
                                    moment /= whole
                                    third /= whole
                                    extent = third[0, 0] + third[1, 1] + third[2, 2]
                                    third -= wp.outer(center, center)
                                    trace = third[0, 0] + third[1, 1] + third[2, 2]
                                    # A little more on its diagonal lets a row of taxels, which bears no moment along
                                    # it, be solved; what rounding leaves of taxels at one place is none.
                                    tilt = wp.vec3f()
                                    if trace > 1.0e-4 * extent:
                                        inertia = 1.0001 * wp.identity(n=3, dtype=wp.float32) - third / trace
                                        tilt = wp.inverse(inertia) @ moment / trace
                                    # No taxel is pulled, however far it lies: what is beyond half of that moves into
                                    # the weights, y e^(λ · r) for y (1 + λ · r).
                                    solved = True
                                    far = most + wp.length(center)
                                    steepest = wp.length(tilt) * far / mean
                                    if steepest > 1.0:
                                        tilt /= steepest
                                        rounds += 1
                                        solved = rounds == wp.static(ROUNDS)
                                        if not solved:
                                            lean += (steepest - 0.5) / mean * wp.cross(push.normal, tilt)
                                            lean *= wp.min(wp.static(STEEPEST) / (far * wp.length(lean)), 1.0)
                                    center += push.point
                                elif source == wp.static(NEAR):
                                    rest += wp.length(push.force)
                                    node = faces.follower[node]
                                else:
                                    source = wp.where(near, source + 1, wp.static(NEAR))
                            else:
                                written = written | (1 << k)
                                fresh = False
                                total = wp.tile_sum(wp.tile(total, preserve_type=True))[0]
                                gap = wp.length(push.force - total)
                                # Rounding of the sums is no loss.
                                if not (gap <= 1.0e-4 * wp.length(push.force)):
                                    rest += gap
                                solved = False
                                rounds = 0
                                lean = wp.vec3f()
                                node = wp.where(source == wp.static(NEAR), faces.follower[node], -1)
                        # Sensors of a link need not all feel it.
                        if not (rest >= lack):
                            lack = rest
                pushed += size
                lost += lack
                face = faces.next[face]
            for k in range(plan.sensors.shape[1]):
                sensor = plan.sensors[link, k]
                if sensor >= 0 and ((written >> k) & 1) == 0:
                    span = plan.spans[sensor]
                    n = span[0] + lane
                    while n < span[1]:
                        if diverged:
                            silenced(io, 6, env, n, probes.radius[n])
                            faces.filled[env, n] = wp.uint8(1)
                        else:
                            clear(faces, io, env, n)
                        n += threads
            if lane == 0:
                if plan.fresh[at % many] == 1:
                    plan.loads[0, env, link] = 0.0
                    plan.loads[1, env, link] = 0.0
                # Sensors of several groups may sit on a link: the most that one of them lacks counts.
                plan.loads[0, env, link] = wp.max(plan.loads[0, env, link], pushed)
                if diverged:
                    lost = wp.nan
                plan.loads[1, env, link] = wp.where(wp.isnan(lost), lost, wp.max(plan.loads[1, env, link], lost))
                if not diverged and not (lost <= 0.01 * pushed):
                    plan.told[0] = 1

    return spread
