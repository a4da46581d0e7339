"""Whitening of a session's trials by its noise, so that squared distances become Mahalanobis distances.

The noise is estimated from the same trials. Their means do not depend on it, but what crossnobis takes away does: the
noise of a trial divided by its own estimate is 1 on average, that of a mean divided by an independent estimate is
E[σ²/σ̂²] > 1. So crossnobis would stay above zero for stimuli that are alike, by 5 % of the noise with 40 degrees of
freedom. The factor is known for Gaussian noise (ν/(ν − 2) per unit, ν/(ν − U − 1) for a full covariance of U units);
with shrinkage it is measured by holding out a tenth of the residuals in turn.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, check_name
from brainbench.metrics.rdms.noise import NOISE_METHODS, NoiseModel, estimate_noise
from brainbench.metrics.rdms.pairs import Floats, Ints
from brainbench.metrics.reliability.sessions import SortedTrials
from brainbench.metrics.stimulus_labels import stimulus_means

_FOLDS = 10


def whitened_sessions(
    sessions: list[SortedTrials], count: int, noise: str, notes: tuple[str, ...]
) -> tuple[list[SortedTrials], str | None, tuple[str, ...]]:
    """Whiten every session; return those with a noise covariance, why there is none (or None), and notes for people."""
    found = [whitened(session, count, noise) for session in sessions]
    kept = [session for session, _ in found if session is not None]
    notes += tuple(dict.fromkeys(told for session, told in found if told and session is not None))
    lost = sorted({told for session, told in found if session is None})
    if not kept:
        return sessions, f"no session has a noise covariance: {'; '.join(lost)}", notes
    if lost:
        notes += (f"{len(found) - len(kept)} sessions left out: {'; '.join(lost)}",)
    return kept, None, notes


def whitened(session: SortedTrials, count: int, noise: str) -> tuple[SortedTrials | None, str]:
    """Return the session with noise of unit covariance, and what was left out in words.

    The covariance comes from all trials of the session, about their stimulus' mean. Units that never vary between
    trials of a stimulus have no noise to divide by and are left out. ``diag`` scales each unit by the trials it was
    recorded in; the other methods mix units, so they leave out units that were not recorded in every trial.

    ``none`` divides by nothing.
    """
    check_name("noise covariance method", noise, ("none", *NOISE_METHODS))
    if noise == "none":
        return session, ""
    varies, power, number = (np.concatenate(part) for part in zip(*_noise(session, count), strict=True))
    usable = varies if noise == "diag" else varies & np.isfinite(session.responses).all(axis=0)
    lost = int((~usable).sum())
    told = f"{lost} units or bins left out: without noise or not in every trial" if lost else ""
    if not usable.any():
        return None, "no unit has noise to divide by"
    responses = session.responses if usable.all() else session.responses[:, usable]
    if noise == "diag":
        # ν = trials − stimuli, per unit; for Gaussian noise E[σ²/σ̂²] = ν/(ν − 2).
        freedom = number[usable] - count
        scaled = np.divide(responses, np.sqrt(power[usable] / freedom), out=responses)
        # Units with two degrees of freedom or fewer have no expected factor; four is the least anyone has.
        inflation = float(np.mean(freedom / np.maximum(freedom - 2, 1)))
        return replace(session, responses=scaled, inflation=inflation), told
    try:
        precision = estimate_noise(responses, session.labels, count, noise).precision()
    except DataError as error:
        return None, str(error).rstrip(".")
    # With the precision P̂ = L Lᵀ, trials times L have noise of unit covariance.
    inflation = _inflation(responses, session.labels, noise, count)
    return replace(session, responses=responses @ np.linalg.cholesky(precision), inflation=inflation), told


def _noise(session: SortedTrials, count: int) -> Iterator[tuple[NDArray[np.bool_], Floats, Ints]]:
    """Yield for slices of units whether each varies between trials of a stimulus, Σ residual² and its trials."""
    for units in session.slices():
        # Noise is what trials differ by from their stimulus' mean; below the rounding of its values a unit has none.
        responses = session.responses[:, units]
        residuals = responses - stimulus_means(responses, session.labels, count)[session.labels]
        largest = np.nanmax(np.abs(responses), axis=0)
        varies = np.nanmax(np.abs(residuals), axis=0) > 8 * np.finfo(np.float64).eps * largest
        yield varies, np.nansum(residuals**2, axis=0), np.isfinite(residuals).sum(axis=0)


def _inflation(responses: Floats, codes: Ints, noise: str, count: int) -> float:
    """Return tr(P̂ S) of a precision P̂ and the covariance S of other trials, over that of its own trials."""
    units, freedom = responses.shape[1], len(codes) - count
    # Mean of an inverse Wishart matrix: E[Σ̂⁻¹] = Σ⁻¹ ν/(ν − U − 1), exact for Gaussian noise.
    if noise == "full":
        return freedom / (freedom - units - 1) if freedom > units + 1 else 1.0
    residuals = responses - stimulus_means(responses, codes, count)[codes]
    # Trials of each stimulus go to the folds in turn, so that every fold has its share.
    place = np.empty(len(codes), dtype=np.int64)
    for stimulus in range(count):
        rows = np.flatnonzero(codes == stimulus)
        place[rows] = (np.arange(len(rows)) + stimulus) % _FOLDS
    found = []
    for fold in range(_FOLDS):
        rest, held = residuals[place != fold], residuals[place == fold]
        try:
            model = estimate_noise(rest, np.zeros(len(rest), dtype=np.int64), 1, noise)
            ratio = _mean_square(held, model, len(held)) / _mean_square(rest, model, len(rest) - 1)
        except DataError:
            return 1.0
        found.append(ratio)
    # An estimate from nine tenths errs by ten ninths of what one from all trials does.
    return 1 + (float(np.mean(found)) - 1) * (1 - 1 / _FOLDS)


def _mean_square(residuals: Floats, model: NoiseModel, freedom: int) -> float:
    """Return tr(P̂ S) for the covariance S of residuals."""
    left, right = model.sides(residuals, residuals)
    return float((left * right).sum()) / freedom
