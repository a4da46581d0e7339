"""Kernels of the sensors that ask how deep a probe lies in what it touches: distance, depth, contact, force field.

Equation numbers are those of the thesis. Vectors are in the frame of the sensor link (m, N, N m).
Letters: B environment, N probe, R row of probes that one thread takes in turn.
"""

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.sensors.kernels.readout import (
    CLEAN,
    FUSED,
    STAGED,
    ProbeArrays,
    ReadoutArrays,
    idle,
    lost,
    readout_functions,
)
from robotics_bridge.sensors.kernels.series import power as series_power
from robotics_bridge.sensors.noise.kernels.noise import NoiseParams, episode_draw, gain, radius_noise
from robotics_bridge.sensors.queries.kernels.distance import FAR, WALL, SolidArrays, SolidShape, shape_functions
from robotics_bridge.sensors.queries.kernels.pairs import PairArrays

wp = warp()

THREADS = 256
"""Threads of a block."""
BLOCKS = {CLEAN: 3, FUSED: 2, STAGED: 3}
"""Blocks that a multiprocessor holds at once, by mode: what registers are left to a thread."""


@cache
def deepest_function(kinds: frozenset[int], raycast: bool) -> Any:
    """Return ``deepest(probes, solids, pairs, env, n, reach) -> (distance, normal, place)``.

    The least signed distance of a probe to what its slot lists, the outward normal there and its place in the list
    (−1: nothing). ``reach`` 0 means: whatever lies inside or within the probe's radius.
    """
    distance = shape_functions(kinds, raycast).distance

    @wp.func
    def deepest(probes: ProbeArrays, solids: SolidArrays, pairs: PairArrays, env: int, n: int, reach: float):
        row = env % solids.kind.shape[0]
        slot = probes.slot[n]
        x = probes.position[n]
        first = pairs.first[slot]
        best = float(wp.static(FAR))
        normal = wp.vec3f(0.0, 0.0, 1.0)
        place = int(-1)
        for k in range(pairs.count[env, slot]):
            at = first + k
            geometry = pairs.geometry[env, at]
            rotation = pairs.rotation[env, at]
            limit = reach
            facing = wp.vec3f()
            if wp.static(WALL in kinds):
                # A probe without a limit asks for the distance, whichever side is the nearest.
                if reach <= 0.0:
                    facing = rotation @ (probes.radius[n] * probes.normal[n])
            if wp.static(raycast or WALL in kinds):
                # A query of triangles searches within a limit: from inside, the surface is at most a bounding diameter
                # away.
                if reach <= 0.0:
                    limit = 2.0 * solids.bound[row, geometry][3] + probes.radius[n]
            found = distance(solids, row, geometry, rotation @ x + pairs.offset[env, at], facing, limit)
            # The largest penetration of 4.2 is the least signed distance. A strict comparison keeps the first of equals
            # in the order of geometry numbers, so that ties do not depend on the order of contacts.
            if found[3] < best:
                best = found[3]
                normal = wp.transpose(rotation) @ wp.vec3f(found[0], found[1], found[2])
                place = at
        return best, normal, place

    return deepest


@cache
def distance_kernel(
    kinds: frozenset[int], raycast: bool, nearest: bool, mode: int, hysteresis: bool, walk: bool
) -> Any:
    """Return the kernel of SurfaceDistanceProbe. Dim [B, N]."""
    deepest, emit = deepest_function(kinds, raycast), readout_functions(mode, hysteresis, walk).emit

    @wp.kernel(module="unique")
    def surface_distance(
        probes: ProbeArrays,
        solids: SolidArrays,
        pairs: PairArrays,
        io: ReadoutArrays,
        limits: wp.array(dtype=wp.float32),
        points: wp.array3d(dtype=wp.float32),
    ):
        env, n = wp.tid()
        if probes.radius[n] <= 0.0:
            idle(io, 1, env, n)
            if wp.static(nearest):
                for axis in range(3):
                    points[axis, env, n] = 0.0
            return
        if (io.status[env] & 1) != 0:
            lost(io, 1, env, n)
            if wp.static(nearest):
                for axis in range(3):
                    points[axis, env, n] = wp.static(float("nan"))
            return
        part = probes.part[n]
        probe = probes.probe[n]
        age = io.age[env]
        episode = io.episode[env]
        best, normal, place = deepest(probes, solids, pairs, env, n, wp.static(FAR))
        if wp.static(nearest):
            # The gradient of a signed distance has unit length: one step of that distance along it ends on the surface.
            near = probes.position[n] - best * normal
            for axis in range(3):
                points[axis, env, n] = wp.where(place >= 0, near[axis], wp.static(float("nan")))
        d = wp.where(place >= 0, wp.min(best, limits[part]), limits[part])
        signal = d
        if wp.static(mode != CLEAN):
            signal = d + radius_noise(io.knobs[part], env + io.env_offset, probe, age, episode)
        emit(io, io.knobs[part], env, n, probe, 0, age, episode, d, signal)

    return surface_distance


@wp.func
def latch(before: float, age: int, value: float, limits: wp.vec2f) -> float:
    """Apply the Schmitt trigger (4.3); a lost reading before counts as no contact."""
    if value > limits[0] or (age > 0 and before > 0.5 and value > limits[1]):
        return 1.0
    return 0.0


@cache
def depth_kernel(kinds: frozenset[int], raycast: bool, binary: bool, mode: int, hysteresis: bool, walk: bool) -> Any:
    """Return the kernel of ContactDepthProbe (4.2) or, ``binary``, of ContactProbe (4.3). Dim [B, N]."""
    deepest, readout = deepest_function(kinds, raycast), readout_functions(mode, hysteresis, walk)
    emit, measure = readout.emit, readout.measure

    @wp.kernel(module="unique")
    def contact_depth(
        probes: ProbeArrays,
        solids: SolidArrays,
        pairs: PairArrays,
        io: ReadoutArrays,
        limits: wp.array(dtype=wp.vec2f),
    ):
        env, n = wp.tid()
        radius = probes.radius[n]
        if radius <= 0.0:
            idle(io, 1, env, n)
            return
        if (io.status[env] & 1) != 0:
            lost(io, 1, env, n)
            return
        part = probes.part[n]
        probe = probes.probe[n]
        age = io.age[env]
        episode = io.episode[env]
        best, _normal, place = deepest(probes, solids, pairs, env, n, 0.0)
        truth = wp.max(radius - best, 0.0)
        signal = truth
        if wp.static(mode != CLEAN):
            noisy = wp.max(radius + radius_noise(io.knobs[part], env + io.env_offset, probe, age, episode), 0.0)
            # Radius noise (4.23) and gain (4.24) act before anything else of the measured branch; the truth sees
            # neither.
            signal = wp.max(noisy - best, 0.0) * gain(io.knobs[part], env + io.env_offset, probe, episode)
        if wp.static(binary):
            if wp.static(mode != CLEAN):
                # Each branch latches on its own last bit (4.3): noise must not switch the true contact.
                y = measure(io, io.knobs[part], env, n, probe, 0, age, episode, signal)
                io.measured[0, env, n] = latch(io.measured[0, env, n], age, y, limits[part])
            io.truth[0, env, n] = latch(io.truth[0, env, n], age, truth, limits[part])
        else:
            emit(io, io.knobs[part], env, n, probe, 0, age, episode, truth, signal)

    return contact_depth


@wp.struct
class KinematicParams:
    """Law of one force field; units as in ``KinematicTaxel``."""

    stiffness: wp.float32
    damping: wp.float32
    exponent: wp.float32
    shear: wp.float32
    twist: wp.float32


@cache
def kinematic_function(physical: bool, fast: bool = False) -> Any:
    """Return ``wrench(params, x, depth, normal, velocity, spin)`` (4.6–4.9).

    Args:
        physical: friction and twist follow the object and the normal force never pulls; otherwise as published.
        fast: the power is the GPU's own (in modules with the option ``fast_math``) in place of a series.
    """
    power = wp.pow if fast else series_power

    @wp.func
    def wrench(
        p: KinematicParams, x: wp.vec3f, depth: float, normal: wp.vec3f, velocity: wp.vec3f, spin: wp.vec3f
    ) -> wp.spatial_vectorf:
        # s = d^α, then 4.7–4.9 in the link's frame. Velocities arrive for the link's origin, so 4.6 is v + ω × x.
        s = power(depth, p.exponent)
        relative = velocity + wp.cross(spin, x)
        approach = wp.dot(relative, normal)
        tangential = relative - approach * normal
        push = s * (p.stiffness + p.damping * approach)
        turn = p.twist * wp.dot(spin, normal)
        f = wp.vec3f(0.0)
        if wp.static(physical):
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
    kinds: frozenset[int], raycast: bool, physical: bool, mode: int, hysteresis: bool, walk: bool, fast: bool = False
) -> Any:
    """Return the kernel of KinematicTaxel (4.6–4.9). Dim [B, R], R rows of probes that one thread takes in turn.

    What a thread asks of its environment and of what is met there is read once and kept.

    Args:
        kinds: of the geometries tracked.
        raycast: ask triangles.
        physical: convention of the forces.
        mode: of the readout.
        hysteresis: whether it is stored.
        walk: whether it is stored.
        fast: square roots and quotients of the GPU's approximate units (2 units in the last place).
    """
    shapes, readout = shape_functions(kinds, raycast), readout_functions(mode, hysteresis, walk)
    shape_of, distance_to = shapes.shape_of, shapes.distance_to
    emit_six, recall_six = readout.emit_six, readout.recall_six
    fast = fast and not raycast
    wrench = kinematic_function(physical, fast)

    @wp.kernel(
        module="unique",
        grid_stride=False,
        launch_bounds=(THREADS, BLOCKS[mode]),
        module_options={"fast_math": fast},
    )
    def kinematic(
        probes: ProbeArrays,
        rows: wp.array(dtype=wp.vec4i),
        solids: SolidArrays,
        pairs: PairArrays,
        io: ReadoutArrays,
        laws: wp.array(dtype=KinematicParams),
    ):
        env, at_row = wp.tid()
        span = rows[at_row]
        part = span[3]
        slot = probes.slot[span[0]]
        variant = int(0)
        if solids.kind.shape[0] > 1:
            variant = env
        n = span[0]
        if (io.status[env] & 1) != 0:
            while n < span[1]:
                if probes.radius[n] > 0.0:
                    lost(io, 6, env, n)
                else:
                    idle(io, 6, env, n)
                n += span[2]
            return
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
            radius = probes.radius[n]
            if radius > 0.0:
                # Memory is asked for first: the distances below are worked out while it arrives.
                lag, drift = recall_six(io, env, n, age)
                x = probes.position[n]
                best = float(wp.static(FAR))
                normal = wp.vec3f(0.0, 0.0, 1.0)
                place = int(0)
                for k in range(count):
                    # Most links meet one geometry: it is read for the first probe only.
                    while held != first + k:
                        held = first + k
                        geometry = pairs.geometry[env, held]
                        shape = shape_of(solids, variant, geometry)
                        rotation = pairs.rotation[env, held]
                        offset = pairs.offset[env, held]
                        if wp.static(raycast or WALL in kinds):
                            limit = 2.0 * solids.bound[variant, geometry][3]
                    facing = wp.vec3f()
                    if wp.static(WALL in kinds):
                        facing = rotation @ (radius * probes.normal[n])
                    found = distance_to(solids.values, shape, rotation @ x + offset, facing, limit + radius)
                    if found[3] < best:
                        best = found[3]
                        normal = wp.transpose(rotation) @ wp.vec3f(found[0], found[1], found[2])
                        place = held
                probe = probes.probe[n]
                number = env + io.env_offset
                fixed = wp.vec3f()
                noisy = float(0.0)
                if wp.static(mode != CLEAN):
                    noisy = wp.max(radius + radius_noise(knobs, number, probe, age, episode), 0.0) - best
                    fixed = episode_draw(knobs, number, probe, episode)
                    noisy = noisy * fixed[0]
                truth = wp.spatial_vectorf()
                signal = wp.spatial_vectorf()
                # Most probes touch nothing: their velocities are never loaded.
                if best < radius or noisy > 0.0:
                    velocity = pairs.velocity[env, place]
                    spin = pairs.spin[env, place]
                    if best < radius:
                        truth = wrench(law, x, radius - best, normal, velocity, spin)
                    if wp.static(mode != CLEAN):
                        if noisy > 0.0:
                            signal = wrench(law, x, noisy, normal, velocity, spin)
                if wp.static(mode == CLEAN):
                    for channel in range(6):
                        io.truth[channel, env, n] = truth[channel]
                else:
                    emit_six(io, knobs, env, n, probe, age, episode, fixed, lag, drift, truth, signal)
            else:
                idle(io, 6, env, n)
            n += span[2]

    return kinematic
