"""Rigid bodies that whiskers may touch: convex parts or closed meshes. Lengths in metres, quaternions (w, x, y, z)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import UsageError
from brainbench.core.limits import NotNegative, limited
from brainbench.core.rotations import Length, Point, from_matrices, to_matrices
from brainbench.geometry import Mesh

RigidMotion = Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Times [n] (s) → positions [n, 3] (m, world) and unit quaternions [n, 4] (w, x, y, z), body to world."""


@dataclass(frozen=True, eq=False)
class ConvexPart:
    """The convex hull of some points that do not lie in one plane."""

    vertices: NDArray[np.float64]
    """[m, 3] (m), at least four."""

    def __post_init__(self) -> None:
        points = np.array(self.vertices, dtype=float)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 4 or not np.isfinite(points).all():
            raise UsageError(
                f"A convex part needs at least four finite vertices [m, 3]; received shape {points.shape}."
            )
        # Singular values of centred points are their extents along the principal axes; the last is the thickness.
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
        if spread[2] < 1e-6 * spread[0]:
            raise UsageError("The vertices of a convex part lie in one plane; a part needs volume to be touched.")
        points.setflags(write=False)
        object.__setattr__(self, "vertices", points)

    def bounds(self) -> NDArray[np.float64]:
        """Return axis-aligned bounds [2, 3]: lowest and highest corner."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def moved(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Self:
        """Return the body rotated by a matrix [3, 3] about the origin, then translated by [3] (m)."""
        return replace(self, vertices=self.vertices @ rotation.T + translation)

    def scaled(self, factor: float) -> Self:
        """Return the body scaled about the origin."""
        return replace(self, vertices=self.vertices * factor)


@dataclass(frozen=True)
class _Primitive:
    """Base of the bodies that some points and lengths describe."""

    _points: ClassVar[tuple[str, ...]]  # names of the fields that move with the body
    _sizes: ClassVar[tuple[str, ...]] = ("radius",)  # names of the fields that only grow with it

    def moved(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Self:
        """Return the body rotated by a matrix [3, 3] about the origin, then translated by [3] (m)."""
        points = {name: rotation @ np.asarray(getattr(self, name)) + translation for name in self._points}
        return replace(self, **{name: tuple(point.tolist()) for name, point in points.items()})

    def scaled(self, factor: float) -> Self:
        """Return the body scaled about the origin."""
        values = {name: getattr(self, name) for name in (*self._points, *self._sizes)}
        grown = {name: np.multiply(value, factor).tolist() for name, value in values.items()}
        return replace(self, **{name: tuple(v) if isinstance(v, list) else v for name, v in grown.items()})


@limited(of="{} of a sphere")
class Sphere(_Primitive):
    """A ball."""

    centre: Point
    radius: Length

    _points = ("centre",)

    def bounds(self) -> NDArray[np.float64]:
        """Return axis-aligned bounds [2, 3]: lowest and highest corner."""
        return np.add(self.centre, [[-self.radius] * 3, [self.radius] * 3])


@dataclass(frozen=True)
class _Segment(_Primitive):
    """Base of capsules and cylinders: a radius around the segment from ``start`` to ``end``."""

    start: Point
    end: Point
    radius: Length

    _points = ("start", "end")

    def _reach(self) -> NDArray[np.float64] | float:
        """Return how far the body reaches beyond its segment along the axes [3] (m)."""
        return self.radius

    def bounds(self) -> NDArray[np.float64]:
        """Return axis-aligned bounds [2, 3]: lowest and highest corner."""
        ends, reach = np.array([self.start, self.end]), self._reach()
        return np.stack([ends.min(axis=0) - reach, ends.max(axis=0) + reach])

    def __post_init__(self) -> None:
        if tuple(self.start) == tuple(self.end):
            name = type(self).__name__.lower()
            raise UsageError(f"start and end of a {name} are the same point {tuple(self.start)}; use a Sphere.")


@limited(of="{} of a capsule")
class Capsule(_Segment):
    """All points within ``radius`` of the segment from ``start`` to ``end``."""


@limited(of="{} of a cylinder")
class Cylinder(_Segment):
    """A flat-ended cylinder around the segment from ``start`` to ``end``."""

    def _reach(self) -> NDArray[np.float64]:
        axis = np.subtract(self.end, self.start) / np.linalg.norm(np.subtract(self.end, self.start))
        # A disc with unit normal n reaches r √(1 − nᵢ²) along axis i.
        return self.radius * np.sqrt(np.clip(1 - axis**2, 0, 1))


@limited(of="{} of a box")
class Box(_Primitive):
    """A box of half edge lengths ``half_sizes`` turned by ``quaternion`` about its centre."""

    centre: Point
    half_sizes: tuple[Length, Length, Length]
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    _points = ("centre",)
    _sizes = ("half_sizes",)

    def __post_init__(self) -> None:
        length = math.hypot(*self.quaternion)
        if not math.isclose(length, 1, abs_tol=1e-6):
            raise UsageError(f"The quaternion of a box must have length 1; {self.quaternion} has length {length:g}.")

    def bounds(self) -> NDArray[np.float64]:
        """Return axis-aligned bounds [2, 3]: lowest and highest corner."""
        # The farthest corner along each axis: absolute rotation matrix times the half edge lengths.
        reach = np.abs(to_matrices(self.quaternion)) @ np.array(self.half_sizes)
        return np.stack([np.array(self.centre) - reach, np.array(self.centre) + reach])

    def moved(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Self:
        """Return the box rotated by a matrix [3, 3] about the origin, then translated by [3] (m)."""
        turned = tuple(from_matrices(rotation @ to_matrices(self.quaternion)).tolist())
        return replace(super().moved(rotation, translation), quaternion=turned)


Part = ConvexPart | Sphere | Capsule | Cylinder | Box


def bounds_of(parts: Iterable[Part], surface: Mesh | None) -> NDArray[np.float64]:
    """Return the lowest and highest corner [2, 3] (m) of a surface, or of some parts without one."""
    if surface is not None:
        return surface.bounds
    corners = np.stack([part.bounds() for part in parts])
    return np.stack([corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)])


@limited(of="{} of an obstacle")
class Obstacle:
    """A rigid body made of parts that a whisker may touch.

    Whiskers do not move it: it stands still or follows ``motion`` exactly.
    """

    parts: tuple[Part, ...]
    """Geometry in the obstacle frame [m]; the world frame when ``motion`` is None."""
    motion: RigidMotion | None = None
    """Times [n] (s) → position [n, 3] (m) and quaternion [n, 4]; None for an obstacle that stands still."""
    friction: NotNegative | None = None
    """Coulomb coefficient of the contact; None takes the whisker's own."""
    surface: Mesh | None = None
    """The exact surface of the body. Engines that collide meshes (``rod``) touch it instead of ``parts``; those that
    collide convex bodies only (``mujoco``, ``bullet``) touch ``parts`` and refuse a surface without parts."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parts", tuple(self.parts))
        if not self.parts and self.surface is None:
            raise UsageError("An obstacle needs at least one part or a surface.")
        if self.surface is not None and min(len(self.surface.vertices), len(self.surface.faces)) < 4:
            shapes = f"{self.surface.vertices.shape} and {self.surface.faces.shape}"
            raise UsageError(f"A closed surface has at least four vertices and four faces; received shapes {shapes}.")

    def friction_beside(self, whisker: float) -> float:
        """Return the Coulomb coefficient of a contact with a whisker whose own is given."""
        return whisker if self.friction is None else self.friction

    def moved(self, rotation: NDArray[np.float64], translation: NDArray[np.float64]) -> Obstacle:
        """Return the body with its geometry rotated by a matrix [3, 3] about the origin, then translated by [3] (m)."""
        surface = self.surface and self.surface.transformed(rotation, translation)
        return replace(self, parts=tuple(part.moved(rotation, translation) for part in self.parts), surface=surface)

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner [2, 3] (m) of what is touched, in the frame of the obstacle."""
        return bounds_of(self.parts, self.surface)
