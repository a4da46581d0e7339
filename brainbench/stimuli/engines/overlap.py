"""Overlap of whiskers with the convex bodies that they touch, for engines that find contacts themselves. Metres.

Inside a convex body the distance from its surface is the least over its faces, so it needs no search and no limit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from brainbench.core.rotations import base_rotation, to_matrices
from brainbench.stimuli.engines.reach import to_obstacle_frame
from brainbench.stimuli.engines.trust import AT_BASE, LARGEST_START_OVERLAP, STARTED_INSIDE, fault
from brainbench.stimuli.objects.obstacle import Box, Capsule, Cylinder, Obstacle, Part, Sphere
from brainbench.stimuli.whiskers.chain import Chain

PARTS = 8
"""Parts of a link at whose ends its overlap is measured."""


def part_depth(part: Part, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how deep [n] points [n, 3] lie in a body; below zero outside, where it is no farther than that."""
    match part:
        case Sphere():
            return part.radius - np.linalg.norm(points - part.centre, axis=1)
        case Box():
            local = (points - part.centre) @ to_matrices(part.quaternion)
            return (np.asarray(part.half_sizes) - np.abs(local)).min(axis=1)
        case Capsule() | Cylinder():
            start, along = np.asarray(part.start), np.subtract(part.end, part.start)
            length = np.linalg.norm(along)
            arc = (points - start) @ (along / length)
            capsule = isinstance(part, Capsule)
            foot = start + np.outer(arc.clip(0, length) if capsule else arc, along / length)
            depth = part.radius - np.linalg.norm(points - foot, axis=1)
            return depth if capsule else np.minimum(depth, np.minimum(arc, length - arc))
        case _:
            planes = ConvexHull(part.vertices).equations
            return -(points @ planes[:, :3].T + planes[:, 3]).max(axis=1)


def obstacle_depth(obstacle: Obstacle, points: NDArray, times: NDArray) -> NDArray[np.float64]:
    """Return how deep [n] points [n, 3] (world), at ``times`` [n] (s), lie in the deepest part of an obstacle."""
    local = to_obstacle_frame(obstacle, points, times)
    return np.max([part_depth(part, local) for part in obstacle.parts], axis=0)


def overlap_fault(
    obstacles: Sequence[Obstacle], chain: Chain, position: NDArray, euler: NDArray, times: NDArray
) -> tuple[int, str, float]:
    """Return the first step at which the whisker starts in an object, or one reaches its base point.

    Also returned are what is wrong in words, and the overlap at the start (m). Without a fault the step is the number
    of steps and the words are empty. ``position`` and ``euler`` [n + 1, 3] are the base's at ``times`` [n + 1] (s).
    """
    share = np.linspace(0, 1, PARTS * chain.links + 1)
    arcs = np.interp(share, np.linspace(0, 1, chain.links + 1), chain.nodes)
    rest = np.stack([np.interp(arcs, chain.nodes, axis) for axis in (*chain.points.T, np.zeros(chain.links + 1))], 1)
    line = rest @ base_rotation(euler[0]).T + position[0]
    first, reason, depth = len(times) - 1, "", 0.0
    for obstacle in obstacles:
        here = obstacle_depth(obstacle, line, np.full(len(line), times[0])) + chain.whisker.radius(arcs)
        depth = max(depth, float(here.max()))
        reached = np.flatnonzero(obstacle_depth(obstacle, position, times)[:-1] > -chain.whisker.base_radius)
        if len(reached) and reached[0] < first:
            first, reason = int(reached[0]), fault(AT_BASE, float(times[reached[0]]), 0.0)
    if depth > LARGEST_START_OVERLAP:
        first, reason = 0, fault(STARTED_INSIDE, float(times[0]), depth)
    return first, reason, depth
