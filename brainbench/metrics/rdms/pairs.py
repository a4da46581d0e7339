"""Stimulus pairs: the order of an RDM's upper triangle and what permuting stimuli does to it.

Pair p of K stimuli is the p-th entry of the upper triangle read row by row:
(0, 1), (0, 2) … (0, K−1), (1, 2) … so P = K(K−1)/2.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from brainbench.core.errors import UsageError
from brainbench.metrics.arrays import is_tensor, library

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
LARGEST = 1e150
"""Largest dissimilarity, whose square is still a number."""


def stimulus_count(pairs: int) -> int:
    """Return K for P = K(K−1)/2 pairs."""
    # Positive root of K² − K − 2P = 0, in integers, so that rounding accepts no wrong P.
    count = (1 + math.isqrt(1 + 8 * pairs)) // 2
    if pairs < 1 or count * (count - 1) // 2 != pairs:
        raise UsageError(
            f"An RDM vector has K(K−1)/2 entries (1, 3, 6, 10, 15 …); this one has {pairs}; "
            f"give the upper triangle without the diagonal."
        )
    return count


def upper(matrix: Any) -> Any:
    """Return the upper triangle [..., P] of square matrices [..., K, K], numpy arrays or tensors."""
    return matrix[..., *_pair_indices(matrix.shape[-1], matrix)]


def _pair_indices(count: int, like: Any) -> Any:
    """Return the rows [P] and columns [P] of all pairs, where and what ``like`` is."""
    if is_tensor(like):
        return library(like).triu_indices(count, count, offset=1, device=like.device).unbind()
    return np.triu_indices(count, k=1)


def square(rdm: ArrayLike) -> Floats:
    """Return symmetric matrices [..., K, K] with a zero diagonal from upper triangles [..., P]."""
    vector = np.asarray(rdm, dtype=np.float64)
    count = stimulus_count(vector.shape[-1])
    matrix = vector.take(_pair_places(count), axis=-1)
    matrix[..., np.arange(count), np.arange(count)] = 0.0
    return matrix


@lru_cache(maxsize=4)
def _pair_places(count: int) -> Ints:
    """Return the place [K, K] of the pair {i, j} in an upper triangle; 0 on the diagonal, which has none."""
    rows, cols = np.triu_indices(count, k=1)
    table = np.zeros((count, count), dtype=np.int64)
    table[rows, cols] = table[cols, rows] = np.arange(len(rows))
    table.flags.writeable = False
    return table


def permuted_pairs(orders: Any, count: int | None = None) -> Any:
    """Return indices [N, P] such that ``rdm[indices[n]]`` is the RDM of stimuli in ``orders[n]`` [N, K].

    Orders may name some of ``count`` stimuli only.
    """
    size = orders.shape[-1]
    table: Any = _pair_places(size if count is None else count)
    if is_tensor(orders):
        table = library(orders).tensor(table, device=orders.device)
    rows, cols = _pair_indices(size, orders)
    # Pair (i, j) of the permuted RDM is the pair (order[i], order[j]) of the given one, which is one look-up.
    return table[orders[..., rows], orders[..., cols]]


def rdm_stack(rdms: ArrayLike | Sequence[ArrayLike], what: str) -> Floats:
    """Return float64 RDM vectors [..., P], checked."""
    try:
        array = np.asarray(rdms)
        if array.dtype.kind in "cSU":
            raise TypeError("dissimilarities are real numbers")
        array = array.astype(np.float64, copy=False)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{what} must be RDM vectors of one length; received {type(rdms).__name__}.") from error
    if array.ndim == 0:
        raise UsageError(f"{what} must be an RDM vector [P]; received a single number.")
    stimulus_count(array.shape[-1])
    # Comparisons with NaN are false: a missing pair passes, an infinite one must not be taken for one.
    if (np.abs(array) > LARGEST).any():
        raise UsageError(f"{what} must hold dissimilarities up to {LARGEST:g}, NaN where one is missing; larger came.")
    return array
