"""Distances between surfaces and between solids, by sampling. Lengths in the units of the meshes (metres).

Letters: n sample, F face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.reading.ranges import check_number
from brainbench.geometry.mesh import Mesh

SAMPLES = 4000
"""Points that are looked at in each direction."""
_NEIGHBOURS = 24
_SPOTS = 20_000
_BLOCK = 4_000_000


@dataclass(frozen=True)
class Deviation:
    """Largest distances over samples between a solid and its approximation."""

    outward: float
    """Largest distance of a point of the approximation from the solid: matter that was added [m]."""
    inward: float
    """Largest distance of a point of the solid's surface from the approximation: matter that was lost [m]."""
    samples: int
    """Points looked at in each direction; a spike between them is missed."""

    @property
    def largest(self) -> float:
        """The two-sided (Hausdorff) distance [m]."""
        return max(self.outward, self.inward)


def deviation(solid: Mesh, pieces: Sequence[Mesh], *, samples: int = SAMPLES, inside: Mesh | None = None) -> Deviation:
    """Measure how far the union of convex ``pieces`` departs from the solid inside a mesh.

    Sampled Hausdorff distance between the two as filled bodies, so faces that pieces share inside the
    solid do not count, and a hollow that they fill counts by its depth. Points lie on the surfaces and,
    for the pieces, on chords through their inside as well.

    Args:
        solid, pieces: the mesh, inside where its winding number exceeds one half; convex meshes.
        samples: points in each direction, on top of the vertices of the pieces; equal calls give equal numbers.
        inside: a coarser mesh of the same solid that decides what is inside, to save time.
    """
    check_number("The number of samples", samples, least=1, whole=True)
    check_number("The number of pieces", len(pieces), least=1, whole=True)
    rng = np.random.default_rng(0)
    areas = np.array([piece.to_trimesh().area for piece in pieces])
    shares = np.maximum(8, np.ceil(samples * areas / areas.sum())).astype(int)
    points = []
    for piece, share in zip(pieces, shares, strict=True):
        surface = sample_surface(piece, share, rng)[0]
        some = surface[: max(4, share // 4)]
        # A chord between two points of a convex piece lies inside it, so it finds a hollow that the piece fills.
        chords = some - rng.random((len(some), 1)) * (some - rng.permutation(surface)[: len(some)])
        points += [surface, chords, piece.vertices]
    outward = _farthest_outside(solid, inside or solid, np.concatenate(points), rng)
    return Deviation(outward, _farthest_from(pieces, sample_surface(solid, samples, rng)[0]), samples)


def hausdorff(first: Mesh, second: Mesh) -> float:
    """Return the sampled two-sided distance [m] between two surfaces (not the bodies inside them)."""
    rng = np.random.default_rng(0)
    there = _Surface(second, rng).distance(sample_surface(first, SAMPLES, rng)[0])
    back = _Surface(first, rng).distance(sample_surface(second, SAMPLES, rng)[0])
    return float(max(there.max(), back.max()))


def winding_number(mesh: Mesh, points: ArrayLike) -> NDArray[np.float64]:
    """Return how often the surface wraps around each point [n, 3]: 1 inside an outward closed surface, 0 outside.

    The sum of signed solid angles (van Oosterom & Strackee 1983) over 4π; of an open surface it is a
    fraction, so "above one half" is the best guess at inside (Jacobson et al. 2013).
    """
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    triangles = mesh.vertices[mesh.faces]
    total = np.zeros(len(points))
    block = max(1, _BLOCK // len(triangles) // 9)
    for start in range(0, len(points), block):
        # tan(Ω/2) = a·(b × c) / (|a||b||c| + (a·b)|c| + (b·c)|a| + (c·a)|b|), van Oosterom & Strackee 1983; arctan2
        # gives Ω/2 with its sign, so the sum over 2π is that of Ω over 4π. Blocks of points bound the memory.
        a, b, c = np.moveaxis(triangles[None] - points[start : start + block, None, None], 2, 0)
        la, lb, lc = (np.linalg.norm(v, axis=-1) for v in (a, b, c))
        ab, bc, ca = (np.einsum("nfi,nfi->nf", u, v) for u, v in ((a, b), (b, c), (c, a)))
        volume = np.einsum("nfi,nfi->nf", a, np.cross(b, c))
        total[start : start + block] = np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1)
    return total / (2 * np.pi)


class _Surface:
    """Distances to a surface: near samples choose candidate triangles, whose distance is exact."""

    def __init__(self, mesh: Mesh, rng: np.random.Generator) -> None:
        from scipy.spatial import KDTree

        self._triangles = mesh.vertices[mesh.faces]
        points, owner = sample_surface(mesh, _SPOTS, rng)
        # Centres as well, so that no small triangle is out of every list.
        self._tree = KDTree(np.concatenate([points, self._triangles.mean(axis=1)]))
        self._owner = np.concatenate([owner, np.arange(len(mesh.faces))])

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the distances [n] of points [n, 3]."""
        candidates = self._owner[self._tree.query(points, k=min(_NEIGHBOURS, self._tree.n))[1]]
        best = np.full(len(points), np.inf)
        for column in candidates.T:
            best = np.minimum(best, point_triangle_distance(points, self._triangles[column]))
        return best


def point_triangle_distance(points: NDArray[np.float64], triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances [n] of points [n, 3] from one triangle each [n, 3, 3]."""
    # trimesh's closest_point (5.2.0) compares with tolerances in metres, and is wrong for triangles of a millimetre.
    edges = np.roll(triangles, -1, axis=1) - triangles
    there = points[:, None] - triangles
    square = np.einsum("nei,nei->ne", edges, edges)
    # The nearest point of an edge of no length is its end.
    share = np.einsum("nei,nei->ne", there, edges) / np.where(square > 0, square, 1.0)
    border = np.linalg.norm(there - share.clip(0, 1)[..., None] * edges, axis=2).min(axis=1)
    normal = np.cross(edges[:, 0], edges[:, 1])
    length = np.linalg.norm(normal, axis=1)
    # The foot of the perpendicular lies inside where it lies on the inner side of all edges, (e × (p − a)) · n ≥ 0. The
    # normal of a triangle without an area is rounding; such a triangle is its edges.
    inner = np.einsum("nei,ni->ne", np.cross(edges, there), normal) >= 0
    over = inner.all(axis=1) & (length > 1e-12 * square.max(axis=1))
    height = np.abs(np.einsum("ni,ni->n", there[:, 0], normal)) / np.where(over, length, 1.0)
    return np.where(over, height, border)


def _farthest_outside(solid: Mesh, inside: Mesh, points: NDArray, rng: np.random.Generator) -> float:
    """Return the largest distance from the solid of those points that lie outside it, as ``inside`` tells."""
    distance = _Surface(solid, rng).distance(points)
    order = np.argsort(-distance)
    # Most far points of a good approximation lie inside, so look at few at a time until one does not.
    for start in range(0, len(order), 256):
        chosen = order[start : start + 256]
        outside = winding_number(inside, points[chosen]) < 0.5
        if outside.any():
            return float(distance[chosen[outside]].max())
    return 0.0


def _farthest_from(pieces: Sequence[Mesh], points: NDArray) -> float:
    """Return the largest distance of points [n, 3] from the union of convex pieces; 0 when all lie inside."""
    # The height over the highest face plane bounds the distance from below, and is it above that face.
    bounds = np.empty((len(points), len(pieces)))
    for index, piece in enumerate(pieces):
        a, b, c = np.moveaxis(piece.vertices[piece.faces], 1, 0)
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal, axis=1)
        # A face without an area has no plane.
        good = length > 1e-12 * piece.diagonal**2
        normal = normal[good] / length[good, None]
        bounds[:, index] = (points @ normal.T - np.einsum("fi,fi->f", a[good], normal)).max(axis=1)
    size = max(piece.diagonal for piece in pieces)
    left = bounds.min(axis=1) > 1e-7 * size
    if not left.any():
        return 0.0
    points, bounds = points[left], bounds[left]
    best = np.full(len(points), np.inf)
    # Exact distances for the four pieces with the smallest lower bounds alone, among which the nearest is expected.
    for index in np.argsort(bounds, axis=1)[:, : min(4, len(pieces))].T:
        for chosen in np.unique(index):
            mine = np.flatnonzero(index == chosen)
            triangles = pieces[chosen].vertices[pieces[chosen].faces]
            pairs = np.repeat(points[mine], len(triangles), axis=0), np.tile(triangles, (len(mine), 1, 1))
            near = point_triangle_distance(*pairs).reshape(len(mine), -1).min(axis=1)
            best[mine] = np.minimum(best[mine], near)
    return float(best.max())


def sample_surface(mesh: Mesh, count: int, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return points [count, 3] spread evenly by area over a surface, and the faces [count] they lie on."""
    # Faces are drawn by area; (1 − √u, √u (1 − v), √u v) is then uniform on a triangle.
    ends = np.cumsum(mesh.to_trimesh().area_faces)
    face = np.minimum(np.searchsorted(ends, rng.random(count) * ends[-1]), len(ends) - 1)
    u, v = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[face]], 1, 0)
    return (1 - u) * a + u * (1 - v) * b + u * v * c, face
