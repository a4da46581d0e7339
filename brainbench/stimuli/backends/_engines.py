"""What the engines share: units, the shape of a link, and when a simulation is doubtful."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from brainbench.errors import UsageError
from brainbench.stimuli.chain import build_chain

if TYPE_CHECKING:
    from collections.abc import Sequence

    from brainbench.stimuli.backends.protocol import Job
    from brainbench.stimuli.fidelity import Fidelity

logger = logging.getLogger(__name__)

MILLI = 1e3
"""Millimetres in a metre, milliseconds in a second, millinewtons in a newton."""
MICRO = 1e6
"""Milligrams in a kilogram, µN·m in a newton metre."""
CONE_SIDES = 8
"""Sides of the cone inside a tapered link."""
LEAST_TAPER = 1e-6
"""Difference of the radii of a link's ends (mm) below which it is a capsule."""
LARGEST_BEND = 1.5
"""Angle between two links (rad) that no intact whisker reaches; beyond it a simulation counts as unstable."""


def require_parts(jobs: Sequence[Job], backend: str) -> None:
    """Refuse obstacles that only engines which collide surfaces can touch.

    Raises:
        UsageError: an obstacle has a surface and no convex parts.
    """
    for obstacle in {id(item): item for job in jobs for item in job.obstacles}.values():
        if obstacle.surface is not None and not obstacle.parts:
            raise UsageError(
                f"The backend {backend!r} collides convex bodies only, and an object here is a concave surface of"
                f" {len(obstacle.surface.faces)} triangles; give the object collision = 'decomposition' (convex pieces,"
                " whose deviation is stated) or use the backend 'rod', which touches the surface itself."
            )


def warn_overdamped(jobs: Sequence[Job], fidelity: Fidelity) -> None:
    """Say when the time step alone damps a whisker at least twice as much as it should be damped."""
    worst, wanted = 0.0, 0.0
    for whisker in {job.whisker for job in jobs}:
        chain = build_chain(whisker, 8)
        ratio = chain.achieved_damping_ratio(fidelity.step(float(chain.frequencies()[0]) / (2 * np.pi)))
        if ratio > 2 * whisker.damping_ratio and ratio > worst:
            worst, wanted = ratio, whisker.damping_ratio
    if worst:
        logger.warning(
            "The time step of %g s damps the first mode of at least one whisker with ratio %.2f instead of %.2f; "
            "its ringing is lost, slow bending is not; choose a smaller step to keep it.",
            fidelity.time_step,
            worst,
            wanted,
        )
