"""Cameras: from points in the world to points in a picture. Metres in the world, pixels in the picture.

Picture axes: x to the right, y down, the origin at the upper left corner of the first pixel. *Nearness*
grows towards the camera and is linear across the picture of a plane: 1/distance in perspective,
minus the distance otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError, unknown_name
from brainbench.core.limits import Limit, limited
from brainbench.core.rotations import Length, Point, Vector

VIEWS: dict[str, Vector] = {
    "top": (0.0, 0.0, 1.0),
    "bottom": (0.0, 0.0, -1.0),
    "side": (1.0, 0.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "front": (0.0, 1.0, 0.0),
    "back": (0.0, -1.0, 0.0),
    "oblique": (0.42, -0.72, 0.55),
}
"""Directions from the target to the camera, in world axes (x right, y rostral, z dorsal): ``side`` looks
at the animal's right side, ``front`` into its face."""


@dataclass(frozen=True)
@limited(of="{} of a camera")
class Camera:
    """Viewpoint, projection and frame of a picture; what is unknown or out of range is a :class:`UsageError`."""

    view: str | Vector = "oblique"
    """A name of :data:`VIEWS`, or the direction from the target to the camera (world)."""
    projection: Literal["perspective", "orthographic"] = "perspective"
    """``perspective``, or ``orthographic`` for measuring."""
    target: Point | None = None
    """Point in the middle of the picture [m, world]; None frames what is shown."""
    width: Length | None = None
    """Width of the picture in the plane of the target [m]; None frames what is shown."""
    field_of_view: Annotated[float, Limit(above=0, below=math.pi, unit="rad")] = math.radians(24)
    """Horizontal opening angle of the perspective [rad]."""

    def __post_init__(self) -> None:
        if isinstance(self.view, str) and self.view not in VIEWS:
            raise unknown_name("view", self.view, VIEWS)
        if not any(self.view):
            raise UsageError("The view of a camera is a direction; (0, 0, 0) is none.")

    @property
    def axes(self) -> NDArray[np.float64]:
        """Unit vectors [3, 3] to the right, up and towards the camera, as rows (world)."""
        towards = np.asarray(VIEWS[self.view] if isinstance(self.view, str) else self.view, dtype=float)
        towards = towards / np.linalg.norm(towards)
        # Dorsal is up, except in pictures from above or below, where rostral is.
        up = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.999 else np.array([0.0, 1.0, 0.0])
        right = np.cross(up, towards)
        right = right / np.linalg.norm(right)
        return np.stack([right, np.cross(towards, right), towards])

    def lens(self, points: ArrayLike, size: tuple[int, int]) -> Lens:
        """Fit the camera to points [n, 3] (m, world) that must be in the picture where target or width are None.

        ``size`` is the width and height of the picture in pixels.
        """
        axes = self.axes
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            points = np.zeros((1, 3))
        local = points @ axes.T
        middle = axes.T @ (local.min(axis=0) + local.max(axis=0)) / 2 if self.target is None else np.array(self.target)
        local = (points - middle) @ axes.T
        margin, aspect = 1.12, size[0] / size[1]
        half = max(np.abs(local[:, 0]).max(), np.abs(local[:, 1]).max() * aspect, 1e-6)
        ratio = math.tan(self.field_of_view / 2)
        if self.projection == "perspective":
            # A point nearer than the target looks larger: its distance is short of the camera's by its depth.
            extent = np.maximum(np.abs(local[:, 0]), np.abs(local[:, 1]) * aspect)
            half = max(float((extent + ratio * local[:, 2]).max()), 1e-6)
        width = 2 * margin * half if self.width is None else self.width
        distance = width / 2 / ratio if self.projection == "perspective" else None
        return Lens(axes, middle, width, size, distance)


@dataclass(frozen=True, eq=False)
class Lens:
    """A camera at its place."""

    axes: NDArray[np.float64]
    """Unit vectors [3, 3] to the right, up and towards the camera, as rows (world)."""
    target: NDArray[np.float64]
    """[3] point (m, world) in the middle of the picture."""
    width: float
    """Width of the picture in the plane of the target [m]."""
    size: tuple[int, int]
    """Width and height in pixels."""
    distance: float | None
    """From the camera to the target [m]; None for an orthographic camera."""

    @property
    def scale(self) -> float:
        """Pixels per metre in the plane of the target."""
        return self.size[0] / self.width

    def project(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return picture x, picture y (pixels) and nearness [..., 3] of points [..., 3] (m, world).

        What lies behind a perspective camera has no picture: NaN.
        """
        local = (points - self.target) @ self.axes.T
        x, y, depth = np.moveaxis(local, -1, 0)
        if self.distance is None:
            factor, nearness = np.full_like(x, self.scale), depth
        else:
            away = self.distance - depth
            # Within a fiftieth of the distance the picture would grow without bound: that counts as behind.
            nearness = np.divide(1.0, away, out=np.full_like(away, np.nan), where=away > 0.02 * self.distance)
            factor = self.scale * self.distance * nearness
        return np.stack([self.size[0] / 2 + factor * x, self.size[1] / 2 - factor * y, nearness], axis=-1)

    def unproject(self, x: ArrayLike, y: ArrayLike, nearness: ArrayLike) -> NDArray[np.float64]:
        """Return the points [n, 3] (m, world) whose picture is at x, y (pixels) with this nearness [n]."""
        x, y, nearness = (np.asarray(values, dtype=float) for values in (x, y, nearness))
        if self.distance is None:
            depth, factor = nearness, 1 / self.scale
        else:
            depth, factor = self.distance - 1 / nearness, 1 / (self.scale * self.distance * nearness)
        local = np.stack([(x - self.size[0] / 2) * factor, (self.size[1] / 2 - y) * factor, depth], axis=-1)
        return self.target + local @ self.axes

    def nearness_of(self, length: float, nearness: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return by how much nearness [n] grows over a short ``length`` (m) towards the camera."""
        # d(1/r) = −dr/r², and nearness is 1/r in perspective.
        return np.full(np.shape(nearness), length) if self.distance is None else length * nearness**2

    def pixel_size(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the length [...] (m) that one pixel covers at each of the points [..., 3] (m, world)."""
        depth = (points - self.target) @ self.axes[2]
        if self.distance is None:
            return np.full(depth.shape, 1 / self.scale)
        return np.maximum(self.distance - depth, 0.02 * self.distance) / (self.distance * self.scale)

    def supersampled(self, factor: int) -> Lens:
        """Return the lens for a picture with ``factor`` times as many pixels each way."""
        return replace(self, size=(self.size[0] * factor, self.size[1] * factor))
