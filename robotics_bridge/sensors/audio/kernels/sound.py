"""Kernels of sound: contacts to excitation, banks of resonators, drives, and listeners.

Letters: B environment, S source or sensor, K sample of a block, M mode, J joint. Planes are [K, B, S].
"""

from brainbench.core.devices import warp
from robotics_bridge.sensors.noise.kernels.noise import normals, philox

wp = warp()

SCRAPE, FRICTION = 200, 201
"""Purposes of random numbers: sliding contact, friction of drives."""


@wp.struct
class SourceParams:
    """One source of contact sound."""

    link: wp.int32
    key_low: wp.uint32
    key_high: wp.uint32
    threshold: wp.float32
    """Rise of force in one update that counts as an impact (N)."""
    impact: wp.float32
    scrape: wp.float32
    """Force noise per force and speed (N per N m/s)."""
    pulse: wp.int32
    """Samples over which an impact spreads."""


@wp.kernel
def gather_contacts(
    count: wp.array(dtype=wp.int32),
    env_of: wp.array(dtype=wp.int32),
    geom: wp.array(dtype=wp.vec2i),
    position: wp.array(dtype=wp.vec3f),
    normal: wp.array(dtype=wp.vec3f),
    strength: wp.array(dtype=wp.float32),
    link_of: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=SourceParams),
    pose: wp.array2d(dtype=wp.transformf),
    velocity: wp.array2d(dtype=wp.spatial_vectorf),
    force: wp.array2d(dtype=wp.float32),
    rubbing: wp.array2d(dtype=wp.float32),
):
    """Sum normal force and force times slip speed of the contacts of each source. Dim [contacts]."""
    c = wp.tid()
    if c >= wp.min(count[0], env_of.shape[0]):
        return
    env = env_of[c]
    a = link_of[geom[c][0]]
    b = link_of[geom[c][1]]
    f = strength[c]
    if not (f > float(0.0)) or not wp.isfinite(f):
        return
    p = position[c]
    va = velocity[env, a]
    vb = velocity[env, b]
    oa = wp.transform_get_translation(pose[env, a])
    ob = wp.transform_get_translation(pose[env, b])
    slip = wp.spatial_top(va) + wp.cross(wp.spatial_bottom(va), p - oa)
    slip = slip - wp.spatial_top(vb) - wp.cross(wp.spatial_bottom(vb), p - ob)
    n = normal[c]
    speed = wp.length(slip - n * wp.dot(n, slip))
    for s in range(sources.shape[0]):
        link = sources[s].link
        if (a == link) != (b == link):
            wp.atomic_add(force, env, s, f)
            wp.atomic_add(rubbing, env, s, f * speed)


@wp.kernel
def excite_modes(
    sources: wp.array(dtype=SourceParams),
    age: wp.array(dtype=wp.int32),
    episode: wp.array(dtype=wp.int32),
    env_offset: int,
    dt: float,
    samples: int,
    force: wp.array2d(dtype=wp.float32),
    before: wp.array2d(dtype=wp.float32),
    rubbing: wp.array2d(dtype=wp.float32),
    drive: wp.array3d(dtype=wp.float32),
):
    """Write the impulse of every sample (N s). Dim [K, B, S]; impacts start at the first sample."""
    k, env, s = wp.tid()
    source = sources[s]
    earlier = before[env, s]
    if age[env] == 0:
        earlier = float(0.0)
    rise = force[env, s] - earlier
    u = float(0.0)
    if rise > source.threshold and k < source.pulse:
        # A raised cosine whose samples sum to one.
        phase = wp.tau * (float(k) + float(1.0)) / (float(source.pulse) + float(1.0))
        u = source.impact * rise * dt * (float(1.0) - wp.cos(phase)) / (float(source.pulse) + float(1.0))
    rub = rubbing[env, s]
    if rub > float(0.0) and source.scrape > float(0.0):
        last = (wp.uint32(episode[env]) << wp.uint32(8)) | wp.uint32(wp.static(SCRAPE))
        w0, w1, _w2, _w3 = philox(
            wp.uint32(k), wp.uint32(env_offset + env), wp.uint32(age[env]), last, source.key_low, source.key_high
        )
        z = normals(w0, w1)
        # White noise of a density that does not depend on the sample rate.
        u = u + source.scrape * rub * z[0] * wp.sqrt(dt / float(samples))
    drive[k, env, s] = u


@wp.kernel
def ring_modes(
    age: wp.array(dtype=wp.int32),
    status: wp.array(dtype=wp.int32),
    samples: int,
    quads: int,
    first: wp.array2d(dtype=wp.vec4),
    second: wp.array2d(dtype=wp.vec4),
    gain: wp.array2d(dtype=wp.vec4),
    drive: wp.array3d(dtype=wp.float32),
    y1: wp.array3d(dtype=wp.vec4),
    y2: wp.array3d(dtype=wp.vec4),
    force: wp.array2d(dtype=wp.float32),
    before: wp.array2d(dtype=wp.float32),
    rubbing: wp.array2d(dtype=wp.float32),
    truth: wp.array3d(dtype=wp.float32),
    measured: wp.array3d(dtype=wp.float32),
):
    """Advance the two-pole resonators (4.32), four at a time, over a block. Dim [B, S]."""
    env, s = wp.tid()
    before[env, s] = force[env, s]
    force[env, s] = float(0.0)
    rubbing[env, s] = float(0.0)
    broken = (status[env] & 1) != 0
    for q in range(quads):
        a = y1[q, env, s]
        b = y2[q, env, s]
        if age[env] == 0:
            a = wp.vec4(float(0.0), float(0.0), float(0.0), float(0.0))
            b = a
        c1 = first[q, s]
        c2 = second[q, s]
        g = gain[q, s]
        for k in range(samples):
            u = drive[k, env, s]
            y = wp.cw_mul(c1, a) - wp.cw_mul(c2, b) + wp.vec4(u, u, u, u)
            b = a
            a = y
            total = wp.dot(g, y)
            if q > 0:
                total = total + truth[k, env, s]
            truth[k, env, s] = total
        if broken or not wp.isfinite(wp.dot(a, a)):
            a = wp.vec4(float(0.0), float(0.0), float(0.0), float(0.0))
            b = a
        y1[q, env, s] = a
        y2[q, env, s] = b
    for k in range(samples):
        if broken:
            truth[k, env, s] = wp.nan
        measured[k, env, s] = truth[k, env, s]


@wp.struct
class DriveSoundParams:
    """Sound of the drives of one sensor; as in ``ActuationAudio``."""

    key_low: wp.uint32
    key_high: wp.uint32
    load: wp.float32
    power: wp.float32
    pitch: wp.float32
    """Frequency of the fundamental per speed (Hz per rad/s)."""
    partials: wp.int32
    rolloff: wp.float32
    friction: wp.float32
    hum: wp.float32
    hum_frequency: wp.float32


@wp.kernel
def sound_drives(
    settings: wp.array(dtype=DriveSoundParams),
    part: wp.array(dtype=wp.int32),
    number: wp.array(dtype=wp.int32),
    age: wp.array(dtype=wp.int32),
    episode: wp.array(dtype=wp.int32),
    env_offset: int,
    dt: float,
    samples: int,
    effort: wp.array2d(dtype=wp.float32),
    speed: wp.array2d(dtype=wp.float32),
    last_loud: wp.array2d(dtype=wp.float32),
    last_speed: wp.array2d(dtype=wp.float32),
    phase: wp.array2d(dtype=wp.float32),
    hum_phase: wp.array2d(dtype=wp.float32),
    truth: wp.array3d(dtype=wp.float32),
    measured: wp.array3d(dtype=wp.float32),
):
    """Sound the drives (4.34): partials of the mesh frequency, friction noise and hum. Thread: joint [B, J]."""
    env, j = wp.tid()
    d = settings[part[j]]
    loud = d.load * wp.abs(effort[env, j]) + d.power * wp.abs(effort[env, j] * speed[env, j])
    fast = wp.abs(speed[env, j])
    loud0 = last_loud[env, j]
    fast0 = last_speed[env, j]
    turn = phase[env, j]
    hum = hum_phase[env, j]
    if age[env] == 0:
        loud0 = loud
        fast0 = fast
        turn = float(0.0)
        hum = float(0.0)
    h = dt / float(samples)
    nyquist = float(0.5) / h
    last = (wp.uint32(episode[env]) << wp.uint32(8)) | wp.uint32(wp.static(FRICTION))
    for k in range(samples):
        share = (float(k) + float(1.0)) / float(samples)
        now = fast0 + share * (fast - fast0)
        base = d.pitch * now
        turn = turn + base * h
        turn = turn - wp.floor(turn)
        tone = float(0.0)
        weight = float(1.0)
        for i in range(d.partials):
            if base * float(i + 1) < nyquist:
                tone = tone + weight * wp.sin(wp.tau * turn * float(i + 1))
            weight = weight * d.rolloff
        value = (loud0 + share * (loud - loud0)) * tone
        if d.friction > float(0.0) and now > float(0.0):
            at = wp.uint32(number[j]) + wp.uint32(k) * wp.uint32(4096)
            w0, w1, _w2, _w3 = philox(at, wp.uint32(env_offset + env), wp.uint32(age[env]), last, d.key_low, d.key_high)
            z = normals(w0, w1)
            value = value + d.friction * now * z[0]
        hum = hum + d.hum_frequency * h
        hum = hum - wp.floor(hum)
        value = value + d.hum * wp.sin(wp.tau * hum)
        truth[k, env, j] = value
        measured[k, env, j] = value
    last_loud[env, j] = loud
    last_speed[env, j] = fast
    phase[env, j] = turn
    hum_phase[env, j] = hum


@wp.kernel
def record_source(
    sound: wp.array3d(dtype=wp.float32),
    first: int,
    count: int,
    slot: int,
    source: int,
    ring: wp.array3d(dtype=wp.float32),
):
    """Enter the sum of a sensor's emitters into the ring [D, B, S]. Dim [K, B]."""
    k, env = wp.tid()
    total = float(0.0)
    for j in range(count):
        total = total + sound[k, env, first + j]
    if not wp.isfinite(total):
        total = float(0.0)
    ring[(slot + k) % ring.shape[0], env, source] = total


@wp.kernel
def measure_paths(
    pose: wp.array2d(dtype=wp.transformf),
    links: wp.array(dtype=wp.int32),
    listener: int,
    place: wp.vec3f,
    age: wp.array(dtype=wp.int32),
    now: wp.array2d(dtype=wp.float32),
    before: wp.array2d(dtype=wp.float32),
):
    """Measure the distance (m) from each source's link to the listener, and keep that of the last block. Dim [B, S]."""
    env, s = wp.tid()
    ear = place
    if listener >= 0:
        ear = wp.transform_point(pose[env, listener], place)
    r = wp.length(wp.transform_get_translation(pose[env, links[s]]) - ear)
    before[env, s] = now[env, s]
    if age[env] == 0:
        before[env, s] = r
    now[env, s] = r


@wp.kernel
def mix_sources(
    ring: wp.array3d(dtype=wp.float32),
    slot: int,
    samples: int,
    rate: float,
    speed: float,
    nearest: float,
    power: float,
    age: wp.array(dtype=wp.int32),
    now: wp.array2d(dtype=wp.float32),
    before: wp.array2d(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
):
    """Sum sources, each later by r / c and weaker by 1 / r^p. Dim [K, B]; the path changes evenly in a block."""
    k, env = wp.tid()
    size = ring.shape[0]
    share = (float(k) + float(1.0)) / float(samples)
    total = float(0.0)
    known = age[env] * samples + k
    for s in range(ring.shape[2]):
        r = before[env, s] + share * (now[env, s] - before[env, s])
        lag = wp.min(r / speed * rate, float(size - samples - 2))
        whole = int(wp.floor(lag))
        part = lag - float(whole)
        here = float(0.0)
        there = float(0.0)
        # What was before the reset is silence.
        if whole <= known:
            here = ring[(slot + k - whole + size) % size, env, s]
        if whole + 1 <= known:
            there = ring[(slot + k - whole - 1 + size) % size, env, s]
        total = total + (here + part * (there - here)) / wp.pow(wp.max(r, nearest), power)
    out[k, env] = total
