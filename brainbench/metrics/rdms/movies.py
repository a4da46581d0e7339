"""RDMs over time: one for every window."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from brainbench.core.errors import UsageError
from brainbench.metrics.rdms.dissimilarity import rdm
from brainbench.metrics.rdms.pairs import Floats


def rdm_movie(
    responses: ArrayLike, labels: ArrayLike | None = None, *, width: int = 1, step: int = 1, **options: Any
) -> Floats:
    """Return an RDM for every window of time [W, P], each the RDM of the responses averaged over that window.

    Window w covers the bins w·step … w·step + width − 1; a bin that is NaN does not count, and a unit without
    any bin in a window is missing there. Compare movies frame by frame with
    ``compare(model_movie, brain_movie)`` or every frame with every other by
    ``compare(model_movie[:, None], brain_movie)``.

    Args:
        responses: Trials [R, T, U] with ``labels``, or patterns [K, T, U].
        labels: Stimulus of each trial, as in :func:`brainbench.metrics.rdm`.
        width: Bins per window.
        step: Bins from one window to the next.
        **options: ``method``, ``folds``, ``precision`` and ``device`` of :func:`brainbench.metrics.rdm`.

    Raises:
        UsageError: not three-dimensional, or a window that does not fit; else as :func:`brainbench.metrics.rdm`.

    >>> import numpy as np
    >>> rdm_movie(np.arange(12.0).reshape(2, 3, 2), method="sqeuclidean").tolist()
    [[36.0], [36.0], [36.0]]
    """
    array = np.asarray(responses)
    if array.ndim != 3:
        raise UsageError(f"A movie takes responses [trials or stimuli, time, units]; received shape {array.shape}.")
    if step < 1 or not 1 <= width <= array.shape[1]:
        raise UsageError(
            f"A movie of {array.shape[1]} time bins takes a width from 1 to {array.shape[1]} and a step from 1; "
            f"received width {width}, step {step}."
        )
    starts = range(0, array.shape[1] - width + 1, step)
    return np.stack([rdm(_window_mean(array[:, start : start + width]), labels, **options) for start in starts])


def _window_mean(window: np.ndarray) -> np.ndarray:
    """Average over the time bins [R, W, U] that were recorded."""
    if window.shape[1] == 1:
        return window[:, 0]
    if window.dtype.kind != "f" or np.isfinite(window).all():
        return window.mean(axis=1, dtype=np.float64)
    missing = np.isnan(window)
    number = (~missing).sum(axis=1)
    # Mean over the bins that were recorded; without any it stays missing, never zero.
    total = np.where(missing, 0.0, window).sum(axis=1)
    return np.divide(total, number, out=np.full(total.shape, np.nan), where=number > 0)
