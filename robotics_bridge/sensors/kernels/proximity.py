"""Surface points in blocks of neighbours, and the proximity taxel that sums over them (thesis 4.11–4.16).

Letters: B environment, N taxel, P surface point, K block of points, R variant row, G geometry, S sensor.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays
from robotics_bridge.sensors.context import numbers_of
from robotics_bridge.sensors.kernels.noise import episode_draw, radius_noise
from robotics_bridge.sensors.kernels.pairs import PairArrays
from robotics_bridge.sensors.kernels.readout import (
    CLEAN,
    FUSED,
    ProbeArrays,
    ReadoutArrays,
    readout_functions,
    silenced,
)
from robotics_bridge.sensors.taxels.sensors import ProximityTaxel

wp = warp()

BLOCK = 32  # points of a block


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
class CellArrays:
    """Points within reach of every cell of a grid, so that a taxel looks at those around it alone."""

    shape: wp.array2d(dtype=wp.int32)
    """[R, G] number of the grid of a geometry, −1 for none."""
    origin: wp.array(dtype=wp.vec3f)
    """[H] corner of a grid in the geometry's frame (m)."""
    inverse: wp.array(dtype=wp.float32)
    """[H] 1 / edge of its cells (1/m)."""
    counts: wp.array(dtype=wp.vec3i)
    """[H] cells along each axis."""
    first: wp.array(dtype=wp.int32)
    """[H] first cell in ``start``."""
    start: wp.array(dtype=wp.int32)
    """First entry of every cell; that of the next is its end."""
    entry: wp.array(dtype=wp.int32)
    """Numbers of points, rising within a cell."""


@wp.struct
@numbers_of(ProximityTaxel)
class ProximityParams:
    """Law of one taxel sensor, with the names and units of ``ProximityTaxel``."""


@wp.struct
class ProximityArrays:
    """Arrays of the proximity taxels of a group."""

    laws: wp.array(dtype=ProximityParams)
    """[S]."""
    densities: wp.array2d(dtype=wp.float32)
    """[S, R] weight of a point."""
    links: wp.array(dtype=wp.int32)
    """[S]."""


@cache
def proximity_kernel(physical: bool, mode: int, hysteresis: bool, walk: bool) -> Any:
    """Return the kernel of ProximityTaxel. Dim [B, N].

    Args:
        physical: convention of the forces.
        mode: of the readout.
        hysteresis: whether it is stored.
        walk: whether it is stored.
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

    @wp.kernel(module="unique", grid_stride=False, launch_bounds=(256, 2 if mode == FUSED else 3))
    def proximity(
        probes: ProbeArrays,
        pairs: PairArrays,
        cloud: CloudArrays,
        cells: CellArrays,
        io: ReadoutArrays,
        own: ProximityArrays,
        state: StateArrays,
    ):
        env, n = wp.tid()
        radius = probes.radius[n]
        if not silenced(io, 6, env, n, radius):
            row = env % cells.shape.shape[0]
            slot = probes.slot[n]
            part = io.part[n]
            probe = io.probe[n]
            x = probes.position[n]
            episode = io.episode[env]
            noisy = radius
            if wp.static(mode != CLEAN):
                # Both branches share one pass over the points: the query reaches as far as the larger of the two radii
                # (4.23).
                error = radius_noise(io.knobs[part], env + io.env_offset, probe, io.age[env], episode)
                noisy = wp.max(radius + error, 0.0)
            reach = wp.max(radius, noisy)
            turning = wp.vec3f(0.0)
            mass = wp.vec2f(0.0)
            moment = wp.vec3f(0.0)
            moment_noisy = wp.vec3f(0.0)
            slip = wp.vec3f(0.0)
            slip_noisy = wp.vec3f(0.0)
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
                number = cells.shape[row, geometry]
                if number >= 0:
                    counts = cells.counts[number]
                    u = cells.inverse[number] * (here - cells.origin[number])
                    # Beyond the grid nothing is within reach.
                    if (
                        wp.min(u) >= 0.0
                        and u[0] < float(counts[0])
                        and u[1] < float(counts[1])
                        and u[2] < float(counts[2])
                    ):
                        cell = cells.first[number] + (int(u[0]) * counts[1] + int(u[1])) * counts[2] + int(u[2])
                        for entry in range(cells.start[cell], cells.start[cell + 1]):
                            away = cloud.point[cells.entry[entry]] - here
                            square = wp.dot(away, away)
                            if square < reach * reach:
                                # P of 4.11 with the sensing sphere and with that of the measured branch, and
                                # Σ P (p − x) as the lever from which torque and slip follow.
                                far = wp.sqrt(square)
                                overlaps = wp.vec2f(wp.max(radius - far, 0.0), wp.max(noisy - far, 0.0))
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
            lag, drift = recall_six(io, env, n)
            emit_six(io, env, n, fixed, lag, drift, truth, signal)

    return proximity
