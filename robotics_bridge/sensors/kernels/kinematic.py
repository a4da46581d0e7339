"""Friction at rest: every taxel holds the point of the body that it touched first, by a spring with Coulomb's limit.

With depth d, normal force f_n and the tangential way u of the held point since, a taxel carries the tangential force
f_n σ, σ = ρ u / d: for d near a working depth a spring of ρ times the normal stiffness (Mindlin 1949). Where |σ| would
exceed the coefficient μ, the point slides after the taxel until |σ| = μ. Anchors lie in the frame of the touched link,
so that motions of both together change nothing and nothing drifts. Letters: B environment, N taxel.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.sensors.context import numbers_of
from robotics_bridge.sensors.kernels.contact_load import ContactFaces, SpreadPlan
from robotics_bridge.sensors.kernels.distance import FAR, SIDED, SolidArrays, SolidShape, distance_function
from robotics_bridge.sensors.kernels.noise import NoiseParams, episode_draw, radius_noise
from robotics_bridge.sensors.kernels.noise import power as series_power
from robotics_bridge.sensors.kernels.pairs import PairArrays, push_side
from robotics_bridge.sensors.kernels.readout import (
    CLEAN,
    FUSED,
    STAGED,
    PressArrays,
    ProbeArrays,
    ReadoutArrays,
    clear,
    load_four,
    load_planes,
    readout_functions,
    silenced,
    store_planes,
)
from robotics_bridge.sensors.taxels.sensors import KinematicTaxel

wp = warp()


@wp.struct
class StickArrays:
    """Points that taxels hold. Nothing is cleared: what the update before did not touch is held no more."""

    anchor: wp.array2d(dtype=wp.vec3f)
    """[B, N] in the frame of the touched link (m)."""
    body: wp.array2d(dtype=wp.int32)
    """[B, N] that link."""
    stamp: wp.array2d(dtype=wp.int32)
    """[B, N] update of the last touch, 1024 · age + episode."""


@wp.func
def hold(
    sticks: StickArrays,
    solids: SolidArrays,
    pairs: PairArrays,
    io: ReadoutArrays,
    env: int,
    n: int,
    place: int,
    x: wp.vec3f,
    normal: wp.vec3f,
    depth: float,
    law: wp.vec2f,
) -> wp.vec3f:
    """Return σ of a taxel at ``x`` that lies ``depth`` deep in what its list names at ``place``; ``law`` is (μ, ρ)."""
    geometry = pairs.geometry[env, place]
    frame = solids.solid[env % solids.solid.shape[0], geometry].frame
    rotation = pairs.rotation[env, place]
    offset = pairs.offset[env, place]
    body = solids.link[geometry]
    age = io.age[env]
    now = 1024 * age + io.episode[env]
    sigma = wp.vec3f()
    point = x
    held = age > 0 and sticks.stamp[env, n] == now - 1024 and sticks.body[env, n] == body
    if held:
        local = wp.transform_point(wp.transform_inverse(frame), sticks.anchor[env, n])
        way = wp.transpose(rotation) @ (local - offset) - x
        sigma = law[1] / depth * (way - wp.dot(way, normal) * normal)
        size = wp.length(sigma)
        if size > law[0]:
            sigma = law[0] / size * sigma
            point = x + depth / law[1] * sigma
            held = False
    if not held:
        sticks.anchor[env, n] = wp.transform_point(frame, rotation @ point + offset)
    sticks.body[env, n] = body
    sticks.stamp[env, n] = now
    return sigma


THREADS = 256  # threads of a block
BLOCKS = {CLEAN: 3, FUSED: 2, STAGED: 3}
"""Blocks that a multiprocessor holds at once, by mode: what registers are left to a thread."""
BLOCKS_SINGLE = 4  # the same where every row is one taxel, except for ray casts, which need the registers


@wp.struct
@numbers_of(KinematicTaxel)
class KinematicParams:
    """Law of one force field, with the names and units of ``KinematicTaxel``."""

    torsion: wp.float32
    friction: wp.float32


@cache
def kinematic_function(physical: bool, sticky: bool, fast: bool = False) -> Any:
    """Return ``wrench(params, x, depth, normal, velocity, spin, sigma)`` (4.6–4.9).

    Args:
        physical: friction and twist follow the object and the normal force never pulls; otherwise as published.
        sticky: friction is the normal force times ``sigma``, and neither sliding nor twisting has a viscous one.
        fast: the power is the GPU's own (in modules with the option ``fast_math``) in place of a series.
    """
    power = wp.pow if fast else series_power

    @wp.func
    def wrench(
        p: KinematicParams,
        x: wp.vec3f,
        depth: float,
        normal: wp.vec3f,
        velocity: wp.vec3f,
        spin: wp.vec3f,
        sigma: wp.vec3f,
    ) -> wp.spatial_vectorf:
        # s = d^α, then 4.7–4.9 in the link's frame. Velocities arrive for the link's origin, so 4.6 is v + ω × x.
        s = power(depth, p.exponent)
        relative = velocity + wp.cross(spin, x)
        approach = wp.dot(relative, normal)
        tangential = relative - approach * normal
        push = s * (p.stiffness + p.damping * approach)
        turn = p.torsion * wp.dot(spin, normal)
        f = wp.vec3f(0.0)
        if wp.static(sticky):
            f = wp.max(push, 0.0) * (normal + sigma)
            turn = 0.0
        elif wp.static(physical):
            # Published signs (4.8, 4.9) let friction act against the object's slip although f is the force on the
            # sensor, and let damping pull. Here friction and twist follow the object, and the normal force is never
            # negative.
            f = wp.max(push, 0.0) * normal + p.shear * tangential
            turn = -turn
        else:
            f = push * normal - p.shear * tangential
        torque = wp.cross(x, f) - turn * normal
        return wp.spatial_vectorf(f[0], f[1], f[2], torque[0], torque[1], torque[2])

    return wrench


@cache
def kinematic_kernel(
    kinds: frozenset[int],
    raycast: bool,
    physical: bool,
    sticky: bool,
    summed: bool,
    mode: int,
    hysteresis: bool,
    walk: bool,
    cuda: bool = False,
    single: bool = False,
) -> Any:
    """Return the kernel of KinematicTaxel (4.6–4.9). Dim [B R], R rows of probes that one thread takes in turn.

    What a thread asks of its environment and of what is met there is read once and kept.

    Args:
        kinds: of the geometries tracked.
        raycast: ask triangles.
        physical: convention of the forces.
        sticky: taxels hold what they touch.
        summed: ``press`` is written in place of the readings of links with a contact (``contact_load``).
        mode: of the readout.
        hysteresis: whether it is stored.
        walk: whether it is stored.
        cuda: a GPU runs it, with square roots and quotients of its approximate units (2 units in the last place).
        single: every row is one taxel; nothing is kept for another.
    """
    distance_to, readout = distance_function(kinds, raycast), readout_functions(mode, hysteresis, walk)
    emit_six, recall_six = readout.emit_six, readout.recall_six
    fast = cuda and not raycast
    wrench = kinematic_function(physical, sticky, fast)
    power = series_power

    @wp.kernel(
        module="unique",
        grid_stride=False,
        launch_bounds=(THREADS, BLOCKS_SINGLE if single and not raycast else BLOCKS[mode]),
        module_options={"fast_math": fast},
    )
    def kinematic(
        probes: ProbeArrays,
        rows: wp.array(dtype=wp.vec4i),
        solids: SolidArrays,
        pairs: PairArrays,
        io: ReadoutArrays,
        laws: wp.array(dtype=KinematicParams),
        sticks: StickArrays,
        plan: SpreadPlan,
        faces: ContactFaces,
        press: PressArrays,
    ):
        # Dividing unsigned numbers of 32 bits costs a third of what a launch of two dimensions does.
        tid = wp.uint32(wp.tid())
        count_rows = wp.uint32(rows.shape[0])
        env = int(tid // count_rows)
        at_row = int(tid % count_rows)
        span = rows[at_row]
        part = span[3]
        n = span[0]
        if (io.status[env] & 1) != 0:
            while n < span[1]:
                silenced(io, 6, env, n, probes.radius[n])
                if wp.static(summed):
                    press.filled[env, n] = wp.uint8(1)
                n += span[2]
            return
        if wp.static(summed):
            if faces.head[env, plan.link[part]] < 0:
                while n < span[1]:
                    clear(press, io, env, n, wp.static(mode == STAGED))
                    n += span[2]
                return
        slot = probes.slot[span[0]]
        variant = int(0)
        if solids.solid.shape[0] > 1:
            variant = env
        first = pairs.first[slot]
        count = pairs.count[env, slot]
        law = laws[part]
        knobs = NoiseParams()
        age = int(0)
        episode = int(0)
        if wp.static(mode != CLEAN):
            knobs = io.knobs[part]
            age = io.age[env]
            episode = io.episode[env]
        # Probes of a row share slot and sensor, hence pairs, law and noise: these stay in registers while the thread
        # strides through its probes.
        held = int(-1)
        shape = SolidShape()
        rotation = wp.mat33f()
        offset = wp.vec3f()
        limit = float(0.0)
        while n < span[1]:
            packed = load_four(probes.packed, n)
            radius = packed[3]
            if radius > 0.0:
                # Memory is asked for first: the distances below are worked out while it arrives.
                lag, drift = recall_six(io, env, n)
                x = wp.vec3f(packed[0], packed[1], packed[2])
                best = float(wp.static(FAR))
                normal = wp.vec3f(0.0, 0.0, 1.0)
                place = int(0)
                for k in range(count):
                    # Most links meet one geometry: it is read for the first probe only.
                    while held != first + k:
                        held = first + k
                        shape = solids.solid[variant, pairs.geometry[env, held]]
                        rotation = pairs.rotation[env, held]
                        offset = pairs.offset[env, held]
                        if wp.static(raycast or bool(kinds & SIDED)):
                            limit = 2.0 * shape.bound[3]
                    facing = wp.vec3f()
                    side = float(0.0)
                    if wp.static(bool(kinds & SIDED)):
                        facing = rotation @ (radius * probes.normal[n])
                        side = push_side(pairs, env, held, probes.normal[n])
                    found = distance_to(solids.values, shape, rotation @ x + offset, facing, side, limit + radius)
                    if found[3] < best:
                        best = found[3]
                        normal = wp.transpose(rotation) @ wp.vec3f(found[0], found[1], found[2])
                        place = held
                probe = int(0)
                number = env + io.env_offset
                fixed = wp.vec3f()
                noisy = float(0.0)
                if wp.static(mode != CLEAN):
                    probe = io.probe[n]
                    noisy = wp.max(radius + radius_noise(knobs, number, probe, age, episode), 0.0) - best
                    fixed = episode_draw(knobs, number, probe, episode)
                    noisy = noisy * fixed[0]
                sigma = wp.vec3f()
                if wp.static(sticky):
                    if best < radius:
                        grip = wp.vec2f(law.friction, law.grip)
                        sigma = hold(sticks, solids, pairs, io, env, n, place, x, normal, radius - best, grip)
                if wp.static(summed):
                    weight = float(0.0)
                    if best < radius:
                        weight = power(radius - best, law.exponent)
                    if wp.static(mode != CLEAN):
                        if noisy > 0.0:
                            noisy = power(noisy, law.exponent)
                        noisy = wp.max(noisy, 0.0)
                        press.noisy[env, n] = noisy
                    press.touch[env, n] = wp.vec4f(normal[0], normal[1], normal[2], weight)
                    if weight + noisy > 0.0:
                        press.body[env, n] = solids.link[pairs.geometry[env, place]]
                        if wp.static(sticky):
                            press.sigma[env, n] = sigma
                    else:
                        clear(press, io, env, n, wp.static(mode == STAGED))
                else:
                    truth = wp.spatial_vectorf()
                    signal = wp.spatial_vectorf()
                    # Most probes touch nothing: their velocities are never loaded.
                    if best < radius or noisy > 0.0:
                        velocity = pairs.velocity[env, place]
                        spin = pairs.spin[env, place]
                        if wp.static(mode == CLEAN):
                            truth = wrench(law, x, radius - best, normal, velocity, spin, sigma)
                        else:
                            # Both are worked out, so that they share what is the same. The law is read again here, as
                            # are the knobs below: until then other numbers need the registers.
                            again = laws[part]
                            truth = wrench(again, x, radius - best, normal, velocity, spin, sigma)
                            signal = wrench(again, x, noisy, normal, velocity, spin, sigma)
                            if best >= radius:
                                truth = wp.spatial_vectorf()
                            if noisy <= 0.0:
                                signal = wp.spatial_vectorf()
                    if wp.static(mode == CLEAN):
                        store_planes(io.truth, env, n, 6, truth)
                    else:
                        emit_six(io, env, n, fixed, lag, drift, truth, signal)
            elif wp.static(not summed):
                silenced(io, 6, env, n, radius)
            n += span[2]
            if wp.static(single):
                # Told so, the compiler keeps nothing for further taxels in registers.
                n = span[1]

    return kinematic


@cache
def measure_kernel(hysteresis: bool, walk: bool) -> Any:
    """Return the kernel ``measure`` that applies the noise to what was spread. Dim [B N]."""
    readout = readout_functions(FUSED, hysteresis, walk, exact=False)
    recall_six, emit_six = readout.recall_six, readout.emit_six

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, launch_bounds=(256, 4))
    def measure(probes: ProbeArrays, press: PressArrays, io: ReadoutArrays):
        tid = wp.uint32(wp.tid())
        count = wp.uint32(probes.radius.shape[0])
        env = int(tid // count)
        n = int(tid % count)
        if silenced(io, 6, env, n, probes.radius[n]):
            return
        lag, drift = recall_six(io, env, n)
        # What nothing touches was not written.
        signal = wp.spatial_vectorf()
        if press.filled[env, n] != wp.uint8(0):
            signal = load_planes(io.measured, env, n, 6)
        fixed = episode_draw(io.knobs[io.part[n]], env + io.env_offset, io.probe[n], io.episode[env])
        emit_six(io, env, n, fixed, lag, drift, signal, signal)

    return measure
