"""Rays against the triangles of a picture. Lengths in widths of the picture, about the point it looks at."""

import warp as wp

FAR = wp.constant(1.0e6)


@wp.kernel
def first_hit(
    mesh: wp.uint64,
    width: int,
    first: int,
    origin: wp.vec3,
    origin_right: wp.vec3,
    origin_down: wp.vec3,
    direction: wp.vec3,
    direction_right: wp.vec3,
    direction_down: wp.vec3,
    # Out, by pixel of a block:
    face: wp.array(dtype=int),
    weights: wp.array(dtype=wp.vec3),
):
    """Write the face that the ray of each pixel of a block meets first (−1: none), and the weights of its corners."""
    i = wp.tid()
    x = float((first + i) % width)
    y = float((first + i) / width)
    start = origin + x * origin_right + y * origin_down
    along = direction + x * direction_right + y * direction_down
    hit = wp.mesh_query_ray(mesh, start, wp.normalize(along), FAR)
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        weights[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)


@wp.kernel
def blocked(mesh: wp.uint64, start: wp.array(dtype=wp.vec3), along: wp.vec3, dark: wp.array(dtype=wp.uint8)):
    """Write for each point ``start`` [n] whether a triangle stands between it and the light (1) or none does (0)."""
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, start[i], along, FAR)
    dark[i] = wp.uint8(0)
    if hit.result:
        dark[i] = wp.uint8(1)
