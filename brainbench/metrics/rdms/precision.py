"""Noise covariance between units, from trials, and its inverse."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import DataError, UsageError, unknown_name
from brainbench.metrics.arrays import fetch, find_device, place
from brainbench.metrics.rdms.noise_model import NOISE_METHODS, NoiseModel, noise_model
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.stimulus_labels import response_matrix, stimulus_codes, stimulus_means

__all__ = ["NOISE_METHODS", "estimate_noise", "noise_precision"]


def noise_precision(
    responses: ArrayLike, labels: ArrayLike, *, method: str = "shrinkage_diag", device: Any = None
) -> Floats:
    """Return the inverse covariance [U, U] of trial-to-trial noise.

    Residuals are trials minus their stimulus' mean, with R − K degrees of freedom (rsatoolbox's
    ``prec_from_unbalanced``). Trials with a missing entry are left out.

    Args:
        responses: Trials [R, U].
        labels: Stimulus of each trial [R].
        method: ``shrinkage_diag`` towards the diagonal (Schäfer & Strimmer 2005), ``shrinkage_eye``
            towards a multiple of the identity (Ledoit & Wolf 2004), ``diag``, or ``full``.
        device: Torch device to compute on, see :func:`brainbench.metrics.rdm`.

    Raises:
        UsageError: unknown method or shapes that do not fit.
        DataError: no more complete trials than stimuli, units without noise, or a singular covariance.
    """
    trials = response_matrix(responses, "trials")
    codes, names = stimulus_codes(labels)
    if len(codes) != len(trials):
        raise UsageError(f"There are {len(trials)} trials but {len(codes)} labels; give one label per trial.")
    model = estimate_noise(trials, codes, len(names), method, device=find_device(device, responses))
    return fetch(model.precision())


def estimate_noise(trials: Any, codes: Ints, count: int, method: str, *, device: Any = None) -> NoiseModel:
    """Return the covariance of trials [R, U] about the means of their ``count`` stimuli, on the device.

    Raises:
        UsageError: unknown method.
        DataError: as :func:`noise_precision`, but a singular covariance is found only when it is used.
    """
    if method not in NOISE_METHODS:
        raise unknown_name("noise covariance method", method, NOISE_METHODS)
    # Residuals are small beside the products of units that follow, so they are always made by numpy.
    trials = np.asarray(fetch(trials), dtype=np.float64)
    # Products between units need both entries of a trial; filling one would invent covariance.
    complete = ~np.isnan(trials).any(axis=1)
    if not complete.all():
        trials, codes = trials[complete], codes[complete]
    freedom = len(trials) - len(np.unique(codes))
    if freedom < 1:
        raise DataError(
            f"A noise covariance needs more complete trials than stimuli; there are {len(trials)} complete trials of "
            f"{len(np.unique(codes))} stimuli."
        )
    residuals = trials - stimulus_means(trials, codes, count)[codes]
    spread = np.maximum(residuals.max(axis=0), -residuals.min(axis=0))
    largest = np.maximum(trials.max(axis=0), -trials.min(axis=0))
    silent = int((spread <= 8 * np.finfo(float).eps * largest).sum())
    if silent:
        raise DataError(
            f"{silent} of {trials.shape[1]} units never vary between trials of a stimulus, so their noise has no "
            "inverse; remove them first."
        )
    return noise_model(residuals if device is None else place(residuals, device), freedom, method)
