"""Responses that are sampled, such as ΔF/F of imaged cells: the mean of each cell over a window."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from brainbench.core.errors import DataError, listing
from brainbench.datasets.sessions import Series, Session

Floats = NDArray[np.float64]


def response_series(session: Session) -> Series | None:
    """Return the signal that stands for responses where a session has no spikes: its only one, or its only ΔF/F."""
    every = {place: item for place, item in session.populations.items() if isinstance(item, Series)}
    preferred = [place for place in every if "DfOverF" in place] if len(every) > 1 else [*every]
    if len(preferred) > 1 or (every and not preferred):
        raise DataError(
            f"{session.source} has several signals of cells ({listing(every)}) and no spikes; keep one of them, or one "
            "in a DfOverF, and remove the others from a copy."
        )
    return every[preferred[0]] if preferred else None


def frame_times(series: Series) -> Floats:
    """Return the times (s) of the frames of a signal, checked."""
    number = series.data.shape[0]
    if series.timestamps is None:
        if not series.rate > 0:
            raise DataError(f"The series {series.name} has neither timestamps nor a rate; its frames have no time.")
        return series.start + np.arange(number) / series.rate
    times = np.asarray(series.timestamps[...], dtype=np.float64).ravel()
    if len(times) != number:
        raise DataError(f"The series {series.name} has {len(times)} timestamps for {number} frames.")
    if not (np.isfinite(times).all() and (np.diff(times) > 0).all()):
        raise DataError(f"The timestamps of {series.name} are not finite and increasing; its frames have no order.")
    return times


def window_means(series: Series, times: Floats, bounds: Floats) -> NDArray[np.float32]:
    """Return the mean of each cell over the frames in each bin [R, T, U], bins [begin, end) from ``bounds`` [R, T + 1].

    Frames that are NaN are left out; a bin without any other is NaN.
    """
    values = np.asarray(series.data[...], dtype=np.float32)
    values = values[:, None] if values.ndim == 1 else values
    place = np.searchsorted(times, bounds, side="left")
    means = np.full((len(bounds), bounds.shape[1] - 1, values.shape[1]), np.nan, dtype=np.float32)
    for row, column in np.ndindex(means.shape[:2]):
        frames = values[place[row, column] : place[row, column + 1]]
        finite = np.isfinite(frames)
        total = np.where(finite, frames, 0.0).sum(axis=0, dtype=np.float64)
        number = finite.sum(axis=0)
        means[row, column] = np.divide(total, number, out=np.full(len(number), np.nan), where=number > 0)
    return means


def fading(means: NDArray[np.float32]) -> str:
    """Return a doubt where the responses [R, T, U] of trials in order of time drift, as where an indicator bleaches."""
    finite = np.isfinite(means)
    number = finite.sum(axis=(1, 2))
    course = np.where(finite, means, 0.0).sum(axis=(1, 2), dtype=np.float64)[number > 0] / number[number > 0]
    if len(course) < FEWEST_TRIALS or not np.ptp(course):
        return ""
    r = float(np.corrcoef(course, np.arange(len(course)))[0, 1])
    if r * r < DRIFT:
        return ""
    return (
        f"the mean over cells {'rises' if r > 0 else 'falls'} over the session (time explains {r * r:.0%} of its "
        "variance), as where an indicator bleaches; take ΔF/F of a running baseline"
    )


FEWEST_TRIALS, DRIFT = 12, 0.5
"""Trials from which a drift is looked for, and the share of the variance over trials from which it is one: without
drift it is 1 / (R − 1), and .5 or more in one of 100 sessions of 12 trials."""
