"""Search trees of triangle surfaces: eight children a node, without pointers, built by sorting alone.

Triangles stand in the order in which halving space leaves them, so that eight neighbours in a row are a leaf, eight
leaves in a row their parent, and so on: the ranks of boxes say where everything is. Eight threads can look at the
children of a node together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

WIDE = 8
"""Children of a node, and triangles of a leaf."""
LEVELS = 7
"""Levels of boxes that a search keeps track of: enough for 16 million triangles."""


def spatial_order(corners: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the order [triangle] of triangles [triangle, 3, 3] in which aligned runs of 8, 16, 32, … lie together.

    Runs are halved along the longest side of the box of their middles, from the whole down to leaves.
    """
    middles = corners.mean(axis=1)
    count = len(middles)
    order = np.arange(count)
    run = WIDE
    while run < count:
        run *= 2
    while run > WIDE:
        here = middles[order]
        begins = np.arange(0, count, run)
        # All runs of one level at once: boxes by reduceat, then one sort whose keys hold the run and the place along
        # its side.
        low, high = np.minimum.reduceat(here, begins), np.maximum.reduceat(here, begins)
        axis = np.argmax(high - low, axis=1)
        which = np.arange(count) // run
        rows = np.arange(len(begins))
        base, side = low[rows, axis], (high - low)[rows, axis]
        along = (here[np.arange(count), axis[which]] - base[which]) / np.maximum(side, 1e-300)[which]
        order = order[np.argsort(which + 0.999 * along.clip(0, 1), kind="stable")]
        run //= 2
    return order


def tree_boxes(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return boxes [box, 2, 3] (lowest, highest corner) of ordered triangles: of leaves, then of parents, and so on.

    The last level has no more than eight boxes; a level that follows ``n`` boxes has ⌈n / 8⌉.
    """
    low, high = corners.min(axis=1), corners.max(axis=1)
    levels = []
    while not levels or len(low) > WIDE:
        begins = np.arange(0, len(low), WIDE)
        # Parents from the boxes of their children, level by level.
        low, high = np.minimum.reduceat(low, begins), np.maximum.reduceat(high, begins)
        levels.append(np.stack([low, high], axis=1))
    return np.concatenate(levels)
