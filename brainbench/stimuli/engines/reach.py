"""What a whisker could ever touch of its obstacles, so that a scene costs only what it uses, and planes it stays in."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.rotations import base_rotation, to_matrices
from brainbench.geometry import winding_number
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.objects.obstacle import Capsule, Cylinder, Obstacle, Sphere
from brainbench.stimuli.whiskers.whisker import Chain, Whisker

LARGEST_SLIDE = 0.1
"""Way that a follicle may give, in lengths of its whisker."""


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
    limit = whisker.arc_length * (1 if whisker.follicle is None else 1 + LARGEST_SLIDE) + whisker.thickest
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


_TINY = 1e-9
"""Share of a length, length (m) of a way, or sine of an angle, that counts as none."""


# A whisker stays in a plane when base, forces and objects are mirror images of themselves in a plane through it, and
# nothing moves across that. It then bends only, and its joints need no hinge for twist. A curved whisker has one such
# plane, a straight one has many: those of its loads and of round pegs are tried. Letters: n time, p part.
def stays_in_plane(
    job: Job, reach: Reach, position: NDArray[np.float64], euler: NDArray[np.float64], times: NDArray[np.float64]
) -> bool:
    """Return True when nothing bends the whisker out of one plane.

    ``position`` [n, 3] (m) and ``euler`` [n, 3] (rad) are the base at ``times`` [n] (s), ``reach`` what it may touch.
    """
    if any(torsion for _, _, torsion in job.whisker.bends):
        return False
    turns = base_rotation(euler)
    paths = [None if obstacle.motion is None else obstacle.motion(times) for obstacle in reach.obstacles]
    pulls = (job.gravity,) if job.air_flow is None else (job.gravity, job.air_flow)
    forces = [np.asarray(force, dtype=float) for force in (*pulls, *(load.force for load in job.loads))]
    length = job.whisker.arc_length
    for normal in _normals(job, reach, turns[0], forces):
        if (
            np.abs(turns @ (turns[0].T @ normal) - normal).max() < _TINY
            and np.abs((position - position[0]) @ normal).max() < _TINY * length
            and all(abs(force @ normal) <= _TINY * np.linalg.norm(force) for force in forces)
            and all(
                _mirrored(obstacle, path, position[0], normal, job.whisker.base_radius)
                for obstacle, path in zip(reach.obstacles, paths, strict=True)
            )
        ):
            return True
    return False


def _normals(job: Job, reach: Reach, turn: NDArray, forces: list[NDArray]) -> Iterator[NDArray[np.float64]]:
    """Yield the normals of the planes that contain the unbent whisker and are worth a try."""
    along, _, across = turn.T
    yield across
    if job.whisker.straight:
        axes = [_axis(part) for item in reach.obstacles for part in item.parts if isinstance(part, (Capsule, Cylinder))]
        for vector in (*(np.cross(along, force) for force in forces), *axes[:1]):
            vector = vector - along * (along @ vector)
            if (size := np.linalg.norm(vector)) > 0:
                yield vector / size


def _axis(part: Capsule | Cylinder) -> NDArray[np.float64]:
    return np.subtract(part.end, part.start)


def _mirrored(
    obstacle: Obstacle, path: tuple[NDArray, NDArray] | None, base: NDArray, normal: NDArray, thickness: float
) -> bool:
    """Return True when the plane of ``normal`` through ``base`` (m) mirrors an obstacle, at all times of its motion.

    A part that lies further beside the plane than the whisker is thick is never touched.
    """
    if obstacle.surface is not None:
        return False
    shift, first = np.zeros(3), np.eye(3)
    if path is not None:
        place, turns = np.asarray(path[0], dtype=float), to_matrices(np.asarray(path[1], dtype=float))
        shift, first = place[0], turns[0]
        across = np.abs((place - shift) @ normal).max()
        if max(across, np.abs(turns @ (first.T @ normal) - normal).max()) >= _TINY:
            return False
    for part in obstacle.parts:
        if isinstance(part, Sphere):
            heights, tilt, extent = np.array([(first @ part.centre + shift - base) @ normal]), 0.0, part.radius
        elif isinstance(part, (Capsule, Cylinder)):
            heights = np.array([(first @ end + shift - base) @ normal for end in (part.start, part.end)])
            axis = first @ _axis(part)
            tilt = float(np.linalg.norm(np.cross(axis, normal)) / np.linalg.norm(axis))
            extent = part.radius if isinstance(part, Capsule) or tilt >= _TINY else 0.0
        else:
            return False
        beside = abs(heights.sum()) == np.abs(heights).sum() and np.abs(heights).min() > extent + thickness
        through = np.abs(heights).max() < _TINY if len(heights) == 1 else heights.min() < 0 < heights.max()
        if not beside and (tilt >= _TINY or not through):
            return False
    return True
