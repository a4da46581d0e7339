"""Shear of planar elastomers on a processor: the Gaussian of 4.20 is a product of weights of rows and of columns.

Vectors are in the frame of the sensor link. Letters: B environment, N marker, G group of four columns, R row.
"""

from brainbench.core.devices import warp
from robotics_bridge.sensors.elastomer.kernels.dilation import NEGLIGIBLE, GelParams, block_of
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
    along: wp.array3d(dtype=wp.vec4f),
    across: wp.array3d(dtype=wp.vec2f),
    out: wp.array2d(dtype=wp.vec2f),
    env: int,
    points: int,
    start: int,
    columns: int,
    span: wp.vec4i,
):
    """Add what the kept points do to the markers between the rows and the groups of ``span``."""
    for row in range(span[0], span[1]):
        for group in range(span[2], span[3]):
            x = wp.vec4f()
            y = wp.vec4f()
            for k in range(points):
                w = along[env, group, k]
                s = across[env, row, k]
                x += w * s[0]
                y += w * s[1]
            for i in range(4):
                column = 4 * group + i
                if column < columns:
                    n = start + row * columns + column
                    out[env, n] = out[env, n] + wp.vec2f(x[i], y[i])


@wp.kernel
def sum_shear(
    probes: ProbeArrays,
    io: ReadoutArrays,
    gels: wp.array(dtype=GelParams),
    blocks: int,
    tracked: wp.array(dtype=wp.int32),
    pairs: PairArrays,
    cloud: CloudArrays,
    moved: wp.array2d(dtype=wp.int32),
    dragged: wp.array2d(dtype=wp.int32),
    anchor: wp.array3d(dtype=wp.float32),
    drive: wp.array2d(dtype=wp.float32),
    order: wp.array2d(dtype=wp.uint8),
    along: wp.array3d(dtype=wp.vec4f),
    across: wp.array3d(dtype=wp.vec2f),
    out: wp.array2d(dtype=wp.vec2f),
):
    """Sum the shear of points that moved, ``out`` [B, N] along and across (m). Thread: environment [B].

    Sensors with a layer are left out: their kernel is no product. ``along`` [B, G, CHUNK] takes weights of columns,
    ``across`` [B, R, CHUNK] drives times weights of rows.
    """
    env = wp.tid()
    variant = env % cloud.first.shape[0]
    for part in range(gels.shape[0]):
        gel = gels[part]
        if dragged[env, part] == io.age[env] * 1024 + io.episode[env] and gel.layered == 0:
            for n in range(gel.start, gel.start + gel.rows * gel.columns):
                out[env, n] = wp.vec2f()
            groups = (gel.columns + 3) // 4
            corner = probes.position[gel.start]
            points = int(0)
            span = wp.vec4i(gel.rows, 0, groups, 0)
            for block in range(part * blocks, part * blocks + blocks):
                packed = moved[block, env]
                if packed > 0:
                    at = packed // 64 - 1
                    rotation = wp.transpose(pairs.rotation[env, at])
                    offset = pairs.offset[env, at]
                    first = block_of(cloud, tracked, variant, pairs.geometry[env, at], block - part * blocks)
                    for k in range(packed % 64):
                        own = int(order[block * wp.static(BLOCK) + k, env])
                        index = block * wp.static(BLOCK) + own
                        z = rotation @ (cloud.point[first * wp.static(BLOCK) + own] - offset)
                        kept = wp.vec3f(anchor[index, 0, env], anchor[index, 1, env], anchor[index, 2, env])
                        slip = drive[block * wp.static(BLOCK) + k, env] * (z - kept)
                        force = wp.vec2f(wp.dot(slip, gel.along), wp.dot(slip, gel.across))
                        x = wp.dot(z - corner, gel.along)
                        y = wp.dot(z - corner, gel.across)
                        for row in range(gel.rows):
                            w = weight(gel.smear, y - float(row) * gel.step_y)
                            across[env, row, points] = w * force
                            if w > 0.0:
                                span[0] = wp.min(span[0], row)
                                span[1] = wp.max(span[1], row + 1)
                        for group in range(groups):
                            four = wp.vec4f()
                            for i in range(4):
                                four[i] = weight(gel.smear, x - float(4 * group + i) * gel.step_x)
                            along[env, group, points] = four
                            if four[0] + four[1] + four[2] + four[3] > 0.0:
                                span[2] = wp.min(span[2], group)
                                span[3] = wp.max(span[3], group + 1)
                        points += 1
                        if points == wp.static(CHUNK):
                            add_chunk(along, across, out, env, points, gel.start, gel.columns, span)
                            points = 0
                            span = wp.vec4i(gel.rows, 0, groups, 0)
            add_chunk(along, across, out, env, points, gel.start, gel.columns, span)
