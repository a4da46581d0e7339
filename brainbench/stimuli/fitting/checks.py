"""Whether measured wrenches can be those of a trial at all, and whether residuals look like noise.

A wrong unit or sign leads least squares to a bound and not to a sentence, so wrenches are looked at before anything is
fitted. Letters: m reading, p parameter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from brainbench.core.contracts import CHANNELS
from brainbench.core.errors import DataError, listing
from brainbench.stimuli.fitting.model import Readings
from brainbench.stimuli.fitting.trials import Trial
from brainbench.stimuli.motion.jobs import Trace

if TYPE_CHECKING:
    from scipy.sparse import coo_array

UNITS = 100.0
"""Size of the wrenches over that at the start, or its inverse, from which the unit is wrong and not the start."""
OPPOSITE = -0.8
"""Correlation with the wrenches at the start from which the sign is wrong."""
MULTIPLE = 1.5
"""Size of the forces (moments) over that of the fitted whisker, or its inverse, from which one of the kinds has another
unit: where they disagree, a fit follows the one and takes the other for noise."""
SURE = 5.0
"""Standard deviations by which such a size is known to differ."""
DEAD = 0.05
"""Share of the largest predicted component of its kind from which one that reads zero throughout is doubtful."""


def check_wrenches(trials: Sequence[Trial], traces: Sequence[Trace]) -> None:
    """Refuse wrenches that are no wrenches of these trials, whose ``traces`` were simulated at the start of a fit."""
    for trial, trace in zip(trials, traces, strict=True):
        for kind, unit, small in (("F", "N", "mN"), ("M", "N·m", "µN·m")):
            measured, expected = _of_kind(trial, trace, kind)
            sizes = [float(np.sqrt(np.mean(part**2))) if part.size else 0.0 for part in (measured, expected)]
            if not min(sizes) > 0:
                continue
            what, ratio = "forces" if kind == "F" else "moments", sizes[0] / sizes[1]
            if not 1 / UNITS < ratio < UNITS:
                raise DataError(
                    f"The measured {what} are {ratio:.2g} times those of the whisker at the start of the fit "
                    f"({sizes[1]:.2g} {unit}); numbers without a unit are in {unit}: name it in the column, as in "
                    f"{kind}y_{small.replace('µ', 'u').replace('·', '')}, or start nearer to the truth."
                )
            alike = float(np.mean(measured * expected)) / (sizes[0] * sizes[1])
            if alike < OPPOSITE:
                raise DataError(
                    f"The measured {what} are the opposite of those of the whisker at the start of the fit "
                    f"(correlation {alike:.2f}); they are the action of the whisker on its base: "
                    "change the sign, or the side to which the whisker was plucked or pushed."
                )


def dead_channels(trials: Sequence[Trial], traces: Sequence[Trace]) -> tuple[str, ...]:
    """Return one sentence where components that read zero throughout, and are left out, should not be zero."""
    doubtful: list[str] = []
    for trial, trace in zip(trials, traces, strict=True):
        if trial.of_shapes:
            continue
        size = np.sqrt(np.mean(trace.wrench**2, axis=0))
        largest = np.repeat([size[:3].max(), size[3:].max()], 3)
        silent = ~np.any(np.nan_to_num(trial.measured["wrench"].values) != 0, axis=0)
        places = [CHANNELS.index(name) for name, zero in zip(trial.channels, silent, strict=True) if zero]
        doubtful += [CHANNELS[place] for place in places if size[place] > DEAD * largest[place]]
    if not doubtful:
        return ()
    return (
        f"{listing(dict.fromkeys(doubtful))} is zero throughout and was left out, although the fitted whisker acts "
        "there: leave out the column if it was not measured.",
    )


def other_sizes(trials: Sequence[Trial], traces: Sequence[Trace]) -> tuple[str, ...]:
    """Return one sentence where forces, or moments, are a multiple of those of the fitted whisker."""
    for trial, trace in zip(trials, traces, strict=True):
        for kind, what in (("F", "forces"), ("M", "moments")):
            measured, expected = _of_kind(trial, trace, kind)
            square = float(expected @ expected)
            if measured.size < 3 or not square > 0:
                continue
            ratio = float(measured @ expected) / square
            spread = float(np.sqrt(np.sum((measured - ratio * expected) ** 2) / (measured.size - 1) / square))
            if not 1 / MULTIPLE < ratio < MULTIPLE and abs(ratio - 1) > SURE * spread:
                return (
                    f"The measured {what} are {ratio:.2g} times those of the fitted whisker: forces and moments do not "
                    "belong together; check their units and about which point moments are taken.",
                )
    return ()


def _of_kind(trial: Trial, trace: Trace, kind: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the measured and the predicted forces (``F``) or moments (``M``) of a trial where both are known."""
    if trial.of_shapes:
        return np.zeros(0), np.zeros(0)
    columns = [place for place, name in enumerate(trial.channels) if name.startswith(kind)]
    measured: Any = trial.measured["wrench"].values[:, columns]
    expected = trace.wrench[:, [CHANNELS.index(trial.channels[place]) for place in columns]]
    finite = np.isfinite(measured) & np.isfinite(expected)
    return measured[finite], expected[finite]


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


# A model that is wrong leaves residuals whose neighbours agree. The statistic of an ordering is S = Σ rᵢ rⱼ over pairs
# of readings at most three places apart. After a fit the residuals are (1 − Q Qᵀ) ε, with an orthonormal basis Q [m, p]
# of the Jacobian's columns, so mean and variance of S = rᵀ W r under white noise are known exactly (Durbin & Watson
# 1950, Biometrika 37, 409-428, for the lag of one):
#
#     E S = −σ² tr(QᵀWQ),   var S = 2 σ⁴ (tr W² − 2 tr(QᵀW²Q) + tr((QᵀWQ)²))
#
# The test is one-sided: agreement counts, and a normal law is taken for S. Residuals that swing have no sum S where
# eight readings make a swing, and a negative one below. So the squares of the deviates of single lags over time are
# also added up, as by Ljung & Box (1978, Biometrika 65, 297-303), and compared with the chi-square law.
def check_residuals(residual: Array, jacobian: Array, readings: Readings) -> tuple[ResidualTest, ...]:
    """Return the tests of whitened residuals [m] with their Jacobian [m, p]; each at its share of :data:`ALPHA`."""
    from scipy.special import chdtrc, ndtr

    # Residuals of a fit lie across the columns of the Jacobian; what is left of white noise there is correlated.
    basis, _ = np.linalg.qr(jacobian)
    free = len(residual) - jacobian.shape[1]
    variance = float(residual @ residual) / free
    results: list[tuple[str, float, float, int]] = []
    for what, column in (("time", 0), ("arc", 1)):
        weights = _neighbours(readings, column, range(1, LAGS + 1))
        pairs = weights.nnz // 2
        if pairs >= FEWEST:
            z = _deviate(residual, basis, weights, variance)
            results.append((what, z, float(ndtr(-z)), pairs))
    lags = [_neighbours(readings, 0, [lag]) for lag in range(1, SWING_LAGS + 1)]
    if min(one.nnz // 2 for one in lags) >= FEWEST:
        square = sum(_deviate(residual, basis, one, variance) ** 2 for one in lags)
        p = float(chdtrc(SWING_LAGS, square))
        results.append(("swing", (square - SWING_LAGS) / math.sqrt(2 * SWING_LAGS), p, len(residual)))
    stated = np.isfinite(readings.noise[readings.group])
    if stated.sum() > jacobian.shape[1] + 1:
        # Sum of squares over repeat noise is chi-square with n − p degrees of freedom.
        degrees = int(stated.sum()) - jacobian.shape[1]
        size = float(np.sum(residual[stated] ** 2))
        p = float(chdtrc(degrees, size))
        results.append(("size", (size - degrees) / math.sqrt(2 * degrees), p, int(stated.sum())))
    level = ALPHA / max(len(results), 1)
    return tuple(ResidualTest(what, z, p, count, p >= level) for what, z, p, count in results)


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
    faults = {
        "time": "neighbouring instants leave residuals of the same sign",
        "arc": "neighbouring points along the whisker leave residuals of the same sign",
        "swing": "the residuals swing",
        "size": "the residuals are larger than the noise of repeats",
    }
    return tuple(
        f"The model does not fit: {faults[test.what]} ({test.statistic:.1f} standard deviations beyond noise, "
        f"p = {test.p:.2g}); the shape, the motion or the contact that was assumed is wrong, or the noise is not white."
        for test in tests
        if not test.passed
    )
