"""Families made by sweeping a circle along a path: tori, knots, springs, rings and hooks."""

from __future__ import annotations

import math

import numpy as np

from brainbench.stimuli.objects.procedural.bodies import Body, ShapeSampler, ball, convex, rod, tube


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
    path = np.column_stack([np.cos(angle), np.sin(angle), rise * t])
    return tube(path, base * (1 - t) + 0.03, sides, closed=False)


def dumbbell(draw: ShapeSampler, detail: int) -> Body:
    """Two balls on a bar."""
    size, bar, length = draw(ball=(0.2, 0.38), bar=(0.06, 0.13), length=(0.75, 1.3))
    sphere = convex(ball(detail // 3)).stretched(size, size, size)
    return rod(bar, length, 32) + sphere.moved(z=length / 2) + sphere.moved(z=-length / 2)
