"""Places of the probes of a sensor: planar grids, explicit lists, patches of a mesh. Metres, link frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, brief, check_number, check_numbers
from brainbench.geometry import Mesh

WIDEST = 10.0  # largest extent of the probes of a sensor along an axis, and largest radius [m]


@dataclass(frozen=True, eq=False)
class Probes:
    """Positions, outward normals and sensing radii of probes. A radius of 0 marks a filler that always reads 0."""

    position: NDArray[np.float64]
    """[N, 3] (m)."""
    normal: NDArray[np.float64]
    """[N, 3], out of the sensing surface; made unit length."""
    radius: NDArray[np.float64]
    """[N] (m); one number serves all."""
    shape: tuple[int, ...] = ()
    """(N,) or (rows, columns) in the order of the probes; empty means (N,)."""
    pitch: tuple[float, float] | None = None
    """Distance of neighbouring rows and columns of a regular planar grid (m); None for any other placement."""

    def __post_init__(self) -> None:
        position, normal = (_vectors(name, getattr(self, name)) for name in ("position", "normal"))
        count = len(position)
        try:
            radius = np.array(np.broadcast_to(np.asarray(self.radius, dtype=float), (count,)))
        except ValueError:
            raise UsageError(f"{count} probes need one radius or {count}; received {np.shape(self.radius)}.") from None
        shape = tuple(np.atleast_1d(np.asarray(self.shape, dtype=object))) or (count,)
        if not count:
            raise UsageError("A sensor needs at least one probe; received none.")
        for side in shape:
            check_number("a side of the shape", side, least=1, whole=True)
        if self.pitch is not None:
            check_numbers("pitch", self.pitch, 2, least=0)
        if len(normal) != count or math.prod(shape) != count or len(shape) > 2:
            raise UsageError(f"{count} positions do not go with {len(normal)} normals in the shape {shape}.")
        if not (np.isfinite(position).all() and np.isfinite(normal).all() and np.isfinite(radius).all()):
            raise UsageError("Positions, normals and radii of probes must be finite numbers.")
        if max(np.ptp(position, axis=0).max(), radius.max()) > WIDEST:
            raise UsageError(f"Probes extend over {WIDEST:g} m at most, and so do their radii; write metres, not mm.")
        if (radius < 0).any():
            raise UsageError(f"The radius of a probe is positive, or 0 for a filler; received {radius.min():g} m.")
        if self.pitch is not None:
            _check_pitch(position, shape, self.pitch)
        length = np.linalg.norm(normal, axis=1)
        if (length[radius > 0] < 1e-9).any():
            raise UsageError("The normal of a probe needs a length; received a zero vector.")
        normal = np.where(length[:, None] > 0, normal / np.maximum(length, 1e-12)[:, None], [0.0, 0.0, 1.0])
        for name, value in (("position", position), ("normal", normal), ("radius", radius)):
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        object.__setattr__(self, "shape", shape)

    def __len__(self) -> int:
        return len(self.position)

    @property
    def active(self) -> NDArray[np.bool_]:
        """Mask [N] of the probes that are no fillers."""
        return self.radius > 0

    @classmethod
    def grid(
        cls,
        rows: int,
        columns: int,
        *,
        size: tuple[float, float],
        center: ArrayLike = (0.0, 0.0, 0.0),
        normal: ArrayLike = (0.0, 0.0, 1.0),
        along: ArrayLike = (1.0, 0.0, 0.0),
        radius: float = 0.004,
    ) -> Probes:
        """Return a regular planar grid [rows, columns].

        Args:
            rows: number across ``along``.
            columns: number along ``along``.
            size: extent (along the rows' direction, along the columns' direction) between the outermost probes (m).
            along: direction in which the column number grows; its part along the normal is removed.
            radius: sensing radius (m).
        """
        for name, number in {"rows": rows, "columns": columns}.items():
            check_number(name, number, least=1, whole=True)
        check_numbers("center", center, 3)
        if np.shape(size) != (2,):
            raise UsageError(f"size is the extent along rows and columns (m); received {size!r}.")
        n = _direction("normal", normal)
        u = _direction("along", along)
        u = u - n * (u @ n)
        if np.linalg.norm(u) < 1e-9:
            raise UsageError(f"'along' {tuple(np.asarray(along))} is parallel to the normal; choose another direction.")
        u = u / np.linalg.norm(u)
        v = np.cross(n, u)
        y = np.linspace(-0.5, 0.5, rows) * size[0] if rows > 1 else np.zeros(1)
        x = np.linspace(-0.5, 0.5, columns) * size[1] if columns > 1 else np.zeros(1)
        position = np.asarray(center, dtype=float) + y[:, None, None] * v + x[None, :, None] * u
        count = rows * columns
        pitch = (size[0] / max(rows - 1, 1), size[1] / max(columns - 1, 1))
        return cls(position.reshape(-1, 3), np.tile(n, (count, 1)), np.full(count, radius), (rows, columns), pitch)

    @classmethod
    def on_mesh(
        cls,
        mesh: Mesh,
        count: int,
        *,
        radius: float = 0.004,
        facing: ArrayLike | None = None,
        within: float = 90.0,
        box: ArrayLike | None = None,
        seed: int = 0,
    ) -> Probes:
        """Spread probes evenly over a patch of a mesh (in the link's frame), with its normals.

        Args:
            radius: sensing radius (m).
            facing: keep triangles whose normal lies within ``within`` degrees of this direction.
            within: that angle (degrees).
            box: keep triangles whose centre lies between two corners [2, 3] (m).
        """
        for name, number, least in (("count", count, 1), ("seed", seed, 0)):
            check_number(name, number, least=least, whole=True)
        check_number("within (degrees)", within, least=0, most=180)
        corners = mesh.vertices[mesh.faces]
        area, normal = face_areas(corners)
        keep = area > 0
        if facing is not None:
            keep &= normal @ _direction("facing", facing) >= np.cos(np.radians(within))
        if box is not None:
            if np.shape(box) != (2, 3):
                raise UsageError(f"box holds two corners (x, y, z) in metres; received the shape {np.shape(box)}.")
            low, high = np.asarray(box, dtype=float)
            middle = corners.mean(axis=1)
            keep &= ((middle >= low) & (middle <= high)).all(axis=1)
        if not keep.any():
            raise UsageError("No triangle of the mesh lies in the patch; widen 'within' or 'box', or turn 'facing'.")
        points, faces = spread_over(corners[keep], area[keep], count, seed)
        return cls(points, normal[keep][faces], np.full(count, radius))

    def with_radius(self, radius: ArrayLike) -> Probes:
        """Return the same places with another radius for all or each (m); fillers stay fillers."""
        if np.shape(radius) not in ((), self.radius.shape):
            raise UsageError(f"{len(self)} probes need one radius or {len(self)}; received {np.shape(radius)}.")
        return Probes(self.position, self.normal, np.where(self.active, radius, 0.0), self.shape, self.pitch)


def _vectors(name: str, values: ArrayLike) -> NDArray[np.float64]:
    """Return vectors [N, 3] of any arrangement [..., 3]; UsageError for anything else."""
    try:
        vectors = np.array(values, dtype=float)
    except (TypeError, ValueError):
        raise UsageError(f"The {name} of probes is an array [N, 3] of numbers; received {brief(values)}.") from None
    if not vectors.ndim or (vectors.size and vectors.shape[-1] != 3):
        raise UsageError(f"The {name} of probes is an array [N, 3]; received the shape {vectors.shape}.")
    return vectors.reshape(-1, 3)


def _check_pitch(position: NDArray[np.float64], shape: tuple[int, ...], pitch: tuple[float, float]) -> None:
    """Raise UsageError unless the probes [rows, columns] form the regular planar grid that a pitch (m) promises."""
    grid = position.reshape(*shape, 3) if len(shape) == 2 else position[None]
    ways = [np.diff(grid, axis=axis).reshape(-1, 3) for axis in range(2)]
    first = np.array([way[0] if len(way) else np.zeros(3) for way in ways])
    # Rows that lean (a grid of rhombs) are no product of two axes.
    lean = abs(first[0] @ first[1]) > 1e-6 * math.prod(np.linalg.norm(first, axis=1))
    for way, start, step in zip(ways, first, pitch, strict=True):
        even = np.allclose(way, start, atol=1e-9) and math.isclose(np.linalg.norm(start), step)
        if len(way) and (lean or not even):
            raise UsageError(f"A pitch {tuple(pitch)} m promises a regular grid, which these {len(position)} probes "
                             "do not form; use Probes.grid, or leave the pitch out.")  # fmt: skip


def _direction(name: str, value: ArrayLike) -> NDArray[np.float64]:
    """Return a direction [3] of unit length; UsageError for anything else."""
    vector = np.asarray(value, dtype=float)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or not 0 < length < math.inf:
        raise UsageError(f"{name!r} is a direction (x, y, z) of some length; received {value!r}.")
    return vector / length


def enclosing_sphere(probes: Probes) -> tuple[NDArray[np.float64], float]:
    """Return centre [3] and radius (m) of a sphere around the sensing spheres of active probes."""
    position, radius = probes.position[probes.active], probes.radius[probes.active]
    if not len(position):
        return np.zeros(3), 1e-6
    # Not the smallest sphere, but near it and never too small.
    center = 0.5 * (position.min(axis=0) + position.max(axis=0))
    return center, float((np.linalg.norm(position - center, axis=1) + radius).max())


def face_areas(corners: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return areas [F] (m²) and unit normals [F, 3] of triangles [F, 3, 3]."""
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(cross, axis=1) / 2
    return area, cross / np.maximum(2 * area, 1e-30)[:, None]


def cover_evenly(corners: NDArray, area: NDArray, count: int) -> NDArray[np.float64]:
    """Return points [count, 3] on triangles [F, 3, 3] with the same density everywhere, edges included.

    Faces are taken at even steps of their summed area, places within them by the R2 sequence (Roberts 2018), so that
    sums over the points converge faster than over random ones.
    """
    # Middles of even strata of the summed area: a face gets as many points as its share of the area, to within one.
    steps = (np.arange(count) + 0.5) / count
    faces = np.minimum(np.searchsorted(np.cumsum(area) / area.sum(), steps), len(corners) - 1)
    root = 1.32471795724474602596
    u, v = (np.arange(1, count + 1)[:, None] / [root, root**2] % 1).T
    # Fold the square onto the triangle.
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    a, b, c = corners[faces].swapaxes(0, 1)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a)


def spread_over(corners: NDArray, area: NDArray, count: int, seed: int) -> tuple[NDArray, NDArray]:
    """Return ``count`` evenly spread points [count, 3] on triangles [F, 3, 3], and their triangles.

    Farthest-point selection among eight times as many area-weighted random points.
    """
    rng = np.random.default_rng(seed)
    many = 8 * count if count <= 4000 else count
    faces = rng.choice(len(corners), many, p=area / area.sum())
    # Uniform on a triangle: the square root makes up for its width, which grows in proportion to the distance from a
    # corner.
    u, v = np.sqrt(rng.random(many)), rng.random(many)
    a, b, c = corners[faces].swapaxes(0, 1)
    points = a * (1 - u)[:, None] + b * (u * (1 - v))[:, None] + c * (u * v)[:, None]
    if many == count:
        return points, faces
    chosen = farthest_points(points, count)
    return points[chosen], faces[chosen]


def farthest_points(points: NDArray, count: int, first: int = 0) -> list[int]:
    """Return the numbers of ``count`` points of [N, 3]: each next one is as far as can be from all before it."""
    chosen, distance = [first], np.linalg.norm(points - points[first], axis=1)
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return chosen
