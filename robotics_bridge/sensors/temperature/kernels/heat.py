"""Kernels of the temperature grid: contacts to conductances, heat exchange of cells, diffusion, lag of the element.

Letters: B environment, S sensor, N cell of all sensors, L link, M contacts kept per sensor.
"""

from brainbench.core.devices import warp

wp = warp()
# Contracted products would change how a level field rounds.
wp.set_module_options({"fuse_fp": False})

CAPACITY = 48
"""M: contacts of one sensor that are looked at."""


@wp.struct
class ThermalParams:
    """One grid."""

    link: wp.int32
    """Number of the link that carries the grid."""
    first: wp.int32
    """Number of its first cell."""
    shape: wp.vec3i
    low: wp.vec3f
    """Lower corner of the grid in the link's frame (m)."""
    cell: wp.vec3f
    """Edges of a cell (m)."""
    conductivity: wp.float32
    """W/(m K)."""
    capacity: wp.float32
    """Heat capacity of a cell (J/K)."""
    emissivity: wp.float32
    convection: wp.float32
    """W/(m² K)."""
    ambient: wp.float32
    """°C."""
    base: wp.float32
    """°C, at a reset."""
    contact: wp.float32
    """Conductance of the bare interface (W/(m² K)); 0 is perfect."""
    bluntness: wp.float32
    """Radius R of the surfaces at a contact point (m)."""
    depth_weight: wp.float32
    published: wp.int32
    """1: equations 4.38, 4.39; 0: half a cell and the touched half-space in series."""
    tau: wp.float32
    """Time constant of the sensing element (s)."""
    cold: wp.float32
    """How far below the base the element reads (K)."""
    warm: wp.float32


@wp.kernel
def collect_contacts(
    contact_count: wp.array(dtype=wp.int32),
    contact_env: wp.array(dtype=wp.int32),
    contact_geom: wp.array(dtype=wp.vec2i),
    link_of: wp.array(dtype=wp.int32),
    sensors: wp.array(dtype=ThermalParams),
    number: wp.array2d(dtype=wp.int32),
    kept: wp.array3d(dtype=wp.int32),
):
    """List the contacts of each sensor. Thread: contact; ``number`` [B, S] was set to zero."""
    c = wp.tid()
    if c >= wp.min(contact_count[0], contact_env.shape[0]):
        return
    env = contact_env[c]
    pair = contact_geom[c]
    a = link_of[pair[0]]
    b = link_of[pair[1]]
    for s in range(sensors.shape[0]):
        link = sensors[s].link
        if (a == link) != (b == link):
            place = wp.atomic_add(number, env, s, 1)
            if place < kept.shape[2]:
                kept[env, s, place] = c


@wp.func
def other_link(pair: wp.vec2i, link_of: wp.array(dtype=wp.int32), link: int) -> int:
    """Return the other link of a contact."""
    a = link_of[pair[0]]
    if a == link:
        return link_of[pair[1]]
    return a


@wp.func
def spot_area(distance: float, radius: float) -> float:
    """Return the area of the circle in which a ball is cut at a depth: π (2 R δ − δ²), at most that of the ball."""
    depth = wp.clamp(-distance, float(0.0), radius)
    return wp.pi * depth * (float(2.0) * radius - depth)


@wp.kernel
def conduct_contacts(
    contact_geom: wp.array(dtype=wp.vec2i),
    contact_distance: wp.array(dtype=wp.float32),
    contact_position: wp.array(dtype=wp.vec3f),
    contact_normal: wp.array(dtype=wp.vec3f),
    link_of: wp.array(dtype=wp.int32),
    sensors: wp.array(dtype=ThermalParams),
    number: wp.array2d(dtype=wp.int32),
    kept: wp.array3d(dtype=wp.int32),
    status: wp.array(dtype=wp.int32),
    pose: wp.array2d(dtype=wp.transformf),
    link_conductivity: wp.array(dtype=wp.float32),
    link_diffusivity: wp.array(dtype=wp.float32),
    link_temperature: wp.array2d(dtype=wp.float32),
    touched: wp.array2d(dtype=wp.float32),
    dt: float,
    conductance: wp.array2d(dtype=wp.float32),
    inflow: wp.array2d(dtype=wp.float32),
):
    """Add the conductance of every contact (W/K) to the cell it lies in. Thread: a kept contact [B, S, M]."""
    env, s, i = wp.tid()
    count = wp.min(number[env, s], kept.shape[2])
    if i >= count or (status[env] & 1) != 0:
        return
    grid = sensors[s]
    frame = pose[env, grid.link]
    c = kept[env, s, i]
    other = other_link(contact_geom[c], link_of, grid.link)
    # The points that share the other link: their number, centre and mean normal.
    points = int(0)
    center = wp.vec3f(float(0.0), float(0.0), float(0.0))
    normal = wp.vec3f(float(0.0), float(0.0), float(0.0))
    spots = float(0.0)
    deepest = float(0.0)
    for j in range(count):
        d = kept[env, s, j]
        if other_link(contact_geom[d], link_of, grid.link) == other:
            points = points + 1
            center = center + contact_position[d]
            side = contact_normal[d]
            if wp.dot(side, contact_normal[c]) < float(0.0):
                side = -side
            normal = normal + side
            spots = spots + spot_area(contact_distance[d], grid.bluntness)
            deepest = wp.max(deepest, -contact_distance[d])
    center = center / float(points)
    area = spots
    if points >= 3:
        # Polygon about the centre, by polar angle: each point spans a triangle with the next one.
        n = wp.normalize(normal)
        u = wp.cross(n, wp.vec3f(float(1.0), float(0.0), float(0.0)))
        if wp.length(u) < float(0.5):
            u = wp.cross(n, wp.vec3f(float(0.0), float(1.0), float(0.0)))
        u = wp.normalize(u)
        v = wp.cross(n, u)
        polygon = float(0.0)
        for j in range(count):
            d = kept[env, s, j]
            if other_link(contact_geom[d], link_of, grid.link) == other:
                p = contact_position[d] - center
                x = wp.dot(p, u)
                y = wp.dot(p, v)
                angle = wp.atan2(y, x)
                least = float(7.0)
                nx = x
                ny = y
                for k in range(count):
                    e = kept[env, s, k]
                    if k != j and other_link(contact_geom[e], link_of, grid.link) == other:
                        q = contact_position[e] - center
                        qx = wp.dot(q, u)
                        qy = wp.dot(q, v)
                        turn = wp.atan2(qy, qx) - angle
                        if turn < float(0.0) or (turn == float(0.0) and k < j):
                            turn = turn + float(6.283185307179586)
                        if turn < least:
                            least = turn
                            nx = qx
                            ny = qy
                polygon = polygon + float(0.5) * (x * ny - y * nx)
        area = wp.max(area, polygon)
    if grid.published == 1:
        # The published floor π d_w δ lacks a length; the radius supplies it.
        area = wp.max(area, wp.pi * grid.depth_weight * wp.max(deepest, float(0.0)) * grid.bluntness)
    whole = area
    area = area / float(points)
    if area > float(0.0):
        local = wp.transform_point(wp.transform_inverse(frame), contact_position[c])
        index = int(0)
        for axis in range(3):
            cell = int(wp.floor((local[axis] - grid.low[axis]) / grid.cell[axis]))
            index = index * grid.shape[axis] + wp.clamp(cell, 0, grid.shape[axis] - 1)
        index = grid.first + index
        k_own = grid.conductivity
        k_other = link_conductivity[other]
        g = float(0.0)
        if grid.published == 1:
            volume = grid.cell[0] * grid.cell[1] * grid.cell[2]
            g = float(2.0) * k_own * k_other / (k_own + k_other) * whole * area / volume
        else:
            facing = wp.quat_rotate_inv(wp.transform_get_rotation(frame), contact_normal[c])
            across = wp.abs(facing[0]) * grid.cell[0] + wp.abs(facing[1]) * grid.cell[1]
            across = across + wp.abs(facing[2]) * grid.cell[2]
            # The spot spreads within its cell as it does in the touched body.
            disc = float(4.0) * wp.sqrt(whole / wp.pi) / float(points)
            resistance = float(1.0) / (k_own * (float(2.0) * area / across + disc))
            if grid.contact > float(0.0):
                resistance = resistance + float(1.0) / (grid.contact * area)
            # A half-space that gives heat through a disc: planar at first, spreading later.
            time = touched[env, index] + float(0.5) * dt
            planar = area / wp.sqrt(wp.pi * link_diffusivity[other] * time)
            resistance = resistance + float(1.0) / (k_other * (planar + disc))
            g = float(1.0) / resistance
        wp.atomic_add(conductance, env, index, g)
        wp.atomic_add(inflow, env, index, g * link_temperature[env, other])


@wp.func
def mean_decay(x: wp.float64) -> wp.float64:
    """Return (1 − exp(−x)) / x: the mean of exp(−x s) for s from 0 to 1."""
    if x < wp.float64(1.0e-4):
        return wp.float64(1.0) - x * (wp.float64(0.5) - x / wp.float64(6.0))
    return (wp.float64(1.0) - wp.exp(-x)) / x


@wp.kernel
def exchange_heat(
    sensors: wp.array(dtype=ThermalParams),
    part: wp.array(dtype=wp.int32),
    exposed: wp.array(dtype=wp.float32),
    source: wp.array(dtype=wp.float32),
    age: wp.array(dtype=wp.int32),
    status: wp.array(dtype=wp.int32),
    dt: float,
    conductance: wp.array2d(dtype=wp.float32),
    inflow: wp.array2d(dtype=wp.float32),
    touched: wp.array2d(dtype=wp.float32),
    temperature: wp.array2d(dtype=wp.float64),
    out: wp.array2d(dtype=wp.float64),
):
    """Exchange heat with contacts, surroundings and source, exponentially. Thread: cell [B, N].

    ``exposed`` [N] is the outer surface of a cell (m²), ``source`` [N] its power (W).
    """
    env, n = wp.tid()
    grid = sensors[part[n]]
    t = temperature[env, n]
    if age[env] == 0:
        t = wp.float64(grid.base)
    g = conductance[env, n]
    heat = inflow[env, n]
    conductance[env, n] = float(0.0)
    inflow[env, n] = float(0.0)
    if (status[env] & 1) != 0 or not wp.isfinite(heat):
        out[env, n] = t
        return
    if g > float(0.0) and age[env] > 0:
        touched[env, n] = touched[env, n] + dt
    elif g > float(0.0):
        touched[env, n] = dt
    else:
        touched[env, n] = float(0.0)
    # Steps as short as 1e-5 s change less than single precision can hold.
    surroundings = grid.ambient + float(273.15)
    start = t
    step = wp.float64(dt) / wp.float64(grid.capacity)
    # Radiation through its secant, q = G (T − T_ambient), taken half way on the second pass.
    for _ in range(2):
        kelvin = float(wp.float64(0.5) * (start + t)) + float(273.15)
        radiation = grid.emissivity * float(5.670374419e-8) * (kelvin * kelvin + surroundings * surroundings)
        loss = exposed[n] * (grid.convection + radiation * (kelvin + surroundings))
        total = wp.float64(g + loss)
        power = wp.float64(heat) - wp.float64(g) * start + wp.float64(source[n])
        power = power + wp.float64(loss) * (wp.float64(grid.ambient) - start)
        t = start + power * step * mean_decay(total * step)
    out[env, n] = t


@wp.kernel
def diffuse_heat(
    axis: int,
    sensors: wp.array(dtype=ThermalParams),
    part: wp.array(dtype=wp.int32),
    offset: wp.array2d(dtype=wp.int32),
    matrix: wp.array(dtype=wp.float32),
    temperature: wp.array2d(dtype=wp.float64),
    out: wp.array2d(dtype=wp.float64),
):
    """Spread heat along one axis by a matrix [n, n] that was exponentiated beforehand. Thread: cell [B, N]."""
    env, n = wp.tid()
    grid = sensors[part[n]]
    length = grid.shape[axis]
    stride = 1
    if axis == 0:
        stride = grid.shape[1] * grid.shape[2]
    if axis == 1:
        stride = grid.shape[2]
    row = ((n - grid.first) // stride) % length
    start = n - row * stride
    base = offset[part[n], axis] + row * length
    # Differences from the cell's own value: a level field stays level to the last digit.
    own = temperature[env, n]
    total = own
    for j in range(length):
        total = total + wp.float64(matrix[base + j]) * (temperature[env, start + j * stride] - own)
    out[env, n] = total


@wp.kernel
def sense_temperature(
    sensors: wp.array(dtype=ThermalParams),
    part: wp.array(dtype=wp.int32),
    age: wp.array(dtype=wp.int32),
    status: wp.array(dtype=wp.int32),
    dt: float,
    fresh: wp.array2d(dtype=wp.float64),
    temperature: wp.array2d(dtype=wp.float64),
    element: wp.array2d(dtype=wp.float64),
    truth: wp.array3d(dtype=wp.float32),
    measured: wp.array3d(dtype=wp.float32),
):
    """Keep the new field, let the sensing element follow it, and write both readings. Thread: cell [B, N]."""
    env, n = wp.tid()
    grid = sensors[part[n]]
    t = fresh[env, n]
    temperature[env, n] = t
    lagged = t
    if grid.tau > float(0.0):
        before = element[env, n]
        if age[env] == 0:
            before = wp.float64(grid.base)
        part_of = wp.float64(dt) / wp.float64(grid.tau)
        lagged = before + (t - before) * part_of * mean_decay(part_of)
        element[env, n] = lagged
    seen = grid.base + wp.clamp(float(lagged - wp.float64(grid.base)), -grid.cold, grid.warm)
    true = float(t)
    # What an environment that diverged reads is marked; its field waits.
    if (status[env] & 1) != 0:
        true = wp.nan
        seen = wp.nan
    truth[0, env, n] = true
    measured[0, env, n] = seen
