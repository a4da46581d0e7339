"""Whether residuals look like noise: their serial correlation over time and along the whisker, and their size.

A model that is wrong leaves residuals whose neighbours agree. The statistic of an ordering is S = Σ rᵢ rⱼ over pairs of
readings at most three places apart. After a fit the residuals are (1 − Q Qᵀ) ε, with an orthonormal basis Q [m, p] of
the Jacobian's columns, so mean and variance of S under white noise are known exactly (Durbin & Watson 1950, Biometrika
37, 409-428, for the lag of one)::

    E S = −σ² tr(QᵀWQ),   var S = 2 σ⁴ (tr W² − 2 tr(QᵀW²Q) + tr((QᵀWQ)²))

where S = rᵀ W r. The test is one-sided: agreement counts, and a normal law is taken for S.

Residuals that swing have no sum S where eight readings make a swing, and a negative one below. So the squares of the
deviates of single lags over time are also added up, as by Ljung & Box (1978, Biometrika 65, 297-303), and compared with
the chi-square law.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from brainbench.stimuli.fitting.model import Readings

if TYPE_CHECKING:
    from scipy.sparse import coo_array

Array = NDArray[np.float64]
LAGS = 3
"""Places up to which readings are neighbours."""
SWING_LAGS = 4
"""Places up to which residuals that swing are looked for."""
ALPHA = 0.01
"""Chance that noise alone fails any of the tests of a fit."""
FEWEST = 20
"""Pairs from which an ordering is tested."""


@dataclass(frozen=True)
class ResidualTest:
    """One test of the residuals."""

    what: str
    """``time``, ``arc`` (serial correlation over time, along the whisker), ``swing`` (of any sign, over time) or
    ``size`` (against repeat noise)."""
    statistic: float
    """Deviation from what noise alone gives, in standard deviations."""
    p: float
    """Chance of a larger one under noise alone."""
    readings: int
    passed: bool


def check_residuals(residual: Array, jacobian: Array, readings: Readings) -> tuple[ResidualTest, ...]:
    """Return the tests of whitened residuals [m] with their Jacobian [m, p]; each at its share of :data:`ALPHA`."""
    from scipy.special import chdtrc, ndtr

    basis, _ = np.linalg.qr(jacobian)
    free = len(residual) - jacobian.shape[1]
    variance = float(residual @ residual) / free
    found: list[tuple[str, float, float, int]] = []
    for what, column in (("time", 0), ("arc", 1)):
        weights = _neighbours(readings, column, range(1, LAGS + 1))
        pairs = weights.nnz // 2
        if pairs >= FEWEST:
            z = _deviate(residual, basis, weights, variance)
            found.append((what, z, float(ndtr(-z)), pairs))
    lags = [_neighbours(readings, 0, [lag]) for lag in range(1, SWING_LAGS + 1)]
    if min(one.nnz // 2 for one in lags) >= FEWEST:
        square = sum(_deviate(residual, basis, one, variance) ** 2 for one in lags)
        p = float(chdtrc(SWING_LAGS, square))
        found.append(("swing", (square - SWING_LAGS) / math.sqrt(2 * SWING_LAGS), p, len(residual)))
    known = np.isfinite(readings.noise[readings.group])
    if known.sum() > jacobian.shape[1] + 1:
        # Sum of squares over repeat noise is chi-square with n − p degrees of freedom.
        degrees = int(known.sum()) - jacobian.shape[1]
        size = float(np.sum(residual[known] ** 2))
        p = float(chdtrc(degrees, size))
        found.append(("size", (size - degrees) / math.sqrt(2 * degrees), p, int(known.sum())))
    level = ALPHA / max(len(found), 1)
    return tuple(ResidualTest(what, z, p, count, p >= level) for what, z, p, count in found)


def _deviate(residual: Array, basis: Array, weights: coo_array, variance: float) -> float:
    moved = weights @ basis
    inner = basis.T @ moved
    mean = -variance * float(np.trace(inner))
    spread = float(weights.power(2).sum()) - 2 * float(np.sum(moved**2)) + float(np.sum(inner * inner.T))
    return (float(residual @ (weights @ residual)) - mean) / max(variance * math.sqrt(2 * max(spread, 0.0)), 1e-300)


def _neighbours(readings: Readings, column: int, lags: Sequence[int]) -> coo_array:
    """Return W [m, m], ½ where two readings differ by one of some lags in one place and agree in all else."""
    from scipy.sparse import coo_array

    count = len(readings)
    fixed = [readings.trial, *(readings.place[:, other] for other in range(3) if other != column)]
    # Sorted, readings of one series stand together in order of the place.
    order = np.lexsort((readings.place[:, column], *fixed[::-1]))
    rows: list[NDArray[np.int_]] = []
    columns: list[NDArray[np.int_]] = []
    for lag in lags:
        first, second = order[:-lag], order[lag:]
        near = readings.place[second, column] - readings.place[first, column] == lag
        for values in fixed:
            near &= values[first] == values[second]
        rows += [first[near], second[near]]
        columns += [second[near], first[near]]
    row, col = np.concatenate(rows), np.concatenate(columns)
    return coo_array((np.full(len(row), 0.5), (row, col)), shape=(count, count))


def failed_words(tests: Sequence[ResidualTest]) -> tuple[str, ...]:
    """Return one sentence for each test that failed."""
    told = {
        "time": "neighbouring instants leave residuals of the same sign",
        "arc": "neighbouring points along the whisker leave residuals of the same sign",
        "swing": "the residuals swing",
        "size": "the residuals are larger than the noise of repeats",
    }
    return tuple(
        f"The model does not fit: {told[test.what]} ({test.statistic:.1f} standard deviations beyond noise, "
        f"p = {test.p:.2g}); the shape, the motion or the contact that was assumed is wrong, or the noise is not white."
        for test in tests
        if not test.passed
    )
