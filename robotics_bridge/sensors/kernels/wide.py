"""Access to memory that costs a GPU fewer instructions than Warp's own: several numbers at once, or without strides.

Arrays are contiguous and begin at a multiple of 16 bytes, as all that Warp makes do; numbers of places are 0 or more.
"""

from brainbench.core.devices import warp

wp = warp()


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    const float4 found = *reinterpret_cast<const float4*>(&index(values, n));
    return wp::vec4f(found.x, found.y, found.z, found.w);
#else
    return index(values, n);
#endif
"""
)
def load_four(values: wp.array(dtype=wp.vec4f), n: int) -> wp.vec4f:
    """Return one vector."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    const int4 found = *reinterpret_cast<const int4*>(&index(pairs, n));
    return wp::vec_t<4, int>(found.x, found.y, found.z, found.w);
#else
    const auto& one = index(pairs, n);
    const auto& two = index(pairs, n + 1);
    return wp::vec_t<4, int>(one[0], one[1], two[0], two[1]);
#endif
"""
)
def load_contacts(pairs: wp.array(dtype=wp.vec2i), n: int) -> wp.vec4i:
    """Return the pairs n and n + 1 of geometries; n is even."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    const int2 found = *reinterpret_cast<const int2*>(&index(owners, n));
    return wp::vec_t<2, int>(found.x, found.y);
#else
    return wp::vec_t<2, int>(index(owners, n), index(owners, n + 1));
#endif
"""
)
def load_owners(owners: wp.array(dtype=wp.int32), n: int) -> wp.vec2i:
    """Return the numbers n and n + 1; n is even."""
    ...


@wp.func_native("return values.data[n];")
def entry(values: wp.array(dtype=wp.int32), n: int) -> int:
    """Return one number."""
    ...


@wp.func_native("return values.data[size_t(row) * values.shape[1] + n];")
def entry_of(values: wp.array2d(dtype=wp.vec3f), row: int, n: int) -> wp.vec3f:
    """Return one vector of a row."""
    ...


@wp.func_native(
    """
    const float* at = planes.data + size_t(row) * planes.shape[2] + n;
    const size_t step = size_t(planes.shape[1]) * planes.shape[2];
    wp::vec_t<6, float> found;
    for (int k = 0; k < 6; ++k) found[k] = k < count ? at[k * step] : 0.0f;
    return found;
"""
)
def load_planes(planes: wp.array3d(dtype=wp.float32), row: int, n: int, count: int) -> wp.spatial_vectorf:
    """Return one place of the first planes, at most six."""
    ...


@wp.func_native(
    """
    float* at = planes.data + size_t(row) * planes.shape[2] + n;
    const size_t step = size_t(planes.shape[1]) * planes.shape[2];
    for (int k = 0; k < 6; ++k) if (k < count) at[k * step] = value[k];
"""
)
def store_planes(planes: wp.array3d(dtype=wp.float32), row: int, n: int, count: int, value: wp.spatial_vectorf):
    """Write one place of the first planes, at most six."""
    ...
