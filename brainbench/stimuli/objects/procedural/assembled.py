"""Families put together from blocks and rods: furniture, stairs, arches, tools, frames."""

from __future__ import annotations

import functools

import numpy as np

from brainbench.stimuli.objects.procedural.bodies import Body, ShapeSampler, around, block, prism, rod, tube


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
