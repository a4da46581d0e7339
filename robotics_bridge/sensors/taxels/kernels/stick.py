"""Friction at rest: every taxel holds the point of the body that it touched first, by a spring with Coulomb's limit.

With depth d, normal force f_n and the tangential way u of the held point since, a taxel carries the tangential force
f_n σ, σ = ρ u / d: for d near a working depth a spring of ρ times the normal stiffness (Mindlin 1949). Where |σ| would
exceed the coefficient μ, the point slides after the taxel until |σ| = μ. Anchors lie in the frame of the touched link,
so that motions of both together change nothing and nothing drifts. Letters: B environment, N taxel.
"""

from brainbench.core.devices import warp
from robotics_bridge.sensors.kernels.readout import ReadoutArrays
from robotics_bridge.sensors.queries.kernels.distance import SolidArrays
from robotics_bridge.sensors.queries.kernels.pairs import PairArrays

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
    frame = solids.frame[env % solids.kind.shape[0], geometry]
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
