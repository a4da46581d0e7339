"""Families made by pushing a flat outline along a line, or a circle along a path: prisms, knots, springs and hooks."""

from __future__ import annotations

import functools
import math

import numpy as np

from brainbench.stimuli.objects.procedural.bodies import Body, ShapeSampler, ball, block, convex, prism, rod, tube


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
    path = np.column_stack([np.cos(angle), np.sin(angle), rise * t])
    return tube(path, base * (1 - t) + 0.03, sides, closed=False)


def dumbbell(draw: ShapeSampler, detail: int) -> Body:
    """Two balls on a bar."""
    size, bar, length = draw(ball=(0.2, 0.38), bar=(0.06, 0.13), length=(0.75, 1.3))
    sphere = convex(ball(detail // 3)).stretched(size, size, size)
    return rod(bar, length, 32) + sphere.moved(z=length / 2) + sphere.moved(z=-length / 2)
