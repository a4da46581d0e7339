"""A depth-buffered triangle rasteriser in NumPy: triangles are tested against the pixels of their bounding boxes.

Pictures are wanted on machines that have Python packages only. 3-D packages draw through OpenGL or Vulkan drivers of
the system, and matplotlib sorts whole polygons instead of pixels, so that thin whiskers show through objects.
Letters: F triangle, H×W pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.figures.camera import Lens

LARGEST = 32
"""Triangles that extend over more pixels are split first."""
CHUNK = 1 << 19
"""Candidate pixels tested at a time; bounds the memory."""
_DEEPEST = 12
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

    def split(self, lens: Lens) -> Triangles:
        """Return the triangles in the picture, cut in four until each is at most :data:`LARGEST` pixels wide."""
        done, rest = [], self
        for _ in range(_DEEPEST):
            if not len(rest.corners):
                break
            flat = lens.project(rest.corners)
            before = np.isfinite(flat[..., 2])
            low, high = flat[..., :2].min(axis=1), flat[..., :2].max(axis=1)
            shown = np.all(before, axis=1) & (high >= 0).all(axis=1) & (low <= lens.size).all(axis=1)
            large = (high - low).max(axis=1) > LARGEST
            done.append(rest._take(shown & ~large))
            # What reaches from before to behind the camera is cut until the rest behind it is negligible.
            partly = np.any(before, axis=1) & ~np.all(before, axis=1)
            rest = rest._take((shown & large) | partly)
            quarters = (_quarter(rest.corners), _quarter(rest.normals), np.tile(rest.colors, (4, 1)))
            rest = Triangles(*quarters)
        return Triangles.joined(done)

    def _take(self, chosen: NDArray[np.bool_]) -> Triangles:
        return Triangles(*(getattr(self, name)[chosen] for name in _FIELDS))


@dataclass(frozen=True, eq=False)
class RasterLayer:
    """Surface that is visible at each pixel of a picture of some triangles."""

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


def draw(triangles: Triangles, lens: Lens) -> RasterLayer:
    """Find the nearest triangle at each pixel, and point, normal and colour there."""
    triangles = triangles.split(lens)
    planes = _planes(lens.project(triangles.corners))
    nearness, owner = visible(planes, lens.size)
    pixels = np.flatnonzero(owner >= 0)
    faces = owner.reshape(-1)[pixels]
    y, x = np.divmod(pixels, lens.size[0])
    points = lens.unproject(x + 0.5, y + 0.5, nearness.reshape(-1)[pixels])
    dx, dy = ((at - planes.origin[faces, axis]).astype(np.float32) for axis, at in enumerate((x, y)))
    corners = triangles.normals.astype(np.float32)
    normals = corners[:, 0][faces]
    for side in (0, 1):
        at, along_x, along_y = planes.weights[faces, side].T
        normals += (at + along_x * dx + along_y * dy)[:, None] * (corners[:, side + 1] - corners[:, 0])[faces]
    # Normals are turned to the camera, because thin surfaces are seen from both sides.
    towards = lens.axes[2] if lens.distance is None else lens.target + lens.distance * lens.axes[2] - points
    length = np.maximum(np.sqrt(np.einsum("ni,ni->n", normals, normals)), 1e-12)
    length = np.where(np.sum(normals * towards, axis=1) < 0, -length, length)
    normals /= length[:, None].astype(np.float32)
    return RasterLayer(nearness, pixels, points, normals, triangles.colors.astype(np.float32)[faces])


@dataclass(frozen=True, eq=False)
class _Planes:
    """Triangles in the picture, as affine functions of the pixel: value, and its change per pixel right and down."""

    origin: NDArray[np.int64]
    """[F, 2] first pixel (column, row) whose centre lies in the bounding box; the functions count from it."""
    extent: NDArray[np.int64]
    """[F, 2] pixels across and down."""
    weights: NDArray[np.float32]
    """[F, 2, 3] barycentric coordinates of the second and third corner."""
    nearness: NDArray[np.float64]
    """[F, 3]."""


def _planes(flat: NDArray[np.float64]) -> _Planes:
    """Prepare triangles [F, 3, 3] of picture x, y (pixels) and nearness."""
    # A pixel belongs to a triangle when its centre, half a pixel from its corner, does.
    first = np.ceil(flat[..., :2].min(axis=1) - 0.5).astype(int)
    last = np.floor(flat[..., :2].max(axis=1) - 0.5).astype(int)
    (ax, bx, cx), (ay, by, cy) = ((flat[..., axis] - first[:, None, axis] - 0.5).T for axis in (0, 1))
    # Twice the signed area; a triangle seen edge-on covers no pixel, which the NaN marks.
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    area = np.where(np.abs(area) > 1e-12, area, np.nan)
    # Barycentric coordinates are linear in the pixel: value and two slopes hold for the whole triangle.
    second = np.stack([ay * (cx - ax) - ax * (cy - ay), cy - ay, ax - cx], axis=-1) / area[:, None]
    third = np.stack([ax * (by - ay) - ay * (bx - ax), ay - by, bx - ax], axis=-1) / area[:, None]
    near = flat[..., 2]
    nearness = second * (near[:, 1] - near[:, 0])[:, None] + third * (near[:, 2] - near[:, 0])[:, None]
    nearness[:, 0] += near[:, 0]
    extent = np.where(np.isnan(area)[:, None], 0, last - first + 1)
    return _Planes(first, extent, np.stack([second, third], axis=1).astype(np.float32), nearness)


def visible(planes: _Planes, size: tuple[int, int]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return per pixel the largest nearness [H, W] and the triangle it belongs to [H, W] (−1 for none)."""
    width, height = size
    nearness, owner = np.full(width * height, -np.inf), np.full(width * height, -1)
    shown = np.flatnonzero((planes.extent > 0).all(axis=1))
    # Bounding boxes rounded up to powers of two; long and upright triangles waste few pixels that way.
    classes = np.ceil(np.log2(planes.extent[shown])).astype(int)
    for across, down in np.unique(classes, axis=0).tolist():
        group = shown[(classes == (across, down)).all(axis=1)]
        each = max(1, CHUNK >> (across + down))
        for start in range(0, len(group), each):
            _fill(group[start : start + each], planes, (1 << across, 1 << down), size, nearness, owner)
    return nearness.reshape(height, width), owner.reshape(height, width)


def _fill(
    group: NDArray[np.int64],
    planes: _Planes,
    box: tuple[int, int],
    size: tuple[int, int],
    nearness: NDArray[np.float64],
    owner: NDArray[np.int64],
) -> None:
    """Enter triangles whose bounding boxes measure about ``box`` pixels into the flat buffers."""
    dx, dy = np.arange(box[0], dtype=np.float32), np.arange(box[1], dtype=np.float32)[:, None]

    def weight(corner: int) -> NDArray[np.float32]:
        at, along_x, along_y = planes.weights[group, corner].T[:, :, None, None]
        return at + along_x * dx + along_y * dy

    second, third = weight(0), weight(1)
    # The tolerance closes the gap between neighbours whose common edge was rounded differently.
    inside = (second >= -1e-4) & (third >= -1e-4)
    second += third
    inside &= second <= 1 + 1e-4
    item, row, column = np.nonzero(inside)
    face = group[item]
    x, y = planes.origin[face, 0] + column, planes.origin[face, 1] + row
    kept = (x >= 0) & (x < size[0]) & (y >= 0) & (y < size[1])
    face, row, column, pixel = face[kept], row[kept], column[kept], (y * size[0] + x)[kept]
    at, along_x, along_y = planes.nearness[face].T
    near = at + along_x * column + along_y * row
    # Several triangles of a group may cover one pixel: first the largest nearness, then the triangle that has it.
    np.maximum.at(nearness, pixel, near)
    winner = near == nearness[pixel]
    owner[pixel[winner]] = face[winner]


def _quarter(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Split [F, 3, 3] corner values at the middles of the edges into [4 F, 3, 3]."""
    a, b, c = np.moveaxis(values, 1, 0)
    ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
    return np.concatenate([np.stack(item, axis=1) for item in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
