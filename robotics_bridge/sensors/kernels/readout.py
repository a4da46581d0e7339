"""How kernels hand over readings: the truth, and the measured branch with its memories, each written once.

Planar storage [C, B, N]: neighbouring probes are neighbours in memory. Letters: B environment, N probe, C channel.
"""

from functools import cache
from types import SimpleNamespace
from typing import Any

CLEAN, FUSED, STAGED = range(3)
"""Modes: no noise; noise applied in the sensor's kernel; radius noise and gain there, the rest in later kernels."""


@cache
def io_structs() -> SimpleNamespace:
    """Return the structures ``ProbeSet`` (where the probes of a group sit) and ``Io`` (where readings go)."""
    import warp as wp

    @wp.struct
    class ProbeSet:
        position: wp.array(dtype=wp.vec3f)
        normal: wp.array(dtype=wp.vec3f)
        radius: wp.array(dtype=wp.float32)
        slot: wp.array(dtype=wp.int32)
        part: wp.array(dtype=wp.int32)
        probe: wp.array(dtype=wp.int32)

    @wp.struct
    class Io:
        truth: wp.array3d(dtype=wp.float32)
        measured: wp.array3d(dtype=wp.float32)
        hysteresis: wp.array3d(dtype=wp.float32)
        walk: wp.array3d(dtype=wp.float32)
        age: wp.array(dtype=wp.int32)
        episode: wp.array(dtype=wp.int32)
        status: wp.array(dtype=wp.int32)
        env_offset: wp.int32
        dt: wp.float32

    return SimpleNamespace(ProbeSet=ProbeSet, Io=Io)


@cache
def io_functions(mode: int, hysteresis: bool, walk: bool, channels: int = 6) -> SimpleNamespace:
    """Return the functions that write a reading.

    ``emit(io, knobs, env, n, probe, channel, truth, signal)`` writes one channel, ``emit_six`` up to six, drawing all
    that they share once (``fixed`` is what ``episode_draw`` gave, ``lag`` and ``drift`` what ``recall_six`` read,
    before anything else so that nothing waits for it); ``measure`` returns the measured
    value and stores its memories without writing it; ``lost(io, channels, env, n)`` marks a diverged environment.

    Args:
        mode: :data:`CLEAN`, :data:`FUSED` or :data:`STAGED`.
        hysteresis: whether the group stores hysteresis.
        walk: whether the group stores a drift.
        channels: that ``emit_six`` writes, known to the compiler so that vectors stay in registers.
    """
    import warp as wp

    from robotics_bridge.sensors.noise.kernels.noise import noise_functions

    io_type = io_structs().Io
    noise = noise_functions()
    params_type, apply_noise = noise.NoiseParams, noise.apply_noise
    apply_drawn, decay = noise.apply_drawn, noise.decay
    episode_draw, pair_normals = noise.episode_draw, noise.pair_normals

    @wp.func
    def measure(
        io: io_type,
        knobs: params_type,
        env: int,
        n: int,
        probe: int,
        channel: int,
        age: int,
        episode: int,
        signal: float,
    ) -> float:
        lag = float(0.0)
        drift = float(0.0)
        if age > 0:
            if wp.static(hysteresis):
                lag = io.hysteresis[channel, env, n]
            if wp.static(walk):
                drift = io.walk[channel, env, n]
        y = apply_noise(knobs, signal, env + io.env_offset, probe, channel, age, episode, io.dt, lag, drift)
        if wp.static(hysteresis):
            io.hysteresis[channel, env, n] = y[1]
        if wp.static(walk):
            io.walk[channel, env, n] = y[2]
        return y[0]

    @wp.func
    def emit(
        io: io_type,
        knobs: params_type,
        env: int,
        n: int,
        probe: int,
        channel: int,
        age: int,
        episode: int,
        truth: float,
        signal: float,
    ):
        io.truth[channel, env, n] = truth
        if wp.static(mode == FUSED):
            io.measured[channel, env, n] = measure(io, knobs, env, n, probe, channel, age, episode, signal)
        if wp.static(mode == STAGED):
            io.measured[channel, env, n] = signal

    @wp.func
    def recall(memory: wp.array3d(dtype=wp.float32), env: int, n: int, age: int) -> wp.spatial_vectorf:
        kept = wp.spatial_vectorf()
        if age > 0:
            for channel in range(wp.static(channels)):
                kept[channel] = memory[channel, env, n]
        return kept

    @wp.func
    def recall_six(io: io_type, env: int, n: int, age: int):
        lag = wp.spatial_vectorf()
        drift = wp.spatial_vectorf()
        if wp.static(hysteresis):
            lag = recall(io.hysteresis, env, n, age)
        if wp.static(walk):
            drift = recall(io.walk, env, n, age)
        return lag, drift

    @wp.func
    def emit_six(
        io: io_type,
        knobs: params_type,
        env: int,
        n: int,
        probe: int,
        age: int,
        episode: int,
        fixed: wp.vec3f,
        lag: wp.spatial_vectorf,
        drift: wp.spatial_vectorf,
        truth: wp.spatial_vectorf,
        signal: wp.spatial_vectorf,
    ):
        for channel in range(wp.static(channels)):
            io.truth[channel, env, n] = truth[channel]
            if wp.static(mode == STAGED):
                io.measured[channel, env, n] = signal[channel]
        if wp.static(mode == FUSED):
            fading = float(0.0)
            if wp.static(hysteresis):
                if knobs.hysteresis != 0.0:
                    fading = decay(io.dt / knobs.tau)
            for pair in range(wp.static((channels + 1) // 2)):
                z = pair_normals(knobs, env + io.env_offset, probe, pair, age, episode)
                for odd in range(2):
                    channel = 2 * pair + odd
                    if channel < wp.static(channels):
                        y = apply_drawn(
                            knobs,
                            signal[channel],
                            z[2 * odd],
                            z[2 * odd + 1],
                            fixed,
                            fading,
                            lag[channel],
                            drift[channel],
                        )
                        io.measured[channel, env, n] = y[0]
                        if wp.static(hysteresis):
                            io.hysteresis[channel, env, n] = y[1]
                        if wp.static(walk):
                            io.walk[channel, env, n] = y[2]

    @wp.func
    def lost(io: io_type, channels: int, env: int, n: int):
        for channel in range(channels):
            io.truth[channel, env, n] = wp.static(float("nan"))
            if wp.static(mode != CLEAN):
                io.measured[channel, env, n] = wp.static(float("nan"))

    @wp.func
    def idle(io: io_type, channels: int, env: int, n: int):
        for channel in range(channels):
            io.truth[channel, env, n] = 0.0
            if wp.static(mode != CLEAN):
                io.measured[channel, env, n] = 0.0

    return SimpleNamespace(
        emit=emit,
        emit_six=emit_six,
        recall_six=recall_six,
        episode_draw=episode_draw,
        measure=measure,
        lost=lost,
        idle=idle,
    )


@cache
def history_kernel() -> Any:
    """Return the kernel ``keep`` that appends readings to a ring written twice, so that any window is contiguous.

    Ring [2 T, C, B, N]; dim [B, N]. An environment that starts anew clears its past.
    """
    import warp as wp

    @wp.kernel(module="unique")
    def keep(
        value: wp.array3d(dtype=wp.float32),
        start: int,
        count: wp.array(dtype=wp.int32),
        age: wp.array(dtype=wp.int32),
        ring: wp.array4d(dtype=wp.float32),
    ):
        env, n = wp.tid()
        length = ring.shape[0] // 2
        at = count[0] % length
        for channel in range(value.shape[0]):
            if age[env] == 0:
                for slot in range(2 * length):
                    ring[slot, channel, env, n] = 0.0
            x = value[channel, env, start + n]
            ring[at, channel, env, n] = x
            ring[at + length, channel, env, n] = x

    return keep
