"""How near a link comes to a shape: among the triangles of a mesh by its search tree, to primitives in closed form."""

from functools import cache
from types import SimpleNamespace
from typing import Any

from brainbench.stimuli.backends.rod._algebra import algebra
from brainbench.stimuli.backends.rod._limits import FAR, MESHES, NEAR
from brainbench.stimuli.backends.rod._shapes import MESH, distances
from brainbench.stimuli.backends.rod._structs import structs
from brainbench.stimuli.backends.rod._tracks import tracks


@cache
def looks(real: type, against: int) -> SimpleNamespace:
    """Return ``Touch``, ``far_mesh`` and ``look_at`` of a precision; without meshes to touch their code is left out."""
    import warp as wp

    vec3: Any = wp.types.vector(3, real)
    vec4: Any = wp.types.vector(4, real)
    shape, maths = distances(real), algebra(real)
    segment_primitive, primitive = shape.segment_primitive, shape.primitive
    segment_triangle, point_triangle = shape.segment_triangle, shape.point_triangle
    unrotate, Bodies, Pose = maths.unrotate, structs(real).Bodies, tracks(real).Pose

    @wp.func
    def outward_of(bodies: Bodies, face: int, v: real, w: real) -> vec3:
        """Pseudo-normal of the corner, edge or face on which the point with these barycentric coordinates lies."""
        u = real(1.0) - v - w
        low = real(1e-4)
        on_p = u > low
        on_q = v > low
        on_r = w > low
        slot = 0
        if on_p and not on_q and not on_r:
            slot = 1
        elif on_q and not on_p and not on_r:
            slot = 2
        elif on_r and not on_p and not on_q:
            slot = 3
        elif not on_p:
            slot = 4
        elif not on_q:
            slot = 5
        elif not on_r:
            slot = 6
        return bodies.outward[face, slot]

    @wp.func
    def single3(x: vec3) -> wp.vec3f:
        return wp.vec3f(wp.float32(x[0]), wp.float32(x[1]), wp.float32(x[2]))

    @wp.struct
    class Touch:
        """How near a link comes to a shape: between its ends, and at its far end."""

        between: wp.int32
        """Whether something between the ends is near."""
        share: real
        gap: real
        normal: vec3
        end: wp.int32
        """Whether the far end is near."""
        end_gap: real
        end_normal: vec3
        clear: real
        """Lower bound of the distance of the link's axis from the surface."""
        close: wp.int32
        """Whether triangles were near."""

    @wp.func
    def corner_point(bodies: Bodies, face: int, v: real, w: real) -> vec3:
        p = bodies.corner[face, 0]
        return p + (bodies.corner[face, 1] - p) * v + (bodies.corner[face, 2] - p) * w

    @wp.func
    def direction(away: vec3, distance: real, outward: vec3, radius: real) -> vec4:
        """Direction out of a mesh and signed distance, given the way from the closest point and the pseudo-normal."""
        if distance < real(1e-3) * radius:
            return vec4(outward[0], outward[1], outward[2], distance)
        side = real(1.0) / distance
        signed = distance
        if wp.dot(away, outward) < real(0.0):
            side = -side
            signed = -distance
        return vec4(away[0] * side, away[1] * side, away[2] * side, signed)

    @wp.func
    def near_mesh(bodies: Bodies, s: int, a: vec3, b: vec3, ra: real, rb: real, margin: real) -> Touch:
        """Look at the triangles around a link whose axis a–b lies within ``margin`` + radius of a mesh."""
        touch = Touch()
        touch.between = 0
        touch.end = 0
        mesh = bodies.mesh[s]
        reach = wp.max(ra, rb) + margin
        low = wp.vec3f(
            wp.float32(wp.min(a[0], b[0]) - reach),
            wp.float32(wp.min(a[1], b[1]) - reach),
            wp.float32(wp.min(a[2], b[2]) - reach),
        )
        high = wp.vec3f(
            wp.float32(wp.max(a[0], b[0]) + reach),
            wp.float32(wp.max(a[1], b[1]) + reach),
            wp.float32(wp.max(a[2], b[2]) + reach),
        )
        query = wp.mesh_query_aabb(mesh, low, high)
        candidate = wp.int32(0)
        nearest = real(1e20)
        face = wp.int32(-1)
        share = real(0.0)
        v = real(0.0)
        w = real(0.0)
        end_nearest = real(1e20)
        end_face = wp.int32(-1)
        end_v = real(0.0)
        end_w = real(0.0)
        start_nearest = real(1e20)
        first = bodies.face[s]
        length = wp.length(b - a)
        axis = (b - a) / length
        zero = real(0.0)
        widest = reach * reach
        # Rounding must not hide a triangle.
        sure = real(0.998)
        while wp.mesh_query_aabb_next(query, candidate):
            row = first + candidate
            p = bodies.corner[row, 0]
            q = bodies.corner[row, 1]
            r = bodies.corner[row, 2]
            # No triangle is nearer than this, squared: beside the axis, and along it from the link and from its ends.
            tp = wp.dot(p - a, axis)
            tq = wp.dot(q - a, axis)
            tr = wp.dot(r - a, axis)
            beside_p = p - a - axis * tp
            beside_q = q - a - axis * tq
            beside_r = r - a - axis * tr
            way = beside_p + beside_q + beside_r
            beside = wp.min(wp.dot(beside_p, way), wp.min(wp.dot(beside_q, way), wp.dot(beside_r, way)))
            beside = wp.max(beside, zero)
            beside = beside * beside / wp.max(wp.length_sq(way), real(1e-20))
            start = wp.min(tp, wp.min(tq, tr))
            stop = wp.max(tp, wp.max(tq, tr))
            apart = wp.max(zero, wp.max(start - length, -stop))
            if sure * (beside + apart * apart) < wp.min(nearest, widest):
                at = segment_triangle(a, b, p, q, r)
                if at[0] < nearest:
                    nearest = at[0]
                    share = at[1]
                    v = at[2]
                    w = at[3]
                    face = row
            apart = wp.max(zero, wp.max(start - length, length - stop))
            if sure * (beside + apart * apart) < wp.min(end_nearest, widest):
                spot = point_triangle(b, p, q, r)
                square = wp.length_sq(b - p - (q - p) * spot[0] - (r - p) * spot[1])
                if square < end_nearest:
                    end_nearest = square
                    end_v = spot[0]
                    end_w = spot[1]
                    end_face = row
            apart = wp.max(zero, wp.max(start, -stop))
            if sure * (beside + apart * apart) < wp.min(start_nearest, widest):
                spot = point_triangle(a, p, q, r)
                start_nearest = wp.min(start_nearest, wp.length_sq(a - p - (q - p) * spot[0] - (r - p) * spot[1]))
        touch.clear = wp.min(reach, wp.sqrt(wp.min(nearest, wp.min(end_nearest, start_nearest))))
        if face >= 0:
            out_here = outward_of(bodies, face, v, w)
            # On a flat or hollow edge the ends of the link are nearer, or as near.
            flat = wp.dot(out_here, bodies.outward[face, 0]) > real(0.99999)
            if share > real(1e-3) and share < real(1.0 - 1e-3) and not (flat and nearest > real(0.0)):
                radius = ra + (rb - ra) * share
                away = a + (b - a) * share - corner_point(bodies, face, v, w)
                out = direction(away, wp.sqrt(nearest), out_here, radius)
                touch.between = 1
                touch.share = share
                touch.gap = out[3] - radius
                touch.normal = vec3(out[0], out[1], out[2])
        if end_face >= 0:
            away = b - corner_point(bodies, end_face, end_v, end_w)
            out = direction(away, wp.sqrt(end_nearest), outward_of(bodies, end_face, end_v, end_w), rb)
            touch.end = 1
            touch.end_gap = out[3] - rb
            touch.end_normal = vec3(out[0], out[1], out[2])
        return touch

    @wp.func
    def far_mesh(bodies: Bodies, s: int, a: vec3, b: vec3, ra: real, rb: real, look: real) -> Touch:
        """Distance bound of a link from a mesh, and a contact when its middle lies inside."""
        touch = Touch()
        touch.between = 0
        touch.end = 0
        middle = real(0.5) * (a + b)
        half = real(0.5) * wp.length(b - a)
        far = look + half
        hit = wp.mesh_query_point_sign_normal(bodies.mesh[s], single3(middle), wp.float32(far))
        touch.clear = far - half
        if hit.result:
            on = wp.mesh_eval_position(bodies.mesh[s], hit.face, hit.u, hit.v)
            away = middle - vec3(real(on[0]), real(on[1]), real(on[2]))
            distance = wp.length(away)
            touch.clear = distance - half
            if hit.sign < 0.0 and distance > real(0.0):
                touch.between = 1
                touch.share = real(0.5)
                touch.normal = -away / distance
                touch.gap = -distance - real(0.5) * (ra + rb)
                touch.clear = real(0.0)
        return touch

    if against < MESHES:

        @wp.func
        def near_mesh(bodies: Bodies, s: int, a: vec3, b: vec3, ra: real, rb: real, margin: real) -> Touch:
            return Touch()

        @wp.func
        def far_mesh(bodies: Bodies, s: int, a: vec3, b: vec3, ra: real, rb: real, look: real) -> Touch:
            return Touch()

    @wp.func
    def look_at(
        bodies: Bodies, s: int, body: Pose, a_world: vec3, b_world: vec3, taper: vec4, margin: real, close: int
    ) -> Touch:
        """How near a link comes to a shape, in lengths of the scene but directions of the shape."""
        turn_s = bodies.turn[s]
        scale = bodies.scale[s]
        local = unrotate(body.turn, a_world - body.place) - bodies.place[s]
        a = unrotate(turn_s, local) / scale
        local = unrotate(body.turn, b_world - body.place) - bodies.place[s]
        b = unrotate(turn_s, local) / scale
        ra = taper[0] / scale
        rb = taper[1] / scale
        touch = Touch()
        touch.close = close
        if bodies.kind[s] == wp.static(MESH):
            # A link that was near is looked at among its triangles at once.
            touch.clear = real(0.0)
            if close == 0:
                touch = far_mesh(bodies, s, a, b, ra, rb, real(wp.static(FAR)) / scale)
            if touch.between == 0 and touch.clear * scale <= margin + taper[0]:
                touch = near_mesh(bodies, s, a, b, ra, rb, (margin + real(wp.static(NEAR))) / scale)
                touch.close = touch.end
        else:
            found = segment_primitive(bodies.kind[s], bodies.size[s] / scale, a, b, ra, rb)
            touch.clear = found[1] + wp.min(ra, rb)
            touch.share = found[0]
            touch.gap = found[1]
            touch.normal = vec3(found[2], found[3], found[4])
            touch.between = 0
            if found[0] > real(1e-3) and found[0] < real(1.0 - 1e-3):
                touch.between = 1
            tip = primitive(bodies.kind[s], bodies.size[s] / scale, b)
            touch.end = 1
            touch.end_gap = tip[3] - rb
            touch.end_normal = vec3(tip[0], tip[1], tip[2])
        touch.clear = touch.clear * scale
        touch.gap = touch.gap * scale
        touch.end_gap = touch.end_gap * scale
        return touch

    @wp.func
    def far_at(bodies: Bodies, s: int, body: Pose, a_world: vec3, b_world: vec3, look: real) -> real:
        """Lower bound of the distance of a straight axis from a shape, up to ``look``; lengths of the scene."""
        turn_s = bodies.turn[s]
        scale = bodies.scale[s]
        local = unrotate(body.turn, a_world - body.place) - bodies.place[s]
        a = unrotate(turn_s, local) / scale
        local = unrotate(body.turn, b_world - body.place) - bodies.place[s]
        b = unrotate(turn_s, local) / scale
        zero = real(0.0)
        if bodies.kind[s] == wp.static(MESH):
            touch = far_mesh(bodies, s, a, b, zero, zero, look / scale)
            return touch.clear * scale
        tip = primitive(bodies.kind[s], bodies.size[s] / scale, real(0.5) * (a + b))
        return tip[3] * scale - real(0.5) * wp.length(b_world - a_world)

    return SimpleNamespace(Touch=Touch, far_at=far_at, look_at=look_at)
