"""Kernels of sound: contacts to excitation, banks of resonators, drives, and listeners.

Letters: B environment, S source or sensor, K sample of a block, M mode, J joint. Planes are [K, B, S].
"""

from __future__ import annotations

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays, in_scene
from robotics_bridge.sensors.audio.sensors import ActuationAudio, ContactAudio
from robotics_bridge.sensors.context import numbers_of
from robotics_bridge.sensors.kernels.noise import draw, normals
from robotics_bridge.sensors.kernels.readout import ReadoutArrays

wp = warp()

SCRAPE, FRICTION = 200, 201  # purposes of random numbers: sliding contact, friction of drives


@wp.struct
@numbers_of(ContactAudio)
class SourceParams:
    """One source of contact sound, with the names and units of ``ContactAudio``."""

    link: wp.int32
    key_low: wp.uint32
    key_high: wp.uint32
    pulse: wp.int32
    """Samples over which an impact spreads."""


@wp.struct
class ContactSoundArrays:
    """Arrays of the contact sounds of a group; Q quads of modes."""

    sources: wp.array(dtype=SourceParams)
    """[S]."""
    link_of: wp.array(dtype=wp.int32)
    """[G] link of a geometry."""
    force: wp.array2d(dtype=wp.float32)
    """[B, S] summed normal force (N)."""
    before: wp.array2d(dtype=wp.float32)
    """[B, S] that of the last update (N)."""
    rubbing: wp.array2d(dtype=wp.float32)
    """[B, S] summed force times slip speed (N m/s)."""
    drive: wp.array3d(dtype=wp.float32)
    """[K, B, S] impulse of every sample (N s)."""
    first: wp.array2d(dtype=wp.vec4)
    """[Q, S] 2 r cos θ of each mode."""
    second: wp.array2d(dtype=wp.vec4)
    """[Q, S] r²."""
    gain: wp.array2d(dtype=wp.vec4)
    """[Q, S] weight in the sum."""
    y1: wp.array3d(dtype=wp.vec4)
    """[Q, B, S] last output of each resonator."""
    y2: wp.array3d(dtype=wp.vec4)
    """[Q, B, S] the one before."""


@wp.kernel
def gather_contacts(state: StateArrays, own: ContactSoundArrays):
    """Sum normal force and force times slip speed of the contacts of each source. Dim [contacts]."""
    c = wp.tid()
    if c >= wp.min(state.contact_count[0], state.contact_env.shape[0]):
        return
    env = state.contact_env[c]
    pair = state.contact_geom[c]
    f = state.contact_force[c]
    if not (f > float(0.0)) or not wp.isfinite(f):
        return
    if not in_scene(pair, own.link_of.shape[0]):
        # A flex (−1) strikes as other bodies do; how fast it slides is not known.
        mine = wp.max(pair)
        if wp.min(pair) == -1 and mine >= 0 and mine < own.link_of.shape[0]:
            for s in range(own.sources.shape[0]):
                if own.sources[s].link == own.link_of[mine]:
                    wp.atomic_add(own.force, env, s, f)
        return
    a = own.link_of[pair[0]]
    b = own.link_of[pair[1]]
    p = state.contact_position[c]
    va = state.velocity[env, a]
    vb = state.velocity[env, b]
    oa = wp.transform_get_translation(state.pose[env, a])
    ob = wp.transform_get_translation(state.pose[env, b])
    # Slip at the contact point, v_a + ω_a × (p − o_a) less the same of the other link, without its normal part.
    slip = wp.spatial_top(va) + wp.cross(wp.spatial_bottom(va), p - oa)
    slip = slip - wp.spatial_top(vb) - wp.cross(wp.spatial_bottom(vb), p - ob)
    n = state.contact_normal[c]
    speed = wp.length(slip - n * wp.dot(n, slip))
    for s in range(own.sources.shape[0]):
        link = own.sources[s].link
        if (a == link) != (b == link):
            wp.atomic_add(own.force, env, s, f)
            wp.atomic_add(own.rubbing, env, s, f * speed)


@wp.kernel
def excite_modes(own: ContactSoundArrays, io: ReadoutArrays, samples: int):
    """Write the impulse of every sample (N s). Dim [K, B, S]; impacts start at the first sample."""
    k, env, s = wp.tid()
    source = own.sources[s]
    # What is held when an episode begins was not struck: the first update only takes note of the force.
    earlier = wp.where(io.age[env] == 0, own.force[env, s], own.before[env, s])
    # Source and filter: a rise of force is an impact and excites the modes with an impulse, sliding excites them with
    # noise.
    rise = own.force[env, s] - earlier
    u = float(0.0)
    if rise > source.threshold and k < source.pulse:
        # A raised cosine whose samples sum to one.
        phase = wp.tau * (float(k) + float(1.0)) / (float(source.pulse) + float(1.0))
        u = source.impact * rise * io.dt * (float(1.0) - wp.cos(phase)) / (float(source.pulse) + float(1.0))
    rub = own.rubbing[env, s]
    if rub > float(0.0) and source.scrape > float(0.0):
        w0, w1, _w2, _w3 = draw(source, io.env_offset + env, k, io.age[env], io.episode[env], wp.static(SCRAPE))
        z = normals(w0, w1)
        # White noise of a density that does not depend on the sample rate.
        u = u + source.scrape * rub * z[0] * wp.sqrt(io.dt / float(samples))
    own.drive[k, env, s] = u


@wp.kernel
def ring_modes(own: ContactSoundArrays, io: ReadoutArrays, samples: int):
    """Advance the two-pole resonators (4.32), four at a time, over a block. Dim [B, S]."""
    env, s = wp.tid()
    own.before[env, s] = own.force[env, s]
    own.force[env, s] = float(0.0)
    own.rubbing[env, s] = float(0.0)
    broken = (io.status[env] & 1) != 0
    for q in range(own.first.shape[0]):
        a = wp.where(io.age[env] == 0, wp.vec4(), own.y1[q, env, s])
        b = wp.where(io.age[env] == 0, wp.vec4(), own.y2[q, env, s])
        # y[k] = 2 r cos θ y[k−1] − r² y[k−2] + u[k] (4.32), with poles of radius r < 1, hence stable at any block
        # length.
        c1 = own.first[q, s]
        c2 = own.second[q, s]
        g = own.gain[q, s]
        for k in range(samples):
            u = own.drive[k, env, s]
            y = wp.cw_mul(c1, a) - wp.cw_mul(c2, b) + wp.vec4(u, u, u, u)
            b = a
            a = y
            total = wp.dot(g, y)
            if q > 0:
                total = total + io.truth[k, env, s]
            io.truth[k, env, s] = total
        # A resonator keeps a NaN for ever, so its memory is emptied.
        if broken or not wp.isfinite(wp.dot(a, a)):
            a = wp.vec4()
            b = a
        own.y1[q, env, s] = a
        own.y2[q, env, s] = b
    for k in range(samples):
        if broken:
            io.truth[k, env, s] = wp.nan
        io.measured[k, env, s] = io.truth[k, env, s]


@wp.struct
@numbers_of(ActuationAudio)
class DriveSoundParams:
    """Sound of the drives of one sensor, with the names and units of ``ActuationAudio``."""

    key_low: wp.uint32
    key_high: wp.uint32


@wp.struct
class DriveSoundArrays:
    """Arrays of the drives of a group."""

    settings: wp.array(dtype=DriveSoundParams)
    """One per sensor."""
    effort: wp.array2d(dtype=wp.float32)
    """[B, J] torque (N m), written by the user."""
    speed: wp.array2d(dtype=wp.float32)
    """[B, J] (rad/s), written by the user."""
    last_loud: wp.array2d(dtype=wp.float32)
    """[B, J] loudness at the end of the last block."""
    last_speed: wp.array2d(dtype=wp.float32)
    """[B, J] (rad/s)."""
    phase: wp.array2d(dtype=wp.float32)
    """[B, J] of the fundamental (turns)."""
    hum_phase: wp.array2d(dtype=wp.float32)
    """[B, J] of the hum (turns)."""


@wp.kernel
def sound_drives(own: DriveSoundArrays, io: ReadoutArrays, samples: int):
    """Sound the drives (4.34): partials of the mesh frequency, friction noise and hum. Thread: joint [B, J]."""
    env, j = wp.tid()
    d = own.settings[io.part[j]]
    loud = d.load * wp.abs(own.effort[env, j]) + d.power * wp.abs(own.effort[env, j] * own.speed[env, j])
    fast = wp.abs(own.speed[env, j])
    fresh = io.age[env] == 0
    loud0 = wp.where(fresh, loud, own.last_loud[env, j])
    fast0 = wp.where(fresh, fast, own.last_speed[env, j])
    turn = wp.where(fresh, float(0.0), own.phase[env, j])
    hum = wp.where(fresh, float(0.0), own.hum_phase[env, j])
    h = io.dt / float(samples)
    nyquist = float(0.5) / h
    for k in range(samples):
        # Loudness and speed change evenly within a block, and phases go on from the last one: steps between blocks
        # would click.
        share = (float(k) + float(1.0)) / float(samples)
        now = fast0 + share * (fast - fast0)
        base = d.pitch * now
        turn = turn + base * h
        turn = turn - wp.floor(turn)
        tone = float(0.0)
        weight = float(1.0)
        for i in range(d.partials):
            # A partial beyond half the sample rate would fold back to a wrong pitch.
            if base * float(i + 1) < nyquist:
                tone = tone + weight * wp.sin(wp.tau * turn * float(i + 1))
            weight = weight * d.rolloff
        value = (loud0 + share * (loud - loud0)) * tone
        if d.friction > float(0.0) and now > float(0.0):
            at = io.probe[j] + k * 4096
            w0, w1, _w2, _w3 = draw(d, io.env_offset + env, at, io.age[env], io.episode[env], wp.static(FRICTION))
            z = normals(w0, w1)
            value = value + d.friction * now * z[0]
        hum = hum + d.hum_frequency * h
        hum = hum - wp.floor(hum)
        value = value + d.hum * wp.sin(wp.tau * hum)
        io.truth[k, env, j] = value
        io.measured[k, env, j] = value
    own.last_loud[env, j] = loud
    own.last_speed[env, j] = fast
    own.phase[env, j] = turn
    own.hum_phase[env, j] = hum


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
    before[env, s] = wp.where(age[env] == 0, r, now[env, s])
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
        # Delay r / c in samples, interpolated between two of them: a moving source then changes its pitch smoothly
        # (Doppler).
        lag = wp.min(r / speed * rate, float(size - samples - 2))
        whole = int(wp.floor(lag))
        part = lag - float(whole)
        # What was before the reset is silence.
        here = wp.where(whole <= known, ring[(slot + k - whole + size) % size, env, s], float(0.0))
        there = wp.where(whole + 1 <= known, ring[(slot + k - whole - 1 + size) % size, env, s], float(0.0))
        total = total + (here + part * (there - here)) / wp.pow(wp.max(r, nearest), power)
    out[k, env] = total
