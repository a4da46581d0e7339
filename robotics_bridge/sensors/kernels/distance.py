"""Signed distance of a point to a solid, as Warp functions: closed forms, sampled distance fields and triangles.

Every function ``name(…, x) -> (normal, distance)`` gives a vec4 in the frame of the geometry: the outward unit normal
and the distance (m), negative inside. Letters: R variant row (1 or B environments), G geometry, F distance field.
"""

from __future__ import annotations

from functools import cache
from typing import Any

from brainbench.core.devices import warp

wp = warp()

PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH, OTHER, WALL, THIN = range(10)
"""Numbers of the kinds, in the order of :data:`robotics_bridge.physics.scene.KINDS`; then meshes with thin walls, and a
mark, no kind, of thin solids among the others."""
SIDED = frozenset({WALL, THIN})  # those that are asked from the side of the sensor

FAR = 1.0e6  # distance that stands for "out of reach" (m)


@wp.struct
class SolidShape:
    """One geometry of a scene."""

    kind: wp.int32
    """Number of the kind."""
    size: wp.vec3f
    """(m), as in ``Geometry.size``; of a thin wall the rounding of its edges and its least
    and largest thickness."""
    bound: wp.vec4f
    """Centre and radius of an enclosing sphere (m)."""
    frame: wp.transformf
    """Pose in the frame of the link."""
    mesh: wp.uint64
    """Id of the triangle tree."""
    thickness: wp.float32
    """Least width of a thin solid that is no wall (m), 0 for others."""
    first: wp.int32
    """First sample of its distance field in ``SolidArrays.values``."""
    counts: wp.vec3i
    """Samples along each axis."""
    origin: wp.vec3f
    """Position of the first sample (m)."""
    spacing: wp.float32
    """(m)."""


@wp.struct
class SolidArrays:
    """The geometries of a scene on a device."""

    solid: wp.array2d(dtype=SolidShape)
    """[R, G]."""
    link: wp.array(dtype=wp.int32)
    """[G]."""
    values: wp.array(dtype=wp.float32)
    """Samples of all distance fields (m)."""


@wp.func
def plane(size: wp.vec3f, x: wp.vec3f) -> wp.vec4f:
    """Return the outward normal at a point (m, frame of the solid), and its signed distance (m), as do those below."""
    return wp.vec4f(0.0, 0.0, 1.0, x[2])


@wp.func
def sphere(size: wp.vec3f, x: wp.vec3f) -> wp.vec4f:
    """Return normal and signed distance (m); ``size`` is the radius. Upwards in the middle."""
    far = wp.length(x)
    n = wp.vec3f(0.0, 0.0, 1.0)
    if far > 1.0e-12:
        n = x / far
    return wp.vec4f(n[0], n[1], n[2], far - size[0])


@wp.func
def capsule(size: wp.vec3f, x: wp.vec3f) -> wp.vec4f:
    """Return normal and signed distance (m); ``size`` is the radius and half the length between the round ends."""
    return sphere(size, wp.vec3f(x[0], x[1], x[2] - wp.clamp(x[2], -size[1], size[1])))


@wp.func
def cylinder(size: wp.vec3f, x: wp.vec3f) -> wp.vec4f:
    """Return normal and signed distance (m) of a capped cylinder; ``size`` is the radius and half the height."""
    # Euclidean to the rim where both are exceeded, else the nearer of side and end.
    radial = wp.sqrt(x[0] * x[0] + x[1] * x[1])
    side = radial - size[0]
    end = wp.abs(x[2]) - size[1]
    ux = float(1.0)
    uy = float(0.0)
    if radial > 1.0e-12:
        ux = x[0] / radial
        uy = x[1] / radial
    uz = wp.where(x[2] < 0.0, -1.0, 1.0)
    if side > 0.0 and end > 0.0:
        far = wp.sqrt(side * side + end * end)
        return wp.vec4f(ux * side / far, uy * side / far, uz * end / far, far)
    if side > end:
        return wp.vec4f(ux, uy, 0.0, side)
    return wp.vec4f(0.0, 0.0, uz, end)


@wp.func
def signs(x: wp.vec3f) -> wp.vec3f:
    """Return the octant of a point: 1 or −1 along each axis."""
    return wp.vec3f(wp.where(x[0] < 0.0, -1.0, 1.0), wp.where(x[1] < 0.0, -1.0, 1.0), wp.where(x[2] < 0.0, -1.0, 1.0))


@wp.func
def box(size: wp.vec3f, x: wp.vec3f) -> wp.vec4f:
    """Return normal and signed distance (m); ``size`` holds half the edges."""
    # By symmetry in one octant: length of the positive excesses outside, the largest of the three (all negative)
    # inside, with that face's normal.
    sign = signs(x)
    over = wp.cw_mul(sign, x) - size
    if over[0] > 0.0 or over[1] > 0.0 or over[2] > 0.0:
        outside = wp.max(over, wp.vec3f())
        far = wp.length(outside)
        n = wp.cw_mul(sign, outside) * (1.0 / far)
        return wp.vec4f(n[0], n[1], n[2], far)
    if over[0] >= over[1] and over[0] >= over[2]:
        return wp.vec4f(sign[0], 0.0, 0.0, over[0])
    if over[1] >= over[2]:
        return wp.vec4f(0.0, sign[1], 0.0, over[1])
    return wp.vec4f(0.0, 0.0, sign[2], over[2])


@wp.func
def ellipsoid(size: wp.vec3f, x: wp.vec3f) -> wp.vec4f:
    """Find the nearest point e² x / (e² + t), t the largest root of Σ (e x / (e² + t))² = 1, by halving."""
    # Coordinates of exactly zero hide the root at the short axis.
    shift = 1.0e-6 * wp.min(size)
    y = wp.max(wp.abs(x), wp.vec3f(shift))
    # The sum decreases steadily beyond t = −min e², so halving finds the root for any ratio of axes; Newton steps
    # overshoot near the centre of flat ellipsoids. Octant by symmetry, sign restored at the end.
    short = wp.min(size)
    squares = wp.cw_mul(size, size)
    scaled = wp.cw_mul(size, y)
    low = -short * short
    high = wp.length(scaled)
    for _ in range(40):
        t = 0.5 * (low + high)
        a = scaled[0] / (squares[0] + t)
        b = scaled[1] / (squares[1] + t)
        c = scaled[2] / (squares[2] + t)
        if a * a + b * b + c * c > 1.0:
            low = t
        else:
            high = t
    t = 0.5 * (low + high)
    near = wp.cw_div(wp.cw_mul(squares, y), squares + wp.vec3f(t))
    n = wp.normalize(wp.cw_div(near, squares))
    distance = wp.dot(y - near, n)
    n = wp.cw_mul(signs(x), n)
    return wp.vec4f(n[0], n[1], n[2], distance)


@wp.func
def field(values: wp.array(dtype=wp.float32), shape: SolidShape, x: wp.vec3f) -> wp.vec4f:
    """Interpolate a sampled field linearly within its cells.

    Beyond the samples the distance is that to the surface point which the nearest border sample points at.
    """
    spacing = shape.spacing
    n = shape.counts
    u = (x - shape.origin) / spacing
    limit = wp.vec3f(float(n[0] - 1), float(n[1] - 1), float(n[2] - 1))
    c = wp.vec3f(wp.clamp(u[0], 0.0, limit[0]), wp.clamp(u[1], 0.0, limit[1]), wp.clamp(u[2], 0.0, limit[2]))
    i = wp.min(int(c[0]), n[0] - 2)
    j = wp.min(int(c[1]), n[1] - 2)
    k = wp.min(int(c[2]), n[2] - 2)
    fx = c[0] - float(i)
    fy = c[1] - float(j)
    fz = c[2] - float(k)
    at = shape.first + (i * n[1] + j) * n[2] + k
    row = n[2]
    sheet = n[1] * n[2]
    v000 = values[at]
    v001 = values[at + 1]
    v010 = values[at + row]
    v011 = values[at + row + 1]
    v100 = values[at + sheet]
    v101 = values[at + sheet + 1]
    v110 = values[at + sheet + row]
    v111 = values[at + sheet + row + 1]
    v00 = v000 + fz * (v001 - v000)
    v01 = v010 + fz * (v011 - v010)
    v10 = v100 + fz * (v101 - v100)
    v11 = v110 + fz * (v111 - v110)
    v0 = v00 + fy * (v01 - v00)
    v1 = v10 + fy * (v11 - v10)
    # Gradient of the same trilinear interpolant, not differences of queries: distance and normal agree within a cell.
    gy = (1.0 - fx) * (v01 - v00) + fx * (v11 - v10)
    gz0 = (1.0 - fy) * (v001 - v000) + fy * (v011 - v010)
    gz1 = (1.0 - fy) * (v101 - v100) + fy * (v111 - v110)
    gradient = wp.vec3f(v1 - v0, gy, (1.0 - fx) * gz0 + fx * gz1)
    far = wp.length(gradient)
    normal = wp.vec3f(0.0, 0.0, 1.0)
    if far > 1.0e-12:
        normal = gradient / far
    distance = v0 + fx * (v1 - v0)
    out = (u - c) * spacing
    if wp.dot(out, out) > 0.0:
        away = out + normal * distance
        distance = wp.length(away)
        normal = away / wp.max(distance, 1.0e-12)
    return wp.vec4f(normal[0], normal[1], normal[2], distance)


@wp.func
def triangles(mesh: wp.uint64, x: wp.vec3f, reach: float, rounding: float) -> wp.vec4f:
    """Find the nearest triangle of a closed mesh; ``rounding`` (in mean edges) joins triangles that are as near."""
    found = wp.mesh_query_point_sign_normal(mesh, x, reach, rounding)
    if not found.result:
        return wp.vec4f(0.0, 0.0, 1.0, wp.static(FAR))
    away = x - wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    far = wp.length(away)
    normal = wp.mesh_eval_face_normal(mesh, found.face)
    sign = found.sign
    # Nearer than rounding can tell a direction, the face knows it.
    if far > 1.2e-4 * wp.length(x):
        across = wp.dot(away, normal)
        # Straight above a face, that face alone decides: normals of both sides cancel in the middle of a wall.
        if wp.abs(across) > 0.99 * far:
            sign = wp.sign(across)
        normal = away * (sign / far)
    return wp.vec4f(normal[0], normal[1], normal[2], sign * far)


@wp.func
def outer(found: wp.vec4f, facing: wp.vec3f) -> wp.vec4f:
    """Turn a normal that points out of the sensor to its mirror image: what touches it lies on its outer side."""
    normal = wp.vec3f(found[0], found[1], found[2])
    normal -= 2.0 * wp.max(wp.dot(normal, facing), 0.0) / wp.max(wp.length_sq(facing), 1.0e-20) * facing
    return wp.vec4f(normal[0], normal[1], normal[2], found[3])


@wp.func
def wall(shape: SolidShape, x: wp.vec3f, facing: wp.vec3f, side: float, reach: float) -> wp.vec4f:
    """Ask a thin wall from the side of the sensor: past its middle, and through it, the side touched stays the same."""
    found = triangles(shape.mesh, x, reach, shape.size[0])
    radius = wp.length(facing)
    slope = wp.dot(wp.vec3f(found[0], found[1], found[2]), facing)
    if slope <= 0.2 * radius:
        return outer(found, facing)
    # Where no contact tells the side, a surface farther behind the sensor than its radius was not passed; nor was one
    # that thins out to its rim, as a lens does, farther behind than it is thick.
    limit = radius
    if shape.size[2] > 1.5 * shape.size[1]:
        limit = wp.min(radius, shape.size[2])
    if side < 0.0 or (side == 0.0 and found[3] >= limit):
        return found
    # The nearest side faces away from the sensor, so the point lies past the middle. Going back along the sensor's
    # normal, the first face that is left, and not entered, is the one that the sensor came through.
    back = -facing / radius
    gone = float(0.0)
    most = (wp.max(found[3], 0.0) + 2.0 * shape.size[2]) * radius / slope
    for _ in range(2):
        hit = wp.mesh_query_ray(shape.mesh, x + gone * back, back, most - gone)
        if hit.result:
            gone += hit.t
            normal = wp.mesh_eval_face_normal(shape.mesh, hit.face)
            across = wp.dot(normal, back)
            if across > 0.0:
                return wp.vec4f(normal[0], normal[1], normal[2], -gone * across)
            gone += 0.01 * shape.size[1]
    return outer(found, facing)


@wp.kernel(module="unique", enable_backward=False)
def measure_walls(
    mesh: wp.uint64,
    point: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
    skip: float,
    thickness: wp.array(dtype=wp.float32),
):
    """Write how thick a mesh is below points of its surface (m), 0 where no opposite wall lies. Thread: a point.

    An opposite wall faces the other way within 25°.
    """
    n = wp.tid()
    inward = -normal[n]
    hit = wp.mesh_query_ray(mesh, point[n] + skip * inward, inward, wp.static(FAR))
    thickness[n] = 0.0
    if hit.result and wp.dot(wp.mesh_eval_face_normal(mesh, hit.face), inward) > 0.9:
        thickness[n] = hit.t + skip


@wp.kernel(module="unique")
def sample_field(mesh: wp.uint64, origin: wp.vec3f, spacing: float, reach: float, values: wp.array3d(dtype=wp.float32)):
    """Write the signed distance (m) to a mesh at every sample of a grid. Thread: a sample [nx, ny, nz]."""
    i, j, k = wp.tid()
    x = origin + wp.vec3f(float(i), float(j), float(k)) * spacing
    # Sign by winding number: small holes in a user's mesh then matter little. Slow, but done once a mesh.
    found = wp.mesh_query_point_sign_winding_number(mesh, x, reach, 2.0, 0.5)
    near = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    values[i, j, k] = found.sign * wp.length(x - near)


@cache
def distance_function(kinds: frozenset[int], raycast: bool) -> Any:
    """Return ``distance_to(solids.values, shape, x, facing, side, reach) -> (normal, distance)`` for a scene's kinds.

    ``facing`` is the outward normal of the sensor times its radius, or 0 for a distance that knows no side, and
    ``side`` is 1 where contacts push on the sensor's side, −1 on the other one, 0 where none tells.

    Args:
        kinds: only their code is compiled.
        raycast: ask triangles instead of closed forms and fields; planes stay planes.
    """
    curved = not raycast
    has_triangles = raycast and bool(kinds - {PLANE, WALL, THIN})
    thin = curved and THIN in kinds

    @wp.func
    def nearest(values: wp.array(dtype=wp.float32), shape: SolidShape, x: wp.vec3f, reach: float) -> wp.vec4f:
        """Return outward normal and signed distance of the surface nearest to ``x``, whichever its side."""
        if wp.static(PLANE in kinds):
            if shape.kind == wp.static(PLANE):
                return plane(shape.size, x)
        if wp.static(has_triangles):
            return triangles(shape.mesh, x, reach, 1.0e-3)
        if wp.static(curved and BOX in kinds):
            if shape.kind == wp.static(BOX):
                return box(shape.size, x)
        if wp.static(curved and SPHERE in kinds):
            if shape.kind == wp.static(SPHERE):
                return sphere(shape.size, x)
        if wp.static(curved and CAPSULE in kinds):
            if shape.kind == wp.static(CAPSULE):
                return capsule(shape.size, x)
        if wp.static(curved and CYLINDER in kinds):
            if shape.kind == wp.static(CYLINDER):
                return cylinder(shape.size, x)
        if wp.static(curved and ELLIPSOID in kinds):
            if shape.kind == wp.static(ELLIPSOID):
                return ellipsoid(shape.size, x)
        if wp.static(curved and MESH in kinds):
            if shape.kind == wp.static(MESH):
                return field(values, shape, x)
        return wp.vec4f(0.0, 0.0, 1.0, wp.static(FAR))

    @wp.func
    def beyond(
        values: wp.array(dtype=wp.float32), shape: SolidShape, x: wp.vec3f, facing: wp.vec3f, side: float,
        found: wp.vec4f,
    ) -> wp.vec4f:  # fmt: skip
        """Return normal and distance of a thin solid on the side that the sensor came through."""
        # As for walls: past the middle of a thin solid the side touched stays the same. Steps of the distance itself
        # lead from the point back along the sensor's normal to the side that it came through.
        radius = wp.length(facing)
        slope = wp.dot(wp.vec3f(found[0], found[1], found[2]), facing)
        if slope <= 0.2 * radius:
            return outer(found, facing)
        # Where no contact tells the side, a surface farther behind the sensor than the solid is thick was not passed:
        # it lies on a thin link.
        if side < 0.0 or (side == 0.0 and found[3] >= wp.min(radius, shape.thickness)):
            return found
        back = -facing / radius
        most = (wp.max(found[3], 0.0) + 2.0 * shape.thickness) * radius / slope
        at = found
        entered = found[3] < 0.0
        gone = float(0.0)
        for _ in range(48):
            gone += wp.max(wp.abs(at[3]), 0.02 * shape.thickness)
            if gone > most:
                return outer(found, facing)
            at = nearest(values, shape, x + gone * back, most)
            if entered and at[3] > -0.002 * shape.thickness:
                across = wp.dot(wp.vec3f(at[0], at[1], at[2]), back)
                if across > 0.2:
                    return wp.vec4f(at[0], at[1], at[2], at[3] - gone * across)
                return outer(found, facing)
            if at[3] < 0.0:
                entered = True
        return outer(found, facing)

    @wp.func
    def distance_to(
        values: wp.array(dtype=wp.float32), shape: SolidShape, x: wp.vec3f, facing: wp.vec3f, side: float, reach: float
    ) -> wp.vec4f:
        if wp.static(WALL in kinds):
            if shape.kind == wp.static(WALL):
                return wall(shape, x, facing, side, reach)
        found = nearest(values, shape, x, reach)
        if wp.static(thin):
            if shape.thickness > 0.0:
                return beyond(values, shape, x, facing, side, found)
        return found

    return distance_to
