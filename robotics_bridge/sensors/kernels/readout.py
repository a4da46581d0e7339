"""Output of the sensor kernels: the truth, and the measured branch with its memories, each written once.

Planar storage [C, B, N]: neighbouring probes are neighbours in memory. Native functions access several numbers at once,
or without strides, which costs a GPU fewer instructions than Warp's own; arrays are contiguous and begin at a multiple
of 16 bytes, as all that Warp makes do. Letters: B environment, N probe, C channel.
"""

from functools import cache
from types import SimpleNamespace

from brainbench.core.devices import warp
from robotics_bridge.sensors.kernels.noise import (
    ReadoutArrays,
    apply_drawn,
    decay,
    episode_draw,
    pair_normals,
)

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


@wp.func_native(
    """
    float* at = planes.data + size_t(row) * planes.shape[2] + n;
    const size_t step = size_t(planes.shape[1]) * planes.shape[2];
    for (int k = 0; k < 6; ++k) if (k < count) at[k * step] = value[k];
"""
)
def store_planes(planes: wp.array3d(dtype=wp.float32), row: int, n: int, count: int, value: wp.spatial_vectorf):
    """Write one place of the first planes, at most six."""


@wp.func
def put_push(planes: wp.array3d(dtype=wp.float32), row: int, n: int, x: wp.vec3f, force: wp.vec3f, add: bool):
    """Write force (N) and torque (N·m) of a push at x (m), or add them to what is there."""
    value = wp.spatial_vector(force, wp.cross(x, force))
    if add:
        value += load_planes(planes, row, n, 6)
    store_planes(planes, row, n, 6, value)


@wp.func
def widest_across(extents: wp.mat33f, normal: wp.vec3f) -> wp.vec3f:
    """Return the unit vector across a normal along which places spread most."""
    u = wp.cross(normal, wp.where(wp.abs(normal[0]) < 0.7, wp.vec3f(1.0, 0.0, 0.0), wp.vec3f(0.0, 1.0, 0.0)))
    u = wp.normalize(u)
    v = wp.cross(normal, u)
    angle = 0.5 * wp.atan2(2.0 * wp.dot(u, extents @ v), wp.dot(u, extents @ u) - wp.dot(v, extents @ v))
    return wp.cos(angle) * u + wp.sin(angle) * v


@wp.func
def within(x: wp.vec3f, normal: wp.vec3f, long: wp.vec3f, most: float) -> wp.vec3f:
    """Return a vector across a normal whose parts along an axis and across it are at most so long."""
    wide = wp.cross(normal, long)
    return wp.clamp(wp.dot(x, long), -most, most) * long + wp.clamp(wp.dot(x, wide), -most, most) * wide


@cache
def group_functions(lanes: int) -> SimpleNamespace:
    """Return functions of so many threads of a GPU, a power of 2 up to 32.

    ``total(vector)`` and ``largest(number)`` are those of the group; ``rank(chosen)`` says how many threads before this
    one and how many in all are chosen; after ``meet()`` each sees what the others wrote. A processor has one thread.
    """
    members = f"""
#if defined(__CUDA_ARCH__)
    const unsigned group = {2**lanes - 1}u << (threadIdx.x % 32 / {lanes} * {lanes});"""
    head = f"""{members}
    #pragma unroll
    for (int half = {lanes // 2}; half; half /= 2)"""
    sums = " ".join(f"value[{axis}] += __shfl_xor_sync(group, value[{axis}], half);" for axis in range(3))
    tail = "\n#endif\n    return value;\n"
    ranks = f"""{members}
    const unsigned all = __ballot_sync(group, chosen) & group;
    return wp::vec2i(__popc(all & ((1u << (threadIdx.x % 32)) - 1u)), __popc(all));
#else
    return wp::vec2i(0, chosen ? 1 : 0);
#endif
"""

    @wp.func_native(f"{head} {{ {sums} }}{tail}")
    def total(value: wp.vec3f) -> wp.vec3f:
        """Return the sum over the group."""

    @wp.func_native(f"{head} value = max(value, __shfl_xor_sync(group, value, half));{tail}")
    def largest(value: float) -> float:
        """Return the greatest of the group."""

    @wp.func_native(ranks)
    def rank(chosen: bool) -> wp.vec2i:
        """Return how many threads before this one and how many of the group are chosen."""

    @wp.func_native(f"{members} __syncwarp(group);\n#endif\n")
    def meet():
        """Wait until all threads of the group are here, so that each sees what the others wrote."""

    return SimpleNamespace(total=total, largest=largest, rank=rank, meet=meet)


CLEAN, FUSED, STAGED = range(3)
"""Modes: no noise; noise applied in the sensor's kernel; radius noise and gain there, the rest in later kernels."""


@wp.struct
class ProbeArrays:
    """Probes of a group, sensor by sensor, in the frame of their links."""

    position: wp.array(dtype=wp.vec3f)
    """[N] (m)."""
    normal: wp.array(dtype=wp.vec3f)
    """[N] unit, out of the sensing surface."""
    radius: wp.array(dtype=wp.float32)
    """[N] sensing radius (m); 0 for fillers."""
    packed: wp.array(dtype=wp.vec4f)
    """[N] position and radius once more, for kernels that read them in one access."""
    slot: wp.array(dtype=wp.int32)
    """[N] slot of the pair lists."""


@wp.struct
class PressArrays:
    """Contact of every taxel."""

    touch: wp.array2d(dtype=wp.vec4f)
    """[B, N] outward normal m of what is touched, where a weight is above 0, and the weight d^α."""
    noisy: wp.array2d(dtype=wp.float32)
    """[B, N] the same weight with radius noise and gain."""
    sigma: wp.array2d(dtype=wp.vec3f)
    """[B, N] σ: friction at rest over normal force, where taxels hold what they touch."""
    body: wp.array2d(dtype=wp.int32)
    """[B, N] its link."""
    listed: wp.array2d(dtype=wp.int32)
    """[B, N] taxels with a weight, from the first place of their sensor on."""
    end: wp.array2d(dtype=wp.int32)
    """[B, S] place after the last of them."""
    filled: wp.array2d(dtype=wp.uint8)
    """[B, N] 1 where a reading is anything but zeros; elsewhere measured ones, before their noise, hold anything."""


@wp.func
def clear(press: PressArrays, io: ReadoutArrays, env: int, n: int, staged: bool):
    """Write a reading of zeros, if it is anything else."""
    if press.filled[env, n] != wp.uint8(0):
        store_planes(io.truth, env, n, 6, wp.spatial_vectorf())
        press.filled[env, n] = wp.uint8(0)
    # Stages after this one write into the measured readings, which are then never left alone.
    if staged:
        store_planes(io.measured, env, n, 6, wp.spatial_vectorf())


@wp.func
def silenced(io: ReadoutArrays, channels: int, env: int, n: int, radius: float) -> bool:
    """Write the reading of a filler (radius 0), zero, or in a diverged environment, NaN; return False for others."""
    if radius > 0.0 and (io.status[env] & 1) == 0:
        return False
    for channel in range(channels):
        # Without noise both planes are one array.
        io.truth[channel, env, n] = wp.where(radius > 0.0, wp.nan, 0.0)
        io.measured[channel, env, n] = wp.where(radius > 0.0, wp.nan, 0.0)
    return True


@cache
def readout_functions(
    mode: int, hysteresis: bool, walk: bool, channels: int = 6, exact: bool = True
) -> SimpleNamespace:
    """Return the functions that write a reading, compiled for what the group stores.

    ``emit_six`` writes up to six channels, drawing all that they share once: ``fixed`` is what ``episode_draw`` gave,
    ``lag`` and ``drift`` what ``recall_six`` read (before anything else, so that nothing waits for memory). ``emit``
    does all of it for a scalar.

    Args:
        mode: :data:`CLEAN`, :data:`FUSED` or :data:`STAGED`.
        hysteresis: whether the group stores hysteresis.
        walk: whether the group stores a drift.
        channels: that ``emit_six`` writes, known to the compiler so that vectors stay in registers.
        exact: whether it writes the truth, too.
    """
    pairs = (channels + 1) // 2
    Normals = wp.types.matrix(shape=(pairs, 4), dtype=wp.float32)

    @wp.func
    def recall_six(io: ReadoutArrays, env: int, n: int):
        lag = wp.spatial_vectorf()
        drift = wp.spatial_vectorf()
        # Before the first update the memories count as zero, whatever the arrays hold: a reset has nothing to clear.
        if io.age[env] > 0:
            if wp.static(hysteresis):
                lag = load_planes(io.hysteresis, env, n, wp.static(channels))
            if wp.static(walk):
                drift = load_planes(io.walk, env, n, wp.static(channels))
        return lag, drift

    @wp.func
    def emit_six(
        io: ReadoutArrays, env: int, n: int, fixed: wp.vec3f, lag: wp.spatial_vectorf, drift: wp.spatial_vectorf,
        truth: wp.spatial_vectorf, signal: wp.spatial_vectorf,
    ):  # fmt: skip
        if wp.static(exact):
            store_planes(io.truth, env, n, wp.static(channels), truth)
        if wp.static(mode == STAGED):
            store_planes(io.measured, env, n, wp.static(channels), signal)
        if wp.static(mode == FUSED):
            knobs = io.knobs[io.part[n]]
            number = env + io.env_offset
            fading = float(0.0)
            if wp.static(hysteresis):
                if knobs.hysteresis != 0.0:
                    fading = decay(io.dt / knobs.hysteresis_tau)
            # Channels go in pairs because one Philox call gives the four normal numbers that two of them need: (white,
            # walk) of the even channel, then of the odd one. Calls next to each other share the schedule of their key.
            z = Normals()
            if knobs.white > 0.0 or knobs.walk > 0.0:
                for pair in range(wp.static(pairs)):
                    z[pair] = pair_normals(knobs, number, io.probe[n], pair, io.age[env], io.episode[env])
            for channel in range(wp.static(channels)):
                white = z[channel // 2, 2 * (channel % 2)]
                step = z[channel // 2, 2 * (channel % 2) + 1]
                y = apply_drawn(knobs, signal[channel], white, step, fixed, fading, lag[channel], drift[channel])
                io.measured[channel, env, n] = y[0]
                if wp.static(hysteresis):
                    io.hysteresis[channel, env, n] = y[1]
                if wp.static(walk):
                    io.walk[channel, env, n] = y[2]

    @wp.func
    def emit(io: ReadoutArrays, env: int, n: int, truth: float, signal: float):
        fixed = wp.vec3f()
        if wp.static(mode == FUSED):
            fixed = episode_draw(io.knobs[io.part[n]], env + io.env_offset, io.probe[n], io.episode[env])
        lag, drift = recall_six(io, env, n)
        all_truth = wp.spatial_vectorf(truth, 0.0, 0.0, 0.0, 0.0, 0.0)
        all_signal = wp.spatial_vectorf(signal, 0.0, 0.0, 0.0, 0.0, 0.0)
        emit_six(io, env, n, fixed, lag, drift, all_truth, all_signal)

    return SimpleNamespace(emit=emit, emit_six=emit_six, recall_six=recall_six)


@wp.kernel
def append_history(
    value: wp.array3d(dtype=wp.float32),
    start: int,
    count: wp.array(dtype=wp.int32),
    ring: wp.array4d(dtype=wp.float32),
):
    """Append readings to a ring [2 T, C, B, N] written twice, so that any window of T is contiguous. Thread: [B, N]."""
    env, n = wp.tid()
    length = ring.shape[0] // 2
    # Each value is written at two places one window apart: any window of T updates is then one contiguous slice.
    at = count[0] % length
    for channel in range(value.shape[0]):
        x = value[channel, env, start + n]
        ring[at, channel, env, n] = x
        ring[at + length, channel, env, n] = x
