"""Exact distance of a link from a shape: from the triangles of a surface by its tree, from primitives in closed form.

The sign of a distance from a surface is that of the angle-weighted pseudo-normal at the closest point (Bærentzen &
Aanæs 2005). On a processor one thread takes one link; on a GPU a group of threads does.
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import ANYWHERE, DISTANCE_BOUNDS, FAR, MESH, MESHES, PARTS, WARP
from brainbench.stimuli.engines.rod.mesh_bvh import WIDE

from .algebra import unrotate, vec2, vec3, vec4
from .distances import primitive, segment_primitive
from .mesh_bvh import NearestTriangles, corner, nearest_triangles
from .motion import BodyMotion, pose_from
from .parameters import against, group_size, module_options, real
from .state import ChainArrays, JobArrays, LinkDistance, LinkTaper, MotionArrays, PausedWhiskers, ShapeArrays
from .thread_groups import warp_max


@wp.func
def pseudo_normal(shapes: ShapeArrays, face: int, v: real, w: real) -> vec3:
    """Return the pseudo-normal of the corner, edge or face that holds a point of these barycentric coordinates."""
    u = real(1.0) - v - w
    low = real(1e-4)
    on_p = u > low
    on_q = v > low
    on_r = w > low
    # Which feature holds the point decides: the normal of one face tells the wrong side near a sharp edge or corner.
    # Slot 0 is the face, 1 to 3 its corners, 4 to 6 the edges opposite to them.
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
    return shapes.outward[face, slot]


@wp.func
def surface_point(shapes: ShapeArrays, face: int, v: real, w: real) -> vec3:
    """Return the point of a triangle with these barycentric coordinates."""
    leaf = face // wp.static(WIDE)
    rank = face % wp.static(WIDE)
    p = corner(shapes.corners, leaf, 0, rank)
    return p + (corner(shapes.corners, leaf, 1, rank) - p) * v + (corner(shapes.corners, leaf, 2, rank) - p) * w


@wp.func
def signed_direction(away: vec3, distance: real, outward: vec3, radius: real) -> vec4:
    """Return the direction out of a mesh and the signed distance, given the way from the closest point."""
    # So near the surface, rounding would turn the way from it.
    if distance < real(1e-3) * radius:
        return vec4(outward[0], outward[1], outward[2], distance)
    side = real(1.0) / distance
    signed = distance
    if wp.dot(away, outward) < real(0.0):
        side = -side
        signed = -distance
    return vec4(away[0] * side, away[1] * side, away[2] * side, signed)


@wp.func
def mesh_distance(
    shapes: ShapeArrays, s: int, a: vec3, b: vec3, ra: real, rb: real, within: real, got: NearestTriangles
) -> LinkDistance:
    """Return contacts no further than ``within`` from the link's axis, or that the link lies far inside."""
    found = LinkDistance()
    found.between = 0
    found.end = 0
    found.leaf = 0
    first = shapes.face[s]
    square = wp.min(got.side, wp.min(got.end, got.start))
    found.clearance = wp.sqrt(square)
    # The nearest of all, with where it is on the axis.
    face = got.face
    share = got.share
    v = got.v
    w = got.w
    if got.end < got.side:
        face = got.end_face
        share = real(1.0)
        v = got.end_v
        w = got.end_w
    if got.start < wp.min(got.side, got.end):
        face = got.start_face
        share = real(0.0)
        v = got.start_v
        w = got.start_w
    if face >= 0:
        found.leaf = face // wp.static(WIDE) + 1
        away = a + (b - a) * share - surface_point(shapes, first + face, v, w)
        radius = ra + (rb - ra) * share
        out = signed_direction(away, found.clearance, pseudo_normal(shapes, first + face, v, w), radius)
        # The whole axis is on the side of its nearest point, or it crosses the surface there.
        if out[3] < real(1e-3) * radius:
            found.crossing = 1
        if share == real(0.0):
            found.start = 1
            found.start_gap = out[3] - radius
            found.start_normal = vec3(out[0], out[1], out[2])
        if found.clearance > within:
            # No contact within reach, but the axis lies inside: without this a deep overlap would count as free.
            if out[3] < real(0.0):
                found.between = 1
                found.share = share
                found.gap = out[3] - radius
                found.normal = vec3(out[0], out[1], out[2])
                found.clearance = real(0.0)
            return found
    # Further away a search need not have found the nearest.
    if got.face >= 0 and got.side <= within * within:
        face = first + got.face
        out_here = pseudo_normal(shapes, face, got.v, got.w)
        # On a flat or hollow edge the ends of the link are nearer, or as near.
        flat = wp.dot(out_here, shapes.outward[face, 0]) > real(0.99999)
        if got.share > real(1e-3) and got.share < real(1.0 - 1e-3) and not (flat and got.side > real(0.0)):
            radius = ra + (rb - ra) * got.share
            away = a + (b - a) * got.share - surface_point(shapes, face, got.v, got.w)
            out = signed_direction(away, wp.sqrt(got.side), out_here, radius)
            found.between = 1
            found.share = got.share
            found.gap = out[3] - radius
            found.normal = vec3(out[0], out[1], out[2])
    if got.end_face >= 0 and got.end <= within * within:
        face = first + got.end_face
        away = b - surface_point(shapes, face, got.end_v, got.end_w)
        out = signed_direction(away, wp.sqrt(got.end), pseudo_normal(shapes, face, got.end_v, got.end_w), rb)
        found.end = 1
        found.end_gap = out[3] - rb
        found.end_normal = vec3(out[0], out[1], out[2])
    return found


@wp.func
def mesh_overlap(
    shapes: ShapeArrays, s: int, a: vec3, b: vec3, ra: real, rb: real, leaf: int, part: int, live: int
) -> vec2:
    """Return the deepest overlap of a link with a surface, and that of its start; measured at places along it."""
    overlap = vec2(real(-1e20), real(0.0))
    for k in range(wp.static(PARTS + 1)):
        share = real(k) / real(wp.static(PARTS))
        x = a + (b - a) * share
        got = nearest_triangles(shapes, s, x, x, real(wp.static(ANYWHERE)), real(0.0), leaf, part, live)
        if got.end_face >= 0:
            face = shapes.face[s] + got.end_face
            away = x - surface_point(shapes, face, got.end_v, got.end_w)
            radius = ra + (rb - ra) * share
            out = pseudo_normal(shapes, face, got.end_v, got.end_w)
            depth = radius - signed_direction(away, wp.sqrt(got.end), out, radius)[3]
            overlap[0] = wp.max(overlap[0], depth)
            if k == 0:
                overlap[1] = depth
    return overlap


@wp.func
def link_shape_distance(
    shapes: ShapeArrays,
    s: int,
    body: BodyMotion,
    a_world: vec3,
    b_world: vec3,
    taper: LinkTaper,
    margin: real,
    bound: real,
    leaf: int,
    part: int,
    live: int,
) -> LinkDistance:
    """Return how near a link comes to a shape, in lengths of the scene but directions of the shape.

    Contacts are told up to a gap of ``margin``; a negative one asks only for a bound of the distance, up to so far.
    ``bound`` is what is known of the distance already: from 0 on down the link may be inside, however deep.
    """
    # Into the frame and the unit of the shape.
    turn_s = shapes.turn[s]
    scale = shapes.scale[s]
    local = unrotate(body.turn, a_world - body.place) - shapes.place[s]
    a = unrotate(turn_s, local) / scale
    local = unrotate(body.turn, b_world - body.place) - shapes.place[s]
    b = unrotate(turn_s, local) / scale
    ra = taper.start_radius / scale
    rb = taper.end_radius / scale
    found = LinkDistance()
    meshed = int(0)
    if wp.static(against == MESHES):
        searching = int(0)
        if shapes.kind[s] == wp.static(MESH):
            meshed = 1
            searching = live
        # Contacts are found within the margin; the nearest triangle of all as far as FAR, for the bound.
        within = (wp.max(taper.start_radius, taper.end_radius) + margin) / scale
        radius = wp.max(within, real(wp.static(FAR)) / scale)
        if margin < real(0.0):
            within = real(0.0)
            radius = -margin / scale
        farthest = radius
        # Without a bound, nothing found within a radius means outside or deep inside: the nearest of all tells.
        if bound <= real(0.0):
            farthest = real(wp.static(ANYWHERE)) / scale
        got = nearest_triangles(shapes, s, a, b, farthest, within, leaf - 1, part, searching)
        found = mesh_distance(shapes, s, a, b, ra, rb, within, got)
        found.clearance = wp.min(found.clearance, radius)
        deep = int(0)
        if searching == 1 and found.crossing == 1 and margin >= real(0.0):
            deep = 1
        if warp_max(deep) == 1:
            overlap = mesh_overlap(shapes, s, a, b, ra, rb, found.leaf - 1, part, deep)
            if deep == 1:
                found.depth = overlap[0]
                found.start = 1
                found.start_gap = -overlap[1]
    # Primitives: what lies between the ends, and the far end on its own.
    if meshed == 0:
        nearest = segment_primitive(shapes.kind[s], shapes.size[s] / scale, a, b, ra, rb)
        # The gap counts from the skin, the bound from the axis; the thinner end keeps it a lower bound.
        found.clearance = nearest[1] + wp.min(ra, rb)
        found.share = nearest[0]
        found.gap = nearest[1]
        found.normal = vec3(nearest[2], nearest[3], nearest[4])
        found.between = 0
        if nearest[0] > real(1e-3) and nearest[0] < real(1.0 - 1e-3):
            found.between = 1
        tip = primitive(shapes.kind[s], shapes.size[s] / scale, b)
        found.end = 1
        found.end_gap = tip[3] - rb
        found.end_normal = vec3(tip[0], tip[1], tip[2])
        near = primitive(shapes.kind[s], shapes.size[s] / scale, a)
        found.start = 1
        found.start_gap = near[3] - ra
        found.start_normal = vec3(near[0], near[1], near[2])
        found.depth = wp.max(-nearest[1], real(0.0))
        # Even where the whisker is thickest, its axis is inside.
        if found.depth > wp.max(ra, rb):
            found.crossing = 1
        found.leaf = leaf
    found.clearance = found.clearance * scale
    found.gap = found.gap * scale
    found.end_gap = found.end_gap * scale
    found.start_gap = found.start_gap * scale
    found.depth = found.depth * scale
    return found


@wp.kernel(enable_backward=False, module="unique", module_options=module_options(), launch_bounds=DISTANCE_BOUNDS)
def measure_distances(
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    jobs: JobArrays,
    paused: PausedWhiskers,
    threads: int,
):
    """Answer all queries: ``group_size`` threads take one link after the other, ``threads`` in all.

    Reads ``paused.query``, ``query_frame`` and ``query_margin``, and the links' last leaves; writes ``paused.answer``.
    Scenes have one shape each.
    """
    thread = wp.tid()
    part = thread % wp.static(group_size)
    place = thread // wp.static(group_size)
    count = wp.min(paused.query_count[0], paused.query.shape[0])
    # All threads of a warp go on, or none.
    while place - place % wp.static(WARP // group_size) < count:
        live = int(0)
        if place < count:
            live = 1
        which = wp.min(place, count - 1)
        place = place + threads // wp.static(group_size)
        index = paused.query[which].job
        i = paused.query[which].link
        s = shapes.first[jobs.scene[index]]
        base = BodyMotion()
        base.coarse = paused.query_frame[index].coarse
        base.place = paused.query_frame[index].place
        body = pose_from(motions, shapes.track[s], paused.query_frame[index].time, base)
        margin = paused.query_margin[index]
        start = paused.query[which].start
        stop = paused.query[which].stop
        leaf = paused.link[i, index].leaf
        taper = chains.taper[i, jobs.whisker[index]]
        bound = paused.query[which].bound
        found = link_shape_distance(shapes, s, body, start, stop, taper, margin, bound, leaf, part, live)
        if live == 1 and part == 0:
            paused.answer[which] = found
