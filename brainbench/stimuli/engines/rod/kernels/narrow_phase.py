"""Exact distance of a link from a shape: from the triangles of a surface by its tree, from primitives in closed form.

The sign of a distance from a surface is that of the angle-weighted pseudo-normal at the closest point (Bærentzen &
Aanæs 2005).
"""

import warp as wp

from brainbench.stimuli.engines.rod.limits import (
    ANYWHERE,
    ASIDE,
    DEPTH_HALVINGS,
    DISTANCE_BOUNDS,
    FAR,
    MESH,
    MESHES,
    PARTS,
    TRIANGLES_TRIED,
    WARP,
    WIDE,
)

from .algebra import unrotate, vec3, vec5
from .distances import beside_triangle, halvings, line_triangle, primitive, pseudo_normal, segment_primitive, way_out
from .mesh_search import NearestTriangles, beyond, nearest_triangles
from .motion import BodyMotion, pose_from
from .parameters import against, group_size, module_options, real, recorded, smooth
from .state import (
    ChainArrays,
    Cone,
    JobArrays,
    LinkDistance,
    MotionArrays,
    PausedWhiskers,
    ShapeArrays,
    cone,
    line_place,
    line_tangent,
)
from .thread_groups import warp_max

end_part = 1e-5 if smooth else 1e-3
"""Part of a link at its ends where a place counts as the end; a force on the rod would turn where it passes there."""
CHORD, NEARER, DEPTHS, DEEPEST, DONE = range(5)
"""What is searched for a link and a mesh, one after another."""


@wp.func
def touch_between(found: wp.ref[LinkDistance], nearest: vec5, triangle: int):
    """Keep the place of a link that is nearest to a shape; places at its ends are handled apart."""
    if wp.static(recorded):
        found.triangle = triangle
    found.share = nearest[0]
    found.gap = nearest[1]
    found.normal = vec3(nearest[2], nearest[3], nearest[4])
    found.between = 0
    if nearest[0] > real(wp.static(end_part)) and nearest[0] < real(wp.static(1.0 - end_part)):
        found.between = 1


@wp.func
def mesh_distance(shapes: ShapeArrays, s: int, link: Cone, within: real, got: NearestTriangles) -> LinkDistance:
    """Return contacts no further than ``within`` from the link's axis, or that the link lies far inside."""
    found = LinkDistance()
    first = shapes.face[s]
    a = link.a
    b = link.b
    ra = link.start_radius
    rb = link.end_radius
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
        if wp.static(smooth):
            found.face = face
        radius = ra + (rb - ra) * share
        out = way_out(shapes, first + face, v, w, a + (b - a) * share, found.clearance, radius)
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
                touch_between(found, vec5(share, out[3] - radius, out[0], out[1], out[2]), first + face)
                found.between = 1
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
            out = way_out(shapes, face, got.v, got.w, a + (b - a) * got.share, wp.sqrt(got.side), radius)
            touch_between(found, vec5(got.share, out[3] - radius, out[0], out[1], out[2]), face)
    if got.end_face >= 0 and got.end <= within * within:
        face = first + got.end_face
        out = way_out(shapes, face, got.end_v, got.end_w, b, wp.sqrt(got.end), rb)
        if wp.static(recorded):
            found.end_triangle = face
        found.end = 1
        found.end_gap = out[3] - rb
        found.end_normal = vec3(out[0], out[1], out[2])
    return found


@wp.func
def link_shape_distance(
    shapes: ShapeArrays,
    s: int,
    body: BodyMotion,
    world: Cone,
    margin: real,
    bound: real,
    leaf: int,
    part: int,
    live: int,
) -> LinkDistance:
    """Return how near a link, in ``world`` axes, comes to a shape, in lengths of the scene but directions of the shape.

    Contacts are told up to a gap of ``margin``; a negative one asks only for a bound of the distance, up to so far.
    ``bound`` is what is known of the distance already: from 0 on down the link may be inside, however deep.
    """
    # Into the frame and the unit of the shape.
    local_quaternion = shapes.quaternion[s]
    scale = shapes.scale[s]
    local = unrotate(body.quaternion, world.a - body.place) - shapes.place[s]
    a = unrotate(local_quaternion, local) / scale
    local = unrotate(body.quaternion, world.b - body.place) - shapes.place[s]
    b = unrotate(local_quaternion, local) / scale
    ra = world.start_radius / scale
    rb = world.end_radius / scale
    link = Cone()
    link.a = a
    link.b = b
    if wp.static(smooth):
        for k in range(4):
            offset = vec3(world.line.offset[0, k], world.line.offset[1, k], world.line.offset[2, k])
            turn = vec3(world.line.turn[0, k], world.line.turn[1, k], world.line.turn[2, k])
            offset = unrotate(local_quaternion, unrotate(body.quaternion, offset)) / scale
            turn = unrotate(local_quaternion, unrotate(body.quaternion, turn)) / scale
            for d in range(3):
                link.line.offset[d, k] = offset[d]
                link.line.turn[d, k] = turn[d]
    link.start_radius = ra
    link.end_radius = rb
    found = LinkDistance()
    meshed = int(0)
    if wp.static(against == MESHES):
        searching = int(0)
        if shapes.kind[s] == wp.static(MESH):
            meshed = 1
            searching = live
        # Contacts are found within the margin; the nearest triangle of all as far as FAR, for the bound.
        within = (wp.max(world.start_radius, world.end_radius) + margin) / scale
        radius = wp.max(within, real(wp.static(FAR)) / scale)
        if margin < real(0.0):
            within = real(0.0)
            radius = -margin / scale
        chord = link
        bow = real(0.0)
        if wp.static(smooth):
            # The centre line lies no further than this from the chord between its ends.
            a = line_place(link, real(0.0))
            b = line_place(link, real(1.0))
            chord.a = a
            chord.b = b
            for k in range(1, 3):
                third = real(k) / real(3.0)
                bow = wp.max(bow, real(1.2) * wp.length(line_place(link, third) - a - (b - a) * third))
            within = within + bow
            radius = radius + bow
        farthest = radius
        # Without a bound, nothing found within a radius means outside or deep inside: the nearest of all tells.
        if bound <= real(0.0):
            farthest = real(wp.static(ANYWHERE)) / scale
        first_leaf = leaf
        # One search, which would be written out for each purpose: of the chord; of what is nearer to the centre line
        # than the triangle before; where the link is inside of places along it, and of the deepest between these.
        phase = int(DONE)
        if searching == 1:
            phase = int(CHORD)
        measured = int(0)
        share = real(0.0)
        face = int(-1)
        looked = int(-1)
        side = int(0)
        nearest = vec5()
        far = real(wp.static(beyond))
        low = real(0.0)
        high = real(1.0)
        deepest = real(wp.static(-beyond))
        falling = vec3()
        rising = vec3()
        while warp_max(int(phase != DONE)) == 1:
            got = nearest_triangles(shapes, s, a, b, farthest, within, first_leaf - 1, part, int(phase != DONE))
            triangle = shapes.face[s] + got.end_face
            if phase == CHORD:
                found = mesh_distance(shapes, s, chord, within, got)
                in_reach = found.clearance <= within and found.leaf > 0
                found.clearance = wp.min(wp.max(found.clearance - bow, real(0.0)), radius - bow)
                first_leaf = found.leaf
                phase = int(DONE)
                if margin >= real(0.0) and found.crossing == 1:
                    phase = int(DEPTHS)
                if wp.static(smooth):
                    if margin >= real(0.0) and in_reach:
                        phase = int(NEARER)
                        triangle = shapes.face[s] + found.face
                within = real(0.0)
            elif phase == DEPTHS or phase == DEEPEST:
                here = ra + (rb - ra) * share
                out = way_out(shapes, triangle, got.end_v, got.end_w, a, wp.sqrt(got.end), here)
                depth = here - out[3]
                found.depth = wp.max(found.depth, depth)
                if out[3] < real(1e-3) * here:
                    found.crossing = 1
                measured = measured + 1
                if phase == DEPTHS:
                    if measured == 1:
                        found.start = 1
                        found.start_gap = -depth
                    if depth > deepest:
                        deepest = depth
                        low = wp.max(share - real(wp.static(1.0 / PARTS)), real(0.0))
                        high = wp.min(share + real(wp.static(1.0 / PARTS)), real(1.0))
                    if measured > wp.static(PARTS):
                        measured = int(0)
                        phase = wp.static(DEEPEST if smooth else DONE)
                else:
                    normal = vec3(out[0], out[1], out[2])
                    slope = wp.dot(normal, line_tangent(link, share)) - (rb - ra)
                    if slope > real(0.0):
                        high = share
                        falling = normal / slope
                    else:
                        low = share
                        rising = normal / wp.min(slope, real(-1e-12))
                    # Differences of simulations see the last of few halvings.
                    if measured == wp.static(halvings if recorded else DEPTH_HALVINGS):
                        if low == real(0.0):
                            share = real(0.0)
                        if high == real(1.0):
                            share = real(1.0)
                        # Between two faces the way out is across the line and their edge.
                        across = (falling - rising) / (wp.length(falling) + wp.length(rising))
                        part_out = wp.length(across)
                        if part_out > real(0.5):
                            normal = across / part_out
                            depth = here - out[3] / part_out
                        touch_between(found, vec5(share, -depth, normal[0], normal[1], normal[2]), triangle)
                        phase = int(DONE)
            if wp.static(smooth):
                if phase == NEARER:
                    looked = looked + 1
                    measured = measured + 1
                    if triangle >= shapes.face[s] and triangle != face:
                        tried = line_triangle(shapes, triangle, link)
                        off = tried[1] + ra + (rb - ra) * tried[0]
                        if off < real(1.0 - 3e-6) * far:
                            nearest = tried
                            far = off
                            face = triangle
                            looked = 0
                            away = vec3(tried[2], tried[3], tried[4])
                            side = beside_triangle(shapes, face, line_place(link, tried[0]), away)
                            # Rounding would decide the way out of a face that the line pierces.
                            if off < real(0.03) * rb:
                                side = int(-1)
                    if looked == 3 or (looked > 0 and side != 0) or measured > wp.static(TRIANGLES_TRIED):
                        found.crossing = 0
                        phase = int(DONE)
                        if side < 0:
                            measured = int(0)
                            phase = int(DEPTHS)
                        else:
                            touch_between(found, nearest, face)
                    aside = real(wp.static(ASIDE)) * real((looked + 1) % 3 - 1)
                    share = wp.clamp(nearest[0] + aside, real(0.0), real(1.0))
                    farthest = real(1.0 - 3e-6) * far
                    if looked > 0:
                        farthest = far + real(wp.static(ASIDE)) * wp.length(link.b - link.a)
            if phase == DEPTHS or phase == DEEPEST:
                share = real(measured) / real(wp.static(PARTS))
                if phase == DEEPEST:
                    share = real(0.5) * (low + high)
                farthest = real(wp.static(ANYWHERE))
            a = line_place(link, share)
            b = a
    # Primitives: what lies between the ends, and the far end on its own.
    if meshed == 0:
        if wp.static(smooth):
            a = line_place(link, real(0.0))
            b = line_place(link, real(1.0))
        tip = primitive(shapes.kind[s], shapes.size[s] / scale, b)
        near = primitive(shapes.kind[s], shapes.size[s] / scale, a)
        beside = segment_primitive(shapes.kind[s], shapes.size[s] / scale, link, near, tip)
        # The gap counts from the skin, the bound from the axis; the thinner end keeps it a lower bound.
        found.clearance = beside[1] + wp.min(ra, rb)
        touch_between(found, beside, -1)
        found.end = 1
        found.end_gap = tip[3] - rb
        found.end_normal = vec3(tip[0], tip[1], tip[2])
        found.start = 1
        found.start_gap = near[3] - ra
        found.start_normal = vec3(near[0], near[1], near[2])
        found.depth = wp.max(-beside[1], real(0.0))
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
    # Model:
    chains: ChainArrays,
    motions: MotionArrays,
    shapes: ShapeArrays,
    jobs: JobArrays,
    # Data in and out:
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
        leaf = paused.link[i, index].leaf
        taper = chains.taper[i, jobs.whisker[index]]
        link = cone(paused.query[which].start, paused.query[which].stop, taper)
        if wp.static(smooth):
            link.line = paused.query[which].line
        bound = paused.query[which].bound
        found = link_shape_distance(shapes, s, body, link, margin, bound, leaf, part, live)
        if live == 1 and part == 0:
            paused.answer[which] = found
