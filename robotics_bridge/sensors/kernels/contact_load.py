"""Kernels that spread every contact force of the engine over the taxels that feel it, and count what none feels.

Contacts by which one body pushes a link from one side, within 60°, are a face, with force F, load P along its normal n
and moment M about the middle c of the taxels that carry it. A taxel of weight y = d^α, less where it faces the face by
more than 60° (y = d^α · 2 m · n), at r from c, carries::

    f = y s q + z (b + θ × r),    s = P / Σ z,    b = (F − s Σ y q) / Σ z,    J θ = M − s Σ r × y q

with the outward normal m of what is touched, z = y (m · n), q = m (and m + σ for taxels that hold what they touch,
``stick``) and J = Σ z (r² − r rᵀ), Σ z r = 0, so that Σ f = F and Σ r × f = M whatever the weights are. Where θ would
pull a taxel along n, weights lean over first, y e^(λ · r), until it does not, as far as some taxels bear the moment:
a load beyond the outermost of them has the rest as its missing moment, since taxels push and never pull.

The carriers of a face are, by source: :data:`TOUCH`, taxels that the body
gives their depth, from that side; else :data:`BEHIND`, those that overlap it behind what is nearer (a block on a card);
else :data:`NEAR`, contact by contact, those near its point that face it (a flex, a height field). What is left is
missing. A node is one side of a contact: 2c of the first geometry, 2c + 1 of the second. Vectors are in the link's
frame (m, N). Letters: B environment, L link, M link with sensors, S sensor, C contact, N taxel, K sensor of a link.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays
from robotics_bridge.sensors.kernels.distance import FAR, SIDED, SolidArrays, distance_function
from robotics_bridge.sensors.kernels.pairs import PairArrays, SlotArrays, push_side
from robotics_bridge.sensors.kernels.readout import (
    CLEAN,
    STAGED,
    PressArrays,
    ProbeArrays,
    ReadoutArrays,
    clear,
    group_functions,
    load_four,
    put_push,
    widest_across,
    within,
)

wp = warp()

SORTED, BEYOND = 8, 2**31 - 1  # nodes that a thread sorts at once, and a number beyond all
Nodes = wp.types.vector(length=SORTED, dtype=wp.int32)
ROUNDS = 12  # times that weights lean over at most
STEEPEST, STRIDE = 40.0, 6.0  # largest exponent of a weight, and the most by which a round changes it
ASIDE = 1e-4  # share of a face's normal below which a taxel lies beside it: rounding of a right angle carries nothing
LOUDEST = 2.0  # loads of a contact that a taxel shows at most, whatever its noise
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
    """[3, B, L] sum of the forces that push a link, and what its taxels lack of them (N) and of their moment (N·m)."""
    fresh: wp.array(dtype=wp.int32)
    """[M] 1 in the first group with sensors on a link, which overwrites its loads of the update before."""
    widths: wp.array(dtype=wp.float32)
    """[L] sensing radius of the widest taxel (m)."""
    told: wp.array(dtype=wp.int32)
    """[2] 1 once any force was missing, and once a load lay off by more than that."""


@wp.struct
class Face:
    """Contacts by which one body pushes a link from one side."""

    next: wp.int32
    """First node of the next face of the same link, −1 for none."""
    last: wp.int32
    """Last node of its own."""
    other: wp.int32
    """Link on the other side, −1 for what is no geometry."""
    normal: wp.vec3f
    """Unit, the way its first contact pushes the link."""
    origin: wp.vec3f
    """Point of its first contact."""
    low: wp.vec3f
    """Corner of the box around its points."""
    high: wp.vec3f
    """The opposite one."""
    overlap: wp.float32
    """Deepest (m)."""
    load: wp.float32
    """Sum of normal forces."""
    force: wp.vec3f
    """Sum of forces on the link, friction included."""
    moment: wp.vec3f
    """Of these about the origin, torques of contacts included (N·m)."""


@wp.struct
class ContactFaces:
    """Faces that push the links with sensors, each under the number of its first node."""

    head: wp.array2d(dtype=wp.int32)
    """[B, L] first face of a link, −1 for none."""
    listed: wp.array2d(dtype=wp.int32)
    """[B, L] first node of a link in any order, −1 for none."""
    chain: wp.array(dtype=wp.int32)
    """[2 C] next node of the same link in that order."""
    items: wp.array2d(dtype=wp.vec2i)
    """[2, B M] places (environment, link) with contacts, and their first face; of these, the places where a face needs
    other carriers than those that touch (on a GPU)."""
    count: wp.array(dtype=wp.int32)
    """[2] how many."""
    follower: wp.array(dtype=wp.int32)
    """[2 C] next node of the same face, −1 for none."""
    watched: wp.array(dtype=wp.int32)
    """[2 C] bit k: sensor k of the link looks at what pushes."""
    face: wp.array(dtype=Face)
    """[2 C]."""


@wp.struct
class ContactPush:
    """What a contact does to a link."""

    point: wp.vec3f
    normal: wp.vec3f
    load: wp.float32
    force: wp.vec3f
    couple: wp.vec3f
    overlap: wp.float32
    lean: wp.vec3f
    """λ of the weights that carry it (1/m)."""
    body: wp.int32
    slot: wp.int32
    source: wp.int32
    """Where its carriers come from: link on the other side, slot of the sensor, source."""


@wp.struct
class Carrier:
    """How a taxel takes part in a face."""

    n: wp.int32
    """Its number."""
    x: wp.vec3f
    weight: wp.float32
    noisy: wp.float32
    facing: wp.float32
    """m · n."""
    way: wp.vec3f
    """q."""


@wp.func
def push_of(plan: SpreadPlan, state: StateArrays, env: int, link: int, node: int) -> ContactPush:
    """Return what a node's contact does to its link."""
    c = node // 2
    # The normal leads from the first to the second, which it pushes away.
    sign = wp.where(node % 2 == 0, -1.0, 1.0)
    here = state.pose[env, link]
    turn = wp.transform_get_rotation(here)
    push = ContactPush()
    push.point = wp.quat_rotate_inv(turn, state.contact_position[c] - wp.transform_get_translation(here))
    push.normal = wp.quat_rotate_inv(turn, sign * state.contact_normal[c])
    push.load = state.contact_force[c]
    push.force = push.load * push.normal + plan.slip * wp.quat_rotate_inv(turn, sign * state.contact_friction[c])
    push.couple = plan.slip * wp.quat_rotate_inv(turn, sign * state.contact_couple[c])
    push.overlap = wp.max(-state.contact_distance[c], 0.0)
    return push


@wp.kernel(enable_backward=False)
def list_contacts(
    plan: SpreadPlan, slots: SlotArrays, link_of: wp.array(dtype=wp.int32), state: StateArrays, stride: int,
    faces: ContactFaces,
):  # fmt: skip
    """List the contacts of every link with sensors, in any order. Thread: contacts [C], ``stride`` apart."""
    c = wp.tid()
    if c == 0:
        faces.count[0] = 0
        faces.count[1] = 0
    count = wp.min(state.contact_count[0], state.contact_env.shape[0])
    while c < count:
        pair = state.contact_geom[c]
        # A state made by hand may hold numbers of no geometry; −1 stands for a flex. What the engine does not tell
        # (NaN) is read as such.
        if not (state.contact_force[c] <= 0.0) and wp.min(pair) >= -1 and wp.max(pair) < link_of.shape[0]:
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
                    faces.chain[node] = wp.atomic_exch(faces.listed, state.contact_env[c], link, node)
        c += stride


@wp.kernel(enable_backward=False)
def join_faces(
    plan: SpreadPlan, link_of: wp.array(dtype=wp.int32), state: StateArrays, faces: ContactFaces, io: ReadoutArrays
):
    """Join the nodes to faces in their order, whatever that of threads was, and list links with any. Thread: [B, M]."""
    env, number = wp.tid()
    link = plan.links[number]
    start = faces.listed[env, link]
    faces.listed[env, link] = -1
    faces.head[env, link] = -1
    if plan.fresh[number] == 1:
        for row in range(3):
            plan.loads[row, env, link] = 0.0
    if start < 0:
        return
    head = int(-1)
    latest = int(-1)
    more = bool(True)
    # The face of the latest node, which is written once another follows.
    at = int(-1)
    face = Face()
    while more:
        # The least numbers beyond the latest; what is sorted stays in registers.
        least = Nodes(wp.static(BEYOND))
        node = start
        while node >= 0:
            place = wp.where(node > latest, node, wp.static(BEYOND))
            for k in range(wp.static(SORTED)):
                lower = wp.min(least[k], place)
                place = wp.max(least[k], place)
                least[k] = lower
            node = faces.chain[node]
        more = least[wp.static(SORTED - 1)] != wp.static(BEYOND)
        while least[0] != wp.static(BEYOND):
            latest = least[0]
            push = push_of(plan, state, env, link, latest)
            geometry = state.contact_geom[latest // 2][1 - latest % 2]
            other = int(-1)
            if geometry >= 0:
                other = link_of[geometry]
            before = int(-1)
            place = head
            # The first face of this body and side, or a new one.
            apart = bool(True)
            while place >= 0 and apart:
                there = face
                if place != at:
                    there = faces.face[place]
                apart = not (there.other == other and wp.dot(there.normal, push.normal) > 0.5)
                if apart:
                    before = place
                    place = there.next
            if place < 0 or place != at:
                if at >= 0:
                    faces.face[at] = face
                at = place
                if at >= 0:
                    face = faces.face[at]
                else:
                    at = latest
                    if before < 0:
                        head = at
                    else:
                        faces.face[before].next = at
                    face = Face()
                    face.next = -1
                    face.last = at
                    face.other = other
                    face.normal = push.normal
                    face.origin = push.point
                    face.low = push.point
                    face.high = push.point
            faces.watched[at] = faces.watched[at] | faces.watched[latest]
            faces.follower[face.last] = latest
            faces.follower[latest] = -1
            face.last = latest
            face.low = wp.min(face.low, push.point)
            face.high = wp.max(face.high, push.point)
            face.overlap = wp.max(face.overlap, push.overlap)
            face.load = face.load + push.load
            face.force = face.force + push.force
            face.moment = face.moment + push.couple + wp.cross(push.point - face.origin, push.force)
            for k in range(wp.static(SORTED - 1)):
                least[k] = least[k + 1]
            least[wp.static(SORTED - 1)] = wp.static(BEYOND)
    faces.face[at] = face
    faces.head[env, link] = head
    if (io.status[env] & 1) == 0:
        faces.items[0, wp.atomic_add(faces.count, 0, 1)] = wp.vec2i(env * plan.links.shape[0] + number, head)


@wp.func
def sphere_of(face: Face) -> wp.vec4f:
    """Return centre and radius of the sphere around the points of a face: a flat one is reported at its corners."""
    center = 0.5 * (face.low + face.high)
    return wp.vec4f(center[0], center[1], center[2], 0.5 * wp.length(face.high - face.low) + face.overlap)


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
        there = faces.face[at]
        if there.other == faces.face[face].other:
            facing = wp.dot(m, there.normal)
            away = wp.max(gap_to(sphere_of(there), x), 0.0) / reach
            if facing / (0.01 + away * away) > best:
                best = facing / (0.01 + away * away)
                nearest = at
        at = there.next
    return nearest == face


@cache
def spread_kernel(kinds: frozenset[int], raycast: bool, mode: int, sticky: bool, lanes: int, deep: bool) -> Any:
    """Return the kernel ``spread`` that writes readings and loads. Group of threads: link of an environment.

    The threads of a group share its taxels, and add up what each has found, so that a contact costs no more than the
    taxels of its link divided by them. A processor takes them in one thread.

    Args:
        kinds: of the geometries tracked.
        raycast: ask triangles.
        mode: of the readout.
        sticky: taxels hold what they touch.
        lanes: threads of a group; a processor has one.
        deep: all sources of carriers; a GPU first takes the links where :data:`TOUCH` is enough, which needs fewer
            registers.
    """
    distance_to = distance_function(kinds, raycast)
    cuda, noisy, staged, group = lanes > 1, mode != CLEAN, mode == STAGED, group_functions(lanes)
    total_of, largest_of, rank_of, group_meets = group.total, group.largest, group.rank, group.meet

    @wp.func
    def behind(
        solids: SolidArrays, pairs: PairArrays, probes: ProbeArrays, env: int, n: int, slot: int, body: int
    ) -> wp.vec4f:
        """Return outward normal and distance of what a taxel overlaps of a body most."""
        row = env % solids.solid.shape[0]
        radius = probes.radius[n]
        nearest = wp.vec4f(0.0, 0.0, 1.0, wp.static(FAR))
        first = pairs.first[slot]
        for place in range(first, first + pairs.count[env, slot]):
            geometry = pairs.geometry[env, place]
            if solids.link[geometry] == body:
                rotation = pairs.rotation[env, place]
                facing = wp.vec3f()
                side = float(0.0)
                limit = float(0.0)
                if wp.static(bool(kinds & SIDED)):
                    facing = rotation @ (radius * probes.normal[n])
                    side = push_side(pairs, env, place, probes.normal[n])
                if wp.static(raycast or bool(kinds & SIDED)):
                    limit = 2.0 * solids.solid[row, geometry].bound[3] + radius
                x = rotation @ probes.position[n] + pairs.offset[env, place]
                touch = distance_to(solids.values, solids.solid[row, geometry], x, facing, side, limit)
                if touch[3] < nearest[3]:
                    m = wp.transpose(rotation) @ wp.vec3f(touch[0], touch[1], touch[2])
                    nearest = wp.vec4f(m[0], m[1], m[2], touch[3])
        return nearest

    @wp.func
    def carrier_of(
        plan: SpreadPlan, probes: ProbeArrays, solids: SolidArrays, pairs: PairArrays, faces: ContactFaces,
        press: PressArrays, push: ContactPush, env: int, place: int, rivals: int, face: int,
    ) -> Carrier:  # fmt: skip
        """Return the part of taxel ``place`` (of those listed, or of all) in a push; without weight if it has none."""
        carrier = Carrier()
        touches = push.source == wp.static(TOUCH)
        n = wp.where(touches, press.listed[env, place], place)
        packed = load_four(probes.packed, n)
        carrier.n = n
        carrier.x = wp.vec3f(packed[0], packed[1], packed[2])
        if touches:
            # All is asked for at once.
            touch = load_four(press.touch[env], n)
            body = press.body[env, n]
            carrier.way = wp.vec3f(touch[0], touch[1], touch[2])
            carrier.facing = wp.dot(carrier.way, push.normal)
            if body == push.body and carrier.facing > wp.static(ASIDE):
                if rivals < 0 or belongs(faces, rivals, face, carrier.x, carrier.way, plan.reach[n]):
                    carrier.weight = touch[3]
                    if wp.static(noisy):
                        carrier.noisy = press.noisy[env, n]
                    if wp.static(sticky):
                        carrier.way += press.sigma[env, n]
        elif wp.static(deep):
            radius = packed[3]
            if radius > 0.0 and push.source == wp.static(BEHIND):
                back = behind(solids, pairs, probes, env, n, push.slot, push.body)
                carrier.way = wp.vec3f(back[0], back[1], back[2])
                carrier.facing = wp.dot(carrier.way, push.normal)
                if carrier.facing > wp.static(ASIDE):
                    carrier.weight = wp.max(radius - back[3], 0.0)
            elif radius > 0.0:
                # Without a distance the taxel's own normal tells its side.
                away = wp.length(carrier.x - push.point) / (plan.reach[n] + push.overlap)
                if away <= 1.0 and wp.dot(probes.normal[n], push.normal) <= 0.1:
                    carrier.weight = 1.001 - away * away
                carrier.facing = 1.0
                carrier.way = push.normal
            carrier.noisy = carrier.weight
        if carrier.weight + carrier.noisy > 0.0:
            # Beyond the 60° of a face less and less: the side of a block faces by no more than its tilt, and takes
            # nothing of what pushes its bottom.
            part = wp.min(2.0 * carrier.facing, 1.0)
            steep = wp.dot(push.lean, carrier.x - push.point)
            if steep != 0.0:
                part *= wp.exp(steep)
            carrier.weight *= part
            carrier.noisy *= part
        return carrier

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(32, 8 if deep else 12 if lanes == 32 else 16),
        module_options={"fast_math": cuda and not raycast},
    )
    def spread(
        plan: SpreadPlan, probes: ProbeArrays, link_of: wp.array(dtype=wp.int32), state: StateArrays,
        solids: SolidArrays, pairs: PairArrays, faces: ContactFaces, press: PressArrays, stride: int,
        io: ReadoutArrays,
    ):  # fmt: skip
        item = int(wp.uint32(wp.tid()) // wp.uint32(wp.static(lanes)))
        lane = int(wp.uint32(wp.tid()) % wp.uint32(wp.static(lanes)))
        many = plan.links.shape[0]
        count = faces.count[wp.static(int(cuda and deep))]
        while item < count:
            entry = faces.items[wp.static(int(cuda and deep)), item]
            item += stride
            head = entry[1]
            env = entry[0] // many
            link = plan.links[entry[0] % many]
            written = int(0)
            pushed = float(0.0)
            lost = wp.vec2f()
            left = bool(False)
            # Most taxels touch nothing: the others are listed once, in their order.
            for k in range(plan.sensors.shape[1]):
                sensor = plan.sensors[link, k]
                if sensor >= 0:
                    span = plan.spans[sensor]
                    end = span[0]
                    n = span[0] + lane
                    while n - lane < span[1]:
                        # Asked for together, so that none waits for another.
                        weights = wp.vec4f()
                        for j in range(4):
                            if n + j * wp.static(lanes) < span[1]:
                                weights[j] = press.touch[env, n + j * wp.static(lanes)][3]
                                if wp.static(noisy):
                                    weights[j] += press.noisy[env, n + j * wp.static(lanes)]
                        for j in range(4):
                            rank = rank_of(weights[j] > 0.0)
                            if weights[j] > 0.0:
                                press.listed[env, end + rank[0]] = n + j * wp.static(lanes)
                            end += rank[1]
                        n += wp.static(4 * lanes)
                    press.end[env, sensor] = end
            if wp.static(cuda):
                group_meets()
            here = head
            while here >= 0:
                # Most links touch one body from one side.
                rivals = wp.where(faces.face[head].next < 0, -1, head)
                sphere = sphere_of(faces.face[here])
                normal = faces.face[here].normal
                body = faces.face[here].other
                lack = wp.vec2f(wp.inf, 0.0)
                watched = faces.watched[here]
                for k in range(plan.sensors.shape[1]):
                    if ((watched >> k) & 1) == 0 or left:
                        continue
                    sensor = plan.sensors[link, k]
                    span = plan.spans[sensor]
                    # What this sensor does not carry of the face: force, and size of force and moment.
                    miss = wp.vec3f()
                    rest = wp.vec2f()
                    fresh = ((written >> k) & 1) == 0
                    near = bool(False)
                    source = int(wp.static(TOUCH))
                    node = here
                    while node >= 0:
                        push = ContactPush()
                        push.point = wp.vec3f(sphere[0], sphere[1], sphere[2])
                        push.normal = normal
                        if wp.static(deep):
                            if source == wp.static(NEAR):
                                push = push_of(plan, state, env, link, node)
                        push.body = body
                        push.slot = span[2]
                        push.source = source
                        end = wp.where(source == wp.static(TOUCH), press.end[env, sensor], span[1])
                        rounds = int(0)
                        carried = bool(False)
                        more = bool(True)
                        scale = float(0.0)
                        even = wp.vec3f()
                        tilt = wp.vec3f()
                        center = wp.vec3f()
                        while more:
                            # Sums over taxels: y, y m · n and whether any is near; y q, y a, y a × q; of y a aᵀ
                            # the diagonal and the rest, and the longest a, which leads from the point.
                            first = wp.vec3f()
                            ways = wp.vec3f()
                            places = wp.vec3f()
                            turns = wp.vec3f()
                            squares = wp.vec3f()
                            products = wp.vec3f()
                            most = float(0.0)
                            place = span[0] + lane
                            while place < end:
                                c = carrier_of(
                                    plan, probes, solids, pairs, faces, press, push, env, place, rivals, here
                                )
                                if c.weight > 0.0:
                                    if not near and first[2] == 0.0 and gap_to(sphere, c.x) <= plan.reach[c.n]:
                                        first[2] = 1.0
                                    a = c.x - push.point
                                    most = wp.max(most, wp.length(a))
                                    along = c.weight * c.facing
                                    first += wp.vec3f(c.weight, along, 0.0)
                                    ways += c.weight * c.way
                                    places += along * a
                                    turns += c.weight * wp.cross(a, c.way)
                                    squares += along * wp.cw_mul(a, a)
                                    products += along * wp.vec3f(a[1] * a[2], a[2] * a[0], a[0] * a[1])
                                place += wp.static(lanes)
                            if wp.static(cuda):
                                first = total_of(first)
                                ways = total_of(ways)
                                places = total_of(places)
                                turns = total_of(turns)
                                squares = total_of(squares)
                                products = total_of(products)
                                most = largest_of(most)
                            whole = first[1]
                            near = near or first[2] > 0.0
                            more = False
                            if whole > 0.0 and (near or source == wp.static(NEAR)):
                                carried = True
                                moment = push.couple
                                if source != wp.static(NEAR):
                                    face = faces.face[here]
                                    push.load = face.load
                                    push.force = face.force
                                    moment = face.moment + wp.cross(face.origin - push.point, push.force)
                                # Taxels that face away by more than 60° on average would be stretched beyond all
                                # measure; b then carries what is missing.
                                scale = push.load / wp.max(whole, 0.5 * first[0])
                                # Normals of a face differ: what is along the first is the load less a little.
                                mean = wp.max(wp.dot(push.force, push.normal), 1.0e-6 * push.load) / whole
                                center = places / whole
                                even = (push.force - scale * ways) / whole
                                moment -= scale * turns + whole * wp.cross(center, even)
                                # Shares of the weights and of their extent, lest squares of small numbers vanish.
                                moment /= whole
                                extents = wp.mat33f(
                                    squares[0], products[2], products[1], products[2], squares[1], products[0],
                                    products[1], products[0], squares[2],
                                ) / whole  # fmt: skip
                                extent = extents[0, 0] + extents[1, 1] + extents[2, 2]
                                extents -= wp.outer(center, center)
                                trace = extents[0, 0] + extents[1, 1] + extents[2, 2]
                                # A little more on its diagonal lets a row of taxels, which bears no moment along
                                # it, be solved; what rounding leaves of taxels at one place is none.
                                tilt = wp.vec3f()
                                inertia = wp.mat33f()
                                if trace > 1.0e-4 * extent:
                                    inertia = (1.0001 * trace) * wp.identity(n=3, dtype=wp.float32) - extents
                                    tilt = wp.inverse(inertia / trace) @ moment / trace
                                # No taxel is pulled, however far it lies: else the tilt moves into the weights,
                                # y e^(λ · r) for y (1 + λ · r). What turns about the normal pulls none, and drags
                                # no more than the load pushes.
                                far = most + wp.length(center)
                                spin = wp.dot(tilt, push.normal)
                                tilt -= spin * push.normal
                                spin = wp.clamp(spin, -mean / far, mean / far)
                                lean = wp.cross(push.normal, tilt) * (far / mean)
                                if wp.length(lean) > 1.0:
                                    # Along their spread and across it by themselves: nothing bears across it what
                                    # presses beside the outermost, which keeps its place along it.
                                    long = widest_across(extents, push.normal)
                                    tilt = wp.cross(within(lean, push.normal, long, 0.7), push.normal) * (mean / far)
                                    rounds += 1
                                    more = rounds < wp.static(ROUNDS)
                                    if more:
                                        # From weights on the wrong side a whole step of Newton's leaps over the right
                                        # ones, to and fro.
                                        lean = within(lean, push.normal, long, wp.static(STRIDE)) + far * push.lean
                                        push.lean = within(lean, push.normal, long, wp.static(STEEPEST)) / far
                                tilt += spin * push.normal
                                if not more:
                                    rest[1] += whole * wp.length(moment - inertia @ tilt)
                        if carried:
                            center += push.point
                            total = wp.vec3f()
                            place = span[0] + lane
                            while place < end:
                                c = carrier_of(
                                    plan, probes, solids, pairs, faces, press, push, env, place, rivals, here
                                )
                                if c.weight + c.noisy > 0.0:
                                    unit = scale * c.way + c.facing * (even + wp.cross(tilt, c.x - center))
                                    total += c.weight * unit
                                    put_push(io.truth, env, c.n, c.x, c.weight * unit, not fresh)
                                    if wp.static(noisy):
                                        # Radius noise of a taxel that hardly touches is beyond all that it weighs.
                                        loudest = wp.static(LOUDEST) * wp.length(push.force)
                                        force = wp.min(c.noisy, loudest / wp.max(wp.length(unit), 1.0e-30)) * unit
                                        # Until it is filled, what is measured may be anything.
                                        adds = not fresh and press.filled[env, c.n] != wp.uint8(0)
                                        put_push(io.measured, env, c.n, c.x, force, adds)
                                    press.filled[env, c.n] = wp.uint8(1)
                                elif fresh:
                                    clear(press, io, env, c.n, wp.static(staged))
                                place += wp.static(lanes)
                            if wp.static(cuda):
                                total = total_of(total)
                            written = written | (1 << k)
                            fresh = False
                            # Rounding of the sums is no loss.
                            if not (wp.length(push.force - total) <= 1.0e-4 * wp.length(push.force)):
                                miss += push.force - total
                            node = wp.where(source == wp.static(NEAR), faces.follower[node], -1)
                        elif source == wp.static(NEAR):
                            miss += push.force
                            node = faces.follower[node]
                        elif wp.static(deep):
                            source += 1
                        else:
                            left = True
                            node = -1
                    rest[0] = wp.length(miss)
                    # Sensors of a link need not all feel it: the best counts, whatever their order.
                    if not (rest[0] > lack[0] or (rest[0] == lack[0] and rest[1] >= lack[1])):
                        lack = rest
                pushed += wp.length(faces.face[here].force)
                lost += lack
                here = wp.where(left, -1, faces.face[here].next)
            if wp.static(not deep):
                if left:
                    if lane == 0:
                        faces.items[1, wp.atomic_add(faces.count, 1, 1)] = entry
                    continue
            for k in range(plan.sensors.shape[1]):
                sensor = plan.sensors[link, k]
                if sensor >= 0 and ((written >> k) & 1) == 0:
                    place = plan.spans[sensor][0] + lane
                    while place < press.end[env, sensor]:
                        clear(press, io, env, press.listed[env, place], wp.static(staged))
                        place += wp.static(lanes)
            if lane == 0:
                # Sensors of several groups may sit on a link: the most that one of them lacks counts.
                plan.loads[0, env, link] = wp.max(plan.loads[0, env, link], pushed)
                for row in range(2):
                    most = wp.max(plan.loads[1 + row, env, link], lost[row])
                    plan.loads[1 + row, env, link] = wp.where(wp.isnan(lost[row]), lost[row], most)
                if not (lost[0] <= 0.01 * pushed):
                    plan.told[0] = 1
                if not (lost[1] <= plan.widths[link] * pushed):
                    plan.told[1] = 1

    return spread
