"""Kernels of the elastomer: indentation, its spreading, points that sink in and drag the gel, and the sum over both.

Thesis 4.17–4.21, and the layer terms derived in docs/elastomers.md. Vectors are in the frame of the sensor link.
Letters: B environment, N marker, P surface point, S sensor of the group.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.sensors.context import numbers_of
from robotics_bridge.sensors.kernels.distance import FAR, SolidArrays, SolidShape, distance_function
from robotics_bridge.sensors.kernels.noise import episode_draw, radius_noise
from robotics_bridge.sensors.kernels.pairs import PairArrays
from robotics_bridge.sensors.kernels.probe import deepest_function
from robotics_bridge.sensors.kernels.proximity import BLOCK, CloudArrays
from robotics_bridge.sensors.kernels.readout import ProbeArrays, ReadoutArrays, readout_functions, silenced
from robotics_bridge.sensors.taxels.sensors import ElastomerTaxel, Layer

wp = warp()

NEGLIGIBLE = 17.0  # exponent of a Gaussian from which it is left out: 4e-8 of its middle


@wp.struct
@numbers_of(ElastomerTaxel, Layer)
class GelParams:
    """One sensor: its material, with the names and units of ``ElastomerTaxel`` and ``Layer``, and its grid."""

    layered: wp.int32
    expansion: wp.vec2f
    frame: wp.vec2f
    center: wp.vec3f
    along: wp.vec3f
    across: wp.vec3f
    normal: wp.vec3f
    start: wp.int32
    rows: wp.int32
    columns: wp.int32
    step_x: wp.float32
    step_y: wp.float32
    slot: wp.int32
    own_first: wp.int32
    own_last: wp.int32


@wp.struct
class ElastomerArrays:
    """Arrays of the elastomers of a group. P counts the points of all sensors, K their blocks of 32.

    ``stamp`` and ``dragged`` mark that something happened in this update: age · 1024 + episode.
    """

    gels: wp.array(dtype=GelParams)
    """[S]."""
    weights: wp.array3d(dtype=wp.float32)
    """[S, 2, …] Gaussian weights along columns and rows, by distance in markers."""
    reach: wp.array2d(dtype=wp.int32)
    """[S, 2] how many markers away they count."""
    stamp: wp.array2d(dtype=wp.int32)
    """[B, S] mark of an indentation."""
    indentation: wp.array3d(dtype=wp.float32)
    """[2 planes, B, N] h (m), then its bulge h^α."""
    spread: wp.array3d(dtype=wp.float32)
    """[3 planes, B, N] sums over columns, or the full convolution."""
    tracked: wp.array(dtype=wp.int32)
    """Geometries whose points are followed."""
    own: wp.array(dtype=wp.int32)
    """Geometries of the pads."""
    blocks: wp.int32
    """K of one sensor."""
    anchor: wp.array3d(dtype=wp.float32)
    """[P, 3, B] where a point sank in (m); x NaN: nowhere."""
    held: wp.array2d(dtype=wp.int32)
    """[K, B] anchors in a block."""
    moved: wp.array2d(dtype=wp.int32)
    """[K, B] points that moved since they sank in, plus 64 times one more than the block's place in the pair list."""
    dragged: wp.array2d(dtype=wp.int32)
    """[B, S] mark of a drag."""
    drive: wp.array2d(dtype=wp.float32)
    """[P, B] s_s h of the points that moved, without gaps."""
    order: wp.array2d(dtype=wp.uint8)
    """[P, B] their numbers in the block."""
    drag: wp.array2d(dtype=wp.vec2f)
    """[B, N] shear along and across (m), where it is summed by rows and columns."""
    along: wp.array3d(dtype=wp.vec4f)
    """[B, groups of four columns, CHUNK] weights of columns."""
    across: wp.array3d(dtype=wp.vec2f)
    """[B, rows, CHUNK] drives times weights of rows."""


@wp.func
def mark_of(io: ReadoutArrays, env: int) -> int:
    """Return the mark of this update."""
    return io.age[env] * 1024 + io.episode[env]


@wp.func
def anchor_of(pads: ElastomerArrays, index: int, env: int) -> wp.vec3f:
    """Return where a point sank in."""
    return wp.vec3f(pads.anchor[index, 0, env], pads.anchor[index, 1, env], pads.anchor[index, 2, env])


@cache
def indent_kernel(kinds: frozenset[int], raycast: bool, planes: int, in_turn: bool = False) -> Any:
    """Return the kernel of the indentation h (4.18), and with ``planes`` 2 of the one with radius noise.

    Dim [B, N], or [B, 1] if ``in_turn``: a thread serves all markers of an environment.
    """
    deepest = deepest_function(kinds, raycast)

    @wp.kernel(module="unique")
    def indent(
        probes: ProbeArrays,
        solids: SolidArrays,
        pairs: PairArrays,
        io: ReadoutArrays,
        pads: ElastomerArrays,
    ):
        env, first = wp.tid()
        end = first + 1
        if wp.static(in_turn):
            end = probes.radius.shape[0]
        for n in range(first, end):
            part = io.part[n]
            h = float(0.0)
            noisy = float(0.0)
            if probes.radius[n] > 0.0 and pairs.count[env, probes.slot[n]] > 0:
                best, _normal, _place = deepest(probes, solids, pairs, env, n, 0.0)
                h = wp.max(-best, 0.0)
                if wp.static(planes == 2):
                    number = env + io.env_offset
                    error = radius_noise(io.knobs[part], number, io.probe[n], io.age[env], io.episode[env])
                    noisy = wp.max(error - best, 0.0)
                # A stamp in place of a flag needs no clearing: pads that nothing touches skip all later sums.
                if h > 0.0 or noisy > 0.0:
                    pads.stamp[env, part] = mark_of(io, env)
            pads.indentation[0, env, n] = h
            if wp.static(planes == 2):
                pads.indentation[1, env, n] = noisy
            # The bulge h^α is asked for by many markers, so it is raised once.
            for plane in range(wp.static(planes)):
                value = wp.where(plane == 1, noisy, h)
                raised = float(0.0)
                if value > 0.0:
                    raised = wp.pow(value, pads.gels[part].exponent)
                pads.indentation[wp.static(planes) + plane, env, n] = raised

    return indent


@cache
def spread_kernel(planes: int, in_turn: bool = False) -> Any:
    """Return the kernel that spreads h along the columns of planar grids: 3 sums per plane.

    Dim [B, N], or [B, 1] if ``in_turn``: a thread serves all markers of an environment.

    With one-dimensional weights w(k) = exp(−λ (k·pitch)²): Σ h w, Σ h k·pitch·w and Σ h^α w.
    """

    @wp.kernel(module="unique")
    def spread(
        probes: ProbeArrays,
        io: ReadoutArrays,
        pads: ElastomerArrays,
    ):
        env, first = wp.tid()
        end = first + 1
        if wp.static(in_turn):
            end = probes.radius.shape[0]
        for n in range(first, end):
            part = io.part[n]
            if pads.stamp[env, part] != mark_of(io, env):
                continue
            gel = pads.gels[part]
            place = io.probe[n] % gel.columns
            row = n - place
            for plane in range(wp.static(planes)):
                plain = float(0.0)
                tilted = float(0.0)
                raised = float(0.0)
                # exp(−λ_d |x_j − x_i|²) is a product of one weight per axis, so 4.19 costs rows + columns instead of
                # rows × columns. Of its three terms, the tangential ones carry one factor x_j − x_i each, the normal
                # one h^α.
                low = wp.max(place - pads.reach[part, 0], 0)
                high = wp.min(place + pads.reach[part, 0] + 1, gel.columns)
                for source in range(low, high):
                    h = pads.indentation[plane, env, row + source]
                    if h > 0.0:
                        away = place - source
                        w = pads.weights[part, 0, wp.abs(away)]
                        plain += h * w
                        tilted += h * w * float(away) * gel.step_x
                        raised += pads.indentation[wp.static(planes) + plane, env, row + source] * w
                pads.spread[3 * plane, env, n] = plain
                pads.spread[3 * plane + 1, env, n] = tilted
                pads.spread[3 * plane + 2, env, n] = raised

    return spread


@wp.func
def block_of(cloud: CloudArrays, tracked: wp.array(dtype=wp.int32), row: int, geometry: int, block: int) -> int:
    """Return the number in the cloud of a block that was counted through all tracked geometries."""
    before = int(0)
    for member in range(tracked.shape[0]):
        if tracked[member] == geometry:
            return cloud.first[row, geometry] + block - before
        before += cloud.blocks[row, tracked[member]]
    return 0


@wp.func
def across_plane(v: wp.vec3f, n: wp.vec3f) -> wp.vec3f:
    """Return the part of a vector across a unit normal."""
    return v - wp.dot(v, n) * n


@wp.func
def traction(gel: GelParams, away: wp.vec3f, slip: wp.vec3f) -> wp.vec3f:
    """Return Cerruti's surface displacement, softened over the contact, minus its image below the bonded base."""
    # Tangential displacement under a tangential point load: ((1 − ν) s + ν (r · s) r / r²) / r. The softening length
    # keeps it finite below the load, the image at 2 × thickness takes out most of what a bonded base forbids.
    square = wp.dot(away, away) + gel.softening * gel.softening
    inverse = 1.0 / wp.sqrt(square)
    u = inverse * ((1.0 - gel.poisson) * slip + gel.poisson * (wp.dot(away, slip) * inverse * inverse) * away)
    if gel.thickness > 0.0:
        deep = 1.0 / wp.sqrt(square + 4.0 * gel.thickness * gel.thickness)
        u -= deep * ((1.0 - gel.poisson) * slip + gel.poisson * (wp.dot(away, slip) * deep * deep) * away)
    return u


@cache
def marker_kernel(
    way: int,
    layered: bool,
    planes: int,
    mode: int,
    hysteresis: bool,
    walk: bool,
    in_turn: bool = False,
    apart: bool = False,
) -> Any:
    """Return the kernel that sums dilation and shear at every marker (4.19–4.21). Dim [B, N], or [B, 1] if ``in_turn``.

    Args:
        way: 0 sums sources directly; 1: h was spread along the columns of planar grids; 2: h was convolved in full.
        layered: some sensor uses the layer terms.
        planes: 2 when the measured branch has its own h.
        mode: of the noise.
        hysteresis: whether the group stores hysteresis.
        walk: whether the group stores a drift.
        in_turn: a thread serves all markers of an environment.
        apart: the shear of sensors without a layer was summed before, in ``drag``.
    """
    readout = readout_functions(mode, hysteresis, walk, 3)
    emit_six, recall_six = readout.emit_six, readout.recall_six

    @wp.kernel(module="unique")
    def markers(
        probes: ProbeArrays,
        io: ReadoutArrays,
        pads: ElastomerArrays,
        pairs: PairArrays,
        cloud: CloudArrays,
    ):
        env, first = wp.tid()
        end = first + 1
        if wp.static(in_turn):
            end = probes.radius.shape[0]
        for n in range(first, end):
            if silenced(io, 3, env, n, probes.radius[n]):
                continue
            part = io.part[n]
            probe = io.probe[n]
            gel = pads.gels[part]
            x = probes.position[n]
            normal = probes.normal[n]
            truth = wp.vec3f(0.0)
            signal = wp.vec3f(0.0)
            if pads.stamp[env, part] == mark_of(io, env):
                for plane in range(wp.static(planes)):
                    u = wp.vec3f(0.0)
                    total = float(0.0)
                    if wp.static(way == 2):
                        # The three convolutions of 4.19 are done; only s_d and the directions of the pad remain.
                        u = gel.dilate_scale * (
                            pads.spread[3 * plane, env, n] * gel.along
                            + pads.spread[3 * plane + 1, env, n] * gel.across
                            + pads.spread[3 * plane + 2, env, n] * normal
                        )
                    elif wp.static(way == 1):
                        # Second pass of the separable sum: rows, over what the first pass left for each column.
                        place = probe // gel.columns
                        along = float(0.0)
                        across = float(0.0)
                        raised = float(0.0)
                        low = wp.max(place - pads.reach[part, 1], 0)
                        high = wp.min(place + pads.reach[part, 1] + 1, gel.rows)
                        for source in range(low, high):
                            at = n + (source - place) * gel.columns
                            w = pads.weights[part, 1, wp.abs(place - source)]
                            along += w * pads.spread[3 * plane + 1, env, at]
                            across += w * float(place - source) * gel.step_y * pads.spread[3 * plane, env, at]
                            raised += w * pads.spread[3 * plane + 2, env, at]
                        u = gel.dilate_scale * (along * gel.along + across * gel.across + raised * normal)
                    else:
                        for source in range(gel.rows * gel.columns):
                            h = pads.indentation[plane, env, gel.start + source]
                            if h > 0.0:
                                # 4.19 as written, source by source: for pads whose markers form no planar grid.
                                away = across_plane(x - probes.position[gel.start + source], normal)
                                square = gel.dilate_spread * wp.dot(away, away)
                                w = wp.exp(-square)
                                if wp.static(layered):
                                    # Layer term 1 − κ λ_d r² (recoil κ): what is pushed outwards near an indenter is
                                    # drawn in farther off.
                                    away = (1.0 - gel.recoil * square) * away
                                bulge = pads.indentation[wp.static(planes) + plane, env, gel.start + source]
                                u += gel.dilate_scale * w * (h * away + bulge * normal)
                    if wp.static(layered):
                        # Layer term: a layer that can hardly be compressed spreads in proportion to the mean
                        # indentation.
                        if gel.expansion[0] != 0.0 or gel.expansion[1] != 0.0:
                            for source in range(gel.rows * gel.columns):
                                total += pads.indentation[plane, env, gel.start + source]
                            local = x - gel.center
                            bx = wp.dot(local, gel.along)
                            by = wp.dot(local, gel.across)
                            scale = total / float(gel.rows * gel.columns)
                            ux = bx
                            uy = by
                            if gel.frame[0] > 0.0:
                                # Displacement of a layer whose edges are clamped: the first mode that vanishes there.
                                ux = gel.frame[0] / wp.pi * wp.sin(wp.pi * wp.clamp(bx / gel.frame[0], -1.0, 1.0))
                                uy = gel.frame[1] / wp.pi * wp.sin(wp.pi * wp.clamp(by / gel.frame[1], -1.0, 1.0))
                            u += scale * (gel.expansion[0] * ux * gel.along + gel.expansion[1] * uy * gel.across)
                    if plane == 0:
                        truth = u
                    else:
                        signal = u
            slide = wp.vec3f(0.0)
            if pads.dragged[env, part] == mark_of(io, env):
                row = env % cloud.first.shape[0]
                last = part * pads.blocks + pads.blocks
                if wp.static(apart):
                    if gel.layered == 0:
                        slide = pads.drag[env, n][0] * gel.along + pads.drag[env, n][1] * gel.across
                        last = 0
                for block in range(part * pads.blocks, last):
                    packed = pads.moved[block, env]
                    if packed > 0:
                        at = packed // 64 - 1
                        rotation = wp.transpose(pairs.rotation[env, at])
                        offset = pairs.offset[env, at]
                        start = block_of(cloud, pads.tracked, row, pairs.geometry[env, at], block - part * pads.blocks)
                        # Σ w (z − anchor) with z = rotation (p − offset): the pose of the block is applied once.
                        here = wp.transpose(rotation) @ x + offset
                        up = wp.transpose(rotation) @ normal
                        # Sum of 4.20 over the block in the object's frame, where points do not move: the sum of weights
                        # times points and that of weights times anchors are rotated once, not point by point.
                        mass = float(0.0)
                        carried = wp.vec3f(0.0)
                        left = wp.vec3f(0.0)
                        for k in range(packed % 64):
                            own = int(pads.order[block * wp.static(BLOCK) + k, env])
                            index = block * wp.static(BLOCK) + own
                            p = cloud.point[start * wp.static(BLOCK) + own]
                            strength = pads.drive[block * wp.static(BLOCK) + k, env]
                            kept = anchor_of(pads, index, env)
                            if wp.static(layered):
                                if gel.layered == 1:
                                    z = rotation @ (p - offset)
                                    slip = across_plane(strength * (z - kept), normal)
                                    slide += traction(gel, across_plane(x - z, normal), slip)
                                    strength = 0.0
                            away = p - here
                            rise = wp.dot(away, up)
                            far = gel.shear_spread * (wp.dot(away, away) - rise * rise)
                            if far < wp.static(NEGLIGIBLE):
                                w = strength * wp.exp(-far)
                                mass += w
                                carried += w * (p - offset)
                                left += w * kept
                        if mass > 0.0:
                            slide += rotation @ carried - left
                if gel.layered == 0:
                    # Π of 4.17 is linear: it is applied to the sum of 4.20 instead of to every term.
                    slide = across_plane(slide, normal)
            if wp.static(planes == 1):
                signal = truth
            # Sum of 4.21. Shear has one value for both branches: radius noise acts on the dilation alone.
            truth += slide
            fixed = wp.vec3f(1.0, 0.0, 0.0)
            if wp.static(mode > 0):
                fixed = episode_draw(io.knobs[part], env + io.env_offset, probe, io.episode[env])
            signal = fixed[0] * (signal + slide)
            all_truth = wp.spatial_vectorf(truth[0], truth[1], truth[2], 0.0, 0.0, 0.0)
            all_signal = wp.spatial_vectorf(signal[0], signal[1], signal[2], 0.0, 0.0, 0.0)
            lag, drift = recall_six(io, env, n)
            emit_six(io, env, n, fixed, lag, drift, all_truth, all_signal)

    return markers


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
    distance_to = distance_function(kinds, raycast)

    @wp.func
    def pad_gap(solids: SolidArrays, own: wp.array(dtype=wp.int32), gel: GelParams, row: int, z: wp.vec3f) -> float:
        """Return the signed distance of a point to the pad's surface, negative inside."""
        # A pad without geometry of its own is the plane through its markers; otherwise the union of its solids.
        if gel.own_last == gel.own_first:
            return wp.dot(z - gel.center, gel.normal)
        phi = float(wp.static(FAR))
        for o in range(gel.own_first, gel.own_last):
            shape = solids.solid[row, own[o]]
            local = wp.transform_point(wp.transform_inverse(shape.frame), z)
            phi = wp.min(phi, distance_to(solids.values, shape, local, wp.vec3f(), 0.0, 2.0 * shape.bound[3])[3])
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
        solid_row = env % solids.solid.shape[0]
        # If even the bounding sphere lies above the release height, no point of the block can hold an anchor.
        middle = rotation @ (wp.vec3f(sphere[0], sphere[1], sphere[2]) - offset)
        if pad_gap(solids, pads.own, gel, solid_row, middle) - sphere[3] > gel.leave:
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
                shape = solids.solid[solid_row, pads.own[gel.own_first]]
                frame = wp.transform_inverse(shape.frame)
                # Pose of the object and frame of the pad joined into one transform: each point then costs one product.
                turn = wp.quat_to_matrix(wp.transform_get_rotation(frame)) @ rotation
                shift = wp.transform_get_translation(frame) - turn @ offset
                limit = 2.0 * shape.bound[3]
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
                        phi = distance_to(solids.values, shape, turn @ p + shift, wp.vec3f(), 0.0, limit)[3]
                else:
                    phi = pad_gap(solids, pads.own, gel, solid_row, z)
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
                        strength = gel.shear_scale * wp.max(-phi, 0.0)
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
                            w = weight(gel.shear_spread, y - float(row) * gel.step_y)
                            pads.across[env, row, points] = w * force
                            if w > 0.0:
                                span[0] = wp.min(span[0], row)
                                span[1] = wp.max(span[1], row + 1)
                        for group in range(groups):
                            four = wp.vec4f()
                            for i in range(4):
                                four[i] = weight(gel.shear_spread, x - float(4 * group + i) * gel.step_x)
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
