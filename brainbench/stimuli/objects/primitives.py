"""Solids of simple shape, and the crescent of the shape-discrimination task. Metres, about the origin."""

from __future__ import annotations

import numpy as np

from brainbench.core.reading.ranges import check_number
from brainbench.core.rotations import Vector
from brainbench.geometry import Mesh
from brainbench.stimuli.objects.obstacle import Box, Capsule, ConvexPart, Cylinder, Sphere
from brainbench.stimuli.objects.solid import Solid

RODGERS_CONTROL = ((-0.720943, 0.195148), (-0.167777, 0.219684), (0.235608, -0.057831), (0.631506, -0.409149))
"""Control points (x, y) of the cubic Bézier curve that is the convex face of the Rodgers solid, in the
units of the published mesh (1 unit = 34.324 mm at a diagonal of 55 mm). Fitted by us; the curve passes
through all 101 published vertices of that face within 6e-7."""
RODGERS_OFFSET = (-0.020447, -0.046006)
"""Displacement (x, y) from the convex to the concave face: the profile is the curve swept along it."""
RODGERS_SPAN = (-0.256589, 0.251290)
"""Lowest and highest z of the extruded profile."""


def sphere(radius: float) -> Solid:
    """Return a ball about the origin; ``radius`` in metres."""
    return Solid("sphere", (Sphere((0.0, 0.0, 0.0), radius),))


def box(size: Vector) -> Solid:
    """Return a box about the origin with edge lengths ``size`` [m]."""
    return Solid("box", (Box((0.0, 0.0, 0.0), (size[0] / 2, size[1] / 2, size[2] / 2)),))


def cylinder(radius: float, height: float) -> Solid:
    """Return an upright (z) cylinder about the origin, such as a pole; metres."""
    return Solid("cylinder", (Cylinder((0.0, 0.0, -height / 2), (0.0, 0.0, height / 2), radius),))


def capsule(radius: float, length: float) -> Solid:
    """Return an upright (z) capsule about the origin; ``length`` [m] between the centres of its caps."""
    return Solid("capsule", (Capsule((0.0, 0.0, -length / 2), (0.0, 0.0, length / 2), radius),))


def rodgers_solid(diagonal: float = 0.055, *, segments: int = 24) -> Solid:
    """Return the crescent of the shape-discrimination task (Rodgers 2022), in the published mesh's frame.

    A cubic Bézier profile of constant offset, extruded along z. Each segment between two points of
    the curve is a parallelogram prism, so the parts are exactly convex, their union is exactly the
    polygonal solid and the concave face stays concave. The concave face looks towards −y. The published simulation has
    a bounding-box diagonal of 55 mm, at which 24 segments leave a sagitta below 0.02 mm.
    """
    check_number("segments of the Rodgers solid", segments, least=2, whole=True)
    t = np.linspace(0.0, 1.0, segments + 1)[:, None]
    # Bernstein polynomials of degree 3.
    weights = np.hstack([(1 - t) ** 3, 3 * t * (1 - t) ** 2, 3 * t**2 * (1 - t), t**3])
    convex = weights @ np.array(RODGERS_CONTROL)
    concave = convex + np.array(RODGERS_OFFSET)
    # Rings of four corners along the curve: convex low, convex high, concave high, concave low.
    low, high = (np.full(segments + 1, height) for height in RODGERS_SPAN)
    profile = ((convex, low), (convex, high), (concave, high), (concave, low))
    rings = np.stack([np.column_stack([side, height]) for side, height in profile], axis=1)
    corner, following = np.arange(4), np.roll(np.arange(4), -1)
    near = 4 * np.arange(segments)[:, None]
    quads = np.stack([near + corner, near + corner + 4, near + following + 4, near + following], axis=-1).reshape(-1, 4)
    last = 4 * segments
    quads = np.vstack([quads, [[0, 1, 2, 3]], [[last + 3, last + 2, last + 1, last]]])
    faces = np.vstack([quads[:, [0, 2, 1]], quads[:, [0, 3, 2]]])
    mesh = Mesh(rings.reshape(-1, 3), faces, "rodgers")
    parts = tuple(ConvexPart(np.vstack([rings[i], rings[i + 1]])) for i in range(segments))
    return Solid("rodgers", parts, mesh, surface=mesh).to_diagonal(diagonal)
