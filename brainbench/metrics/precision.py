"""Noise covariance between units, from trials, and its inverse."""

from __future__ import annotations

import contextlib
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from brainbench.errors import DataError, UsageError, unknown_name
from brainbench.metrics._labels import response_matrix, stimulus_codes, stimulus_means
from brainbench.metrics._pairs import Floats


def noise_precision(responses: ArrayLike, labels: ArrayLike, *, method: str = "shrinkage_diag") -> Floats:
    """Return the inverse covariance [U, U] of trial-to-trial noise.

    Residuals are trials minus their stimulus' mean, with R − K degrees of freedom (rsatoolbox's
    ``prec_from_unbalanced``). Trials with a missing entry are left out.

    Args:
        responses: Trials [R, U].
        labels: Stimulus of each trial [R].
        method: ``shrinkage_diag`` towards the diagonal (Schäfer & Strimmer 2005), ``shrinkage_eye``
            towards a multiple of the identity (Ledoit & Wolf 2004), ``diag``, or ``full``.

    Raises:
        UsageError: unknown method or shapes that do not fit.
        DataError: no more complete trials than stimuli, units without noise, or a singular covariance.
    """
    if method not in _METHODS:
        raise unknown_name("noise covariance method", method, _METHODS)
    trials = response_matrix(responses, "trials").astype(np.float64)
    codes, names = stimulus_codes(labels)
    if len(codes) != len(trials):
        raise UsageError(f"There are {len(trials)} trials but {len(codes)} labels; give one label per trial.")
    # Products between units need both entries of a trial; filling one would invent covariance.
    complete = ~np.isnan(trials).any(axis=1)
    trials, codes = trials[complete], codes[complete]
    freedom = len(trials) - len(np.unique(codes))
    if freedom < 1:
        raise DataError(
            f"A noise covariance needs more complete trials than stimuli; there are {len(trials)} complete trials of "
            f"{len(np.unique(codes))} stimuli."
        )
    residuals = trials - stimulus_means(trials, codes, len(names))[codes]
    silent = int((np.abs(residuals).max(axis=0) <= 8 * np.finfo(float).eps * np.abs(trials).max(axis=0)).sum())
    if silent:
        raise DataError(
            f"{silent} of {trials.shape[1]} units never vary between trials of a stimulus, so their noise has no "
            "inverse; remove them first."
        )
    return _inverse(_METHODS[method](residuals, freedom), method)


def _diag(residuals: Floats, freedom: int) -> Floats:
    return np.diag((residuals**2).sum(axis=0) / freedom)


def _full(residuals: Floats, freedom: int) -> Floats:
    return residuals.T @ residuals / freedom


def _shrinkage_diag(residuals: Floats, freedom: int) -> Floats:
    # rsatoolbox divides by the number of rows less one here, whatever the degrees of freedom.
    count = len(residuals)
    covariance = _full(residuals, freedom)
    scaled = residuals / np.sqrt(np.diag(covariance))
    mean = scaled.T @ scaled / (count - 1)
    spread = count / freedom**2 * ((scaled**2).T @ scaled**2 / (count - 1) - mean**2)
    off = ~np.eye(len(covariance), dtype=bool)
    signal = float((mean[off] ** 2).sum())
    amount = min(max(float(spread[off].sum()) / signal, 0.0), 1.0) if signal > 0 else 1.0
    return np.where(off, (1 - amount) * covariance, covariance)


def _shrinkage_eye(residuals: Floats, freedom: int) -> Floats:
    count, units = residuals.shape
    covariance = residuals.T @ residuals / count
    target = np.trace(covariance) / units * np.eye(units)
    distance = float(((covariance - target) ** 2).sum())
    error = float(((residuals**2).T @ residuals**2 / count - covariance**2).sum()) / count
    amount = min(error, distance) / distance if distance > 0 else 1.0
    return (amount * target + (1 - amount) * covariance) * count / freedom


def _inverse(covariance: Floats, method: str) -> Floats:
    from scipy.linalg import LinAlgError, cho_factor, cho_solve

    factor = None
    with contextlib.suppress(LinAlgError):
        factor = cho_factor(covariance, lower=True)
    # A factor exists for a numerically singular matrix too; its pivots tell.
    pivots = np.zeros(1) if factor is None else np.diag(factor[0])
    if factor is None or pivots.min() <= pivots.max() * np.sqrt(len(pivots) * np.finfo(float).eps):
        raise DataError(
            f"The noise covariance of {len(covariance)} units (method={method!r}) is singular: there are too few "
            "trials for this many units; use method='shrinkage_diag'."
        )
    inverse = cho_solve(factor, np.eye(len(covariance)))
    return (inverse + inverse.T) / 2


_METHODS: dict[str, Callable[[Floats, int], Floats]] = {
    "shrinkage_diag": _shrinkage_diag,
    "shrinkage_eye": _shrinkage_eye,
    "diag": _diag,
    "full": _full,
}

NOISE_METHODS = tuple(_METHODS)
"""Names that ``method`` of :func:`noise_precision` takes."""
