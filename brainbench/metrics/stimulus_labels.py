"""Stimulus labels of trials, and the mean response to each stimulus."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import DataError, UsageError
from brainbench.metrics.arrays import Array, Floats, Ints, is_tensor, library, place, slices

_SLICE_ELEMENTS = 1 << 20

_OFFSET = 1e3  # ratio of means to their spread over stimuli above which sums are taken about a value within the data


def stimulus_codes(labels: ArrayLike, count: int | None = None) -> tuple[Ints, tuple[str, ...]]:
    """Return integer codes [R] and the names of all stimuli.

    Integers are codes already (0 … K−1, and K is ``count`` or the largest plus one); strings are
    coded in sorted order. The order of appearance never matters.
    """
    array = np.asarray(labels)
    if array.ndim != 1:
        raise UsageError(f"Labels are one per trial [R]; received an array of shape {array.shape}.")
    if array.dtype.kind in "US" or (array.dtype == object and all(isinstance(label, str) for label in array)):
        if count is not None:
            raise UsageError(
                "Labels of sessions are integers 0 … K−1 in the order of the stimuli (a session may lack one, so names "
                f"cannot be numbered here); received strings such as {str(array[0])!r}."
            )
        # Sorted, never by first appearance: that misaligned sessions in published code.
        names, codes = np.unique(array.astype(str), return_inverse=True)
        return codes.astype(np.int64), tuple(str(name) for name in names)
    if array.dtype.kind not in "iu":
        raise UsageError(f"Labels must be integers from 0 or strings; received {array.dtype}.")
    codes = array.astype(np.int64)
    total = int(codes.max(initial=-1)) + 1 if count is None else count
    if codes.min(initial=0) < 0 or codes.max(initial=-1) >= total:
        raise UsageError(f"Integer labels run from 0 to {total - 1}; received {codes.min()} to {codes.max()}.")
    return codes, tuple(str(code) for code in range(total))


def response_matrix(responses: ArrayLike, rows: str) -> Any:
    """Return responses as a floating array [rows, U], keeping float32 and tensors where they lie."""
    try:
        array: Any = responses if is_tensor(responses) else np.asarray(responses)
    except ValueError as error:
        raise UsageError(f"Responses must be real numbers [{rows}, units]; received rows of unequal length.") from error
    real = not array.dtype.is_complex if is_tensor(array) else array.dtype.kind in "fiub"
    if array.ndim != 2 or not real or array.shape[1] == 0:
        raise UsageError(
            f"Responses must be real numbers [{rows}, units] with at least one unit; "
            f"received {array.dtype} of shape {tuple(array.shape)}; flatten time and space into units first."
        )
    if is_tensor(array):
        return array.detach() if array.dtype.is_floating_point else array.double()
    return array if array.dtype.kind == "f" else array.astype(np.float64)


def labelled_trials(responses: ArrayLike, labels: ArrayLike, count: int | None = None) -> tuple[Any, Ints, Any]:
    """Return trials [R, U], the codes [R] of their stimuli, and the names of all stimuli; UsageError if they differ."""
    trials, (codes, names) = response_matrix(responses, "trials"), stimulus_codes(labels, count)
    check_lengths(trials, codes)
    return trials, codes, names


def check_lengths(trials: Any, codes: Ints) -> None:
    """Raise UsageError unless there is one label per trial."""
    if len(codes) != len(trials):
        raise UsageError(f"There are {len(trials)} trials but {len(codes)} labels; give one label per trial.")


def membership(codes: Ints, count: int) -> Floats:
    """Return 1 where a trial is one of a stimulus, else 0 [K, R]."""
    return (codes == np.arange(count)[:, None]).astype(np.float64)


def stimulus_means(responses: NDArray, codes: Ints, count: int) -> Floats:
    """Return the mean response [K, U] over the trials of each stimulus; NaN entries are missing.

    A unit without any value for a stimulus is NaN there.
    """
    check_lengths(responses, codes)
    numbers = np.bincount(codes, minlength=count)[:, None].astype(np.float64)
    if (means := _complete_means(responses, codes, numbers)) is not None:
        return means
    check_finite(responses)
    member = membership(codes, count)
    present = ~np.isnan(responses)
    # One offset for all, taken from the data, so that a large mean does not cost the digits of differences.
    shift = float(responses[present][0]) if present.any() else 0.0
    totals = member @ np.where(present, responses.astype(np.float64) - shift, 0.0)
    numbers = member @ present.astype(np.float64)
    return np.where(numbers > 0, totals / np.where(numbers > 0, numbers, 1.0), np.nan) + shift


def _complete_means(responses: NDArray, codes: Ints, numbers: Floats) -> Floats | None:
    """Average in slices of units, so that nothing large is copied; None if an entry is missing."""
    from scipy.sparse import csr_array

    rows = np.arange(len(codes))
    # A sparse row of 1/n at its stimulus' trials: the mean is one product, with no copy of the responses.
    member = csr_array((1.0 / numbers[codes, 0], (codes, rows)), shape=(len(numbers), len(codes)))
    means = np.empty((len(numbers), responses.shape[1]))
    step = max(16, _SLICE_ELEMENTS // max(1, len(responses)))
    for start in range(0, responses.shape[1], step):
        columns = slice(start, start + step)
        part = np.ascontiguousarray(responses[:, columns], dtype=np.float64)
        mean = member @ part
        if not np.isfinite(mean).all():
            return None
        if len(part) and (np.abs(mean).max(axis=0) > _OFFSET * np.ptp(mean, axis=0)).any():
            # Sums about a value from within the data keep the digits that a large offset would cost.
            mean = member @ (part - part[0]) + part[0]
        means[:, columns] = mean
    means[numbers[:, 0] == 0] = np.nan
    return means


def tensor_means(responses: Any, codes: Ints, count: int, device: Any) -> Array:
    """Return means [K, U] as :func:`stimulus_means` does, on ``device``, by products with the trials' membership."""
    member = place(membership(codes, count), device)
    xp, parts = library(member), []
    for _, part in slices(responses, _SLICE_ELEMENTS, device):
        present = xp.isfinite(part)
        if xp.isinf(part).any():
            check_finite(xp.cat([part for _, part in slices(responses, _SLICE_ELEMENTS, device)], -1).cpu().numpy())
        seen = xp.where(present, xp.ones_like(part), 0.0)
        # Sums about a value from within the data keep the digits that a large offset would cost.
        shift = xp.where(present, part, 0.0).sum(0) / seen.sum(0).clip(1.0)
        totals, numbers = member @ xp.where(present, part - shift, 0.0), member @ seen
        parts.append(xp.where(numbers > 0, totals / numbers.clip(1.0), np.nan) + shift)
    return xp.cat(parts, -1)


def check_finite(responses: NDArray) -> None:
    """Raise DataError if a response is infinite; NaN means missing."""
    infinite = int(np.isinf(responses).sum())
    if infinite:
        raise DataError(f"{infinite} responses are infinite; a missing response is NaN, everything else is finite.")
