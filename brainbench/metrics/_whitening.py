"""Whitening of a session's trials by its noise, so that squared distances become Mahalanobis distances."""

from __future__ import annotations

import numpy as np

from brainbench.errors import DataError, unknown_name
from brainbench.metrics._halves import Session
from brainbench.metrics._labels import stimulus_means
from brainbench.metrics.precision import NOISE_METHODS, noise_precision


def whitened(session: Session, count: int, noise: str) -> tuple[Session | None, str]:
    """Return the session with noise of unit covariance, and what was left out in words.

    The covariance comes from all trials of the session, about their stimulus' mean. Units that never
    vary between trials of a stimulus have no noise to divide by and are left out. ``diag`` scales each
    unit by the trials it was recorded in; the other methods mix units, so they leave out units that
    were not recorded in every trial.

    Raises:
        UsageError: unknown ``noise`` method.
    """
    if noise not in NOISE_METHODS:
        raise unknown_name("noise covariance method", noise, NOISE_METHODS)
    residuals = session.responses - stimulus_means(session.responses, session.codes, count)[session.codes]
    largest = np.nanmax(np.abs(session.responses), axis=0)
    varies = np.nanmax(np.abs(residuals), axis=0) > 8 * np.finfo(np.float64).eps * largest
    usable = varies if noise == "diag" else varies & np.isfinite(session.responses).all(axis=0)
    told = (
        f"{int((~usable).sum())} units or bins left out: without noise or not in every trial"
        if not usable.all()
        else ""
    )
    if not usable.any():
        return None, "no unit has noise to divide by"
    responses = session.responses[:, usable]
    if noise == "diag":
        rest = residuals[:, usable]
        freedom = np.isfinite(rest).sum(axis=0) - count
        scaled = responses / np.sqrt(np.nansum(rest**2, axis=0) / freedom)
        return Session(scaled, session.codes, session.hashes), told
    try:
        precision = noise_precision(responses, session.codes, method=noise)
    except DataError as error:
        return None, str(error).rstrip(".")
    return Session(responses @ np.linalg.cholesky(precision), session.codes, session.hashes), told
