"""Confidence intervals over animals: t, percentile and bias-corrected accelerated (BCa) bootstrap.

Measured coverage of each, for 3 to 20 animals, is in docs/statistics.md: with few animals the
percentile interval is too narrow, so the t interval is what a score reports.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core import statistics
from brainbench.core.errors import unknown_name
from brainbench.core.records import Interval
from brainbench.core.statistics import LEVEL, check_level
from brainbench.metrics.rdms.pairs import Floats

VERIFIED_ANIMALS = 5
"""Coverage was measured from this many animals up; below, intervals are marked unreliable."""

INTERVAL_METHODS = ("t", "percentile", "bca")


def t_interval(values: ArrayLike, level: float = LEVEL) -> Interval | None:
    """Return the t interval of the mean of one value per animal [A]; None for fewer than two or missing ones.

    Raises:
        UsageError: a level outside (0, 1).
    """
    found = statistics.t_interval(values, level, over="animals")
    return found and replace(found, method=found.method + caution(np.size(values)))


def percentile_interval(
    draws: ArrayLike, level: float = LEVEL, *, what: str = "percentile bootstrap"
) -> Interval | None:
    """Return the percentiles of bootstrap draws [D]; None without a finite draw.

    Raises:
        UsageError: a level outside (0, 1).
    """
    check_level(level)
    finite = _finite(draws)
    if not finite.size:
        return None
    # Draws without a value are left out: they say nothing about where the score lies.
    low, high = np.quantile(finite, [(1 - level) / 2, (1 + level) / 2])
    return Interval(float(low), float(high), level, what)


def bca_interval(
    draws: ArrayLike, estimate: float, jackknife: ArrayLike, level: float = LEVEL, *, what: str = "BCa bootstrap"
) -> Interval | None:
    """Return the bias-corrected accelerated interval (Efron 1987, eq. 6.6), or None where it does not exist.

    :func:`scipy.stats.bootstrap` has the same method, but draws anew; here the draws are hierarchical and given.

    Args:
        draws: [D] bootstrap values.
        estimate: Value on the data themselves.
        jackknife: [A] values with each animal left out, for the acceleration.
        level: Coverage asked for.
        what: Name of the method in the result.

    Raises:
        UsageError: a level outside (0, 1).
    """
    from scipy.special import ndtr, ndtri

    check_level(level)
    finite, left_out = _finite(draws), _finite(jackknife)
    if not finite.size or left_out.size < 2:
        return None
    # Ties with the estimate count half, as if rounding had decided them.
    below = float((finite < estimate).mean() + 0.5 * (finite == estimate).mean())
    if not 0 < below < 1:
        return None
    # Bias correction z₀ = Φ⁻¹(share of draws below the estimate).
    shift = float(ndtri(below))
    # Acceleration a = Σd³ / (6 (Σd²)^1.5) of jackknife differences d; zero where they are symmetric.
    spread = left_out.mean() - left_out
    square = float((spread**2).sum())
    acceleration = float((spread**3).sum()) / (6 * square**1.5) if square > 0 else 0.0
    # Quantiles at Φ(z₀ + w/(1 − a w)) with w = z₀ + z; at the pole of that map there is no interval.
    edges = shift + ndtri(np.array([(1 - level) / 2, (1 + level) / 2]))
    slope = 1 - acceleration * edges
    if (slope <= 0).any():
        return None
    low, high = np.quantile(finite, ndtr(shift + edges / slope))
    return Interval(float(low), float(high), level, what)


def interval_reasons(count: int) -> tuple[str, ...]:
    """Say what the number of animals means for the interval."""
    if count == 1:
        return ("one animal: no confidence interval, since nothing is known about other animals",)
    if count < VERIFIED_ANIMALS:
        return (f"interval from {count} animals is unreliable: coverage not verified below {VERIFIED_ANIMALS}",)
    return ()


def caution(count: int) -> str:
    """Say in an interval's method what the number of animals means for it."""
    return "" if count >= VERIFIED_ANIMALS else f"; unreliable: coverage not verified below {VERIFIED_ANIMALS} animals"


def check_interval_method(method: str) -> None:
    """Raise UsageError with the nearest name unless ``method`` is known."""
    if method not in INTERVAL_METHODS:
        raise unknown_name("interval method", method, INTERVAL_METHODS)


def _finite(values: ArrayLike) -> Floats:
    array = np.asarray(values, dtype=np.float64).ravel()
    return array[np.isfinite(array)]
