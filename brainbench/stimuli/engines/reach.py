"""Which parts or surfaces of the obstacles a whisker could ever touch. A scene costs only what it uses."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.rotations import to_matrices
from brainbench.geometry import Mesh, winding_number
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
    kept, nearest = [], math.inf
    for obstacle in obstacles:
        points = _in_obstacle_frame(obstacle, base, times)
        # Between two times a base is no further from one of its two places than half the way between them.
        between = float(np.linalg.norm(np.diff(points, axis=0), axis=1).max(initial=0.0)) / 2
        obstacle = touched(obstacle, surfaces=surfaces)
        boxes = [part.bounds() for part in obstacle.parts] if obstacle.surface is None else obstacle.surface.boxes
        distances = [max(0.0, float(_box_distance(box, points).min()) - between) for box in boxes]
        if min(distances) > limit and not _encloses(obstacle, points[0]):
            continue
        near = tuple(part for part, distance in zip(obstacle.parts, distances, strict=False) if distance <= limit)
        kept.append(replace(obstacle, parts=near))
        nearest = min(nearest, *distances)
    return Reach(tuple(kept), nearest)


def _encloses(obstacle: Obstacle, point: NDArray[np.float64]) -> bool:
    """Return whether a point [3] in the frame of the obstacle lies inside its surface."""
    surface = obstacle.surface
    if surface is None or ((point < obstacle.bounds[0]) | (point > obstacle.bounds[1])).any():
        return False
    return bool(winding_number(Mesh(surface.vertices, surface.faces), point)[0] > 0.5)


def touched(obstacle: Obstacle, *, surfaces: bool) -> Obstacle:
    """Return the obstacle with only what an engine touches of it, its parts or its surface; see :func:`reachable`."""
    if obstacle.surface is not None and (surfaces or not obstacle.parts):
        return replace(obstacle, parts=())
    return replace(obstacle, surface=None)


def distances(obstacle: Obstacle, bounds: NDArray, points: NDArray, times: NDArray) -> NDArray[np.float64]:
    """Distances [n] (m) of points [n, 3] (world) at ``times`` [n] from a box [2, 3] that the obstacle carries."""
    return np.broadcast_to(_box_distance(bounds, _in_obstacle_frame(obstacle, points, times)), len(times))


def _in_obstacle_frame(obstacle: Obstacle, points: NDArray, times: NDArray) -> NDArray[np.float64]:
    if obstacle.motion is None:
        return points[:1] if np.ptp(points, axis=0).max() == 0 else points
    position, quaternion = obstacle.motion(times)
    # The transposed rotation: from world axes into those of the obstacle.
    return np.einsum("nji,nj->ni", to_matrices(quaternion), points - position)


def _box_distance(bounds: NDArray, points: NDArray) -> NDArray[np.float64]:
    """Distance of points [n, 3] from an axis-aligned box [2, 3]; zero inside."""
    outside = np.maximum(np.maximum(bounds[0] - points, points - bounds[1]), 0.0)
    return np.linalg.norm(outside, axis=1)
