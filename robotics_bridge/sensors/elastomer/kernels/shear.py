"""Shear of planar elastomers on a processor: the Gaussian of 4.20 is a product of weights of rows and of columns.

Vectors are in the frame of the sensor link. Letters: B environment, N marker, G group of four columns, R row.
"""

from brainbench.core.devices import warp
from robotics_bridge.sensors.elastomer.kernels.dilation import NEGLIGIBLE, ElastomerArrays, anchor_of, block_of, mark_of
from robotics_bridge.sensors.kernels.readout import ProbeArrays, ReadoutArrays
from robotics_bridge.sensors.queries.kernels.pairs import PairArrays
from robotics_bridge.sensors.taxels.kernels.proximity import BLOCK, CloudArrays

wp = warp()

CHUNK = 32
"""Points whose weights are kept at once."""


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
