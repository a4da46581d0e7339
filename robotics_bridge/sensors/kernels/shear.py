"""Anchors of surface points that sink into an elastomer, and how hard each point drags the gel (before thesis 4.20).

Vectors are in the frame of the sensor link. Letters: B environment, P surface point, S sensor of the group.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.sensors.kernels.dilation import (
    NEGLIGIBLE,
    ElastomerArrays,
    GelParams,
    anchor_of,
    block_of,
    mark_of,
)
from robotics_bridge.sensors.kernels.distance import FAR, SolidArrays, SolidShape, shape_functions
from robotics_bridge.sensors.kernels.pairs import PairArrays
from robotics_bridge.sensors.kernels.proximity import BLOCK, CloudArrays
from robotics_bridge.sensors.kernels.readout import ProbeArrays, ReadoutArrays

wp = warp()


@cache
def anchor_kernel(kinds: frozenset[int], raycast: bool, side_by_side: bool) -> Any:
    """Return the kernel that follows surface points inside the elastomer (before 4.20).

    A point sets its anchor where it sinks below −enter and loses it above +leave, or when its geometry no longer
    touches. Anchors are [P, 3, B] (x NaN: none). Blocks of points that lie off the pad are passed over: ``held`` counts
    the anchors of each. Of points that moved since, ``drive`` [P, B] lists s_s h without gaps, ``order`` their numbers
    in the block, and ``moved`` how many they are plus 64 times one more than the block's place in the pair list.

    Args:
        kinds: of the pad's geometries.
        raycast: ask triangles.
        side_by_side: environments are neighbouring threads, dim [S · blocks, B]; otherwise dim [B, S · blocks], and
            what a pad of one geometry asks for each point is worked out once per block (costs registers).
    """
    shapes = shape_functions(kinds, raycast)
    shape_of, distance_to, distance = shapes.shape_of, shapes.distance_to, shapes.distance

    @wp.func
    def height_over(solids: SolidArrays, own: wp.array(dtype=wp.int32), gel: GelParams, row: int, z: wp.vec3f) -> float:
        """Return the signed distance of a point to the pad's surface, negative inside."""
        # A pad without geometry of its own is the plane through its markers; otherwise the union of its solids.
        if gel.own_last == gel.own_first:
            return wp.dot(z - gel.center, gel.normal)
        phi = float(wp.static(FAR))
        for o in range(gel.own_first, gel.own_last):
            local = wp.transform_point(wp.transform_inverse(solids.frame[row, own[o]]), z)
            limit = 2.0 * solids.bound[row, own[o]][3]
            phi = wp.min(phi, distance(solids, row, own[o], local, wp.vec3f(), limit)[3])
        return phi

    @wp.kernel(module="unique")
    def anchors(
        pads: ElastomerArrays,
        solids: SolidArrays,
        pairs: PairArrays,
        cloud: CloudArrays,
        io: ReadoutArrays,
    ):
        i, j = wp.tid()
        env = i
        store = j
        if wp.static(side_by_side):
            env = j
            store = i
        part = store // pads.blocks
        gel = pads.gels[part]
        had = pads.held[store, env]
        if io.age[env] == 0:
            had = 0
        pads.moved[store, env] = 0
        count = pairs.count[env, gel.slot]
        row = env % cloud.first.shape[0]
        # Which geometry the block belongs to, counted through those that are tracked.
        block = store - part * pads.blocks
        geometry = int(-1)
        for member in range(pads.tracked.shape[0]):
            if geometry < 0:
                if block < cloud.blocks[row, pads.tracked[member]]:
                    geometry = pads.tracked[member]
                else:
                    block -= cloud.blocks[row, pads.tracked[member]]
        at = int(-1)
        if geometry >= 0:
            for k in range(count):
                if pairs.geometry[env, pairs.first[gel.slot] + k] == geometry:
                    at = pairs.first[gel.slot] + k
        if at < 0 or (io.status[env] & 1) != 0:
            pads.held[store, env] = 0
            return
        rotation = wp.transpose(pairs.rotation[env, at])
        offset = pairs.offset[env, at]
        first = cloud.first[row, geometry] + block
        sphere = cloud.sphere[first]
        solid_row = env % solids.kind.shape[0]
        # If even the bounding sphere lies above the release height, no point of the block can hold an anchor.
        middle = rotation @ (wp.vec3f(sphere[0], sphere[1], sphere[2]) - offset)
        if height_over(solids, pads.own, gel, solid_row, middle) - sphere[3] > gel.leave:
            pads.held[store, env] = 0
            return
        found = int(0)
        holds = int(0)
        shape = SolidShape()
        turn = wp.mat33f()
        shift = wp.vec3f()
        limit = float(0.0)
        alone = False
        if wp.static(not side_by_side):
            alone = gel.own_last - gel.own_first == 1
            if alone:
                pad = pads.own[gel.own_first]
                frame = wp.transform_inverse(solids.frame[solid_row, pad])
                # Pose of the object and frame of the pad joined into one transform: each point then costs one product.
                turn = wp.quat_to_matrix(wp.transform_get_rotation(frame)) @ rotation
                shift = wp.transform_get_translation(frame) - turn @ offset
                shape = shape_of(solids, solid_row, pad)
                limit = 2.0 * solids.bound[solid_row, pad][3]
        for n in range(wp.static(BLOCK)):
            p = cloud.point[first * wp.static(BLOCK) + n]
            index = store * wp.static(BLOCK) + n
            strength = float(0.0)
            if not wp.isnan(p[0]):
                kept = wp.static(float("nan"))
                if had > 0:
                    kept = pads.anchor[index, 0, env]
                z = rotation @ (p - offset)
                phi = float(0.0)
                if alone:
                    if wp.static(not side_by_side):
                        phi = distance_to(solids.values, shape, turn @ p + shift, wp.vec3f(), limit)[3]
                else:
                    phi = height_over(solids, pads.own, gel, solid_row, z)
                # Two heights as in a Schmitt trigger: an anchor set at −enter is lost only above +leave, so that a
                # point that trembles at the surface keeps its history of shear.
                if wp.isnan(kept):
                    if phi < -gel.enter:
                        kept = z[0]
                        pads.anchor[index, 1, env] = z[1]
                        pads.anchor[index, 2, env] = z[2]
                elif phi > gel.leave:
                    kept = wp.static(float("nan"))
                pads.anchor[index, 0, env] = kept
                if not wp.isnan(kept):
                    way = z - wp.vec3f(kept, pads.anchor[index, 1, env], pads.anchor[index, 2, env])
                    if wp.length_sq(way) > 0.0:
                        # s_s h_p of 4.20; the Gaussian and the slip z − e follow for each marker.
                        strength = gel.shear * wp.max(-phi, 0.0)
                    holds += 1
            if strength > 0.0:
                # Points that moved are listed without gaps: markers loop over these alone, without asking each point.
                pads.drive[store * wp.static(BLOCK) + found, env] = strength
                pads.order[store * wp.static(BLOCK) + found, env] = wp.uint8(n)
                found += 1
        pads.held[store, env] = holds
        if found > 0:
            pads.moved[store, env] = 64 * (at + 1) + found
            pads.dragged[env, part] = mark_of(io, env)

    return anchors


CHUNK = 32  # points whose weights are kept at once


@wp.func
def weight(smear: float, away: float) -> float:
    """Return the Gaussian of 4.20 along one axis."""
    far = smear * away * away
    if far < wp.static(NEGLIGIBLE):
        return wp.exp(-far)
    return 0.0


@wp.func
def add_chunk(
    pads: ElastomerArrays,
    env: int,
    points: int,
    start: int,
    columns: int,
    span: wp.vec4i,
):
    """Add what the kept points do to the markers between the rows and the groups of ``span``."""
    # Sum of products of a weight per row and one per column, four columns at a time for the processor's vector units.
    for row in range(span[0], span[1]):
        for group in range(span[2], span[3]):
            x = wp.vec4f()
            y = wp.vec4f()
            for k in range(points):
                w = pads.along[env, group, k]
                s = pads.across[env, row, k]
                x += w * s[0]
                y += w * s[1]
            for i in range(4):
                column = 4 * group + i
                if column < columns:
                    n = start + row * columns + column
                    pads.drag[env, n] = pads.drag[env, n] + wp.vec2f(x[i], y[i])


@wp.kernel
def sum_shear(
    probes: ProbeArrays,
    io: ReadoutArrays,
    pads: ElastomerArrays,
    pairs: PairArrays,
    cloud: CloudArrays,
):
    """Sum the shear of points that moved into ``drag``. Thread: environment [B].

    Sensors with a layer are left out: their kernel is no product.
    """
    env = wp.tid()
    variant = env % cloud.first.shape[0]
    for part in range(pads.gels.shape[0]):
        gel = pads.gels[part]
        if pads.dragged[env, part] == mark_of(io, env) and gel.layered == 0:
            for n in range(gel.start, gel.start + gel.rows * gel.columns):
                pads.drag[env, n] = wp.vec2f()
            groups = (gel.columns + 3) // 4
            corner = probes.position[gel.start]
            points = int(0)
            span = wp.vec4i(gel.rows, 0, groups, 0)
            for block in range(part * pads.blocks, part * pads.blocks + pads.blocks):
                packed = pads.moved[block, env]
                if packed > 0:
                    at = packed // 64 - 1
                    rotation = wp.transpose(pairs.rotation[env, at])
                    offset = pairs.offset[env, at]
                    first = block_of(cloud, pads.tracked, variant, pairs.geometry[env, at], block - part * pads.blocks)
                    for k in range(packed % 64):
                        own = int(pads.order[block * wp.static(BLOCK) + k, env])
                        index = block * wp.static(BLOCK) + own
                        z = rotation @ (cloud.point[first * wp.static(BLOCK) + own] - offset)
                        kept = anchor_of(pads, index, env)
                        # s_s h (z − e) of 4.20, projected on the pad's axes, which leaves out the part along the
                        # normal.
                        slip = pads.drive[block * wp.static(BLOCK) + k, env] * (z - kept)
                        force = wp.vec2f(wp.dot(slip, gel.along), wp.dot(slip, gel.across))
                        x = wp.dot(z - corner, gel.along)
                        y = wp.dot(z - corner, gel.across)
                        for row in range(gel.rows):
                            # exp(−λ_s r²) = exp(−λ_s y²) exp(−λ_s x²): rows + columns exponentials a point. Rows and
                            # columns with no weight bound the span that is added to.
                            w = weight(gel.smear, y - float(row) * gel.step_y)
                            pads.across[env, row, points] = w * force
                            if w > 0.0:
                                span[0] = wp.min(span[0], row)
                                span[1] = wp.max(span[1], row + 1)
                        for group in range(groups):
                            four = wp.vec4f()
                            for i in range(4):
                                four[i] = weight(gel.smear, x - float(4 * group + i) * gel.step_x)
                            pads.along[env, group, points] = four
                            if four[0] + four[1] + four[2] + four[3] > 0.0:
                                span[2] = wp.min(span[2], group)
                                span[3] = wp.max(span[3], group + 1)
                        points += 1
                        # Chunks keep the weights few enough to stay in the processor's cache.
                        if points == wp.static(CHUNK):
                            add_chunk(pads, env, points, gel.start, gel.columns, span)
                            points = 0
                            span = wp.vec4i(gel.rows, 0, groups, 0)
            add_chunk(pads, env, points, gel.start, gel.columns, span)
