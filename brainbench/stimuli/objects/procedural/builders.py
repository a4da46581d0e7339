"""Families: round bodies from the lathe, outlines that are extruded, and things assembled from several bodies."""

from __future__ import annotations

import functools
import math

import numpy as np

from brainbench.stimuli.objects.procedural.bodies import (
    Body,
    ShapeSampler,
    around,
    ball,
    block,
    convex,
    lathe,
    points_of,
    prism,
    rod,
    tube,
)


def _outline(heights: list[float], radii: list[float], count: int) -> np.ndarray:
    """Smooth outline [count, 2] (radius, height) through control points, without overshoot."""
    from scipy.interpolate import PchipInterpolator

    z = np.linspace(heights[0], heights[-1], count)
    return np.column_stack([PchipInterpolator(heights, radii)(z), z])


def _rings(detail: int) -> int:
    return max(8, detail // (5 * around(detail)))


def vase(draw: ShapeSampler, detail: int) -> Body:
    """Hollow vase with a belly, a neck and a flared lip."""
    belly, neck, lip, low = draw(belly=(0.32, 0.5), neck=(0.12, 0.2), lip=(0.22, 0.34), belly_height=(0.3, 0.5))
    (height,) = draw(height=(1.2, 1.6))
    line = _outline([0, low * height, 0.8 * height, height], [0.2, belly, neck, lip], _rings(detail))
    return lathe(line, around(detail), wall=0.05, floor=line[1, 1])


def bottle(draw: ShapeSampler, detail: int) -> Body:
    """Cylindrical bottle with a shoulder and a narrow neck."""
    radius, neck, shoulder = draw(radius=(0.22, 0.32), neck=(0.07, 0.11), shoulder=(0.5, 0.68))
    (height,) = draw(height=(1.3, 1.7))
    z = [0, 0.04, shoulder * height, (shoulder + 0.2) * height, 0.94 * height, height]
    line = _outline(z, [0.9 * radius, radius, radius, neck, neck, 1.2 * neck], 2 * _rings(detail))
    return lathe(line, around(detail))


def cup(draw: ShapeSampler, detail: int) -> Body:
    """Hollow tumbler that widens upwards, without a handle."""
    low, high, height = draw(base=(0.22, 0.32), rim=(0.34, 0.46), height=(0.7, 1.0))
    z = np.linspace(0, height, max(4, _rings(detail) // 2))
    return lathe(np.column_stack([low + (high - low) * z / height, z]), around(detail), wall=0.05, floor=z[1])


def mug(draw: ShapeSampler, detail: int) -> Body:
    """Cylindrical cup with a handle."""
    radius, height, reach = draw(radius=(0.26, 0.42), height=(0.6, 1.0), handle_reach=(0.2, 0.3))
    (thick,) = draw(handle_thickness=(0.04, 0.06))
    z = np.linspace(0, height, 8)
    body = lathe(np.column_stack([np.full(8, radius), z]), around(detail), wall=0.05, floor=z[1])
    angle = np.linspace(-np.pi / 2, np.pi / 2, max(12, around(detail) // 2))
    # The ends of the handle sink into the wall but do not come out inside.
    x = radius - 0.03 + reach * np.cos(angle)
    arc = np.column_stack([x, np.zeros_like(x), height / 2 + 0.34 * height * np.sin(angle)])
    return body + tube(arc, thick * 0.99, 12, closed=False)


def bowl(draw: ShapeSampler, detail: int) -> Body:
    """Wide hollow bowl on a small foot."""
    rim, height, foot = draw(rim=(0.5, 0.65), height=(0.25, 0.42), foot=(0.15, 0.22))
    count = _rings(detail)
    share = np.linspace(0, 1, count)
    line = np.column_stack([foot + (rim - foot) * np.sin(share * np.pi / 2) ** 0.8, height * (0.1 + 0.9 * share)])
    line[0, 1] = 0
    return lathe(line, around(detail), wall=0.06, floor=line[max(2, count // 6), 1])


def goblet(draw: ShapeSampler, detail: int) -> Body:
    """Wine glass: hollow cup on a thin stem with a disc foot."""
    cup_radius, stem, foot = draw(cup=(0.26, 0.36), stem=(0.035, 0.06), foot=(0.24, 0.32))
    (split,) = draw(stem_share=(0.45, 0.58))
    bottom = np.array([[foot, 0.0], [foot, 0.04], [0.4 * foot, 0.09], [stem, 0.16], [stem, split - 0.05]])
    cup_line = _outline([split, split + 0.15, 1.0, 1.15], [0.1, 0.9 * cup_radius, cup_radius, 0.92 * cup_radius], 12)
    return lathe(np.vstack([bottom, cup_line]), around(detail), wall=0.045, floor=cup_line[1, 1])


def spool(draw: ShapeSampler, detail: int) -> Body:
    """Two discs joined by a thick core."""
    core, flange, thick = draw(core=(0.15, 0.26), flange=(0.4, 0.5), flange_thickness=(0.08, 0.14))
    (height,) = draw(height=(0.7, 1.1))
    facets = around(detail)
    disc = rod(flange, thick, facets)
    shaft = rod(core, height, facets)
    return shaft + disc.moved(z=(height - thick) / 2) + disc.moved(z=(thick - height) / 2)


def hourglass(draw: ShapeSampler, detail: int) -> Body:
    """Two bulbs that meet in a waist."""
    waist, end, bulge, height = draw(waist=(0.06, 0.14), end=(0.32, 0.46), bulge=(1.0, 1.12), height=(1.0, 1.4))
    z = [0, 0.2 * height, 0.5 * height, 0.8 * height, height]
    return lathe(_outline(z, [end, end * bulge, waist, end * bulge, end], 2 * _rings(detail)), around(detail))


def mushroom(draw: ShapeSampler, detail: int) -> Body:
    """Domed cap on a stem."""
    cap, stem, length, dome = draw(cap=(0.38, 0.5), stem=(0.1, 0.17), stem_length=(0.4, 0.65), dome=(0.28, 0.42))
    angle = np.linspace(0, np.pi / 2, _rings(detail))
    curve = np.column_stack([cap * np.cos(angle), length + dome * np.sin(angle)])
    curve[-1, 0] = 0
    facets = around(detail)
    return lathe(curve, facets) + rod(1.15 * stem, length + 0.1, facets, top=stem).moved(z=length / 2 + 0.05)


def dome(draw: ShapeSampler, detail: int) -> Body:
    """Half an ellipsoid on its flat side."""
    radius, height = draw(radius=(0.4, 0.55), height=(0.3, 0.6))
    angle = np.linspace(0, np.pi / 2, 2 * _rings(detail))
    curve = np.column_stack([radius * np.cos(angle), height * np.sin(angle)])
    curve[-1, 0] = 0
    return lathe(curve, around(detail))


def top(draw: ShapeSampler, detail: int) -> Body:
    """Spinning top: a cone on its tip, a rim and a handle."""
    rim, depth, pin, length = draw(rim=(0.34, 0.58), depth=(0.3, 0.65), pin=(0.04, 0.08), pin_length=(0.25, 0.4))
    (shoulder,) = draw(shoulder=(0.08, 0.2))
    z = [0, depth, depth + 0.06, depth + 0.06 + shoulder, depth + 0.06 + shoulder + length]
    return lathe(np.column_stack([[0.0, rim, rim, 1.4 * pin, pin], z]), around(detail))


def bell(draw: ShapeSampler, detail: int) -> Body:
    """Hollow bell, mouth up, with a flaring rim."""
    rim, crown, height, flare = draw(rim=(0.42, 0.52), crown=(0.2, 0.28), height=(0.7, 0.95), flare=(0.55, 0.75))
    waist = crown + 0.25 * (rim - crown)
    line = _outline([0, 0.08, flare * height, height], [0.6 * crown, crown, waist, rim], _rings(detail))
    return lathe(line, around(detail), wall=0.05, floor=line[2, 1])


def ellipsoid(draw: ShapeSampler, detail: int) -> Body:
    """Ellipsoid with three different axes."""
    y, z = draw(y_over_x=(0.5, 0.8), z_over_x=(0.3, 0.5))
    return convex(ball(detail)).stretched(1.0, y, z)


def superquadric(draw: ShapeSampler, detail: int) -> Body:
    """Draw a rounded box, cylinder or double cone (Barr 1981) with both exponents drawn."""
    vertical, around_z, y = draw(exponent_vertical=(0.25, 1.9), exponent_around=(0.25, 1.9), y_over_x=(0.7, 1.0))
    (z,) = draw(z_over_x=(0.6, 1.4))

    def _warp(points: np.ndarray) -> np.ndarray:
        # Along the ray of every point to the surface (|x|^(2/a) + |y|^(2/a))^(a/v) + |z|^(2/v) = 1.
        p = np.abs(points)
        flat = (p[:, 0] ** (2 / around_z) + p[:, 1] ** (2 / around_z)) ** (around_z / vertical)
        return points * ((flat + p[:, 2] ** (2 / vertical)) ** (-vertical / 2))[:, None]

    return convex(ball(detail, _warp)).stretched(1.0, y, z)


def bumpy(draw: ShapeSampler, detail: int) -> Body:
    """Sphere with rounded bumps."""
    count, height, width = draw(bumps=range(10, 25), height=(0.15, 0.3), width=(0.25, 0.38))
    # A spiral by the golden angle with equal steps of z spreads points evenly over a sphere.
    golden = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    z = 1 - (2 * np.arange(count) + 1) / count
    centres = np.column_stack([np.sqrt(1 - z**2) * np.cos(golden), np.sqrt(1 - z**2) * np.sin(golden), z])
    centres += 0.08 * draw.normals(count, 3)
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)

    def _warp(points: np.ndarray) -> np.ndarray:
        # Angle between a point of the sphere and each bump.
        gap = np.arccos(np.clip(points @ centres.T, -1, 1))
        return points * (1 + height * np.exp(-((gap / width) ** 2)).sum(axis=1, keepdims=True))

    return Body(ball(detail, _warp), None)


def pebble(draw: ShapeSampler, detail: int) -> Body:
    """Smooth irregular stone: a flattened ball with gentle low-order undulation."""
    flat, amount = draw(flatness=(0.4, 0.65), undulation=(0.08, 0.16))
    waves = draw.normals(6, 3)
    waves *= 1.8 / np.linalg.norm(waves, axis=1, keepdims=True)
    phase = draw.normals(6) * np.pi

    def _warp(points: np.ndarray) -> np.ndarray:
        return points * (1 + amount * np.cos(points @ waves.T + phase).mean(axis=1, keepdims=True) * 2)

    return Body(ball(detail, _warp), None).stretched(z=flat)


def urchin(draw: ShapeSampler, detail: int) -> Body:
    """Ball with conical spikes along the axes and diagonals."""
    spikes, length, width = draw(spikes=range(8, 15), length=(0.7, 1.2), width=(0.16, 0.28))
    golden = np.pi * (3 - np.sqrt(5)) * np.arange(spikes)
    z = 1 - (2 * np.arange(spikes) + 1) / spikes
    body = convex(ball(detail // 3)).stretched(0.6, 0.6, 0.6)
    cone = rod(width, 0.35 + length, 16, top=0.03).moved(z=0.25 + (0.35 + length) / 2)
    for angle, height in zip(golden, z, strict=True):
        body = body + cone.turned(y=np.degrees(np.arccos(height))).turned(z=np.degrees(angle))
    return body


def lens(draw: ShapeSampler, detail: int) -> Body:
    """Intersection of two balls."""
    (apart,) = draw(separation=(0.6, 1.6))
    sphere = ball(2 * detail)
    return convex(sphere.translate((0, 0, apart / 2)) ^ sphere.translate((0, 0, -apart / 2)))


def carved(draw: ShapeSampler, detail: int) -> Body:
    """Ball bored through along the three axes."""
    (bore,) = draw(bore=(0.3, 0.52))
    hole = rod(bore, 3.0, around(detail))
    return Body(ball(detail), None) - hole - hole.turned(x=90.0) - hole.turned(y=90.0)


def orange(draw: ShapeSampler, detail: int) -> Body:
    """Ball with one wedge cut out."""
    opening, flat = draw(opening=(60.0, 130.0), flatness=(0.75, 1.0))
    sphere = ball(detail)
    cutter = block(4, 4, 4).moved(y=2.0)
    below, above = cutter.turned(z=180.0 + opening / 2), cutter.turned(z=-opening / 2)
    # The two half-spaces overlap in what stays when the wedge is less than a half.
    halves = [sphere ^ below.solid, sphere ^ above.solid]
    return Body(halves[0] + halves[1], [points_of(half) for half in halves]).stretched(z=flat)


def _polar(radii: np.ndarray, angles: np.ndarray) -> np.ndarray:
    return np.column_stack([radii * np.cos(angles), radii * np.sin(angles)])


def star(draw: ShapeSampler, detail: int) -> Body:
    """Star of four to seven points, thick as a block or tapered."""
    points, depth, thick, top = draw(points=range(4, 8), notch=(0.4, 0.58), thickness=(0.25, 0.6), taper=(0.6, 1.0))
    angles = np.pi * np.arange(2 * points) / points
    return prism(_polar(np.where(np.arange(2 * points) % 2, depth, 1.0), angles), thick, top=top)


def gear(draw: ShapeSampler, detail: int) -> Body:
    """Spur gear without a bore."""
    teeth, tooth, thick = draw(teeth=range(8, 15), tooth=(0.15, 0.28), thickness=(0.25, 0.6))
    (width,) = draw(tooth_width=(0.42, 0.58))
    start = 2 * np.pi * np.arange(teeth)[:, None] / teeth
    share = np.array([-0.5 * width - 0.12, -0.5 * width, 0.5 * width, 0.5 * width + 0.12])
    angles = (start + 2 * np.pi / teeth * share).ravel()
    return prism(_polar(np.tile([1 - tooth, 1.0, 1.0, 1 - tooth], teeth), angles), thick)


def flower(draw: ShapeSampler, detail: int) -> Body:
    """Thick disc with a wavy rim of petals."""
    petals, depth, thick = draw(petals=range(4, 9), depth=(0.14, 0.26), thickness=(0.25, 0.6))
    count = 12 * petals
    angles = 2 * np.pi * np.arange(count) / count
    return prism(_polar(1 + depth * np.cos(petals * angles), angles), thick)


def cross(draw: ShapeSampler, detail: int) -> Body:
    """Flat cross of two bars."""
    width, thick, shift, arm = draw(width=(0.2, 0.45), thickness=(0.2, 0.5), shift=(0.0, 0.25), arm=(0.65, 1.0))
    return block(width, 2.0, thick) + block(2.0 * arm, width, thick).moved(y=shift)


def arrow(draw: ShapeSampler, detail: int) -> Body:
    """Arrow with a broad head."""
    head, width, shaft = draw(head=(0.5, 0.9), head_width=(0.45, 0.75), shaft_width=(0.12, 0.24))
    thick, sweep = draw(thickness=(0.2, 0.45), sweep=(0.0, 0.2))
    outline = [(-1, -shaft), (1 - head, -shaft), (1 - head - sweep, -width), (1, 0)]
    return prism([*outline, (1 - head - sweep, width), (1 - head, shaft), (-1, shaft)], thick)


def crescent(draw: ShapeSampler, detail: int) -> Body:
    """Moon-shaped slab."""
    bite, thick, opening = draw(bite=(0.35, 0.7), thickness=(0.3, 0.7), opening=(0.55, 0.75))
    angles = np.linspace(-opening * np.pi, opening * np.pi, 49)
    outer = _polar(np.ones(49), angles + np.pi)
    tip = outer[[0, -1]]
    # The inner edge is an arc through both tips, pushed towards the outer one.
    share = np.linspace(1, -1, 49)[1:-1]
    depth = tip[0, 0] - (2 - bite * 1.3 - (1 - tip[0, 0])) * (1 - share**2)
    inner = np.column_stack([np.maximum(depth, -1 + 0.3 * bite), tip[0, 1] * -share])
    outline = np.vstack([outer, inner[:: 1 if np.sign(inner[0, 1]) == np.sign(outer[-1, 1]) else -1]])
    return prism(outline, thick)


def heart(draw: ShapeSampler, detail: int) -> Body:
    """Heart-shaped slab."""
    wide, thick, tip = draw(width=(0.85, 1.2), thickness=(0.3, 0.7), tip=(0.9, 1.25))
    t = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    y = (13 * np.cos(t) - 5 * np.cos(2 * t) - 2 * np.cos(3 * t) - np.cos(4 * t)) / 16
    return prism(np.column_stack([wide * np.sin(t) ** 3, np.where(y < 0, tip * y, y)])[::-1], thick)


_LETTERS = {
    "E": [(0, 0, 0.25, 1), (0, 0, 0.7, 0.2), (0, 0.4, 0.6, 0.2), (0, 0.8, 0.7, 0.2)],
    "F": [(0, 0, 0.25, 1), (0, 0.4, 0.6, 0.2), (0, 0.8, 0.7, 0.2)],
    "H": [(0, 0, 0.22, 1), (0.5, 0, 0.22, 1), (0, 0.4, 0.72, 0.2)],
    "L": [(0, 0, 0.25, 1), (0, 0, 0.7, 0.22)],
    "T": [(0, 0.78, 0.8, 0.22), (0.28, 0, 0.24, 1)],
    "U": [(0, 0, 0.22, 1), (0.5, 0, 0.22, 1), (0, 0, 0.72, 0.22)],
}
"""Bars (x, y, width, height) of block letters."""


def letter(draw: ShapeSampler, detail: int) -> Body:
    """Block letter E, F, H, L, T or U."""
    (chosen,) = draw(letter=sorted(_LETTERS))
    wide, thick = draw(width=(0.8, 1.2), thickness=(0.2, 0.4))
    blocks = [block(w, h, thick).moved(x + w / 2, y + h / 2) for x, y, w, h in _LETTERS[chosen]]
    return functools.reduce(Body.__add__, blocks).stretched(x=wide)


def twist(draw: ShapeSampler, detail: int) -> Body:
    """Bar of three to five sides, twisted about its axis."""
    sides, turn, height, top = draw(sides=range(3, 6), turn=(90.0, 240.0), height=(1.8, 3.0), taper=(0.6, 1.0))
    angles = 2 * np.pi * np.arange(sides) / sides
    corners = _polar(np.full(sides, 0.6), angles)
    share = np.arange(8)[:, None] / 8
    # Sides cut into eighths follow the twisted surface instead of folding it along diagonals.
    sides = zip(corners, np.roll(corners, -1, 0), strict=True)
    outline = np.concatenate([(1 - share) * a + share * b for a, b in sides])
    return prism(outline, height, top=top, twist=turn, slices=39)


def polygon(draw: ShapeSampler, detail: int) -> Body:
    """Upright prism of three to eight sides."""
    sides, height = draw(sides=range(3, 9), height=(0.8, 2.2))
    return prism(_polar(np.ones(sides), 2 * np.pi * np.arange(sides) / sides), height)


def _mesh_of(detail: int, *, sides: int = 0) -> tuple[int, int]:
    """Sides of the cross-section and steps along the path for about ``detail`` triangles."""
    sides = sides or max(10, int(math.sqrt(detail) / 5))
    return sides, min(math.ceil(detail / sides / 2) + 2, 9_900 // sides)


def torus(draw: ShapeSampler, detail: int) -> Body:
    """Ring of round cross-section."""
    (ratio,) = draw(tube_over_ring=(0.2, 0.48))
    sides, steps = _mesh_of(detail, sides=max(16, int(math.sqrt(detail) / 3)))
    angle = 2 * np.pi * np.arange(steps) / steps
    return tube(np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]), ratio, sides, closed=True)


def ring(draw: ShapeSampler, detail: int) -> Body:
    """Flat band, like a finger ring or a section of pipe."""
    wall, height = draw(wall=(0.06, 0.12), height=(0.3, 0.8))
    steps = max(24, detail // 40)
    angle = 2 * np.pi * np.arange(steps) / steps
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    corners = np.array([[-wall, -height / 2], [wall, -height / 2], [wall, height / 2], [-wall, height / 2]])
    low, high = 1 - wall, 1 + wall
    parts = []
    for i in range(steps):
        pair = circle[[i, (i + 1) % steps]]
        parts.append(np.array([[r * x, r * y, z] for x, y in pair for r in (low, high) for z in corners[[0, 2], 1]]))
    outer, inner = rod(high, height, steps), rod(low, 2 * height, steps)
    return Body((outer - inner).solid, parts)


def knot(draw: ShapeSampler, detail: int) -> Body:
    """Torus knot with two turns through the hole and three or five lobes."""
    (drawn,) = draw(lobes=["3", "5"])
    lobes = int(drawn)
    swing, radius, rise = draw(swing=(0.38, 0.5), tube=(0.12, 0.22), rise=(0.38, 0.5))
    radius = radius if lobes == 3 else 0.6 * radius
    sides, steps = _mesh_of(detail)
    t = 2 * np.pi * np.arange(steps) / steps
    away = 1 + swing * np.cos(lobes * t)
    path = np.column_stack([away * np.cos(2 * t), away * np.sin(2 * t), -rise * np.sin(lobes * t)])
    return tube(path, radius, sides, closed=True)


def spring(draw: ShapeSampler, detail: int) -> Body:
    """Helix with open turns."""
    turns, pitch, wire = draw(turns=(3.0, 5.5), pitch=(0.38, 0.6), wire=(0.08, 0.14))
    sides, steps = _mesh_of(detail)
    t = np.linspace(0, 2 * np.pi * turns, steps)
    return tube(np.column_stack([np.cos(t), np.sin(t), pitch * t / (2 * np.pi)]), wire, sides, closed=False)


def horseshoe(draw: ShapeSampler, detail: int) -> Body:
    """Round bar bent to a U."""
    length, bar = draw(arms=(0.4, 1.2), bar=(0.14, 0.26))
    sides, steps = _mesh_of(detail)
    angle = np.linspace(0, np.pi, steps // 2)
    bend = np.column_stack([np.cos(angle), np.sin(angle)])
    arm = np.linspace(0, length, max(3, steps // 4))[1:]
    path = np.vstack([np.column_stack([1 + 0 * arm, -arm])[::-1], bend, np.column_stack([-1 + 0 * arm, -arm])])
    return tube(np.column_stack([path, 0 * path[:, 0]]), bar, sides, closed=False)


def hook(draw: ShapeSampler, detail: int) -> Body:
    """Draw a walking cane: a straight bar that curls round at one end."""
    length, bar, curl = draw(shaft=(1.6, 2.8), bar=(0.12, 0.2), curl=(0.8, 1.25))
    sides, steps = _mesh_of(detail)
    angle = np.linspace(0, curl * np.pi, steps // 2)
    bend = np.column_stack([0.6 * np.cos(angle), 0.6 * np.sin(angle)])
    shaft = np.linspace(-length, 0, steps // 2)[:-1]
    path = np.vstack([np.column_stack([0.6 + 0 * shaft, shaft]), bend])
    return tube(np.column_stack([path, 0 * path[:, 0]]), bar, sides, closed=False)


def horn(draw: ShapeSampler, detail: int) -> Body:
    """Curved horn that tapers to a blunt tip."""
    turn, base, rise = draw(turn=(0.55, 0.95), base=(0.24, 0.36), rise=(0.1, 0.5))
    sides, steps = _mesh_of(detail)
    t = np.linspace(0, 1, steps)
    angle = turn * np.pi * t
    return tube(np.column_stack([np.cos(angle), np.sin(angle), rise * t]), base * (1 - t) + 0.03, sides, closed=False)


def dumbbell(draw: ShapeSampler, detail: int) -> Body:
    """Two balls on a bar."""
    size, bar, length = draw(ball=(0.2, 0.38), bar=(0.06, 0.13), length=(0.75, 1.3))
    sphere = convex(ball(detail // 3)).stretched(size, size, size)
    return rod(bar, length, 32) + sphere.moved(z=length / 2) + sphere.moved(z=-length / 2)


def table(draw: ShapeSampler, detail: int) -> Body:
    """Four-legged table."""
    length, width, height, leg = draw(length=(0.9, 1.5), width=(0.6, 0.9), height=(0.5, 0.9), leg=(0.06, 0.12))
    return _legs(length, width, height, leg) + block(length, width, 0.1).moved(z=0.05)


def chair(draw: ShapeSampler, detail: int) -> Body:
    """Four-legged chair with a back."""
    seat, height, leg, back = draw(seat=(0.55, 0.75), height=(0.45, 0.65), leg=(0.06, 0.11), back=(0.5, 0.85))
    rest = block(seat, 0.08, back).moved(y=seat / 2 - 0.04, z=back / 2 + 0.05)
    return _legs(seat, seat, height, leg) + block(seat, seat, 0.1).moved(z=0.05) + rest


def _legs(length: float, width: float, height: float, leg: float) -> Body:
    """Four legs below z = 0, sunk a little into what stands on them."""
    corner = block(leg, leg, height + 0.05).moved(z=0.025 - height / 2)
    x, y = (length - leg) / 2, (width - leg) / 2
    return corner.moved(x, y) + corner.moved(-x, y) + corner.moved(x, -y) + corner.moved(-x, -y)


def stairs(draw: ShapeSampler, detail: int) -> Body:
    """Flight of three to seven steps."""
    steps, width = draw(steps=range(3, 8), width=(0.4, 1.0))
    (rise,), run = draw(rise=(0.7, 1.2)), 1.2
    # Every slab reaches to the back, so that the slabs overlap and their union is one body.
    slabs = []
    for i in range(steps):
        long, tall = run * (steps - i) / steps, rise * (i + 1) / steps
        slabs.append(block(long, width, tall).moved(x=run - long / 2, z=tall / 2))
    return functools.reduce(Body.__add__, slabs)


def arch(draw: ShapeSampler, detail: int) -> Body:
    """Round arch on two pillars."""
    span, pillar, height, depth = draw(span=(0.35, 0.55), pillar=(0.18, 0.32), height=(0.4, 1.0), depth=(0.3, 0.6))
    outer = span + pillar
    count = 2 * (around(detail) // 4)
    angle = np.linspace(0, np.pi, count + 1)
    curve = np.column_stack([np.cos(angle), np.sin(angle)])
    feet = [(-outer, -height), (-span, -height)]
    outline = [*[(outer, -height)], *outer * curve, *feet, *span * curve[::-1], (span, -height)]
    return prism(np.vstack(outline), depth)


def frame(draw: ShapeSampler, detail: int) -> Body:
    """Rectangular window frame."""
    wide, tall, bar, depth = draw(width=(0.8, 1.6), height=(0.8, 1.2), bar=(0.1, 0.18), depth=(0.15, 0.4))
    upright, beam = block(bar, tall, depth), block(wide, bar, depth)
    x, y = (wide - bar) / 2, (tall - bar) / 2
    return upright.moved(x) + upright.moved(-x) + beam.moved(y=y) + beam.moved(y=-y)


def perforated(draw: ShapeSampler, detail: int) -> Body:
    """Box with one to three round holes bored through it."""
    holes, length, width, thick = draw(holes=range(1, 4), length=(1.2, 1.8), width=(0.6, 0.9), thickness=(0.25, 0.6))
    (share,) = draw(hole=(0.28, 0.38))
    hole = rod(share * min(width, length / holes), 2.0, around(detail))
    body = block(length, width, thick)
    for i in range(holes):
        body = body - hole.moved(x=length * ((i + 0.5) / holes - 0.5))
    return body


def pyramid(draw: ShapeSampler, detail: int) -> Body:
    """Pyramid over three to six sides, with a small flat top."""
    sides, height, top = draw(sides=range(3, 7), height=(0.8, 1.7), top=(0.02, 0.15))
    angles = 2 * np.pi * np.arange(sides) / sides
    return prism(np.column_stack([np.cos(angles), np.sin(angles)]), height, top=top)


def wedge(draw: ShapeSampler, detail: int) -> Body:
    """Ramp: a box cut along its diagonal."""
    height, width, lip = draw(height=(0.35, 0.9), width=(0.4, 1.0), lip=(0.02, 0.1))
    return prism([(0, 0), (1.3, 0), (1.3, lip), (0, height)], width).turned(x=90.0)


def cone(draw: ShapeSampler, detail: int) -> Body:
    """Cone with a small flat top."""
    radius, height, top = draw(radius=(0.35, 0.6), height=(0.8, 1.4), top=(0.01, 0.06))
    return rod(radius, height, around(detail), top=top)


def cylinder(draw: ShapeSampler, detail: int) -> Body:
    """Cylinder, from a disc to a pole."""
    radius, height = draw(radius=(0.15, 0.6), height=(0.5, 1.4))
    return rod(radius, height, 2 * around(detail))


def brick(draw: ShapeSampler, detail: int) -> Body:
    """Rectangular block."""
    return block(1.0, *draw(y_over_x=(0.4, 0.9), z_over_x=(0.2, 0.7)))


def hammer(draw: ShapeSampler, detail: int) -> Body:
    """Cylindrical head across the end of a handle."""
    head, length, grip, shaft = draw(head=(0.13, 0.2), head_length=(0.5, 0.8), grip=(0.05, 0.08), handle=(1.0, 1.5))
    facets = around(detail)
    return rod(head, length, facets).turned(x=90.0).moved(z=shaft / 2) + rod(grip, shaft, facets)


def bolt(draw: ShapeSampler, detail: int) -> Body:
    """Hexagonal head on a round shank."""
    head, thick, shank, length = draw(head=(0.32, 0.46), head_height=(0.2, 0.32), shank=(0.12, 0.22), length=(0.6, 1.6))
    nut = rod(head, thick, 6)
    return rod(shank, length, around(detail)) + nut.moved(z=(length + thick) / 2 - 0.01)


def jack(draw: ShapeSampler, detail: int) -> Body:
    """Three rods crossing at right angles, with thick ends."""
    bar, knob, arm = draw(bar=(0.08, 0.14), knob=(0.15, 0.22), arm=(0.5, 0.75))
    facets = around(detail)
    end = rod(knob, 0.16, facets)
    axle = rod(bar, 2 * arm, facets) + end.moved(z=arm) + end.moved(z=-arm)
    return axle + axle.turned(x=90.0) + axle.turned(y=90.0)


def house(draw: ShapeSampler, detail: int) -> Body:
    """Box under a pitched roof with eaves."""
    wide, deep, wall, roof = draw(width=(0.6, 0.9), depth=(0.7, 1.2), wall=(0.4, 0.7), roof=(0.25, 0.5))
    (eave,) = draw(eave=(0.05, 0.15))
    half = wide / 2 + eave
    gable = prism([(-half, 0), (half, 0), (0, roof)], deep + 2 * eave).turned(x=90.0)
    return block(wide, deep, wall + 0.02).moved(z=0.01 - wall / 2) + gable


def basket(draw: ShapeSampler, detail: int) -> Body:
    """Open box with an arched handle."""
    wide, deep, tall, handle = draw(width=(0.8, 1.1), depth=(0.5, 0.75), height=(0.3, 0.5), handle=(0.3, 0.55))
    wall = 0.07
    side, end = block(wall, deep, tall), block(wide, wall, tall)
    x, y = (wide - wall) / 2, (deep - wall) / 2
    tub = block(wide, deep, wall).moved(z=(wall - tall) / 2) + side.moved(x) + side.moved(-x)
    angle = np.linspace(0, np.pi, max(16, around(detail) // 2))
    arc = np.column_stack([x * np.cos(angle), 0 * angle, tall / 2 - 0.02 + handle * np.sin(angle)])
    return tub + end.moved(y=y) + end.moved(y=-y) + tube(arc, 0.034, 10, closed=False)
