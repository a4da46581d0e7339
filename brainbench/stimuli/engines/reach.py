"""Parts and surfaces of the obstacles that a whisker could ever touch. A scene costs only what it uses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.rotations import to_matrices
from brainbench.geometry import winding_number
from brainbench.stimuli.objects.obstacle import Obstacle
from brainbench.stimuli.whiskers.chain import Chain
from brainbench.stimuli.whiskers.whisker import Whisker


@dataclass(frozen=True)
class Reach:
    """Obstacles within reach of one whisker."""

    obstacles: tuple[Obstacle, ...]
    """The obstacles with only what is touched of them: their reachable parts, or their surface."""
    nearest: float
    """Least distance of anything touched from the base (m); points at a smaller arc length cannot touch."""
    indices: tuple[int, ...] = ()
    """Numbers of these among all obstacles."""

    def __bool__(self) -> bool:
        """Return True when anything is within reach."""
        return bool(self.obstacles)

    @property
    def parts(self) -> int:
        """Number of convex parts within reach."""
        return sum(len(obstacle.parts) for obstacle in self.obstacles)

    @property
    def triangles(self) -> int:
        """Number of triangles of the surfaces within reach."""
        return sum(len(obstacle.surface.faces) for obstacle in self.obstacles if obstacle.surface is not None)

    def links(self, chain: Chain) -> int:
        """Return how many links of the chain come near enough to touch; links closer to the base never do."""
        return int(np.count_nonzero(chain.nodes[1:] + chain.radii >= self.nearest)) if self else 0


def reachable(
    whisker: Whisker,
    base: NDArray[np.float64],
    obstacles: tuple[Obstacle, ...],
    times: NDArray[np.float64],
    *,
    surfaces: bool = False,
) -> Reach:
    """Find what the whisker can reach from its base at [n, 3] (m, world) at the step times [n] (s).

    Conservative: an inextensible whisker never leaves the ball of its arc length around its base, so a
    part whose bounding box stays outside that ball at every time cannot be touched, however it bends.
    What base and obstacle travel against one another between two times is added to the ball. A surface around the base
    is kept however far it is: a whisker that starts deep inside it must be flagged.

    With ``surfaces`` the surface of every obstacle that has one is taken, as by engines that collide meshes; otherwise
    its parts, and the surface only where there are none.
    """
    limit = whisker.arc_length + max(whisker.base_radius, whisker.tip_radius)
    still = np.array([obstacle.motion is None for obstacle in obstacles], dtype=bool)
    bounds = np.array([obstacle.bounds for obstacle, stands in zip(obstacles, still, strict=True) if stands])
    apart = np.zeros(len(obstacles))
    apart[still] = _box_distances(bounds.reshape(-1, 2, 3), base)
    touchable, indices, nearest = [], [], math.inf
    for index in np.flatnonzero(apart <= limit).tolist():
        obstacle, distances = touched(obstacles[index], surfaces=surfaces), apart[index : index + 1]
        boxes = obstacle.bounds[None]
        if obstacle.surface is not None:
            boxes = obstacle.surface.boxes
        elif len(obstacle.parts) > 1:
            boxes = np.stack([part.bounds() for part in obstacle.parts])
        # The bounds of what stands still have been looked at.
        points = to_obstacle_frame(obstacle, base, times)
        if len(boxes) > 1 or not still[index]:
            distances = _box_distances(boxes, points)
        if distances.min() > limit and not _encloses(obstacle, points[0]):
            continue
        if obstacle.surface is None and distances.max() > limit:
            near = (part for part, distance in zip(obstacle.parts, distances, strict=True) if distance <= limit)
            obstacle = replace(obstacle, parts=tuple(near))
        touchable.append(obstacle)
        indices.append(index)
        nearest = min(nearest, float(distances.min()))
    return Reach(tuple(touchable), nearest, tuple(indices))


def _box_distances(boxes: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how near each box [b, 2, 3] comes at least to a way along points [n, 3]; zero inside."""
    if np.ptp(points, axis=0).max() == 0:
        points = points[:1]
    # Between two points the way is no further from one of them than half their distance.
    between = float(np.linalg.norm(np.diff(points, axis=0), axis=1).max(initial=0.0)) / 2
    nearest = np.empty(len(boxes))
    some = max(1, 100_000 // len(points))
    for first in range(0, len(boxes), some):
        low, high = boxes[first : first + some, 0, None], boxes[first : first + some, 1, None]
        outside = np.maximum(np.maximum(low - points, points - high), 0.0)
        nearest[first : first + some] = np.sqrt(np.einsum("bnd,bnd->bn", outside, outside)).min(axis=1)
    return np.maximum(nearest - between, 0.0)


def _encloses(obstacle: Obstacle, point: NDArray[np.float64]) -> bool:
    """Return whether a point [3] in the frame of the obstacle lies inside its surface."""
    surface = obstacle.surface
    if surface is None or ((point < obstacle.bounds[0]) | (point > obstacle.bounds[1])).any():
        return False
    return bool(winding_number(surface, point)[0] > 0.5)


def touched(obstacle: Obstacle, *, surfaces: bool) -> Obstacle:
    """Return the obstacle with only what an engine touches of it, its parts or its surface; see :func:`reachable`."""
    if obstacle.surface is None:
        return obstacle
    return replace(obstacle, parts=()) if surfaces or not obstacle.parts else replace(obstacle, surface=None)


def distances(obstacle: Obstacle, bounds: NDArray, points: NDArray, times: NDArray) -> NDArray[np.float64]:
    """Distances [n] (m) of points [n, 3] (world) at ``times`` [n] from a box [2, 3] that the obstacle carries."""
    local = to_obstacle_frame(obstacle, points, times)
    outside = np.maximum(np.maximum(bounds[0] - local, local - bounds[1]), 0.0)
    return np.broadcast_to(np.linalg.norm(outside, axis=1), len(times))


def to_obstacle_frame(obstacle: Obstacle, points: NDArray, times: NDArray) -> NDArray[np.float64]:
    """Return points [n, 3] (world) as the obstacle sees them at ``times`` [n] (s)."""
    if obstacle.motion is None:
        return points
    position, quaternion = obstacle.motion(times)
    # The transposed rotation: from world axes into those of the obstacle.
    return np.einsum("nji,nj->ni", to_matrices(quaternion), points - position)
