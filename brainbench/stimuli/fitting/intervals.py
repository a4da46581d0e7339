"""Confidence intervals of fitted parameters: Laplace's, and of the profile likelihood.

Letters: m residual, p parameter. Sums of squares S are of whitened residuals, priors included as residuals.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from brainbench.core.records import Interval
from brainbench.stimuli.fitting.parameters import PARAMETERS, FreeParameters

Array = NDArray[np.float64]
WIDEST = 12.0
"""Distance from the estimate, in coordinates, at which an interval counts as open (a factor of 160,000)."""
_STEPS = 12
"""Points at which the profile is looked at on each side."""


def quantile(level: float, freedom: float) -> float:
    """Return Student's t of a two-sided interval; the normal one for infinitely many degrees of freedom."""
    from scipy.special import ndtri, stdtrit

    share = (1 + level) / 2
    return float(stdtrit(freedom, share)) if math.isfinite(freedom) else float(ndtri(share))


def laplace_interval(free: FreeParameters, index: int, u: Array, deviation: float, level: float, t: float) -> Interval:
    """Return the interval u ± t s of one parameter, in its unit; infinite where the deviation s is."""
    half = t * deviation if math.isfinite(deviation) else math.inf
    return _interval(free, index, u[index] - half, u[index] + half, level, "Laplace")


def _interval(free: FreeParameters, index: int, low: float, high: float, level: float, method: str) -> Interval:
    name = free.names[index]
    parameter, start = PARAMETERS[name], free.start[name]

    def value(end: float) -> float:
        if abs(end) <= 700:
            return parameter.value(start, end, free.start.whisker)
        return (0.0 if end < 0 else math.inf) if parameter.kind == "log" else end

    one, other = value(low), value(high)
    return Interval(min(one, other), max(one, other), level, method)


@dataclass(frozen=True, eq=False)
class Profile:
    """The likelihood along one parameter, maximised over the others."""

    residual: Callable[[Array], Array]
    jacobian: Callable[[Array], Array]
    limits: tuple[Array, Array]
    best: Array
    """[p]"""
    covariance: Array
    """[p, p] at the best fit, scaled by the noise."""
    least: float
    """Sum of squares at the best fit."""
    scale: float
    """Variance of a whitened residual."""

    def interval(self, free: FreeParameters, index: int, level: float, t: float, error: float = 0.0) -> Interval:
        """Return where (S − S_min)/s² stays below t² along a parameter; a side that reaches its bound ends there.

        ``error`` is another standard deviation of the coordinate, which does not depend on the data's.
        """
        best = self.best[index]
        low, high = (best + side * math.hypot(self._end(index, side, t) - best, t * error) for side in (-1, 1))
        return _interval(free, index, low, high, level, "profile likelihood")

    def _end(self, index: int, side: int, t: float) -> float:
        deviation = math.sqrt(max(float(self.covariance[index, index]), 0.0))
        bound = float(self.limits[0 if side < 0 else 1][index])
        most = min(abs(bound - self.best[index]), WIDEST)
        if not math.isfinite(deviation) or most <= 0:
            return bound
        near, far = (0.0, 0.0), None
        reach = min(t * deviation, most)
        # The signed root of the fall is nearly linear in the coordinate, so the secant through 0 is a good guess.
        for _ in range(_STEPS):
            fall = self._fall(index, self.best[index] + side * reach)
            if abs(fall - t) < 0.01 * t:
                return self.best[index] + side * reach
            if fall < t:
                near = (reach, fall)
                if reach >= most:
                    return bound
            else:
                far = (reach, fall)
            if far is None:
                reach = min(reach * min(max(1.05 * t / max(fall, 1e-3), 1.05), 3.0), most)
            else:
                share = (t - near[1]) / max(far[1] - near[1], 1e-12)
                reach = near[0] + min(max(share, 0.05), 0.95) * (far[0] - near[0])
        return self.best[index] + side * reach

    def _fall(self, index: int, place: float) -> float:
        """Return √((S − S_min)/s²) with one coordinate at a place and the others at their best."""
        from scipy.optimize import least_squares

        others = [j for j in range(len(self.best)) if j != index]
        u = self.best.copy()
        # Along the profile the others follow their regression on this one.
        u += self.covariance[:, index] / max(float(self.covariance[index, index]), 1e-300) * (place - u[index])
        u[index] = place
        u = np.clip(u, self.limits[0] + 1e-9, self.limits[1] - 1e-9)
        u[index] = place

        def full(rest: Array) -> Array:
            point = u.copy()
            point[others] = rest
            return point

        if others:
            found = least_squares(
                lambda rest: self.residual(full(rest)),
                u[others],
                jac=lambda rest: self.jacobian(full(rest))[:, others],  # type: ignore[arg-type]
                bounds=(self.limits[0][others], self.limits[1][others]),
                max_nfev=8,
                ftol=1e-6,
                xtol=1e-5,
            )
            squares = 2 * float(found.cost)
        else:
            squares = float(np.sum(self.residual(u) ** 2))
        return math.sqrt(max(squares - self.least, 0.0) / self.scale)
