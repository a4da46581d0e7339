"""Rotations and the three hinge angles of a follicle. Letters: n time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError

STEEPEST = math.radians(87)
"""Elevation up to which a follicle is driven by its Euler angles."""
_RATE = 1000.0
"""Instants per second at which angles are followed from the start; between two of them nothing turns by 180°."""


def principal_angles(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (θ, φ, ζ) [..., 3] (rad) of base frames [..., 3, 3], the inverse of ``base_rotation``.

    φ lies within ±90°, θ − 90° and ζ + 90° within ±180°.
    """
    # Rz(θ − 90°) Ry(−φ) Rx(ζ + 90°) has the first column (cos φ cos θ′, cos φ sin θ′, sin φ) and the last row (sin φ,
    # cos φ sin ζ′, cos φ cos ζ′), with θ′ = θ − 90° and ζ′ = ζ + 90°.
    theta = np.arctan2(rotation[..., 1, 0], rotation[..., 0, 0]) + np.pi / 2
    phi = np.arcsin(np.clip(rotation[..., 2, 0], -1.0, 1.0))
    zeta = np.arctan2(rotation[..., 2, 1], rotation[..., 2, 2]) - np.pi / 2
    return np.stack([theta, phi, zeta], axis=-1)


def follow_angles(
    rotation: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    times: NDArray[np.float64],
    first: ArrayLike,
    name: str,
) -> NDArray[np.float64]:
    """Return the angles (θ, φ, ζ) [n, 3] (rad) of a moving base frame at ``times`` [n] (s), without jumps by turns.

    ``rotation`` gives base frames [m, 3, 3] at times [m]; ``first`` are the angles at t = 0, which tell the turn to
    start in. Times may have any order: the angles do not depend on which others are asked for.
    """
    times = np.asarray(times, dtype=float)
    grid = np.arange(math.floor(max(times.max(initial=0.0), 0.0) * _RATE) + 2) / _RATE
    # The last instant may lie beyond what is known of the motion.
    grid = np.minimum(grid, max(times.max(initial=0.0), 0.0))
    coarse, fine = principal_angles(rotation(grid)), principal_angles(rotation(times))
    for angles, when in ((coarse, grid), (fine, times)):
        steep = np.abs(angles[:, 1]) > STEEPEST
        if steep.any():
            raise UsageError(
                f"The whisker {name} points along the vertical axis of its array (elevation "
                f"{math.degrees(angles[steep][0, 1]):.0f}°) at {when[steep][0]:.4g} s; the follicle is driven by "
                f"azimuth, elevation and torsion, which lose their meaning beyond "
                f"{math.degrees(STEEPEST):.0f}° (gimbal lock). Leave this whisker out, or let it move less."
            )
    # The number of whole turns follows from the way since t = 0; the even grid makes it independent of ``times``.
    track = np.unwrap(coarse, axis=0)
    track += 2 * np.pi * np.round((np.asarray(first, dtype=float) - track[0]) / (2 * np.pi))
    # Exact principal angles, each with the whole turns that bring it nearest to the followed ones.
    expected = np.stack([np.interp(times, grid, track[:, axis]) for axis in range(3)], axis=1)
    return fine + 2 * np.pi * np.round((expected - fine) / (2 * np.pi))
