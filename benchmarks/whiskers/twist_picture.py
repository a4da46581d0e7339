"""Draw a curved rat whisker pushed out of its plane, with bars that turn with its cross-sections.

``python -m benchmarks.whiskers.twist_picture [docs/images/twist.png]``
"""

from __future__ import annotations

import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from brainbench.stimuli.figures.camera import Camera
from brainbench.stimuli.figures.raster import Triangles, draw
from brainbench.stimuli.figures.shading import floor, lamp, paint, shade
from brainbench.stimuli.figures.surfaces import tube
from brainbench.stimuli.validation import references
from brainbench.stimuli.whiskers.array import WhiskerArray
from tests.factories.kirchhoff import KirchhoffRod, load_rod, trace_rod

SIZE, SAMPLES = (1100, 620), 2
AT, SHARE, EXAGGERATED = 0.7, 0.15, 12.0
"""Place of the force and deflection in parts of the arc length; factor on the twist that is drawn."""
BARS = 15
STILL, LOADED, BAR = (0.72, 0.74, 0.78), (0.16, 0.36, 0.62), (0.85, 0.45, 0.13)


def bars(points: NDArray, frames: NDArray, twist: NDArray, size: float, color: tuple[float, float, float]) -> Triangles:
    """Short bars across the whisker, in the plane in which it curves at rest, turned by the exaggerated twist."""
    found = []
    for k in np.linspace(0, len(points) - 1, BARS).astype(int):
        extra = (EXAGGERATED - 1) * twist[k]
        way = np.cos(extra) * frames[k, :, 1] + np.sin(extra) * frames[k, :, 2]
        line = points[k] + np.linspace(-size, size, 4)[:, None] * way
        found.append(tube(line, np.full(4, 0.09 * size), np.broadcast_to(color, (4, 3))))
    return Triangles.joined(found)


def main() -> None:
    whisker = WhiskerArray.rat()["C1"].whisker
    at, straight = AT * whisker.arc_length, replace(whisker, curvature=0.0)
    force = SHARE * whisker.arc_length / references.point_load_deflection(straight, 1.0, at)
    rod, arcs = KirchhoffRod.of(whisker), np.linspace(0, at, 121)
    scene, size = [], 0.03 * whisker.arc_length
    for load, color, bar in ((0.0, STILL, STILL), (force, LOADED, BAR)):
        points, frames, twist = trace_rod(rod, load_rod(rod, at, (0.0, 0.0, load)), arcs)
        scene += [
            tube(points, 5 * whisker.radius(arcs), np.broadcast_to(color, points.shape)),
            bars(points, frames, twist, size, bar),
        ]
    triangles = Triangles.joined(scene)
    corners = triangles.corners.reshape(-1, 3)
    plain = Camera((-0.2, -0.75, 0.8)).lens(corners, SIZE)
    lens = plain.supersampled(SAMPLES)
    light = lamp(lens, SAMPLES, corners, triangles)
    ground = floor(plain, light, float(corners[:, 2].min() - 0.03 * plain.width)).repeat(SAMPLES, 0).repeat(SAMPLES, 1)
    image = np.repeat(ground[..., None], 3, axis=2)
    layer = draw(triangles, lens)
    paint(layer, shade(layer, lens, light, gloss=0.2), image)
    height, width, _ = image.shape
    image = image.reshape(height // SAMPLES, SAMPLES, width // SAMPLES, SAMPLES, 3).mean(axis=(1, 3))
    Image.fromarray(np.round(255 * image).astype(np.uint8)).save(
        sys.argv[1] if sys.argv[1:] else "docs/images/twist.png"
    )
    print(f"twist of {np.degrees(twist[-1]):.2f}° at the force, drawn {EXAGGERATED:g} times")


if __name__ == "__main__":
    main()
