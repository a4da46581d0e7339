"""Kernels of the temperature grid: contacts to conductances, heat exchange of cells, diffusion, lag of the element.

Letters: B environment, S sensor, N cell of all sensors, L link, M contacts kept per sensor.
"""

from __future__ import annotations

from brainbench.core.devices import warp
from robotics_bridge.physics.kernels.state import StateArrays
from robotics_bridge.sensors.context import numbers_of
from robotics_bridge.sensors.kernels.readout import ReadoutArrays
from robotics_bridge.sensors.temperature.grid import TemperatureGrid
from robotics_bridge.sensors.temperature.materials import ThermalMaterial

wp = warp()
# Contracted products would change how a level field rounds.
wp.set_module_options({"fuse_fp": False})

CAPACITY = 48  # M: contacts of one sensor that are looked at
PIECES = 8  # a patch is cut into this many pieces along each of its two directions, each of which lies in one cell


@wp.struct
@numbers_of(TemperatureGrid, ThermalMaterial)
class ThermalParams:
    """One grid, with the names and units of ``TemperatureGrid`` and of its ``ThermalMaterial``."""

    link: wp.int32
    """Number of the link that carries the grid."""
    first: wp.int32
    """Number of its first cell."""
    corner: wp.vec3f
    """Lower corner of the grid in the link's frame (m)."""
    cell: wp.vec3f
    """Edges of a cell (m)."""
    diffusivity: wp.float32
    """m²/s."""
    capacity: wp.float32
    """Heat capacity of a cell (J/K)."""
    published: wp.int32
    """1: equations 4.38, 4.39; 0: the cell and the touched half-space in series."""


@wp.struct
class HeatArrays:
    """Arrays of the grids of a group."""

    sensors: wp.array(dtype=ThermalParams)
    """[S]."""
    exposed: wp.array(dtype=wp.float32)
    """[N] outer surface of a cell (m²)."""
    source: wp.array(dtype=wp.float32)
    """[N] power of a cell (W)."""
    link_of: wp.array(dtype=wp.int32)
    """[G] link of a geometry."""
    link_conductivity: wp.array(dtype=wp.float32)
    """[L + 1], the last of flexes (W/(m K))."""
    link_diffusivity: wp.array(dtype=wp.float32)
    """[L + 1] (m²/s)."""
    link_temperature: wp.array2d(dtype=wp.float32)
    """[B, L + 1] (°C)."""
    number: wp.array2d(dtype=wp.int32)
    """[B, S] contacts of a grid."""
    listed: wp.array3d(dtype=wp.int32)
    """[B, S, M] their numbers in the state."""
    touched: wp.array2d(dtype=wp.float32)
    """[B, N] time since a contact began (s)."""
    covered: wp.array2d(dtype=wp.float32)
    """[B, N] area of the contacts of a cell (m²)."""
    conductance: wp.array2d(dtype=wp.float32)
    """[B, N] of the contacts of a cell (W/K)."""
    inflow: wp.array2d(dtype=wp.float32)
    """[B, N] Σ conductance · temperature of what is touched (W)."""
    temperature: wp.array2d(dtype=wp.float64)
    """[B, N] (°C)."""
    element: wp.array2d(dtype=wp.float64)
    """[B, N] of the sensing elements (°C)."""
    matrix: wp.array(dtype=wp.float32)
    """Exponentials of the diffusion along each axis of each grid."""
    offset: wp.array2d(dtype=wp.int32)
    """[S, 3] where each begins."""
    begins: wp.int32
    """1 in the first part of an update, in which fields begin where the environment was reset."""


@wp.func
def link_at(geometry: int, heat: HeatArrays) -> int:
    """Return the link of a geometry, or the number that stands for flexes."""
    if geometry < 0:
        return heat.link_conductivity.shape[0] - 1
    return heat.link_of[geometry]


@wp.kernel
def collect_contacts(state: StateArrays, heat: HeatArrays):
    """List the contacts of each sensor. Thread: contact [C]; their numbers were set to zero."""
    c = wp.tid()
    if c >= wp.min(state.contact_count[0], state.contact_env.shape[0]):
        return
    env = state.contact_env[c]
    pair = state.contact_geom[c]
    # A state made by hand may hold numbers of no geometry; −1 stands for a flex.
    if wp.min(pair) < -1 or wp.max(pair) >= heat.link_of.shape[0]:
        return
    a = link_at(pair[0], heat)
    b = link_at(pair[1], heat)
    for s in range(heat.sensors.shape[0]):
        link = heat.sensors[s].link
        if (a == link) != (b == link):
            place = wp.atomic_add(heat.number, env, s, 1)
            if place < heat.listed.shape[2]:
                heat.listed[env, s, place] = c


@wp.func
def other_link(pair: wp.vec2i, heat: HeatArrays, link: int) -> int:
    """Return the other link of a contact."""
    a = link_at(pair[0], heat)
    return wp.where(a == link, link_at(pair[1], heat), a)


@wp.func
def spot_area(distance: float, radius: float) -> float:
    """Return the area of the circle in which a ball is cut at a depth: π (2 R δ − δ²), at most that of the ball."""
    depth = wp.clamp(-distance, float(0.0), radius)
    return wp.pi * depth * (float(2.0) * radius - depth)


@wp.func
def slab_length(spread: float, across: float, share: float) -> float:
    """Return ℓ (m): a cell at the mean T gives k (T − T_face) / ℓ to a face that was touched when it was level.

    Early, heat comes from the skin alone, as from a half-space: √(π α t) for the initial temperature, less what the
    mean of the cell has fallen, of which the covered share of the face tells the rest (Carslaw & Jaeger 1959, 3.3).
    The two meet at √(α t) = √π/4 of the cell; much later it is half of it.

    Args:
        spread: √(α t) (m).
        across: Depth of the cell (m).
        share: Part of its face that is touched.
    """
    x = spread / across
    s = wp.min(x, float(0.4431135))
    early = float(1.7724539) * s - float(2.0) * share * s * s
    fade = s / x
    return across * (float(0.5) - wp.max(float(0.5) - early, float(0.0)) * fade * fade)


@wp.func
def rim(area: float, spread: float) -> float:
    """Return what a disc on a half-space conducts beyond the planar flow, per k and area (1/m), at √(α t) = ``spread``.

    From π a at first to 4 a in the end, by the interpolation of Shoup & Szabo (1982), which is right within .6 %.
    """
    a = wp.sqrt(area / wp.pi)
    return float(4.0) * a / area * (float(0.7854) + float(0.2146) * wp.exp(float(-0.39115) * a / spread))


@wp.func
def conductance_of(
    state: StateArrays,
    heat: HeatArrays,
    io: ReadoutArrays,
    env: int,
    s: int,
    c: int,
    index: int,
    other: int,
    whole: float,
) -> float:
    """Return the conductance per area (W/(m² K)) of a contact c of area ``whole`` within one cell."""
    grid = heat.sensors[s]
    k_own = grid.conductivity
    k_other = heat.link_conductivity[other]
    volume = grid.cell[0] * grid.cell[1] * grid.cell[2]
    if grid.published == 1:
        # 4.38 and 4.39: harmonic conductivity over the length L = V / A of the whole contact, shared by area.
        return float(2.0) * k_own * k_other / (k_own + k_other) * whole / volume
    facing = wp.quat_rotate_inv(wp.transform_get_rotation(state.pose[env, grid.link]), state.contact_normal[c])
    across = wp.abs(facing[0]) * grid.cell[0] + wp.abs(facing[1]) * grid.cell[1] + wp.abs(facing[2]) * grid.cell[2]
    share = wp.min(heat.covered[env, index] * across / volume, float(1.0))
    # Mean of 1/√t over the step, which its middle misses by 29 % in the first one.
    past = wp.where(heat.begins == 1 and io.age[env] == 0, float(0.0), heat.touched[env, index])
    root = float(0.5) * (wp.sqrt(past) + wp.sqrt(past + io.dt))
    spread = root * wp.sqrt(grid.diffusivity)
    length = slab_length(spread, across, share)
    # Resistances in series: the cell, the interface, the touched body. A sum of resistances stays finite and positive
    # for any pair of materials.
    resistance = float(1.0) / (k_own * (float(1.0) / length + (float(1.0) - share) * rim(whole, spread)))
    resistance = resistance + float(1.0) / grid.contact_conductance
    # A half-space that gives heat through a disc: planar at first, spreading later.
    spread = root * wp.sqrt(heat.link_diffusivity[other])
    planar = float(1.0) / (spread * wp.sqrt(wp.pi))
    return float(1.0) / (resistance + float(1.0) / (k_other * (planar + rim(whole, spread))))


@wp.kernel
def conduct_contacts(measure: int, state: StateArrays, heat: HeatArrays, io: ReadoutArrays):
    """Add the conductance of every contact (W/K) to the cells it covers. Thread: a kept contact [B, S, M].

    Launched first to ``measure`` the area that is touched in each cell (1), then to add conductances (0).
    """
    env, s, i = wp.tid()
    count = wp.min(heat.number[env, s], heat.listed.shape[2])
    if i >= count or (io.status[env] & 1) != 0:
        return
    grid = heat.sensors[s]
    frame = state.pose[env, grid.link]
    c = heat.listed[env, s, i]
    other = other_link(state.contact_geom[c], heat, grid.link)
    # The points that share the other link: their number, centre and mean normal.
    points = int(0)
    center = wp.vec3f(float(0.0), float(0.0), float(0.0))
    normal = wp.vec3f(float(0.0), float(0.0), float(0.0))
    spots = float(0.0)
    deepest = float(0.0)
    for j in range(count):
        d = heat.listed[env, s, j]
        if other_link(state.contact_geom[d], heat, grid.link) == other:
            points = points + 1
            center = center + state.contact_position[d]
            # Contacts may list the two geometries in either order; normals are turned to one side before they are
            # averaged.
            side = state.contact_normal[d]
            normal = normal + wp.where(wp.dot(side, state.contact_normal[c]) < float(0.0), -side, side)
            spots = spots + spot_area(state.contact_distance[d], grid.contact_radius)
            deepest = wp.max(deepest, -state.contact_distance[d])
    center = center / float(points)
    here = state.contact_position[c] - center
    n = wp.normalize(normal)
    u = wp.cross(n, wp.vec3f(float(1.0), float(0.0), float(0.0)))
    if wp.length(u) < float(0.5):
        u = wp.cross(n, wp.vec3f(float(0.0), float(1.0), float(0.0)))
    u = wp.normalize(u)
    v = wp.cross(n, u)
    whole = spots
    area = spots / float(points)
    # The contact's own part of a polygon: the triangle of the centre, itself and the next point.
    following = here
    filled = int(0)
    if points >= 3:
        # Polygon about the centre, by polar angle: each point spans a triangle with the next one.
        polygon = float(0.0)
        own = float(0.0)
        for j in range(count):
            d = heat.listed[env, s, j]
            if other_link(state.contact_geom[d], heat, grid.link) == other:
                p = state.contact_position[d] - center
                x = wp.dot(p, u)
                y = wp.dot(p, v)
                angle = wp.atan2(y, x)
                least = float(7.0)
                nx = x
                ny = y
                for k in range(count):
                    e = heat.listed[env, s, k]
                    if k != j and other_link(state.contact_geom[e], heat, grid.link) == other:
                        q = state.contact_position[e] - center
                        qx = wp.dot(q, u)
                        qy = wp.dot(q, v)
                        turn = wp.atan2(qy, qx) - angle
                        if turn < float(0.0) or (turn == float(0.0) and k < j):
                            turn = turn + float(6.283185307179586)
                        if turn < least:
                            least = turn
                            nx = qx
                            ny = qy
                triangle = float(0.5) * (x * ny - y * nx)
                polygon = polygon + triangle
                if d == c:
                    own = triangle
                    following = nx * u + ny * v
        if polygon > spots:
            whole = polygon
            area = own
            filled = 1
    if grid.published == 1:
        # The published floor π d_w δ lacks a length; the radius supplies it.
        floor = wp.pi * grid.depth_weight * wp.max(deepest, float(0.0)) * grid.contact_radius
        if floor > whole:
            whole = floor
            area = floor / float(points)
            filled = 0
    if area <= float(0.0):
        return
    # Pieces of equal area: of the triangle by rows towards the centre, of a disc by rings and angles.
    inverse = wp.transform_inverse(frame)
    radius = wp.sqrt(area / wp.pi)
    piece = area / float(wp.static(PIECES * PIECES))
    # Neighbouring pieces in one cell are entered together.
    last = int(-1)
    run = float(0.0)
    for number in range(wp.static(PIECES * PIECES + 1)):
        i = number // wp.static(PIECES)
        outward = wp.sqrt((float(i) + float(0.5)) / float(wp.static(PIECES)))
        along = (float(number % wp.static(PIECES)) + float(0.5)) / float(wp.static(PIECES))
        place = center + outward * (here + along * (following - here))
        if filled == 0:
            # Every other ring is turned by half a piece.
            angle = wp.tau * (along + wp.static(0.5 / PIECES) * float(i % 2))
            place = state.contact_position[c] + radius * outward * (wp.cos(angle) * u + wp.sin(angle) * v)
        local = wp.transform_point(inverse, place)
        index = int(0)
        for axis in range(3):
            cell = int(wp.floor((local[axis] - grid.corner[axis]) / grid.cell[axis]))
            index = index * grid.cells[axis] + wp.clamp(cell, 0, grid.cells[axis] - 1)
        index = grid.first + index
        if last >= 0 and (index != last or number == wp.static(PIECES * PIECES)):
            if measure == 1:
                wp.atomic_add(heat.covered, env, last, run)
            else:
                g = run * conductance_of(state, heat, io, env, s, c, last, other, whole)
                wp.atomic_add(heat.conductance, env, last, g)
                wp.atomic_add(heat.inflow, env, last, g * heat.link_temperature[env, other])
            run = float(0.0)
        last = index
        run = run + piece


@wp.func
def mean_decay(x: wp.float64) -> wp.float64:
    """Return (1 − exp(−x)) / x: the mean of exp(−x s) for s from 0 to 1."""
    # Near zero the quotient cancels; three terms of its Taylor series do not.
    if x < wp.float64(1.0e-4):
        return wp.float64(1.0) - x * (wp.float64(0.5) - x / wp.float64(6.0))
    return (wp.float64(1.0) - wp.exp(-x)) / x


@wp.kernel
def exchange_heat(heat: HeatArrays, io: ReadoutArrays, out: wp.array2d(dtype=wp.float64)):
    """Exchange heat with contacts, surroundings and source, exponentially. Thread: cell [B, N]."""
    env, n = wp.tid()
    grid = heat.sensors[io.part[n]]
    t = heat.temperature[env, n]
    begins = heat.begins == 1 and io.age[env] == 0
    if begins:
        t = wp.float64(grid.base_temperature)
    g = heat.conductance[env, n]
    inflow = heat.inflow[env, n]
    heat.covered[env, n] = float(0.0)
    heat.conductance[env, n] = float(0.0)
    heat.inflow[env, n] = float(0.0)
    if (io.status[env] & 1) != 0 or not wp.isfinite(inflow):
        out[env, n] = t
        return
    past = wp.where(begins, float(0.0), heat.touched[env, n])
    heat.touched[env, n] = wp.where(g > float(0.0), past + io.dt, float(0.0))
    # Steps as short as 1e-5 s change less than single precision can hold.
    surroundings = grid.ambient_temperature + float(273.15)
    start = t
    step = wp.float64(io.dt) / wp.float64(grid.capacity)
    # Radiation through its secant, q = G (T − T_ambient), taken half way on the second pass.
    for _ in range(2):
        kelvin = float(wp.float64(0.5) * (start + t)) + float(273.15)
        radiation = grid.emissivity * float(5.670374419e-8) * (kelvin * kelvin + surroundings * surroundings)
        loss = heat.exposed[n] * (grid.convection + radiation * (kelvin + surroundings))
        total = wp.float64(g + loss)
        power = wp.float64(inflow) - wp.float64(g) * start + wp.float64(heat.source[n])
        power = power + wp.float64(loss) * (wp.float64(grid.ambient_temperature) - start)
        # Exact solution of C dT/dt = P − G (T − T₀) over the step with constant G: a large step ends at the balance,
        # which forward Euler (4.36, 4.39) overshoots.
        t = start + power * step * mean_decay(total * step)
    out[env, n] = t


@wp.kernel
def diffuse_heat(
    axis: int, heat: HeatArrays, io: ReadoutArrays, temperature: wp.array2d(dtype=wp.float64),
    out: wp.array2d(dtype=wp.float64),
):  # fmt: skip
    """Spread heat along one axis by a matrix [n, n] that was exponentiated beforehand. Thread: cell [B, N]."""
    env, n = wp.tid()
    grid = heat.sensors[io.part[n]]
    length = grid.cells[axis]
    stride = 1
    if axis == 0:
        stride = grid.cells[1] * grid.cells[2]
    if axis == 1:
        stride = grid.cells[2]
    row = ((n - grid.first) // stride) % length
    start = n - row * stride
    base = heat.offset[io.part[n], axis] + row * length
    # Differences from the cell's own value: a level field stays level to the last digit.
    own = temperature[env, n]
    # Row of the matrix exponential of insulated diffusion: stable at any Δt and free of loss, unlike 4.35.
    total = own
    for j in range(length):
        total = total + wp.float64(heat.matrix[base + j]) * (temperature[env, start + j * stride] - own)
    out[env, n] = total


@wp.kernel
def sense_temperature(heat: HeatArrays, io: ReadoutArrays, fresh: wp.array2d(dtype=wp.float64)):
    """Keep the new field, let the sensing element follow it, and write both readings. Thread: cell [B, N]."""
    env, n = wp.tid()
    grid = heat.sensors[io.part[n]]
    t = fresh[env, n]
    earlier = heat.temperature[env, n]
    heat.temperature[env, n] = t
    lagged = t
    # The lag of 4.40, exact for a temperature that changes evenly within the step; forward Euler diverges beyond
    # Δt = 2 τ, and a temperature held at its last value is read too early by Δt/2.
    if grid.tau > float(0.0):
        before = heat.element[env, n]
        if heat.begins == 1 and io.age[env] == 0:
            before = wp.float64(grid.base_temperature)
            earlier = before
        part_of = wp.float64(io.dt) / wp.float64(grid.tau)
        held = mean_decay(part_of)
        lagged = t + (before - earlier) * (wp.float64(1.0) - part_of * held) - (t - earlier) * held
        heat.element[env, n] = lagged
    above = float(lagged - wp.float64(grid.base_temperature))
    seen = grid.base_temperature + wp.clamp(above, -grid.cold_range, grid.warm_range)
    # What an environment that diverged reads is marked; its field waits.
    lost = (io.status[env] & 1) != 0
    io.truth[0, env, n] = wp.where(lost, wp.nan, float(t))
    io.measured[0, env, n] = wp.where(lost, wp.nan, seen)
