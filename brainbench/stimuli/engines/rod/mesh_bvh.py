"""Search trees of triangle surfaces: eight children a node, without pointers, built by sorting alone.

Triangles stand in the order in which halving space leaves them, so that eight neighbours in a row are a leaf, eight
leaves in a row their parent, and so on: the ranks of boxes say where everything is. Eight threads can look at the
children of a node together.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

BITS = 3
WIDE = 1 << BITS
"""Children of a node, and triangles of a leaf."""
EMPTY = 1e30
"""Coordinate of children that a node lacks: further away than any search goes."""
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
    """Return the nodes [node, 6, 8] above ordered triangles: boxes (lowest, highest corner) of eight children each.

    Children of the first nodes are leaves, of the next ones these nodes, and so on; the last node is the top. A level
    above ``n`` boxes has ⌈n / 8⌉ nodes.
    """
    low, high = corners.min(axis=1), corners.max(axis=1)
    levels = []
    while not levels or len(low) > WIDE:
        begins = np.arange(0, len(low), WIDE)
        # Parents from the boxes of their children, level by level.
        low, high = np.minimum.reduceat(low, begins), np.maximum.reduceat(high, begins)
        levels.append(in_eights(np.concatenate([low, high], axis=1)))
    return np.concatenate(levels)


def in_eights(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rows [row, number] as runs of eight [run, number, 8]: a processor reads a number of all eight at once."""
    missing = np.full((-len(rows) % WIDE, rows.shape[1]), EMPTY)
    return np.concatenate([rows, missing]).reshape(-1, WIDE, rows.shape[1]).swapaxes(1, 2)
