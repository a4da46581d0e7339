"""Kernels of the sensors that ask how deep a probe lies in what it touches: distance, depth, contact.

Equation numbers are those of the thesis. Vectors are in the frame of the sensor link (m, N, N m).
Letters: B environment, N probe, R row of probes that one thread takes in turn.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.sensors.kernels.distance import FAR, SIDED, SolidArrays, distance_function
from robotics_bridge.sensors.kernels.noise import episode_draw, radius_noise
from robotics_bridge.sensors.kernels.pairs import PairArrays, push_side
from robotics_bridge.sensors.kernels.readout import CLEAN, ProbeArrays, ReadoutArrays, readout_functions, silenced

wp = warp()


@cache
def deepest_function(kinds: frozenset[int], raycast: bool) -> Any:
    """Return ``deepest(probes, solids, pairs, env, n, reach) -> (distance, normal, place)``.

    The least signed distance of a probe to what its slot lists, the outward normal there and its place in the list
    (−1: nothing). ``reach`` 0 means: whatever lies inside or within the probe's radius.
    """
    distance_to = distance_function(kinds, raycast)

    @wp.func
    def deepest(probes: ProbeArrays, solids: SolidArrays, pairs: PairArrays, env: int, n: int, reach: float):
        row = env % solids.solid.shape[0]
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
            side = float(0.0)
            if wp.static(bool(kinds & SIDED)):
                # A probe without a limit asks for the distance, whichever side is the nearest.
                if reach <= 0.0:
                    facing = rotation @ (probes.radius[n] * probes.normal[n])
                    side = push_side(pairs, env, at, probes.normal[n])
            if wp.static(raycast or bool(kinds & SIDED)):
                # A query of triangles searches within a limit: from inside, the surface is at most a bounding diameter
                # away.
                if reach <= 0.0:
                    limit = 2.0 * solids.solid[row, geometry].bound[3] + probes.radius[n]
            shape = solids.solid[row, geometry]
            found = distance_to(solids.values, shape, rotation @ x + pairs.offset[env, at], facing, side, limit)
            # The largest penetration of 4.2 is the least signed distance. A strict comparison keeps the first of equals
            # in the order of geometry numbers, so that ties do not depend on the order of contacts.
            if found[3] < best:
                best = found[3]
                normal = wp.transpose(rotation) @ wp.vec3f(found[0], found[1], found[2])
                place = at
        return best, normal, place

    return deepest


@wp.func
def latch(before: float, age: int, value: float, limits: wp.vec2f) -> float:
    """Apply the Schmitt trigger (4.3); a lost reading before counts as no contact."""
    if value > limits[0] or (age > 0 and before > 0.5 and value > limits[1]):
        return 1.0
    return 0.0


@cache
def probe_kernel(kinds: frozenset[int], raycast: bool, reads: str, mode: int, hysteresis: bool, walk: bool) -> Any:
    """Return the kernel of probes that read a ``distance``, a ``depth`` (4.2) or a ``contact`` (4.3). Dim [B, N].

    Its ``limits`` are the largest distance, or the depths beyond which contact begins and down to which it lasts.
    """
    deepest, emit = deepest_function(kinds, raycast), readout_functions(mode, hysteresis, walk, 1).emit
    distance, binary = reads == "distance", reads == "contact"

    @wp.kernel(module="unique")
    def read_probes(
        probes: ProbeArrays,
        solids: SolidArrays,
        pairs: PairArrays,
        io: ReadoutArrays,
        limits: wp.array(dtype=wp.vec2f),
    ):
        env, n = wp.tid()
        radius = probes.radius[n]
        if silenced(io, 1, env, n, radius):
            return
        part = io.part[n]
        probe = io.probe[n]
        age = io.age[env]
        episode = io.episode[env]
        best, _normal, place = deepest(probes, solids, pairs, env, n, wp.static(FAR if distance else 0.0))
        truth = wp.max(radius - best, 0.0)
        if wp.static(distance):
            truth = wp.where(place >= 0, wp.min(best, limits[part][0]), limits[part][0])
        signal = truth
        if wp.static(mode != CLEAN):
            error = radius_noise(io.knobs[part], env + io.env_offset, probe, age, episode)
            if wp.static(distance):
                signal = truth + error
            else:
                # Radius noise (4.23) and gain (4.24) act before anything else of the measured branch; the truth sees
                # neither.
                fixed = episode_draw(io.knobs[part], env + io.env_offset, probe, episode)
                signal = wp.max(wp.max(radius + error, 0.0) - best, 0.0) * fixed[0]
        if wp.static(binary):
            # Each branch latches on its own last bit (4.3): noise must not switch the true contact.
            truth = latch(io.truth[0, env, n], age, truth, limits[part])
        bit = io.measured[0, env, n]
        emit(io, env, n, truth, signal)
        if wp.static(binary and mode != CLEAN):
            io.measured[0, env, n] = latch(bit, age, io.measured[0, env, n], limits[part])

    return read_probes
