"""Collision shape of a tapered link in engines of convex bodies: all points within a margin of a slim cone.

A staircase of capsules turns the force of a peg that sits on a step dr by up to √(2 dr/R). The cone has the taper as
its surface and the margin rounds it, so its facets are smaller than dr and do not matter.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAST_TAPER = 1e-6
"""Difference of the radii of a link's ends (mm) below which it is a capsule."""
_SIDES = 8


def cone_vertices(core: float, length: float, *, narrows: bool) -> NDArray[np.float64]:
    """Return the vertices [9, 3] (mm) of the cone inside a link along x, ``core`` (mm) being the radius of its base.

    It ``narrows`` when the link is thinner at its end than at its start.
    """
    # Eight sides: a facet lies at most 8 % of ``core``, a difference of radii, inside the cone.
    angle = 2 * np.pi * np.arange(_SIDES) / _SIDES
    wide, apex = (0.0, length) if narrows else (length, 0.0)
    ring = np.stack([np.full(_SIDES, wide), core * np.cos(angle), core * np.sin(angle)], axis=1)
    return np.append(ring, [(apex, 0.0, 0.0)], axis=0)
