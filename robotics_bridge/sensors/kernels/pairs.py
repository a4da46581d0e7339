"""Lists of the geometries that a sensor link meets in every environment, with their relative pose and motion.

A slot is one sensor link with the geometries it may meet. Its list holds, per environment, those in contact (or all
that are near), each with the transform from link to geometry frame and the relative velocity, so that taxels need no
pose arithmetic of their own. Letters: B environment, S slot, P place in the lists of all slots, W word of touch bits.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays, in_scene, link_fails
from robotics_bridge.sensors.kernels.distance import PLANE, SolidArrays

wp = warp()


UNIT = 1.0e4  # whole number that a component of a normal of 1 is added as


@wp.struct
class SlotArrays:
    """Plan of who may meet whom."""

    link: wp.array(dtype=wp.int32)
    """[S] sensor link."""
    watched: wp.array(dtype=wp.int32)
    """[G] link of a geometry whose contacts matter, else −1."""
    contact: wp.array(dtype=wp.int32)
    """[S] 1: only geometries in contact are listed."""
    felt: wp.array(dtype=wp.int32)
    """[S] link whose contacts matter, −1 where none do."""
    first: wp.array(dtype=wp.int32)
    """[S + 1] first place of the list."""
    room: wp.array(dtype=wp.int32)
    """[S] places of the list."""
    members: wp.array(dtype=wp.int32)
    """Geometries that may be met, slot by slot."""
    member_first: wp.array(dtype=wp.int32)
    """[S + 1] first member."""
    place: wp.array2d(dtype=wp.int32)
    """[S, G] number of a geometry among the members, −1 for none."""
    center: wp.array(dtype=wp.vec3f)
    """[S] middle of the probes, link frame (m)."""
    reach: wp.array(dtype=wp.float32)
    """[S] how far from it a geometry matters (m); 0 is unlimited."""


@wp.struct
class PairArrays:
    """Geometries that the slots meet now."""

    count: wp.array2d(dtype=wp.int32)
    """[B, S]."""
    first: wp.array(dtype=wp.int32)
    """[S + 1] first place of a slot's list."""
    geometry: wp.array2d(dtype=wp.int32)
    """[B, P]."""
    rotation: wp.array2d(dtype=wp.mat33f)
    """[B, P] from the link's to the geometry's frame."""
    offset: wp.array2d(dtype=wp.vec3f)
    """[B, P] of the link's origin in the geometry's frame (m)."""
    velocity: wp.array2d(dtype=wp.vec3f)
    """[B, P] of the geometry at the link's origin, relative to the link, link frame (m/s)."""
    spin: wp.array2d(dtype=wp.vec3f)
    """[B, P] relative angular velocity, link frame (rad/s)."""
    push: wp.array2d(dtype=wp.vec3f)
    """[B, P] mean normal of the contacts, the way they push the link, link frame; 0 without any, empty where no solid
    is asked from the side of the sensor."""


@wp.kernel(module="unique")
def count_update(age: wp.array(dtype=wp.int32)):
    """Count an update. Thread: a counter."""
    env = wp.tid()
    age[env] = age[env] + 1


@wp.kernel(module="unique")
def reset_clock(
    mask: wp.array(dtype=wp.bool),
    age: wp.array(dtype=wp.int32),
    episode: wp.array(dtype=wp.int32),
    status: wp.array(dtype=wp.int32),
):
    """Start an episode in chosen environments. Thread: environment [B]."""
    env = wp.tid()
    if mask[env]:
        age[env] = -1
        episode[env] = episode[env] + 1
        status[env] = 0


@wp.kernel(module="unique")
def clear_readings(mask: wp.array(dtype=wp.bool), planes: wp.array3d(dtype=wp.float32)):
    """Set readings [C, B, N] of chosen environments to zero. Thread: environment and probe [B, N]."""
    env, n = wp.tid()
    if mask[env]:
        for channel in range(planes.shape[0]):
            planes[channel, env, n] = float(0.0)


@wp.func
def push_side(pairs: PairArrays, env: int, place: int, normal: wp.vec3f) -> float:
    """Return 1 where contacts push a sensor against its outward normal, −1 where along it, 0 where neither."""
    push = wp.dot(pairs.push[env, place], normal)
    return wp.where(push < -0.5, 1.0, wp.where(push > 0.5, -1.0, 0.0))


@wp.func
def mark(
    slots: SlotArrays, env: int, link: int, other: int, words: int, bits: wp.array2d(dtype=wp.int32), push: wp.vec3f,
    pushes: wp.array3d(dtype=wp.int32),
):  # fmt: skip
    """Note in the bits of every slot of a link that it touches a geometry, and which way it is pushed."""
    for slot in range(slots.link.shape[0]):
        if slots.felt[slot] == link:
            place = slots.place[slot, other]
            if place >= 0:
                # One bit per geometry: a set of any size costs one atomic operation, and its order does not depend on
                # the threads.
                word = slot * words + place // 32
                bit = wp.int32(1) << wp.int32(place % 32)
                # Many contacts of one pair set the same bit; reading first spares most of the atomic operations.
                if (bits[env, word] & bit) == 0:
                    wp.atomic_or(bits, env, word, bit)
                if pushes.shape[2] == 4:
                    # Sums of whole numbers do not depend on the order of threads.
                    member = slots.member_first[slot] + place
                    for axis in range(3):
                        wp.atomic_add(pushes, env, member, axis, int(wp.rint(wp.static(UNIT) * push[axis])))
                    wp.atomic_add(pushes, env, member, 3, 1)


@cache
def start_kernel(contacts: bool) -> Any:
    """Return the kernel ``start`` of an update: counts it, and marks who touches whom, if any slot looks at contacts.

    One launch for both, since launches are what small updates cost. Thread: environments [B] and contacts [C],
    ``stride`` apart.
    """

    @wp.kernel(module="unique", grid_stride=False)
    def start(
        slots: SlotArrays,
        state: StateArrays,
        words: int,
        bits: wp.array2d(dtype=wp.int32),
        pushes: wp.array3d(dtype=wp.int32),
        age: wp.array(dtype=wp.int32),
        status: wp.array(dtype=wp.int32),
        stride: int,
    ):
        tid = wp.tid()
        room = state.contact_env.shape[0]
        count = state.contact_count[0]
        if tid < state.pose.shape[0]:
            age[tid] = age[tid] + 1
            flags = wp.where(count > room, 2, 0)
            # An environment that was lost once stays so until its reset: engines put it back in ways of their own, and
            # memories of sensors would mix what was before with what is now.
            if age[tid] > 0:
                flags = flags | (status[tid] & 1)
            status[tid] = flags
        if wp.static(contacts):
            c = tid
            while c < wp.min(count, room):
                pair = state.contact_geom[c]
                if in_scene(pair, slots.watched.shape[0]):
                    for side in range(2):
                        link = slots.watched[pair[side]]
                        if link >= 0:
                            push = wp.where(side == 0, -1.0, 1.0) * state.contact_normal[c]
                            mark(slots, state.contact_env[c], link, pair[1 - side], words, bits, push, pushes)
                c += stride

    return start


@wp.kernel(module="unique", grid_stride=False)
def list_pairs(
    slots: SlotArrays,
    solids: SolidArrays,
    state: StateArrays,
    words: int,
    bits: wp.array2d(dtype=wp.int32),
    pushes: wp.array3d(dtype=wp.int32),
    out: PairArrays,
    stride: int,
    crowded: wp.array(dtype=wp.int32),
    status: wp.array(dtype=wp.int32),
):
    """List what each slot meets, in the order of geometry numbers, and flag numbers of the state that are not finite.

    Thread: slots [B S], then links [B L], ``stride`` apart.
    """
    tid = wp.tid()
    # Empty arrays have one unused element.
    many = slots.first.shape[0] - 1
    listed = state.pose.shape[0] * many
    if tid >= listed:
        owner = (tid - listed) // stride
        for look in range((tid - listed) % stride, state.pose.shape[1], stride):
            if link_fails(state, owner, look):
                wp.atomic_or(status, owner, 1)
        return
    env = tid // many
    slot = tid % many
    row = env % solids.solid.shape[0]
    link = slots.link[slot]
    here = state.pose[env, link]
    origin = wp.transform_get_translation(here)
    turn = wp.transform_get_rotation(here)
    twist = state.velocity[env, link]
    own_velocity = wp.vec3f(twist[0], twist[1], twist[2])
    own_spin = wp.vec3f(twist[3], twist[4], twist[5])
    first = slots.first[slot]
    room = slots.room[slot]
    members = slots.member_first[slot]
    total = slots.member_first[slot + 1] - members
    found = int(0)
    word = int(0)
    for place in range(total):
        wanted = int(1)
        if slots.contact[slot] == 1:
            if place % 32 == 0:
                word = bits[env, slot * words + place // 32]
                if word != 0:
                    bits[env, slot * words + place // 32] = 0
            wanted = (word >> wp.int32(place % 32)) & 1
        push = wp.vec3f()
        if pushes.shape[2] == 4:
            count = float(pushes[env, members + place, 3])
            for axis in range(3):
                push[axis] = float(pushes[env, members + place, axis]) / wp.max(wp.static(UNIT) * count, 1.0)
            for axis in range(4):
                pushes[env, members + place, axis] = 0
        if wanted == 1:
            geometry = slots.members[members + place]
            there = state.pose[env, solids.link[geometry]]
            frame = wp.transform_multiply(there, solids.solid[row, geometry].frame)
            relative = wp.transform_multiply(wp.transform_inverse(frame), here)
            near = True
            if slots.reach[slot] > 0.0 and solids.solid[row, geometry].kind != wp.static(PLANE):
                bound = solids.solid[row, geometry].bound
                center = wp.transform_point(relative, slots.center[slot])
                # Sphere around the probes against sphere around the geometry: planes have none and always count.
                gap = wp.length(center - wp.vec3f(bound[0], bound[1], bound[2]))
                near = gap < bound[3] + slots.reach[slot]
            if near:
                if found < room:
                    other = state.velocity[env, solids.link[geometry]]
                    spin = wp.vec3f(other[3], other[4], other[5])
                    # Velocity of the other body at the link's origin, less the link's own (4.4–4.6); each probe
                    # adds ω × x itself.
                    lever = origin - wp.transform_get_translation(there)
                    speed = wp.vec3f(other[0], other[1], other[2]) + wp.cross(spin, lever) - own_velocity
                    at = first + found
                    out.geometry[env, at] = geometry
                    out.rotation[env, at] = wp.quat_to_matrix(wp.transform_get_rotation(relative))
                    out.offset[env, at] = wp.transform_get_translation(relative)
                    out.velocity[env, at] = wp.quat_rotate_inv(turn, speed)
                    out.spin[env, at] = wp.quat_rotate_inv(turn, spin - own_spin)
                    if pushes.shape[2] == 4:
                        out.push[env, at] = wp.quat_rotate_inv(turn, push)
                found += 1
    if found > room:
        wp.atomic_max(crowded, env, found)
    out.count[env, slot] = wp.min(found, room)
