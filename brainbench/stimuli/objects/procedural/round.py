"""Families made from a ball: ellipsoids, superquadrics, bumpy and carved spheres."""

from __future__ import annotations

import numpy as np

from brainbench.stimuli.objects.procedural.bodies import Body, ShapeSampler, around, ball, block, convex, points_of, rod


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
