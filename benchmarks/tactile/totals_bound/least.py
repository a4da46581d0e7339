"""The least that engine totals do: kernels of a chain without faces, sources, neighbours or checks.

Contacts are added up per link as they come (one face a link); taxels that overlap share the sum in proportion to their
weight, with (moments) or without the moment, in two passes or three (one leaning).
"""

from __future__ import annotations
from functools import cache
from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays, in_scene
from robotics_bridge.sensors.kernels.contact_load import ContactFaces, SpreadPlan, push_of
from robotics_bridge.sensors.kernels.noise import episode_draw
from robotics_bridge.sensors.kernels.pairs import SlotArrays, mark
from robotics_bridge.sensors.kernels.readout import (
    FUSED,
    CLEAN,
    PressArrays,
    ProbeArrays,
    ReadoutArrays,
    load_four,
    load_planes,
    put_push,
    readout_functions,
    silenced,
    store_planes,
)

wp = warp()
Sums = wp.types.vector(length=20, dtype=wp.float32)
Record = wp.types.vector(length=16, dtype=wp.float32)


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def start_sum(
    slots: SlotArrays,
    state: StateArrays,
    friction: wp.array(dtype=wp.vec3f),
    plan: SpreadPlan,
    words: int,
    bits: wp.array2d(dtype=wp.int32),
    pushes: wp.array3d(dtype=wp.int32),
    age: wp.array(dtype=wp.int32),
    status: wp.array(dtype=wp.int32),
    stride: int,
    sums: wp.array3d(dtype=wp.float32),
):
    """The shipped first kernel, which also adds up force, load and moment of every link."""
    tid = wp.tid()
    room = state.contact_env.shape[0]
    count = state.contact_count[0]
    if tid < state.pose.shape[0]:
        age[tid] = age[tid] + 1
        flags = wp.where(count > room, 2, 0)
        if age[tid] > 0:
            flags = flags | (status[tid] & 1)
        status[tid] = flags
    c = tid
    while c < wp.min(count, room):
        pair = state.contact_geom[c]
        if in_scene(pair, slots.watched.shape[0]):
            for side in range(2):
                link = slots.watched[pair[side]]
                if link >= 0:
                    env = state.contact_env[c]
                    way = wp.where(side == 0, -1.0, 1.0) * state.contact_normal[c]
                    mark(slots, env, link, pair[1 - side], words, bits, way, pushes)
                    sensor = plan.sensors[link, 0]
                    if sensor >= 0 and not (state.contact_force[c] <= 0.0):
                        if slots.place[plan.spans[sensor][2], pair[1 - side]] >= 0:
                            push = push_of(plan, state, friction, env, link, 2 * c + side)
                            turn = wp.cross(push.point, push.force)
                            for axis in range(3):
                                wp.atomic_add(sums, env, link, axis, push.force[axis])
                                wp.atomic_add(sums, env, link, 3 + axis, turn[axis])
                            wp.atomic_add(sums, env, link, 6, push.load)
        c += stride


@cache
def reduce_function(lanes: int):
    """Sum of 19 numbers and the largest of the last over a group (up to 32), or over a block of so many threads."""
    width = min(lanes, 32)
    mask = f"{2**width - 1}u << (threadIdx.x % 32 / {width} * {width})" if width < 32 else "0xffffffffu"
    text = f"""
#if defined(__CUDA_ARCH__)
    const unsigned group = {mask};
    #pragma unroll
    for (int half = {width // 2}; half; half /= 2) {{
        #pragma unroll
        for (int k = 0; k < 19; ++k) if (k < used) value[k] += __shfl_xor_sync(group, value[k], half);
        value[19] = max(value[19], __shfl_xor_sync(group, value[19], half));
    }}
"""
    if lanes > 32:
        text += f"""
    __shared__ float part[{lanes // 32}][20];
    __syncthreads();
    if (threadIdx.x % 32 == 0) for (int k = 0; k < 20; ++k) part[threadIdx.x / 32][k] = value[k];
    __syncthreads();
    #pragma unroll
    for (int k = 0; k < 19; ++k) if (k < used) {{ value[k] = 0.0f; for (int w = 0; w < {lanes // 32}; ++w) value[k] += part[w][k]; }}
    for (int w = 0; w < {lanes // 32}; ++w) value[19] = max(value[19], part[w][19]);
"""
    text += "#endif\n    return value;\n"

    @wp.func_native(text)
    def reduce(value: Sums, used: int) -> Sums: ...

    return reduce


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def meet(): ...


@cache
def least_kernel(lanes: int, per: int, moments: bool, passes: int, noisy: bool, write: bool):
    """Sums of a link's taxels, and (write) its readings, else a record. Group: link of an environment.

    per: taxels that a thread keeps in registers (it has no more); 0 asks memory in every pass.
    """
    reduce = reduce_function(lanes)
    room = max(per, 1)
    used = 19 if moments else 2
    Row = wp.types.matrix(shape=(room, 3), dtype=wp.float32)
    Numbers = wp.types.vector(length=room, dtype=wp.float32)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False, module_options={"fast_math": True})
    def least(
        plan: SpreadPlan,
        probes: ProbeArrays,
        faces: ContactFaces,
        press: PressArrays,
        io: ReadoutArrays,
        sums: wp.array3d(dtype=wp.float32),
        records: wp.array2d(dtype=Record),
        missing: wp.array3d(dtype=wp.float32),
    ):
        item = int(wp.uint32(wp.tid()) // wp.uint32(wp.static(lanes)))
        lane = int(wp.uint32(wp.tid()) % wp.uint32(wp.static(lanes)))
        many = plan.links.shape[0]
        env = item // many
        link = plan.links[item % many]
        if faces.head[env, link] < 0:
            return
        sensor = plan.sensors[link, 0]
        span = plan.spans[sensor]
        force = wp.vec3f(sums[env, link, 0], sums[env, link, 1], sums[env, link, 2])
        moment0 = wp.vec3f(sums[env, link, 3], sums[env, link, 4], sums[env, link, 5])
        load = sums[env, link, 6]
        meet()
        if lane == 0:
            for k in range(7):
                sums[env, link, k] = 0.0
        normal = wp.normalize(force)
        xs = Row()
        ms = Row()
        weights = Numbers()
        noises = Numbers()
        if wp.static(per > 0):
            for j in range(wp.static(room)):
                n = span[0] + lane + j * wp.static(lanes)
                if n < span[1]:
                    touch = load_four(press.touch[env], n)
                    packed = load_four(probes.packed, n)
                    for axis in range(3):
                        ms[j, axis] = touch[axis]
                        xs[j, axis] = packed[axis]
                    weights[j] = touch[3]
                    if wp.static(noisy):
                        noises[j] = press.noisy[env, n]
        lean = wp.vec3f()
        scale = float(0.0)
        even = wp.vec3f()
        tilt = wp.vec3f()
        center = wp.vec3f()
        for turn in range(wp.static(passes - 1)):
            s = Sums()
            if wp.static(per > 0):
                for j in range(wp.static(room)):
                    if weights[j] > 0.0:
                        x = wp.vec3f(xs[j, 0], xs[j, 1], xs[j, 2])
                        m = wp.vec3f(ms[j, 0], ms[j, 1], ms[j, 2])
                        w = weights[j]
                        if turn > 0:
                            w = w * wp.exp(wp.dot(lean, x))
                        s = gather(s, x, m, w, normal)
            else:
                n = span[0] + lane
                while n < span[1]:
                    touch = load_four(press.touch[env], n)
                    w = touch[3]
                    if w > 0.0:
                        packed = load_four(probes.packed, n)
                        x = wp.vec3f(packed[0], packed[1], packed[2])
                        if turn > 0:
                            w = w * wp.exp(wp.dot(lean, x))
                        s = gather(s, x, wp.vec3f(touch[0], touch[1], touch[2]), w, normal)
                    n += wp.static(lanes)
            s = reduce(s, wp.static(used))
            whole = wp.max(s[1], 1.0e-30)
            if wp.static(moments):
                scale = load / wp.max(whole, 0.5 * s[0])
                ways = wp.vec3f(s[2], s[3], s[4])
                center = wp.vec3f(s[5], s[6], s[7]) / whole
                even = (force - scale * ways) / whole
                moment = moment0 - scale * wp.vec3f(s[8], s[9], s[10]) - whole * wp.cross(center, even)
                moment /= whole
                extents = wp.mat33f(s[11], s[16], s[15], s[16], s[12], s[14], s[15], s[14], s[13]) / whole
                extents -= wp.outer(center, center)
                trace = extents[0, 0] + extents[1, 1] + extents[2, 2]
                inertia = (1.0001 * trace) * wp.identity(n=3, dtype=wp.float32) - extents
                tilt = wp.inverse(inertia / trace) @ moment / trace
                far = s[19] + wp.length(center)
                mean = wp.max(wp.dot(force, normal), 1.0e-6 * load) / whole
                steepest = wp.length(tilt) * far / mean
                if steepest > 1.0:
                    lean += wp.cross(normal, tilt) / mean * wp.min(6.0 / (steepest * far), 1.0)
                    tilt /= steepest
            else:
                scale = load / whole
                even = (force - scale * whole * normal) / whole
        if wp.static(write):
            total = Sums()
            if wp.static(per > 0):
                for j in range(wp.static(room)):
                    n = span[0] + lane + j * wp.static(lanes)
                    if weights[j] + noises[j] > 0.0:
                        x = wp.vec3f(xs[j, 0], xs[j, 1], xs[j, 2])
                        m = wp.vec3f(ms[j, 0], ms[j, 1], ms[j, 2])
                        unit = scale * m + wp.dot(m, normal) * (even + wp.cross(tilt, x - center))
                        if wp.static(passes > 2):
                            unit = unit * wp.exp(wp.dot(lean, x))
                        total = add(total, weights[j] * unit)
                        put_push(io.truth, env, n, x, weights[j] * unit, False)
                        if wp.static(noisy):
                            put_push(io.measured, env, n, x, noises[j] * unit, False)
                        press.filled[env, n] = wp.uint8(1)
            else:
                n = span[0] + lane
                while n < span[1]:
                    touch = load_four(press.touch[env], n)
                    noise = float(0.0)
                    if wp.static(noisy):
                        noise = press.noisy[env, n]
                    if touch[3] + noise > 0.0:
                        packed = load_four(probes.packed, n)
                        x = wp.vec3f(packed[0], packed[1], packed[2])
                        m = wp.vec3f(touch[0], touch[1], touch[2])
                        unit = scale * m + wp.dot(m, normal) * (even + wp.cross(tilt, x - center))
                        if wp.static(passes > 2):
                            unit = unit * wp.exp(wp.dot(lean, x))
                        total = add(total, touch[3] * unit)
                        put_push(io.truth, env, n, x, touch[3] * unit, False)
                        if wp.static(noisy):
                            put_push(io.measured, env, n, x, noise * unit, False)
                        press.filled[env, n] = wp.uint8(1)
                    n += wp.static(lanes)
            total = reduce(total, 3)
            if lane == 0:
                gap = wp.length(force - wp.vec3f(total[0], total[1], total[2]))
                missing[0, env, link] = wp.length(force)
                missing[1, env, link] = wp.where(gap > 1.0e-4 * wp.length(force), gap, 0.0)
                missing[2, env, link] = 0.0
        elif lane == 0:
            r = Record()
            r[0] = scale
            for axis in range(3):
                r[1 + axis] = even[axis]
                r[4 + axis] = tilt[axis]
                r[7 + axis] = center[axis]
                r[10 + axis] = normal[axis]
                r[13 + axis] = lean[axis]
            records[env, link] = r
            missing[0, env, link] = wp.length(force)

    return least


@wp.func
def add(s: Sums, f: wp.vec3f) -> Sums:
    for axis in range(3):
        s[axis] = s[axis] + f[axis]
    return s


@wp.func
def gather(s: Sums, x: wp.vec3f, m: wp.vec3f, w: float, normal: wp.vec3f) -> Sums:
    along = w * wp.dot(m, normal)
    turn = w * wp.cross(x, m)
    s[0] = s[0] + w
    s[1] = s[1] + along
    for axis in range(3):
        s[2 + axis] = s[2 + axis] + w * m[axis]
        s[5 + axis] = s[5 + axis] + along * x[axis]
        s[8 + axis] = s[8 + axis] + turn[axis]
        s[11 + axis] = s[11 + axis] + along * x[axis] * x[axis]
    s[14] = s[14] + along * x[1] * x[2]
    s[15] = s[15] + along * x[2] * x[0]
    s[16] = s[16] + along * x[0] * x[1]
    s[19] = wp.max(s[19], wp.length(x))
    return s


@cache
def emit_kernel(noisy: bool, passes: int, hysteresis: bool, walk: bool):
    """Write the readings, a thread each, from the record of their link; with noise as the law's kernel does."""
    readout = readout_functions(FUSED if noisy else CLEAN, hysteresis, walk)
    recall_six, emit_six = readout.recall_six, readout.emit_six

    @wp.func
    def emit_one(
        plan: SpreadPlan,
        probes: ProbeArrays,
        faces: ContactFaces,
        press: PressArrays,
        io: ReadoutArrays,
        records: wp.array2d(dtype=Record),
        env: int,
        n: int,
    ):
        packed = load_four(probes.packed, n)
        if silenced(io, 6, env, n, packed[3]):
            return
        part = probes.part[n]
        link = plan.link[part]
        age = int(0)
        lag = wp.spatial_vectorf()
        drift = wp.spatial_vectorf()
        if wp.static(noisy):
            age = io.age[env]
            lag, drift = recall_six(io, env, n, age)
        truth = wp.spatial_vectorf()
        signal = wp.spatial_vectorf()
        if faces.head[env, link] >= 0:
            touch = load_four(press.touch[env], n)
            noise = float(0.0)
            if wp.static(noisy):
                noise = press.noisy[env, n]
            if touch[3] + noise > 0.0:
                r = records[env, link]
                x = wp.vec3f(packed[0], packed[1], packed[2])
                m = wp.vec3f(touch[0], touch[1], touch[2])
                normal = wp.vec3f(r[10], r[11], r[12])
                unit = r[0] * m + wp.dot(m, normal) * (
                    wp.vec3f(r[1], r[2], r[3]) + wp.cross(wp.vec3f(r[4], r[5], r[6]), x - wp.vec3f(r[7], r[8], r[9]))
                )
                if wp.static(passes > 2):
                    unit = unit * wp.exp(wp.dot(wp.vec3f(r[13], r[14], r[15]), x))
                truth = wp.spatial_vector(touch[3] * unit, wp.cross(x, touch[3] * unit))
                if wp.static(noisy):
                    signal = wp.spatial_vector(noise * unit, wp.cross(x, noise * unit))
        if wp.static(not noisy):
            store_planes(io.truth, env, n, 6, truth)
        else:
            probe = probes.probe[n]
            fixed = episode_draw(io.knobs[part], env + io.env_offset, probe, io.episode[env])
            emit_six(io, io.knobs[part], env, n, probe, age, io.episode[env], fixed, lag, drift, truth, signal)

    @wp.kernel(
        module="unique",
        enable_backward=False,
        grid_stride=False,
        launch_bounds=(256, 4),
        module_options={"fast_math": True},
    )
    def emit(
        plan: SpreadPlan,
        probes: ProbeArrays,
        faces: ContactFaces,
        press: PressArrays,
        io: ReadoutArrays,
        records: wp.array2d(dtype=Record),
        each: int,
    ):
        tid = wp.uint32(wp.tid())
        total = probes.radius.shape[0]
        count = wp.uint32((total + each - 1) // each)
        env = int(tid // count)
        n = int(tid % count)
        while n < total:
            emit_one(plan, probes, faces, press, io, records, env, n)
            n += int(count)

    return emit


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def read_contacts(state: StateArrays, friction: wp.array(dtype=wp.vec3f), out: wp.array(dtype=wp.float32)):
    """Read the contact arrays once."""
    c = wp.tid()
    if c < state.contact_count[0]:
        pair = state.contact_geom[c]
        v = state.contact_position[c] + state.contact_normal[c] + friction[c]
        t = (
            v[0]
            + v[1]
            + v[2]
            + state.contact_force[c]
            + state.contact_distance[c]
            + float(state.contact_env[c] + pair[0] + pair[1])
        )
        if t == 1.2345e30:
            out[0] = t


@cache
def stream_kernel(noisy: bool, hysteresis: bool, walk: bool):
    """Write readings once (clean: of those that touch), with the memories of noise read and written, and no arithmetic."""

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def stream(
        io: ReadoutArrays, filled: wp.array2d(dtype=wp.uint8), missing: wp.array3d(dtype=wp.float32), whole: int
    ):
        tid = wp.uint32(wp.tid())
        count = wp.uint32(filled.shape[1])
        env = int(tid // count)
        n = int(tid % count)
        if n < missing.shape[2]:
            for k in range(3):
                missing[k, env, n] = float(n)
        v = wp.spatial_vectorf(1.0, 2.0, 3.0, 4.0, 5.0, float(env))
        if wp.static(noisy):
            lag = wp.spatial_vectorf()
            drift = wp.spatial_vectorf()
            if wp.static(hysteresis):
                lag = load_planes(io.hysteresis, env, n, 6)
            if wp.static(walk):
                drift = load_planes(io.walk, env, n, 6)
            store_planes(io.truth, env, n, 6, v)
            store_planes(io.measured, env, n, 6, v + lag + drift)
            if wp.static(hysteresis):
                store_planes(io.hysteresis, env, n, 6, v + lag)
            if wp.static(walk):
                store_planes(io.walk, env, n, 6, v + drift)
        elif whole == 1 or filled[env, n] != wp.uint8(0):
            store_planes(io.truth, env, n, 6, v)

    return stream


@wp.kernel(module="unique", enable_backward=False, grid_stride=False)
def nothing(out: wp.array(dtype=wp.float32)):
    if out.shape[0] == 0:
        out[0] = 1.0
