"""Device code of the noise model (thesis, equations 4.22–4.28): random numbers, the measured branch, crosstalk, delay.

Random numbers are counted, not drawn: Philox 4×32-10 (Salmon et al., SC 2011) of the counter (probe, environment,
update of the episode, episode and purpose) under a key made of seed and sensor name. A value therefore depends on
nothing else: not on the batch, not on other environments, not on the device. Integers are equal bit for bit
everywhere; normal numbers too in modules with the option ``fuse_fp=False``, elsewhere to the last digit.

Order of the measured branch: radius noise and gain → crosstalk → hysteresis → random walk → white noise → bias →
quantisation → dead taxels → (threshold, by the sensor) → delay. Letters: B environment, N probe, C channel.
"""

from __future__ import annotations

from typing import Any

from brainbench.core.devices import warp
from robotics_bridge.sensors.context import numbers_of
from robotics_bridge.sensors.noise.model import Noise

wp = warp()


@wp.func
def split_log(x: float) -> wp.vec2:
    """Return (e, ln f) with x = f 2^e and f in [√½, √2), for positive normal numbers."""
    # Subtracting the bits of √½ before the shift puts f in [√½, √2): ln f stays small and the polynomial in f − 1
    # short.
    bits = wp.cast(x, wp.int32)
    e = (bits - wp.int32(0x3F3504F3)) >> wp.int32(23)
    s = wp.cast(bits - (e << wp.int32(23)), wp.float32) - float(1.0)
    inner = float(0.118881621) + s * (float(-0.116756515) + s * float(0.0674664))
    inner = float(-0.166679964) + s * (float(0.142195523) + s * (float(-0.124055892) + s * inner))
    inner = float(0.333333135) + s * (float(-0.250000089) + s * (float(0.200021192) + s * inner))
    # The leading terms s − s²/2 are added last, when the rest is already small: less rounding than plain Horner.
    q = s * s
    return wp.vec2(float(e), s + q * (s * inner - float(0.5)))


@wp.func
def power_of_two(whole: float, rest: float) -> float:
    """Return 2^(whole + rest), 0 or infinity where that is beyond the range."""
    n = wp.clamp(wp.rint(whole + rest), float(-250.0), float(250.0))
    # The integer part is removed first, which is exact; 2^r is then a polynomial on [−½, ½].
    r = (whole - n) + rest
    inner = float(0.009618004) + r * (float(0.001340027) + r * float(0.000154763))
    inner = float(0.69314718) + r * (float(0.240226507) + r * (float(0.055503279) + r * inner))
    # Two factors reach further than one.
    half = int(n) >> 1
    first = wp.cast((half + 127) << 23, wp.float32)
    second = wp.cast((int(n) - half + 127) << 23, wp.float32)
    return (float(1.0) + r * inner) * first * second


@wp.func
def power(x: float, exponent: float) -> float:
    """Return x^exponent of a positive number."""
    if exponent == float(1.0):
        return x
    split = split_log(x)
    # The leading bits of the exponent times a small integer are exact.
    leading = wp.cast(wp.cast(exponent, wp.int32) & wp.int32(-4096), wp.float32)
    rest = (exponent - leading) * split[0] + exponent * (split[1] * float(1.4426950408889634))
    return power_of_two(leading * split[0], rest)


wp.set_module_options({"fuse_fp": False})

EPISODE, RADIUS, JITTER, CHANNELS = 0, 1, 2, 16
"""Purposes of random numbers: of an episode, the radius, the delay, and from 16 on of pairs of channels."""
PAIRS = 256 - CHANNELS  # purposes of pairs of channels


@wp.struct
@numbers_of(Noise)
class NoiseParams:
    """The knobs of one sensor, with the names and units of ``Noise``."""

    key_low: wp.uint32
    key_high: wp.uint32
    levels: wp.float32
    """1 / quantum, where there is one."""


@wp.func
def philox(a: wp.uint32, b: wp.uint32, c: wp.uint32, d: wp.uint32, key_low: wp.uint32, key_high: wp.uint32):
    """Return the four words of Philox 4×32-10 for a counter (a, b, c, d) and a key."""
    c0 = a
    c1 = b
    c2 = c
    c3 = d
    k0 = key_low
    k1 = key_high
    # The constants are those of the paper, written as signed numbers.
    for _ in range(10):
        p0 = wp.uint64(wp.uint32(-766435501)) * wp.uint64(c0)
        p1 = wp.uint64(wp.uint32(-845247145)) * wp.uint64(c2)
        n0 = wp.uint32(p1 >> wp.uint64(32)) ^ c1 ^ k0
        n2 = wp.uint32(p0 >> wp.uint64(32)) ^ c3 ^ k1
        c1 = wp.uint32(p1)
        c3 = wp.uint32(p0)
        c0 = n0
        c2 = n2
        k0 = k0 + wp.uint32(-1640531527)
        k1 = k1 + wp.uint32(-1150833019)
    return c0, c1, c2, c3


@wp.func
def draw(p: Any, env: int, probe: int, age: int, episode: int, purpose: int):
    """Return four random words of a structure's key; ``env`` is the number in the whole experiment."""
    # The purpose takes the low eight bits, so that draws for different ends in one update never share a counter.
    last = (wp.uint32(episode) << wp.uint32(8)) | wp.uint32(purpose)
    return philox(wp.uint32(probe), wp.uint32(env), wp.uint32(age), last, p.key_low, p.key_high)


@wp.func
def uniform(word: wp.uint32) -> float:
    """Return a number in [0, 1) with 24 random bits."""
    # 24 bits are what a float holds exactly: the largest value, 1 − 2⁻²⁴, does not round up to 1.
    return float(word >> wp.uint32(8)) * float(5.9604644775390625e-08)


@wp.func
def minus_two_log(word: wp.uint32) -> float:
    """Return −2 ln(word / 2³²), odd words only, by a series: libraries of devices differ in the last digit."""
    split = split_log(float(word | wp.uint32(1)))
    return (float(32.0) - split[0]) * float(1.3862943611198906) - float(2.0) * split[1]


@wp.func
def normals(first: wp.uint32, second: wp.uint32) -> wp.vec2:
    """Return two independent standard normal numbers of two random words (Box and Muller 1958)."""
    # Box and Muller: √(−2 ln u₁) (cos 2π u₂, sin 2π u₂). Series instead of library calls keep the digits the same on
    # every device.
    length = wp.sqrt(minus_two_log(first))
    # The angle within a quarter turn, counted from its middle: −π/4 … π/4.
    part = float((second >> wp.uint32(7)) & wp.uint32(0x7FFFFF)) - float(4194303.5)
    x = part * float(1.8725351414619535e-07)
    q = x * x
    sine = x + x * q * (float(-0.16666655) + q * (float(0.008332178) + q * float(-0.000195173)))
    cosine = float(1.0) + q * (
        float(-0.5) + q * (float(0.041666646) + q * (float(-0.0013887368) + q * float(2.4438452e-05)))
    )
    # The upper two bits turn by quarters: (c, s), (−s, c), (−c, −s), (s, −c).
    odd = (second & wp.uint32(0x40000000)) != wp.uint32(0)
    turned = (second ^ (second << wp.uint32(1))) & wp.uint32(-2147483648)
    below = second & wp.uint32(-2147483648)
    a = wp.cast(wp.where(odd, sine, cosine), wp.uint32) ^ turned
    b = wp.cast(wp.where(odd, cosine, sine), wp.uint32) ^ below
    return wp.vec2(length * wp.cast(a, wp.float32), length * wp.cast(b, wp.float32))


@wp.func
def radius_noise(p: NoiseParams, env: int, probe: int, age: int, episode: int) -> float:
    """Return the error of the sensing radius in this update [m] (4.23)."""
    if p.radius <= float(0.0):
        return float(0.0)
    w0, _w1, _w2, _w3 = draw(p, env, probe, age, episode, wp.static(RADIUS))
    return p.radius * (float(2.0) * uniform(w0) - float(1.0))


@wp.func
def decay(t: float) -> float:
    """Return exp(−t) for t ≥ 0, by a series."""
    return power_of_two(float(0.0), wp.max(t * float(-1.4426950408889634), float(-150.0)))


@wp.func
def pair_normals(p: NoiseParams, env: int, probe: int, pair: int, age: int, episode: int) -> wp.vec4:
    """Return (white, walk) of channel 2 ``pair`` and of the next, from one Philox call."""
    # A purpose has eight bits: pairs beyond count as those of another probe, far above any there is.
    other = probe + (pair // wp.static(PAIRS)) * wp.static(1 << 20)
    w0, w1, w2, w3 = draw(p, env, other, age, episode, wp.static(CHANNELS) + pair % wp.static(PAIRS))
    first = normals(w0, w1)
    second = normals(w2, w3)
    return wp.vec4(first[0], first[1], second[0], second[1])


@wp.func
def episode_draw(p: NoiseParams, env: int, probe: int, episode: int) -> wp.vec3:
    """Return what holds for an episode: (gain γ of 4.24, 1 if the probe is dead, the value it is stuck at)."""
    out = wp.vec3(p.gain[0], float(0.0), float(0.0))
    if p.gain[1] > p.gain[0] or p.dead_probability > float(0.0):
        # Age 0 in the counter: the same numbers in every update of the episode, without storing them.
        w0, w1, w2, _w3 = draw(p, env, probe, 0, episode, wp.static(EPISODE))
        if p.gain[1] > p.gain[0]:
            out[0] = p.gain[0] + (p.gain[1] - p.gain[0]) * uniform(w0)
        if uniform(w1) < p.dead_probability:
            out[1] = float(1.0)
            out[2] = p.dead_range[0] + (p.dead_range[1] - p.dead_range[0]) * uniform(w2)
    return out


@wp.func
def apply_drawn(
    p: NoiseParams,
    x: float,
    white: float,
    walk: float,
    fixed: wp.vec3,
    fading: float,
    hysteresis_state: float,
    walk_state: float,
) -> wp.vec3:
    """Return the measured value of one channel and the two memories to keep for the next update.

    Args:
        p: Knobs of the sensor.
        x: The signal after radius noise, gain and crosstalk. A value that is not finite is returned as it is, and the
            memories as they were.
        white: Standard normal number of the white noise.
        walk: Standard normal number of the drift.
        fixed: Of :func:`episode_draw`.
        fading: e^(−Δt/τ).
        hysteresis_state: e^(−Δt/τ) ξ − x of the last update (0 at first), from which 4.26 follows.
        walk_state: Drift d of the last update (0 at first).
    """
    # Equations 4.26 and 4.27: the state kept is e^(−Δt/τ) ξ − x, so ξ of this update needs no copy of the last signal.
    # Knobs that are off add zeros, which costs less than asking.
    xi = hysteresis_state + x
    drift = walk_state + p.walk * walk
    y = x + p.hysteresis * xi + drift + p.white * white + p.bias
    lag = fading * xi - x
    # Quantisation acts on the sum of 4.22; a dead probe (4.25) overwrites whatever was measured.
    y = wp.where(p.quantum > float(0.0), p.quantum * wp.rint(y * p.levels), y)
    y = wp.where(fixed[1] > float(0.0), fixed[2], y)
    # A lost reading passes as it is and leaves the memories untouched, so that later readings are valid again.
    finite = wp.isfinite(x)
    return wp.vec3(wp.where(finite, y, x), wp.where(finite, lag, hysteresis_state), wp.where(finite, drift, walk_state))


@wp.struct
class ReadoutArrays:
    """Readings of a group, their noise and the clock of its environments."""

    truth: wp.array3d(dtype=wp.float32)
    """[C, B, N] unit of the sensor."""
    measured: wp.array3d(dtype=wp.float32)
    """[C, B, N]; the same array as ``truth`` where there is no noise."""
    hysteresis: wp.array3d(dtype=wp.float32)
    """[C, B, N] memory of the hysteresis, if it is stored."""
    walk: wp.array3d(dtype=wp.float32)
    """[C, B, N] drift, if it is stored."""
    age: wp.array(dtype=wp.int32)
    """[B] updates since the reset, 0 at the first."""
    episode: wp.array(dtype=wp.int32)
    """[B] resets so far."""
    status: wp.array(dtype=wp.int32)
    """[B] bits of the suite; 1 is diverged."""
    knobs: wp.array(dtype=NoiseParams)
    """[S] noise of each sensor."""
    part: wp.array(dtype=wp.int32)
    """[N] number of the sensor."""
    probe: wp.array(dtype=wp.int32)
    """[N] number within the sensor."""
    env_offset: wp.int32
    """Number of environment 0 in the whole experiment."""
    dt: wp.float32
    """Time step (s)."""


@wp.kernel
def measure(io: ReadoutArrays, active: wp.array(dtype=wp.int32), gained: int, x: wp.array3d(dtype=wp.float32)):
    """Measure a whole reading ``x`` [C, B, N]; ``gained`` 1: the sensor has applied the gain. Thread: [B, N]."""
    env, n = wp.tid()
    if active[n] == 0:
        for channel in range(x.shape[0]):
            io.measured[channel, env, n] = float(0.0)
        return
    knobs = io.knobs[io.part[n]]
    probe = io.probe[n]
    age = io.age[env]
    episode = io.episode[env]
    # Numbers belong to the environment of the whole experiment: splitting it over devices does not change them.
    number = io.env_offset + env
    fixed = episode_draw(knobs, number, probe, episode)
    scale = wp.where(gained == 0, fixed[0], float(1.0))
    fading = float(0.0)
    if knobs.hysteresis != float(0.0):
        fading = decay(io.dt / knobs.hysteresis_tau)
    z = wp.vec4()
    for channel in range(x.shape[0]):
        # One call of Philox yields four words: white noise and drift of two neighbouring channels.
        if channel % 2 == 0 and (knobs.white > float(0.0) or knobs.walk > float(0.0)):
            z = pair_normals(knobs, number, probe, channel // 2, age, episode)
        white = wp.where(channel % 2 == 0, z[0], z[2])
        step = wp.where(channel % 2 == 0, z[1], z[3])
        lag = float(0.0)
        drift = float(0.0)
        if age > 0:
            if io.hysteresis.shape[1] > 0:
                lag = io.hysteresis[channel, env, n]
            if io.walk.shape[1] > 0:
                drift = io.walk[channel, env, n]
        y = apply_drawn(knobs, scale * x[channel, env, n], white, step, fixed, fading, lag, drift)
        io.measured[channel, env, n] = y[0]
        if io.hysteresis.shape[1] > 0:
            io.hysteresis[channel, env, n] = y[1]
        if io.walk.shape[1] > 0:
            io.walk[channel, env, n] = y[2]


@wp.kernel
def crosstalk(
    along: int, io: ReadoutArrays, value: wp.array3d(dtype=wp.float32), shape: wp.array2d(dtype=wp.int32),
    weights: wp.array2d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Compute one half of the crosstalk (4.28), zero outside the grid. Thread: channel, environment, probe [C, B, N].

    Launched along the rows into a buffer, then along the columns, where the signal is mixed in.
    """
    channel, env, n = wp.tid()
    i = io.part[n]
    strength = io.knobs[i].crosstalk
    x = value[channel, env, n]
    if strength <= float(0.0):
        out[channel, env, n] = x
        return
    columns = shape[i, 1]
    place = io.probe[n] % columns
    length = columns
    stride = 1
    if along == 0:
        place = io.probe[n] // columns
        length = shape[i, 0]
        stride = columns
    # The Gaussian G of 4.28 is a product of weights along rows and columns: two passes cost 2 K, not K², per probe.
    # Both neighbours at distance k share one weight since the kernel is symmetric.
    half = weights.shape[1] - 1
    total = weights[i, 0] * x
    for k in range(1, half + 1):
        if place + k < length:
            total = total + weights[i, k] * value[channel, env, n + k * stride]
        if place >= k:
            total = total + weights[i, k] * value[channel, env, n - k * stride]
    if along == 0:
        # (1 − χ) z + χ (G ∗ z), mixed only after the second pass.
        total = (float(1.0) - strength) * io.measured[channel, env, n] + strength * total
    out[channel, env, n] = total


@wp.kernel
def delay_line(io: ReadoutArrays, ring: wp.array4d(dtype=wp.float32), out: wp.array3d(dtype=wp.float32)):
    """Record a reading and read an earlier one (zero-order hold). Thread: environment and probe [B, N]."""
    env, n = wp.tid()
    knobs = io.knobs[io.part[n]]
    age = io.age[env]
    wait = knobs.read_delay
    if knobs.jitter > float(0.0):
        w0, _w1, _w2, _w3 = draw(knobs, io.env_offset + env, -1, age, io.episode[env], wp.static(JITTER))
        wait = wait + knobs.jitter * (float(2.0) * uniform(w0) - float(1.0))
    size = ring.shape[0]
    # The last reading at or before the moment; before the first has arrived, the first.
    back = wp.min(wp.min(int(wp.ceil(wait / io.dt - float(1.0e-4))), age), size - 1)
    for channel in range(out.shape[0]):
        # Written before it is read: a delay of zero returns this update. What is stored is the measured value, so a
        # delayed reading keeps the noise it was recorded with.
        ring[age % size, channel, env, n] = io.measured[channel, env, n]
        out[channel, env, n] = ring[(age - back) % size, channel, env, n]
