"""Light and shadow for the rasterised surfaces of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.figures.camera import Camera, Lens
from brainbench.stimuli.figures.raster import RasterLayer, Triangles, draw

AMBIENT, KEY = 0.58, 0.50
FLOOR_SHADE = 0.22
SHADOW_DETAIL = 1.2
_PENUMBRA = ((0, 0), (-2, -1), (1, -2), (2, 1), (-1, 2))


@dataclass(frozen=True, eq=False)
class Light:
    """A distant lamp and what it sees: what lies behind that is in shadow."""

    lens: Lens
    nearness: NDArray[np.float64]
    """[H, W] of the surfaces that the lamp sees."""
    strength: float = 1.0
    """Strength of the shadows, from 0 to 1: translucent objects throw weaker ones."""

    @property
    def direction(self) -> NDArray[np.float64]:
        """[3] unit vector towards the lamp (world)."""
        return self.lens.axes[2]

    def reaches(self, points: NDArray[np.float64], bias: float = 4.0) -> NDArray[np.float32]:
        """Return how much of the light arrives [n], 0 to 1, at points [n, 3] (m).

        ``bias`` is the depth that is forgiven, in pixels of the lamp's picture: less, and surfaces that the
        lamp grazes would shade themselves in stripes.
        """
        flat = self.lens.project(points)
        x, y = (np.floor(flat[:, axis]).astype(int) for axis in (0, 1))
        width, height = self.lens.size
        lit = np.zeros(len(points), dtype=np.float32)
        for dx, dy in _PENUMBRA:
            pixel = np.clip(y + dy, 0, height - 1) * width + np.clip(x + dx, 0, width - 1)
            lit += self.nearness.reshape(-1)[pixel] <= flat[:, 2] + bias / self.lens.scale
        return 1 - np.float32(self.strength) * (1 - lit / np.float32(len(_PENUMBRA)))


def lamp(lens: Lens, samples: int, points: NDArray[np.float64], triangles: Triangles, strength: float = 1.0) -> Light:
    """Return a lamp over the camera's left shoulder, fitted to the ``points`` [n, 3] (m) that can throw shadows.

    ``samples`` are those per pixel and direction, of which shadows take about one; ``triangles`` throw shadows now,
    whose ``strength`` lies between 0 and 1.
    """
    right, up, towards = lens.axes
    # High in the world as well, so that shadows fall on the floor.
    direction = 0.9 * towards + 0.35 * up - 0.8 * right + np.array([0.0, 0.0, 0.45])
    camera = Camera(view=(float(direction[0]), float(direction[1]), float(direction[2])), projection="orthographic")
    edge = int(SHADOW_DETAIL * max(lens.size) / samples)
    fitted = camera.lens(points, (edge, edge))
    return Light(fitted, draw(triangles, fitted).nearness, strength)


def shade(
    layer: RasterLayer, lens: Lens, light: Light, *, gloss: float = 0.0, bias: float = 4.0
) -> NDArray[np.float64]:
    """Return the colours [n, 3] of a layer's pixels: diffuse, with shadows and a highlight of strength ``gloss``."""
    facing = layer.normals @ light.direction.astype(np.float32)
    lit = np.zeros(len(facing), dtype=np.float32)
    bright = np.flatnonzero(facing > 0)
    # Three pixels of the lamp off the surface, which would otherwise shade itself.
    lifted = layer.points[bright] + 3 / light.lens.scale * layer.normals[bright]
    lit[bright] = light.reaches(lifted, bias)
    # Faces that look up receive a little more of the ambient light.
    sky = 0.9 + 0.1 * layer.normals[:, 2]
    colors = layer.colors * (AMBIENT * sky + KEY * np.maximum(facing, 0) * lit)[:, None]
    if gloss:
        # Highlight by the half-way vector of light and view (Blinn 1977).
        half = light.direction + lens.axes[2]
        shine = np.maximum(layer.normals @ (half / np.linalg.norm(half)).astype(np.float32), 0) ** 40
        colors = colors + gloss * (shine * lit)[:, None]
    return np.clip(colors, 0.0, 1.0)


def floor(lens: Lens, light: Light, height: float) -> NDArray[Any]:
    """Return the brightness [H, W] of a white floor at ``height`` (m) with the shadows on it.

    Only a perspective from above shows a floor: drawings to scale stay free of it.
    """
    from scipy.ndimage import uniform_filter

    width, rows = lens.size
    bright = np.ones((rows, width), dtype=np.float32)
    if lens.distance is None or not 0.05 < lens.axes[2, 2] < 0.9:
        return bright
    # Shadows on the floor are soft: every second pixel is enough.
    y, x = np.mgrid[0:rows:2, 0:width:2]
    eye = lens.target + lens.distance * lens.axes[2]
    rays = lens.unproject(x + 1.0, y + 1.0, np.full(x.shape, 1 / lens.distance)) - eye
    down = rays[..., 2] < -1e-9
    # Where the ray of each pixel meets the plane z = height.
    points = eye + ((height - eye[2]) / rays[down, 2])[:, None] * rays[down]
    shadow = np.zeros(x.shape, dtype=np.float32)
    shadow[down] = FLOOR_SHADE * (1 - light.reaches(points))
    shadow = uniform_filter(shadow, 7, mode="nearest")
    return bright - shadow.repeat(2, axis=0).repeat(2, axis=1)[:rows, :width]


def paint(layer: RasterLayer, colors: NDArray[Any], background: NDArray[Any], opacity: float = 1.0) -> None:
    """Lay the colours [n, 3] of a layer over ``background`` [H, W, 3], in place."""
    flat = background.reshape(-1, 3)
    flat[layer.pixels] = opacity * colors + (1 - opacity) * flat[layer.pixels]
