"""What a camera sees of triangles, and light and shadow on it, by rays against a tree of boxes.

Pictures are wanted on machines that have Python packages only: 3-D packages draw through OpenGL or Vulkan drivers of
the system, and matplotlib sorts whole polygons instead of pixels, so that thin whiskers show through objects.
Letters: F triangle, H×W pixels, n pixels that show something.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.devices import usable_processors, warp
from brainbench.stimuli.figures.camera import Camera, Lens

AMBIENT, KEY = 0.58, 0.50
FLOOR_SHADE = 0.22
SHADOW_DETAIL = 1.2
_PENUMBRA = np.array([(0, 0), (-2, -1), (1, -2), (2, 1), (-1, 2)])
"""Steps to the side of a point's rays to the lamp, in details of its shadows: edges become soft."""
_BLOCK = 1 << 17
_FIELDS = ("corners", "normals", "colors")


@dataclass(frozen=True, eq=False)
class Triangles:
    """Triangles with a normal at each corner and one colour each."""

    corners: NDArray[np.float64]
    """[F, 3, 3] m, world."""
    normals: NDArray[np.float64]
    """[F, 3, 3] unit vectors; the side they point to does not matter."""
    colors: NDArray[np.float64]
    """[F, 3] red, green, blue from 0 to 1."""

    @classmethod
    def joined(cls, items: list[Triangles]) -> Triangles:
        """Return the triangles of all items."""
        none = Triangles(np.zeros((0, 3, 3)), np.zeros((0, 3, 3)), np.zeros((0, 3)))
        return cls(*(np.concatenate([getattr(item, name) for item in (none, *items)]) for name in _FIELDS))


class RayTree:
    """Triangles in a tree of boxes, for rays seen from around ``centre`` [3] (m) at a scale of ``unit`` (m)."""

    def __init__(self, corners: NDArray[np.float64], centre: NDArray[np.float64], unit: float) -> None:
        # Rays are in single precision: coordinates near one keep its digits.
        self._centre, self._unit, self._mesh = centre, unit, None
        if len(corners):
            wp, local = warp(), self.local(corners).reshape(-1, 3)
            self._extent = 1.01 * unit * float(np.linalg.norm(local, axis=1).max())
            points = wp.array(local, dtype=wp.vec3, device="cpu")
            self._mesh = wp.Mesh(points, wp.array(np.arange(3 * len(corners), dtype=np.int32), device="cpu"))

    def local(self, points: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return points [..., 3] (m, world) in the units of the rays."""
        return ((points - self._centre) / self._unit).astype(np.float32)

    def first_hits(self, lens: Lens) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        """Return the first triangle on each pixel's ray [H·W] (−1 for none), and weights [H·W, 3] of its corners."""
        from brainbench.stimuli.figures.kernels.rays import first_hit

        count = lens.size[0] * lens.size[1]
        face, weights = np.full(count, -1, dtype=np.int32), np.zeros((count, 3), dtype=np.float32)
        if self._mesh is None:
            return face, weights
        wp = warp()
        rays = [wp.vec3(*(value / self._unit).tolist()) for value in self._pixel_rays(lens)]

        def cast(mesh: Any, first: int, last: int) -> None:
            outputs = [face[first:last], weights[first:last]]
            wp.launch(first_hit, last - first, [mesh.id, lens.size[0], first, *rays], outputs, device="cpu")

        self._in_blocks(count, cast)
        return face, weights

    def blocked(self, points: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return whether a triangle lies in ``direction`` [3] of each of the points [n, 3] (m, world)."""
        from brainbench.stimuli.figures.kernels.rays import blocked

        wp = warp()
        start, dark = self.local(points), np.zeros(len(points), dtype=np.uint8)

        def cast(mesh: Any, first: int, last: int) -> None:
            wp.launch(
                blocked, last - first, [mesh.id, start[first:last], wp.vec3(*direction.tolist())], [dark[first:last]],
                device="cpu",
            )  # fmt: skip

        self._in_blocks(len(points), cast)
        return dark.astype(bool)

    def _in_blocks(self, count: int, cast: Any) -> None:
        """Call ``cast(mesh, first, last)`` for blocks of the rays, on all processors: Warp has one thread a launch."""
        if self._mesh is None:
            return
        warp().load_module("brainbench.stimuli.figures.kernels.rays", device="cpu")
        starts = range(0, count, _BLOCK)
        with ThreadPoolExecutor(usable_processors()) as pool:
            list(pool.map(lambda first: cast(self._mesh, first, min(first + _BLOCK, count)), starts))

    def _pixel_rays(self, lens: Lens) -> tuple[NDArray[np.float64], ...]:
        """Return origin and direction of the first pixel's ray, each with its steps to the right and down (m)."""
        right, up, towards = lens.axes
        pixel = 1 / lens.scale
        corner = ((0.5 - lens.size[0] / 2) * right - (0.5 - lens.size[1] / 2) * up) * pixel
        middle, steps, still = lens.target - self._centre, (pixel * right, -pixel * up), (np.zeros(3), np.zeros(3))
        if lens.distance is None:
            return middle + corner + self._extent * towards, *steps, -towards * self._unit, *still
        return middle + lens.distance * towards, *still, corner - lens.distance * towards, *steps


@dataclass(frozen=True, eq=False)
class VisibleSurface:
    """What is visible of some triangles at the pixels of a picture."""

    nearness: NDArray[np.float64]
    """[H, W] nearness of the surface; −∞ where there is none."""
    pixels: NDArray[np.int64]
    """[n] flat indices of the covered pixels."""
    points: NDArray[np.float64]
    """[n, 3] surface points (m, world)."""
    normals: NDArray[np.float32]
    """[n, 3] unit normals that face the camera."""
    colors: NDArray[np.float32]
    """[n, 3] colours."""


def draw(triangles: Triangles, lens: Lens) -> VisibleSurface:
    """Find the nearest triangle at each pixel, and point, normal and colour there."""
    face, weights = RayTree(triangles.corners, lens.target, lens.width).first_hits(lens)
    pixels = np.flatnonzero(face >= 0)
    face, weights = face[pixels], weights[pixels]
    points = np.einsum("nk,nki->ni", weights, triangles.corners[face])
    nearness = np.full(lens.size[0] * lens.size[1], -np.inf)
    nearness[pixels] = lens.project(points)[:, 2]
    normals = np.einsum("nk,nki->ni", weights, triangles.normals.astype(np.float32)[face])
    # Normals are turned to the camera, because thin surfaces are seen from both sides.
    towards = lens.axes[2] if lens.distance is None else lens.target + lens.distance * lens.axes[2] - points
    length = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    length = np.where(np.sum(normals * towards, axis=1) < 0, -length, length)
    normals /= length[:, None].astype(np.float32)
    grid = nearness.reshape(lens.size[1], lens.size[0])
    return VisibleSurface(grid, pixels, points, normals, triangles.colors.astype(np.float32)[face])


@dataclass(frozen=True, eq=False)
class Light:
    """A distant lamp, and the triangles that throw shadows in its light."""

    tree: RayTree
    axes: NDArray[np.float64]
    """Unit vectors [3, 3] to the right, up and towards the lamp as it sees the scene, as rows (world)."""
    pixel: float
    """Finest detail of shadows [m]."""
    strength: float = 1.0
    """Strength of the shadows, from 0 to 1: translucent objects throw weaker ones."""

    @property
    def direction(self) -> NDArray[np.float64]:
        """[3] unit vector towards the lamp (world)."""
        return self.axes[2]

    def reaches(self, points: NDArray[np.float64], bias: float = 4.0) -> NDArray[np.float32]:
        """Return how much of the light arrives [n], 0 to 1, at points [n, 3] (m).

        What lies within ``bias`` details towards the lamp throws no shadow: a surface that the lamp grazes would shade
        itself in stripes.
        """
        dark = np.zeros(len(points), dtype=np.float32)
        for aside in _PENUMBRA @ self.axes[:2]:
            dark += self.tree.blocked(points + self.pixel * (aside + bias * self.direction), self.direction)
        return 1 - np.float32(self.strength / len(_PENUMBRA)) * dark


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
    return Light(RayTree(triangles.corners, lens.target, lens.width), fitted.axes, 1 / fitted.scale, strength)


def shade(
    layer: VisibleSurface, lens: Lens, light: Light, *, gloss: float = 0.0, bias: float = 4.0
) -> NDArray[np.float64]:
    """Return the colours [n, 3] of a layer's pixels: diffuse, with shadows and a highlight of strength ``gloss``."""
    facing = layer.normals @ light.direction.astype(np.float32)
    lit = np.zeros(len(facing), dtype=np.float32)
    bright = np.flatnonzero(facing > 0)
    # Three details off the surface, which would otherwise shade itself.
    lifted = layer.points[bright] + 3 * light.pixel * layer.normals[bright]
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


def paint(layer: VisibleSurface, colors: NDArray[Any], background: NDArray[Any], opacity: float = 1.0) -> None:
    """Lay the colours [n, 3] of a layer over ``background`` [H, W, 3], in place."""
    flat = background.reshape(-1, 3)
    flat[layer.pixels] = opacity * colors + (1 - opacity) * flat[layer.pixels]
