"""Anchors of surface points that sink into an elastomer, and how hard each point drags the gel (before thesis 4.20).

Vectors are in the frame of the sensor link. Letters: B environment, P surface point, S sensor of the group.
"""

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.sensors.elastomer.kernels.dilation import ElastomerArrays, GelParams, mark_of
from robotics_bridge.sensors.kernels.readout import ReadoutArrays
from robotics_bridge.sensors.queries.kernels.distance import FAR, SolidArrays, SolidShape, shape_functions
from robotics_bridge.sensors.queries.kernels.pairs import PairArrays
from robotics_bridge.sensors.taxels.kernels.proximity import BLOCK, CloudArrays

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
