"""Building blocks of the shape families: bodies that know a convex decomposition of themselves.

A family draws its proportions from a :class:`ShapeSampler` and combines bodies in any unit; the result is scaled
afterwards. Booleans are exact to rounding and always closed (Manifold library).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.rotations import euler_matrix

if TYPE_CHECKING:
    from manifold3d import Manifold

WEDGES = 24  # wedges around the axis that stand for a hollow turned wall: convex pieces within 1 % of its radius


class ShapeSampler:
    """Random proportions of one shape, remembered by name."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.drawn: dict[str, float | int | str] = {}

    def __call__(self, **ranges: tuple[float, float] | range | list[str]) -> tuple[Any, ...]:
        """Draw, in this order, numbers evenly between two, whole numbers of a range, or one of some names."""
        for name, choices in ranges.items():
            if isinstance(choices, tuple):
                self.drawn[name] = float(self._rng.uniform(*choices))
            elif isinstance(choices, range):
                self.drawn[name] = int(self._rng.integers(choices.start, choices.stop))
            else:
                self.drawn[name] = choices[int(self._rng.integers(len(choices)))]
        return tuple(self.drawn[name] for name in ranges)

    def normals(self, *shape: int) -> NDArray[np.float64]:
        """Draw standard normal numbers of a shape, too many to be named."""
        return self._rng.normal(size=shape)


class Body:
    """A closed solid with, where it is known, the point sets whose convex hulls together fill it."""

    def __init__(self, solid: Manifold, parts: Sequence[NDArray[np.float64]] | None) -> None:
        self.solid = solid
        self.parts = None if parts is None else list(parts)

    def __add__(self, body: Body) -> Body:
        """Union."""
        convex = self.parts is not None and body.parts is not None
        return Body(self.solid + body.solid, [*(self.parts or ()), *(body.parts or ())] if convex else None)

    def __sub__(self, body: Body) -> Body:
        """Difference; a convex decomposition is no longer known."""
        return Body(self.solid - body.solid, None)

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Body:
        """Translate."""
        parts = None if self.parts is None else [points + np.array([x, y, z]) for points in self.parts]
        return Body(self.solid.translate((x, y, z)), parts)

    def turned(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Body:
        """Rotate by degrees about the fixed x, then y, then z axis."""
        return self._mapped(euler_matrix(np.radians((x, y, z))))

    def stretched(self, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> Body:
        """Scale by positive factors along the axes."""
        return self._mapped(np.diag([x, y, z]))

    def _mapped(self, matrix: NDArray[np.float64]) -> Body:
        parts = None if self.parts is None else [points @ matrix.T for points in self.parts]
        return Body(self.solid.transform(np.hstack([matrix, np.zeros((3, 1))])), parts)


def around(detail: int) -> int:
    """Facets around a circle for about ``detail`` triangles in all, a multiple of :data:`WEDGES`."""
    return WEDGES * max(1, round(32 * math.sqrt(detail / 2000) / WEDGES))


def convex(solid: Manifold) -> Body:
    """Return a solid that is convex as it stands."""
    return Body(solid, [points_of(solid)])


def points_of(solid: Manifold) -> NDArray[np.float64]:
    """Vertices [n, 3] of a solid."""
    return np.array(solid.to_mesh64().vert_properties[:, :3], dtype=float)


def block(x: float, y: float, z: float) -> Body:
    """Return a box about the origin with these edge lengths."""
    from manifold3d import Manifold

    return convex(Manifold.cube((x, y, z), center=True))


def rod(radius: float, height: float, facets: int, *, top: float | None = None) -> Body:
    """Return an upright cylinder or frustum about the origin."""
    from manifold3d import Manifold

    return convex(Manifold.cylinder(height, radius, radius if top is None else top, facets, center=True))


def ball(detail: int, warp: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None) -> Manifold:
    """Return a unit sphere of about ``detail`` triangles, its points moved by ``warp`` [n, 3] → [n, 3]."""
    from manifold3d import Manifold

    # A sphere of n segments is an octahedron whose faces are cut n/4 times: n²/2 triangles.
    sphere = Manifold.sphere(1.0, 4 * max(4, math.ceil(math.sqrt(detail / 8))))
    return sphere if warp is None else sphere.warp_batch(lambda points: warp(np.asarray(points)))


def lathe(outer: ArrayLike, facets: int, *, wall: float | None = None, floor: float = 0.0) -> Body:
    """Turn an outline [n, 2] of radius and height about the z axis, with a multiple of :data:`WEDGES` facets.

    Heights increase; the ends may have radius zero. With a ``wall`` thickness the body is hollow above the ``floor``,
    the height of a point of the outline, and open at the top.
    """
    from manifold3d import CrossSection, FillRule

    outline = np.asarray(outer, dtype=float)
    hollow = outline[outline[:, 1] >= floor] if wall is not None else outline[:0]
    inner = hollow - np.array([wall or 0.0, 0.0])
    polygon = [(0.0, outline[0, 1]), *map(tuple, outline)]
    polygon += [*map(tuple, inner[::-1]), (0.0, floor)] if len(inner) else [(0.0, outline[-1, 1])]
    solid = CrossSection([np.array(polygon)], FillRule.Positive).revolve(facets)
    angles = 2 * np.pi * np.arange(facets) / facets
    circle = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(facets)])
    rings = [point[0] * circle + [0, 0, point[1]] for point in outline]
    full = len(outline) - len(hollow) + (1 if len(hollow) else 0)
    parts = [np.concatenate(pair) for pair in pairwise(rings[:full])]
    span = facets // WEDGES
    for low, high in pairwise(range(len(hollow))):
        corners = np.array([hollow[low], hollow[high], inner[high], inner[low]])
        for first in range(0, facets, span):
            sector = circle[(first + np.arange(span + 1)) % facets]
            # Of the inner side only the ends count; between them the wedge is filled to the chord.
            sides = (sector, sector, sector[[0, -1]], sector[[0, -1]])
            parts.append(np.concatenate([r * s + [0, 0, z] for s, (r, z) in zip(sides, corners, strict=True)]))
    return Body(solid, parts)


def tube(path: ArrayLike, radius: ArrayLike, sides: int, *, closed: bool) -> Body:
    """Sweep a circle of ``sides`` corners and of one radius, or one per point, along a path [n, 3], without twist.

    On a closed path the last point is followed by the first.
    """
    from manifold3d import Manifold, Mesh64

    line = np.asarray(path, dtype=float)
    count = len(line)
    tangent = np.roll(line, -1, 0) - np.roll(line, 1, 0) if closed else np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    normal = transported_normals(tangent, closed=closed)
    side = np.cross(tangent, normal)
    angle = 2 * np.pi * np.arange(sides) / sides
    radii = np.broadcast_to(np.asarray(radius, dtype=float), count)[:, None, None]
    cosine, sine = np.cos(angle)[None, :, None], np.sin(angle)[None, :, None]
    rings = line[:, None] + radii * (cosine * normal[:, None] + sine * side[:, None])
    here = np.arange(count if closed else count - 1)
    ahead = (here + 1) % count
    k = np.arange(sides)
    a, b = here[:, None] * sides + k, here[:, None] * sides + (k + 1) % sides
    c, d = ahead[:, None] * sides + k, ahead[:, None] * sides + (k + 1) % sides
    faces = [np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)]
    points = rings.reshape(-1, 3)
    if not closed:
        fan = np.arange(1, sides - 1)
        zero = np.zeros_like(fan)
        last = (count - 1) * sides
        faces += [np.stack([zero, fan + 1, fan], -1), np.stack([zero, fan, fan + 1], -1) + last]
    solid = Manifold(Mesh64(points, np.concatenate(faces).astype(np.uint64)))
    return Body(solid, [np.concatenate([rings[i], rings[j]]) for i, j in zip(here, ahead, strict=True)])


def prism(outline: ArrayLike, height: float, *, top: float = 1.0, twist: float = 0.0, slices: int = 0) -> Body:
    """Extrude a simple polygon [n, 2] (counter-clockwise) upwards from z = −height/2.

    The upper end has ``top`` times the size of the lower and is turned by ``twist`` [degrees]; that needs ``slices``
    between the ends, and the convex parts are then true within a slice's turn.
    """
    from manifold3d import CrossSection, triangulate

    polygon = np.asarray(outline, dtype=float)
    solid = CrossSection([polygon]).extrude(height, slices, twist, (top, top)).translate((0, 0, -height / 2))
    share = np.linspace(0.0, 1.0, slices + 2)
    levels = []
    for s in share:
        angle, scale = math.radians(twist * s), 1 + (top - 1) * s
        turn = scale * np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
        flat = polygon @ turn.T
        levels.append(np.column_stack([flat, np.full(len(flat), (s - 0.5) * height)]))
    cells = convex_cells(polygon, np.asarray(triangulate([polygon]), dtype=np.int64).reshape(-1, 3))
    pairs = list(pairwise(levels))
    return Body(solid, [np.concatenate([low[cell], high[cell]]) for low, high in pairs for cell in cells])


def convex_cells(points: NDArray[np.float64], triangles: NDArray[np.int64]) -> list[list[int]]:
    """Join triangles [t, 3] of a polygon's points [n, 2] into convex cells (Hertel & Mehlhorn 1983)."""
    cells = [list(map(int, triangle)) for triangle in triangles]
    merged = True
    while merged:
        merged = False
        sides = {(cell[i - 1], cell[i]): n for n, cell in enumerate(cells) for i in range(len(cell))}
        for (start, end), n in sides.items():
            facing = sides.get((end, start))
            if facing is None or facing == n:
                continue
            first, second = cells[n], cells[facing]
            i, j = first.index(end), second.index(start)
            joined = [*first[i:], *first[:i], *second[j + 1 :], *second[:j]][: len(first) + len(second) - 2]
            if _is_convex(points[joined]):
                cells[n] = joined
                cells.pop(facing)
                merged = True
                break
    return cells


def _is_convex(corners: NDArray[np.float64]) -> bool:
    edge = np.roll(corners, -1, 0) - corners
    ahead = np.roll(edge, -1, 0)
    # Every corner of a counter-clockwise polygon turns left, or goes straight on.
    return bool((edge[:, 0] * ahead[:, 1] - edge[:, 1] * ahead[:, 0] >= -1e-12).all())


def transported_normals(tangent: NDArray[np.float64], *, closed: bool = False) -> NDArray[np.float64]:
    """Return unit normals [n, 3] of a path with unit tangents [n, 3] that turn about it as little as possible.

    On a closed path the angle by which the last would miss the first is spread evenly.
    """
    # The axis that is least along the tangent keeps the product away from zero.
    start = np.cross(tangent[0], np.eye(3)[np.argmin(np.abs(tangent[0]))])
    normals = [start / np.linalg.norm(start)]
    for here in [*tangent[1:], *([tangent[0]] if closed else [])]:
        # The part of the last normal across the new tangent: the smallest turn from one to the other.
        step = normals[-1] - (normals[-1] @ here) * here
        normals.append(step / np.linalg.norm(step))
    result = np.array(normals[: len(tangent)])
    if not closed:
        return result
    # Angle between the transported and the first normal, seen along the tangent.
    across = np.cross(tangent[0], result[0])
    slip = math.atan2(float(normals[-1] @ across), float(normals[-1] @ result[0]))
    turn = (-slip * np.arange(len(tangent)) / len(tangent))[:, None]
    return np.cos(turn) * result + np.sin(turn) * np.cross(tangent, result)
