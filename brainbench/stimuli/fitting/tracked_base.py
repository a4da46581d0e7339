"""Motion of a whisker's base from its own track: the rest shape laid on the first part of each traced shape.

Near the base a whisker bends least, so there its traced shape shows where the base is and which way it points. Poses of
single frames are noisy; a smoothing spline through them (generalised cross-validation) is the motion.

Letters: n frame, k traced point.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, UsageError
from brainbench.stimuli.whiskers.whisker import Whisker

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
FEWEST = 3
"""Points near the base that a frame needs."""


@dataclass(frozen=True, eq=False)
class TrackedFollicle:
    """A base that moves in the x-y plane as it was tracked."""

    splines: tuple[Any, Any, Any]
    """x and y (m) and the direction (rad) over time in frames."""
    interval: float
    """Time of a frame [s]."""
    begin: float
    """First tracked instant [s]; before it the base stands still."""
    end: float
    """Last tracked instant [s]; behind it the base goes on as it moved."""
    finest: float
    """Shortest period of the motion (s): two frames are half of one."""

    def pose(self, times: Array) -> tuple[Array, Array]:
        """Return positions [n, 3] (m) and Euler angles [n, 3] (θ, φ, ζ; rad); the whisker curves in the x-y plane."""
        times = np.asarray(times, dtype=float)
        inside = np.clip(times, self.begin, self.end)
        beyond = np.maximum(times - self.end, 0.0)
        inside, beyond, end = inside / self.interval, beyond / self.interval, self.end / self.interval
        x, y, angle = (spline(inside) + beyond * spline(end, 1) for spline in self.splines)
        still = np.zeros_like(x)
        # θ − π/2 turns about z, and ζ = −π/2 lays the whisker's plane on x-y (the default of StillFollicle).
        euler = np.stack([angle + math.pi / 2, still, still - math.pi / 2], axis=-1)
        return np.stack([x, y, still], axis=-1), euler


def track_base(shapes: xr.Dataset, whisker: Whisker, *, share: float = 0.25) -> TrackedFollicle:
    """Return the motion of the base that traced shapes show.

    Args:
        shapes: traced shapes with two axes; their first point is the base.
        whisker: its length and curvature.
        share: part of the length, from the base on, on which the rest shape is laid.

    Raises:
        UsageError: the shapes have three axes.
        DataError: fewer than five frames have three points on that part.
    """
    from scipy.interpolate import make_smoothing_spline

    points = shapes["shape"].values
    if points.shape[-1] != 2:
        raise UsageError("The base is tracked in the plane of the video; give shapes with two axes.")
    poses = np.array([_pose(frame, whisker, share) for frame in points])
    times, known = shapes["time"].values.astype(float), np.isfinite(poses).all(axis=1)
    if known.sum() < 5:
        raise DataError(
            f"{int(known.sum())} frames have {FEWEST} points on the first {100 * share:g} % of the whisker; five are "
            "needed to follow its base: trace nearer to the face, or give the motion as a scene."
        )
    times, poses = times[known], poses[known]
    poses[:, 2] = np.unwrap(poses[:, 2])
    interval = float(np.diff(times).min())
    # SciPy's search for the smoothing takes times for numbers near one.
    x, y, angle = (make_smoothing_spline(times / interval, column) for column in poses.T)
    return TrackedFollicle((x, y, angle), interval, float(times[0]), float(times[-1]), 2 * interval)


def _pose(frame: Array, whisker: Whisker, share: float) -> Array:
    """Return x, y (m) and direction (rad) of the base of one frame's points [k, 2]; NaN with too few near it.

    The rigid motion with the least squares (Arun, Huang & Blostein 1987, IEEE Trans. PAMI 9, 698), in the plane.
    """
    known = frame[np.isfinite(frame).all(axis=-1)]
    if not len(known):
        return np.full(3, np.nan)
    # The distance from the base, which noise hardly changes, stands for the arc length.
    distance = np.linalg.norm(known - known[0], axis=1)
    near = distance <= share * whisker.arc_length
    if near.sum() < FEWEST:
        return np.full(3, np.nan)
    rest, traced = whisker.centre_line(distance[near]), known[near]
    a, b = rest - rest.mean(axis=0), traced - traced.mean(axis=0)
    angle = math.atan2(float(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])), float(np.sum(a * b)))
    cosine, sine = math.cos(angle), math.sin(angle)
    x, y = traced.mean(axis=0) - np.array([[cosine, -sine], [sine, cosine]]) @ rest.mean(axis=0)
    return np.array([x, y, angle])
