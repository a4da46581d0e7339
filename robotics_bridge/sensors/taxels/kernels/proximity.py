"""Surface points in blocks of neighbours, and the proximity taxel that sums over them (thesis 4.11–4.16).

Letters: B environment, N taxel, P surface point, K block of points, R variant row, G geometry, S sensor.
"""

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays
from robotics_bridge.sensors.kernels.readout import CLEAN, ProbeArrays, ReadoutArrays, idle, lost, readout_functions
from robotics_bridge.sensors.noise.kernels.noise import episode_draw, radius_noise
from robotics_bridge.sensors.queries.kernels.pairs import PairArrays

wp = warp()

BLOCK = 32
"""Points of a block."""
CELL = 16
"""Neighbouring probes that ask for the points around them together."""


@wp.struct
class CloudArrays:
    """Surface points of the geometries that a sensor tracks."""

    point: wp.array(dtype=wp.vec3f)
    """[P] in the geometry's frame (m); NaN fills the last block of a geometry."""
    sphere: wp.array(dtype=wp.vec4f)
    """[K] centre and radius of a sphere around each block (m)."""
    first: wp.array2d(dtype=wp.int32)
    """[R, G] first block of a geometry."""
    blocks: wp.array2d(dtype=wp.int32)
    """[R, G] number of its blocks."""


@wp.struct
class ProximityParams:
    """Law of one taxel sensor; units as in ``ProximityTaxel``."""

    stiffness: wp.float32
    coupling: wp.float32


@wp.struct
class ProximityArrays:
    """Arrays of the proximity taxels of a group."""

    laws: wp.array(dtype=ProximityParams)
    """[S]."""
    densities: wp.array2d(dtype=wp.float32)
    """[S, R] weight of a point."""
    links: wp.array(dtype=wp.int32)
    """[S]."""
    near: wp.array2d(dtype=wp.int32)
    """[B, …] points near a cell by pair, each list ended by −1; only where points are gathered."""
    members: wp.array(dtype=wp.int32)
    """[N] taxels, cell by cell."""
    cells: wp.array(dtype=wp.vec3i)
    """First and last member of a cell, and its slot."""
    around: wp.array(dtype=wp.vec4f)
    """Sphere around all that a cell senses (m)."""


@cache
def proximity_kernel(physical: bool, mode: int, hysteresis: bool, walk: bool, gathered: bool = False) -> Any:
    """Return the kernel of ProximityTaxel. Dim [B, N], or [B] if ``gathered``.

    Args:
        physical: convention of the forces.
        mode: of the readout.
        hysteresis: whether it is stored.
        walk: whether it is stored.
        gathered: a thread serves all probes of an environment, and lists the points around each cell of neighbouring
            probes before these look at them. The terms of a sum, and their order, are the same.
    """
    readout = readout_functions(mode, hysteresis, walk)
    emit_six, recall_six = readout.emit_six, readout.recall_six

    @wp.func
    def wrench(
        law: ProximityParams,
        density: float,
        x: wp.vec3f,
        normal: wp.vec3f,
        mass: float,
        moment: wp.vec3f,
        slip: wp.vec3f,
    ) -> wp.spatial_vectorf:
        """Return force and torque of the summed overlaps: ``mass`` ΣP, ``moment`` ΣP (p − x), ``slip`` ΣP v."""
        # Equations 4.15 and 4.16 with the sums over points taken out of the law: Σ P, Σ P (p − x) and Σ P v are linear
        # in the points, so the projection of 4.13 is applied once to the summed slip.
        push = law.stiffness * density * mass
        drag = law.coupling * density * (slip - wp.dot(slip, normal) * normal)
        turn = law.stiffness * density * wp.cross(moment, normal)
        f = push * normal + drag
        if wp.static(physical):
            # Force on the sensor by the object: opposite to the published sign, with the torque about the link's origin
            # rather than about the taxel.
            f = drag - push * normal
            turn = wp.cross(x, f) - turn
        return wp.spatial_vectorf(f[0], f[1], f[2], turn[0], turn[1], turn[2])

    @wp.func
    def overlap(far: float, radius: float, noisy: float) -> wp.vec2f:
        """Return the overlap of a point with the sensing sphere, and with that of the measured branch."""
        if wp.static(mode == CLEAN):
            return wp.vec2f(wp.max(radius - far, 0.0), 0.0)
        return wp.vec2f(wp.max(radius - far, 0.0), wp.max(noisy - far, 0.0))

    @wp.func
    def feel(
        probes: ProbeArrays,
        pairs: PairArrays,
        cloud: CloudArrays,
        io: ReadoutArrays,
        own: ProximityArrays,
        state: StateArrays,
        env: int,
        n: int,
    ):
        """Read one probe."""
        radius = probes.radius[n]
        if radius <= 0.0:
            idle(io, 6, env, n)
        elif (io.status[env] & 1) != 0:
            lost(io, 6, env, n)
        else:
            row = env % cloud.first.shape[0]
            slot = probes.slot[n]
            part = probes.part[n]
            probe = probes.probe[n]
            x = probes.position[n]
            age = io.age[env]
            episode = io.episode[env]
            noisy = radius
            if wp.static(mode != CLEAN):
                # Both branches share one pass over the points: the query reaches as far as the larger of the two radii
                # (4.23).
                noisy = wp.max(radius + radius_noise(io.knobs[part], env + io.env_offset, probe, age, episode), 0.0)
            reach = wp.max(radius, noisy)
            turning = wp.vec3f(0.0)
            mass = wp.vec2f(0.0)
            moment = wp.vec3f(0.0)
            moment_noisy = wp.vec3f(0.0)
            slip = wp.vec3f(0.0)
            slip_noisy = wp.vec3f(0.0)
            cursor = int(0)
            for k in range(pairs.count[env, slot]):
                at = pairs.first[slot] + k
                geometry = pairs.geometry[env, at]
                rotation = pairs.rotation[env, at]
                here = rotation @ x + pairs.offset[env, at]
                # Points stay in the frame of their geometry and the probe is moved there: one transform per pair, not
                # per point.
                own_mass = wp.vec2f(0.0)
                lever = wp.vec3f(0.0)
                lever_noisy = wp.vec3f(0.0)
                if wp.static(gathered):
                    # The list was filled in the order of the pairs, each part closed by −1, so one cursor walks through
                    # all of it.
                    index = own.near[env, cursor]
                    cursor += 1
                    while index >= 0:
                        away = cloud.point[index] - here
                        square = wp.dot(away, away)
                        if square < reach * reach:
                            overlaps = overlap(wp.sqrt(square), radius, noisy)
                            # P of 4.11, and Σ P (p − x) as the lever from which torque and slip follow.
                            own_mass += overlaps
                            lever += overlaps[0] * away
                            if wp.static(mode != CLEAN):
                                lever_noisy += overlaps[1] * away
                        index = own.near[env, cursor]
                        cursor += 1
                else:
                    first = cloud.first[row, geometry]
                    for block in range(cloud.blocks[row, geometry]):
                        sphere = cloud.sphere[first + block]
                        gap = here - wp.vec3f(sphere[0], sphere[1], sphere[2])
                        # Two spheres that do not meet hold no point in reach: the block of points is skipped as a
                        # whole.
                        limit = reach + sphere[3]
                        if wp.dot(gap, gap) < limit * limit:
                            for i in range(wp.static(BLOCK)):
                                away = cloud.point[(first + block) * wp.static(BLOCK) + i] - here
                                square = wp.dot(away, away)
                                # A comparison with NaN, which fills the last block, is false.
                                if square < reach * reach:
                                    overlaps = overlap(wp.sqrt(square), radius, noisy)
                                    own_mass += overlaps
                                    lever += overlaps[0] * away
                                    if wp.static(mode != CLEAN):
                                        lever_noisy += overlaps[1] * away
                if own_mass[0] > 0.0 or own_mass[1] > 0.0:
                    link = own.links[part]
                    twist = state.velocity[env, link]
                    turn = wp.transform_get_rotation(state.pose[env, link])
                    turning = wp.quat_rotate_inv(turn, wp.vec3f(twist[3], twist[4], twist[5]))
                    # Points turn with their own link, not with the difference of both.
                    spin = pairs.spin[env, at] + turning
                    speed = pairs.velocity[env, at] + wp.cross(pairs.spin[env, at], x)
                    lever = wp.transpose(rotation) @ lever
                    mass += own_mass
                    moment += lever
                    # Σ P v over the rigid points (4.12): v is linear in p, so two sums per geometry stand for all
                    # velocities.
                    slip += own_mass[0] * speed + wp.cross(spin, lever)
                    if wp.static(mode != CLEAN):
                        lever_noisy = wp.transpose(rotation) @ lever_noisy
                        moment_noisy += lever_noisy
                        slip_noisy += own_mass[1] * speed + wp.cross(spin, lever_noisy)
            density = own.densities[part, row]
            normal = probes.normal[n]
            truth = wrench(own.laws[part], density, x, normal, mass[0], moment, slip)
            signal = truth
            fixed = wp.vec3f(1.0, 0.0, 0.0)
            if wp.static(mode != CLEAN):
                fixed = episode_draw(io.knobs[part], env + io.env_offset, probe, episode)
                # The gain (4.24) scales the summed overlaps; the wrench is linear in them, so it is applied to the
                # result.
                signal = fixed[0] * wrench(own.laws[part], density, x, normal, mass[1], moment_noisy, slip_noisy)
            lag, drift = recall_six(io, env, n, age)
            emit_six(io, io.knobs[part], env, n, probe, age, episode, fixed, lag, drift, truth, signal)

    @wp.kernel(module="unique")
    def proximity(
        probes: ProbeArrays,
        pairs: PairArrays,
        cloud: CloudArrays,
        io: ReadoutArrays,
        own: ProximityArrays,
        state: StateArrays,
    ):
        env, n = wp.tid()
        feel(probes, pairs, cloud, io, own, state, env, n)

    @wp.kernel(module="unique")
    def proximity_gathered(
        probes: ProbeArrays,
        pairs: PairArrays,
        cloud: CloudArrays,
        io: ReadoutArrays,
        own: ProximityArrays,
        state: StateArrays,
    ):
        env = wp.tid()
        row = env % cloud.first.shape[0]
        for c in range(own.cells.shape[0]):
            cell = own.cells[c]
            bound = own.around[c]
            middle = wp.vec3f(bound[0], bound[1], bound[2])
            found = int(0)
            for k in range(pairs.count[env, cell[2]]):
                at = pairs.first[cell[2]] + k
                geometry = pairs.geometry[env, at]
                here = pairs.rotation[env, at] @ middle + pairs.offset[env, at]
                first = cloud.first[row, geometry]
                # Same order of blocks and points as without gathering, since sums in single precision depend on it.
                for block in range(cloud.blocks[row, geometry]):
                    sphere = cloud.sphere[first + block]
                    gap = here - wp.vec3f(sphere[0], sphere[1], sphere[2])
                    limit = bound[3] + sphere[3]
                    if wp.dot(gap, gap) < limit * limit:
                        for i in range(wp.static(BLOCK)):
                            index = (first + block) * wp.static(BLOCK) + i
                            away = cloud.point[index] - here
                            if wp.dot(away, away) < bound[3] * bound[3]:
                                own.near[env, found] = index
                                found += 1
                own.near[env, found] = -1
                found += 1
            for m in range(cell[0], cell[1]):
                feel(probes, pairs, cloud, io, own, state, env, own.members[m])

    return proximity_gathered if gathered else proximity
