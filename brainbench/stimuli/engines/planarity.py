"""Test of whether a whisker stays in one plane: it then bends only, and its joints need no hinge for twist.

That holds when base, forces and objects are mirror images of themselves in a plane through the whisker, and nothing
moves across it. A curved whisker has one such plane, a straight one has many: those of its loads and of round pegs are
tried. Letters: n time, p part.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from brainbench.core.rotations import base_rotation, to_matrices
from brainbench.stimuli.engines.reach import Reach
from brainbench.stimuli.motion.jobs import Job
from brainbench.stimuli.objects.obstacle import Capsule, Cylinder, Obstacle, Sphere

_TINY = 1e-9
"""Share of a length, length (m) of a way, or sine of an angle, that counts as none."""


def stays_in_plane(
    job: Job, reach: Reach, position: NDArray[np.float64], euler: NDArray[np.float64], times: NDArray[np.float64]
) -> bool:
    """Return True when nothing bends the whisker out of one plane.

    ``position`` [n, 3] (m) and ``euler`` [n, 3] (rad) are the base at ``times`` [n] (s), ``reach`` what it may touch.
    """
    turns = base_rotation(euler)
    paths = [None if obstacle.motion is None else obstacle.motion(times) for obstacle in reach.obstacles]
    forces = [np.asarray(job.gravity, dtype=float), *(np.asarray(load.force, dtype=float) for load in job.loads)]
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
    if job.whisker.curvature == 0:
        axes = [_axis(part) for item in reach.obstacles for part in item.parts if isinstance(part, (Capsule, Cylinder))]
        for vector in (*(np.cross(along, force) for force in forces), *axes[:1]):
            vector = vector - along * (along @ vector)
            if (size := np.linalg.norm(vector)) > 0:
                yield vector / size


def _axis(part: Capsule | Cylinder) -> NDArray[np.float64]:
    return np.subtract(part.end, part.start)


def _mirrored(
    obstacle: Obstacle,
    path: tuple[NDArray, NDArray] | None,
    base: NDArray,
    normal: NDArray,
    thickness: float,
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
