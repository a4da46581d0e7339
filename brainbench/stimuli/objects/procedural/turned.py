"""Families of round bodies: vases, cups and spools from the lathe, and balls that are stretched, bumpy or cut."""

from __future__ import annotations

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
    line = np.vstack([bottom, cup_line])
    return lathe(line, around(detail), wall=0.045, floor=cup_line[1, 1])


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
    points = list(zip([0.0, rim, rim, 1.4 * pin, pin], z, strict=True))
    return lathe(np.array(points), around(detail))


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

    def warp(points: np.ndarray) -> np.ndarray:
        # Along the ray of every point to the surface (|x|^(2/a) + |y|^(2/a))^(a/v) + |z|^(2/v) = 1.
        p = np.abs(points)
        flat = (p[:, 0] ** (2 / around_z) + p[:, 1] ** (2 / around_z)) ** (around_z / vertical)
        return points * ((flat + p[:, 2] ** (2 / vertical)) ** (-vertical / 2))[:, None]

    return convex(ball(detail, warp)).stretched(1.0, y, z)


def bumpy(draw: ShapeSampler, detail: int) -> Body:
    """Sphere with rounded bumps."""
    count, height, width = draw(bumps=range(10, 25), height=(0.15, 0.3), width=(0.25, 0.38))
    # A spiral by the golden angle with equal steps of z spreads points evenly over a sphere.
    golden = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    z = 1 - (2 * np.arange(count) + 1) / count
    centres = np.column_stack([np.sqrt(1 - z**2) * np.cos(golden), np.sqrt(1 - z**2) * np.sin(golden), z])
    centres += 0.08 * draw.normals(count, 3)
    centres /= np.linalg.norm(centres, axis=1, keepdims=True)

    def warp(points: np.ndarray) -> np.ndarray:
        # Angle between a point of the sphere and each bump.
        gap = np.arccos(np.clip(points @ centres.T, -1, 1))
        return points * (1 + height * np.exp(-((gap / width) ** 2)).sum(axis=1, keepdims=True))

    return Body(ball(detail, warp), None)


def pebble(draw: ShapeSampler, detail: int) -> Body:
    """Smooth irregular stone: a flattened ball with gentle low-order undulation."""
    flat, amount = draw(flatness=(0.4, 0.65), undulation=(0.08, 0.16))
    waves = draw.normals(6, 3)
    waves *= 1.8 / np.linalg.norm(waves, axis=1, keepdims=True)
    phase = draw.normals(6) * np.pi

    def warp(points: np.ndarray) -> np.ndarray:
        return points * (1 + amount * np.cos(points @ waves.T + phase).mean(axis=1, keepdims=True) * 2)

    return Body(ball(detail, warp), None).stretched(z=flat)


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
