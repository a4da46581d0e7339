"""The Warp kernel that samples the distance field of a mesh."""

from functools import cache
from typing import Any


@cache
def field_kernel() -> Any:
    """Return the kernel ``sample``: signed distance at every grid point. Dim [nx, ny, nz]."""
    import warp as wp

    @wp.kernel(module="unique")
    def sample(mesh: wp.uint64, origin: wp.vec3f, spacing: float, reach: float, values: wp.array3d(dtype=wp.float32)):
        i, j, k = wp.tid()
        x = origin + wp.vec3f(float(i), float(j), float(k)) * spacing
        found = wp.mesh_query_point_sign_winding_number(mesh, x, reach, 2.0, 0.5)
        near = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
        values[i, j, k] = found.sign * wp.length(x - near)

    return sample
